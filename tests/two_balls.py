"""A task of two balls of 10 mm, 80 mm apart along x."""

from characterisation.tasks.task_file import Task

TASK = Task.model_validate(
    {
        "features": {
            "left": {"kind": "sphere", "point_mm": [-40.0, 0.0, 0.0], "radius_mm": 10.0},
            "right": {"kind": "sphere", "point_mm": [40.0, 0.0, 0.0], "radius_mm": 10.0},
        },
        "measurements": {
            "apart": {"kind": "point_distance", "features": ["left", "right"], "nominal": 80.0, "unit": "mm"},
            "radius": {"kind": "radius", "features": ["left"], "nominal": 10.0, "unit": "mm"},
        },
    }
)
