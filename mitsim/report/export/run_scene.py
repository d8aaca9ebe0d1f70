"""Read the three-dimensional content of a run folder: the part, views, their image grids and clouds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from characterisation.files.errors import InputError
from characterisation.point_cloud import PointCloud, ViewGrid
from mitsim.sensor.transforms import Transform
from mitsim.study.run_folder import Run, read_run

#: kinds of clouds of a run, by the first word of their file's name
KINDS = ("predicted", "rendered")


@dataclass(frozen=True)
class ShownView:
    """A candidate view: its number, its pose, its clouds by kind, and the measurements for which it is the best."""

    number: int
    part_from_sensor: Transform
    clouds: dict[str, PointCloud]
    best_of: tuple[str, ...]

    @property
    def name(self) -> str:
        """Return the name, such as ``view_0012``."""
        return f"view_{self.number:04d}"


@dataclass(frozen=True)
class RunScene:
    """Part [mm, part frame], views, and the image ``grid`` of every view, None without a cloud."""

    part: trimesh.Trimesh | None
    views: tuple[ShownView, ...]
    grid: ViewGrid | None
    sensor: str


def read_run_scene(folder: str | Path, views: str = "best") -> RunScene:
    """Read the three-dimensional content of a finished run.

    ``views``: ``best``, views with clouds and best views of a measurement; ``all``; or numbers, ``3,12``. Raises
    InputError if the folder is not a run, or a view does not exist.
    """
    run = read_run(folder)
    shown = []
    for number in chosen_views(run, views):
        clouds = {kind: run.cloud(kind, number) for kind in KINDS if run.has_cloud(kind, number)}
        best_of = tuple(name for name, best in run.about.leaders.items() if best == number)
        shown.append(ShownView(number, view_pose(run, number), clouds, best_of))
    grids = [cloud.grid for view in shown for cloud in view.clouds.values()]
    if not grids and run.clouds:
        grids = [run.predicted(run.clouds[0]).grid]
    return RunScene(run.part(), tuple(shown), grids[0] if grids else None, run.about.sensor)


def view_pose(run: Run, number: int) -> Transform:
    """Return the pose of the sensor in the part frame [mm] for a view of a run."""
    return Transform.from_matrix(run.scores["world_from_sensor"].sel(view=number).values)


def chosen_views(run: Run, views: str) -> list[int]:
    """Return the view numbers selected by ``best``, or as in :func:`numbers_of`, ascending."""
    numbers = [int(number) for number in run.scores["view"].values]
    if views == "best":
        with_cloud = [number for number in numbers if any(run.has_cloud(kind, number) for kind in KINDS)]
        return sorted({*with_cloud, *run.about.leaders.values()})
    return numbers_of(views, numbers)


def numbers_of(views: str, available: Sequence[int]) -> list[int]:
    """Return the view numbers selected by ``all`` or a comma-separated list, ascending.

    Raises InputError if the selection is neither, or a view does not exist.
    """
    if views == "all":
        return sorted(available)
    if not available:
        raise InputError("--views", "", repr(views), "best or all: there are no views")
    allowed = f"best, all, or comma-separated numbers of views from {min(available)} to {max(available)}"
    try:
        chosen = sorted({int(word) for word in views.split(",")})
    except ValueError:
        raise InputError("--views", "", repr(views), allowed) from None
    if unknown := [number for number in chosen if number not in available]:
        raise InputError("--views", "", unknown[0], allowed)
    return chosen


def frustum(grid: ViewGrid, depth: float) -> tuple[NDArray[np.float64], list[tuple[int, int]]]:
    """Return apex and corners (5, 3), outer corners of a pinhole's image at ``depth`` along the axis, and 8 edges."""
    x = (np.array([-0.5, grid.width - 0.5]) - grid.cx) / grid.fx
    y = (np.array([-0.5, grid.height - 0.5]) - grid.cy) / grid.fy
    corners = [(x[0], y[0], 1.0), (x[1], y[0], 1.0), (x[1], y[1], 1.0), (x[0], y[1], 1.0)]
    vertices = depth * np.array([(0.0, 0.0, 0.0), *corners])
    return vertices, [(0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1)]


def quaternion(pose: Transform) -> tuple[float, float, float, float]:
    """Return the rotation of a pose as a unit quaternion x, y, z, w with w >= 0."""
    x, y, z, w = Rotation.from_matrix(pose.rotation).as_quat(canonical=True).tolist()
    return x, y, z, w


def sensor_from_grid(grid: ViewGrid) -> Transform:
    """Return the pose of a grid in the sensor frame."""
    return Transform(grid.rotation, grid.origin)
