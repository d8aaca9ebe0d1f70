"""Candidate views: where the sensor could stand."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from characterisation.documents import Document
from characterisation.orientations import sphere_directions
from mitsim.sensor.frames import Transform, look_at


class ViewsTable(Document):
    """The ``[views]`` table of a study: an icosahedron subdivided, its vertices above the horizon, and rolls.

    The sensor looks at ``target_mm`` (default: the middle of the scene) from ``standoff_mm``, |V| along the axis of
    its reference camera (default: as near as the whole part can be measured); a roll turns it about that axis, because
    its baseline has a direction.
    """

    subdivisions: int = Field(default=2, ge=0, le=4)
    standoff_mm: Annotated[float, Field(ge=50, le=20000)] | None = None
    rolls_deg: list[Annotated[float, Field(ge=-360, le=360)]] = Field(min_length=1, default_factory=lambda: [0.0])
    lowest_elevation_deg: Annotated[float, Field(ge=-90, lt=90)] = 10.0
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    target_mm: tuple[float, float, float] | None = None


@dataclass(frozen=True)
class View:
    """One candidate: ``direction`` (3,) unit, from the target to the sensor; ``roll_deg``; and the pose."""

    number: int
    direction: NDArray[np.float64]
    roll_deg: float
    standoff: float
    world_from_sensor: Transform

    @property
    def elevation_deg(self) -> float:
        """Above the plane z = 0 of the part [deg]."""
        return math.degrees(math.asin(float(np.clip(self.direction[2], -1, 1))))

    @property
    def azimuth_deg(self) -> float:
        """About the part's z axis from x [deg]."""
        return math.degrees(math.atan2(self.direction[1], self.direction[0]))


def candidate_views(table: ViewsTable, standoff: float, centre: NDArray[np.floating], camera: Transform) -> list[View]:
    """All views of a table; ``camera`` is ``sensor_from_camera`` of the reference camera, whose axis meets the target.

    Numbered from the zenith down, the rolls of one direction together.
    """
    target = np.asarray(table.target_mm if table.target_mm is not None else centre, float)
    up = np.asarray(table.up, float)
    up /= np.linalg.norm(up)
    directions = sphere_directions(table.subdivisions)
    height = directions @ up
    keep = height >= math.sin(math.radians(table.lowest_elevation_deg)) - 1e-9
    directions, height = directions[keep], height[keep]
    order = np.lexsort((np.arctan2(directions[:, 1], directions[:, 0]), -np.round(height, 9)))
    # a roll of 0 at the zenith has the baseline along x
    forward = np.array([0.0, 1.0, 0.0]) if abs(up[1]) < 0.9 else np.array([0.0, 0.0, 1.0])
    views: list[View] = []
    for direction in directions[order]:
        reference = forward if direction @ up > 1 - 1e-6 else up
        for roll in table.rolls_deg:
            world_from_camera = look_at(target + standoff * direction, target, reference, roll)
            pose = world_from_camera @ camera.inverse()
            views.append(View(len(views), direction, roll, standoff, pose))
    return views
