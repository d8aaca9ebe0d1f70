"""Poses that a program gives: what is none is refused."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from characterisation.files.errors import InputError
from mitsim.sensor.poses import as_pose, look_at
from mitsim.sensor.transforms import Transform


@pytest.mark.parametrize(
    ("given", "field"),
    [
        ({"position": (0, 0, "a")}, "position"),
        ({"position": (0, 0, 100), "target": None}, "target"),
        ({"position": (0, 0, 100), "up": (0, [1], 0)}, "up"),
        ({"position": (0, 0, 100), "roll_deg": math.nan}, "roll_deg"),
    ],
)
def test_what_is_no_place_is_told(given: dict[str, Any], field: str) -> None:
    with pytest.raises(InputError, match=rf"look_at: {field}"):
        look_at(**given)


def test_a_pose_that_scales_is_none() -> None:
    """Before, a Transform was taken as it was."""
    turned = look_at((0, 0, 100), up=(0, 1, 0))
    assert as_pose(turned, "plot") is turned
    for scaled in (Transform(2 * turned.rotation, turned.translation), np.diag([2.0, 2, 2, 1])):
        with pytest.raises(InputError, match="plot: pose: found a matrix that is not a rigid motion"):
            as_pose(scaled, "plot")
