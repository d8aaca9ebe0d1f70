"""How wrong the given pose of a part may be, as docs/how-to/measure.md says it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from characterisation.tasks.evaluation import measure
from characterisation.tasks.task_file import Task
from tests.seen_shapes import GRID, cloud_of, plane, sphere

TASK = Task.model_validate(
    {
        "features": {
            "ball": {"kind": "sphere", "point_mm": [0, 0, -15], "radius_mm": 15},
            "plate": {"kind": "plane", "point_mm": [0, 0, 0], "direction": [0, 0, -1]},
        },
        "measurements": {
            "height": {"kind": "point_plane_distance", "features": ["ball", "plate"], "nominal": 15, "unit": "mm"}
        },
    }
)


def height(shift, turn_deg, axis, rng):
    """The height of a ball over a plate of 140 mm by 110 mm at 500 mm, at a wrong pose: 15 mm by any."""
    ball, plate = sphere([0, 0, 485], 15), plane([0, 0, 500], [0, 0, -1])
    seen = np.isfinite(ball)
    columns, rows = np.meshgrid(np.arange(GRID.width) - 99.5, np.arange(GRID.height) - 79.5)
    label = np.where(seen, 0, np.where(np.hypot(columns, rows) > 30, 1, -1)).astype(np.int16)
    cloud = replace(cloud_of(np.where(seen, ball, plate), 0.05, rng), feature=label, feature_names=("ball", "plate"))
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(np.deg2rad(turn_deg) * np.asarray(axis)).as_matrix()
    pose[:3, 3] = np.array([0, 0, 500]) + shift * np.asarray(axis)
    return measure(cloud, TASK, pose)["height"]


@pytest.mark.parametrize("axis", [(1.0, 0, 0), (0, 1.0, 0), (0, 0, 1.0), (0.6, 0, -0.8), (-0.6, 0.8, 0)])
def test_a_pose_correct_to_a_millimetre_and_half_a_degree_is_enough(axis, rng):
    found = height(1.0, 0.5, axis, rng)
    assert found.value == pytest.approx(15.0, abs=5 * found.uncertainty)


@pytest.mark.parametrize(("shift", "turn_deg"), [(5.0, 0.0), (0.0, 3.0)])
def test_a_pose_that_is_wrong_by_a_hundredth_of_the_distance_is_not(shift, turn_deg, rng):
    assert "nominal" in height(shift, turn_deg, (1.0, 0.0, 0.0), rng).reason
