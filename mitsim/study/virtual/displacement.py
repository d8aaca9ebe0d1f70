"""Displace the decoded points of a trial by the errors of path length and expansion, and by form and coat of the part.

Signal chain: decoded cloud -> path length and expansion -> form and coat of the faces that each pixel meets -> cloud
with the labels of its faces, to measure.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from characterisation.files.arrays import Floats
from characterisation.point_cloud import PointCloud
from characterisation.tasks.task_file import Task
from mitsim.scene.load import Scene
from mitsim.scene.ray_casting.raycast import Surfaces
from mitsim.sensor.transforms import Transform
from mitsim.sensor.unknowns import UnknownsTable
from mitsim.study.virtual.coat import coated, coated_shapes
from mitsim.study.virtual.form import SeenFaces, form_deviation, forms_of_faces
from mitsim.study.virtual.world import DrawnValues


class RealFaces:
    """Faces of a part with the form and the coat of a draw."""

    def __init__(self, scene: Scene, task: Task, table: UnknownsTable) -> None:
        self.scene, self.table = scene, table
        self.forms = forms_of_faces(scene, task, table.form.features)
        self._has_coat = bool(coated_shapes(scene, table.coat))

    def deviate(self, drawn: DrawnValues) -> bool:
        """Return whether the faces of a draw have a form deviation."""
        return bool(self.forms and drawn.form)

    def lie_off(self, drawn: DrawnValues) -> bool:
        """Return whether the faces of a draw lie off their nominal places, by form or coat."""
        return self.deviate(drawn) or bool(self._has_coat and drawn.coat)

    def labelled(
        self,
        cloud: PointCloud,
        drawn: DrawnValues,
        assumed: Transform,
        surfaces: Surfaces | None,
        labels: NDArray[np.int16],
        with_form: bool = True,
    ) -> PointCloud:
        """Return a decoded cloud with the errors of path, temperature, coat and, if asked for, form of the part.

        Parameters
        ----------
        cloud
            Organised cloud, sensor frame.
        drawn
            Draw of the trial.
        assumed
            Pose of the sensor that the evaluation assumes.
        surfaces
            Nominal shape and normal that each pixel meets, sensor frame; None if no face lies off its place.
        labels
            (H, W) number of the shape of each pixel.
        with_form
            Whether faces deviate from their form.
        """
        scene, table = self.scene, self.table
        points = displaced(cloud, drawn, assumed, scene.centre)
        if surfaces is not None:
            forms = self.forms if drawn.form and with_form else []
            seen = SeenFaces(scene, surfaces, assumed, cloud.grid)
            points = form_deviation(points, seen, forms, drawn.form)
            if drawn.coat:
                points = coated(points, seen, table.coat, drawn.coat)
        return replace(cloud, points=points, feature=labels, feature_names=scene.names)


def displaced(
    cloud: PointCloud, drawn: DrawnValues, world_from_sensor: Transform, centre: Sequence[float] | Floats
) -> NDArray[np.float32]:
    """Return points (H, W, 3) [mm] of a cloud with the errors of the path length and the expansion of the part.

    The part expands about its middle.

    Parameters
    ----------
    cloud
        Organised cloud, sensor frame.
    drawn
        Drawn errors of a trial: of the path length (offset [mm] and scale) and of the expansion of the part.
    world_from_sensor
        Pose of the sensor that the evaluation assumes.
    centre
        Middle (3,) of the part [mm], part frame.
    """
    valid = cloud.valid
    points = cloud.points[valid].astype(float)
    offset, scale = drawn.path
    if offset or scale:
        away = points - cloud.grid.origin
        length = np.linalg.norm(away, axis=-1, keepdims=True)
        points = cloud.grid.origin + away * (1 + scale + offset / length)
    if drawn.expansion:
        middle = world_from_sensor.inverse().points(np.asarray(centre, float))
        points = middle + (1 + drawn.expansion) * (points - middle)
    out = cloud.points.copy()
    out[valid] = points
    return out
