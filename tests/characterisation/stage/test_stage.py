"""Stages: angles that show a normal, against the chain turned forward."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from characterisation.coupon.orientations import cap_directions
from characterisation.files.documents import validate
from characterisation.files.errors import InputError
from characterisation.stage.angles import Stage

PAN_TILT = {
    "axes": [
        {"name": "pan", "direction": [0, 1, 0], "limits_deg": [-60, 60]},
        {"name": "tilt", "direction": [1, 0, 0], "limits_deg": [-30, 45]},
    ]
}


def stage(**changes):
    return validate("stage", {**PAN_TILT, **changes}, Stage)


def test_forward_is_the_product_of_rotations():
    angles = np.radians([[10.0, 20.0], [-35.0, 40.0]])
    expected = [(Rotation.from_rotvec([0, a, 0]) * Rotation.from_rotvec([b, 0, 0])).apply([0, 0, 1]) for a, b in angles]
    assert np.allclose(stage().normals(angles), expected, atol=1e-12)


unit = st.tuples(*[st.floats(-1, 1) for _ in range(3)]).filter(lambda v: np.linalg.norm(v) > 0.1)
angle = st.floats(-3.1, 3.1)


@given(unit, unit, unit, angle, angle)
def test_what_a_stage_shows_it_can_be_asked_for(first, second, normal, one, two):
    """Any two axes: the normal at any angles is found again, perhaps by other angles."""
    free = [-360, 360]
    axes = [
        {"name": "1", "direction": first, "limits_deg": free},
        {"name": "2", "direction": second, "limits_deg": free},
    ]
    made = stage(axes=axes, normal=normal)
    if np.linalg.norm(np.cross(axes[0]["direction"], axes[1]["direction"])) < 1e-3:
        return  # nearly parallel axes are one, and badly conditioned
    shown = made.normals([[one, two]])
    angles = made.angles(shown)
    assert np.isfinite(angles).all()
    assert np.linalg.norm(made.normals(angles) - shown) < 1e-6


def test_limits_decide_what_is_reachable():
    normals = cap_directions(3, math.radians(80))
    angles = stage().angles(normals)
    reached = np.isfinite(angles).all(axis=1)
    # N = (sin pan cos tilt, -sin tilt, cos pan cos tilt)
    tilt = -np.degrees(np.arcsin(normals[:, 1]))
    pan = np.degrees(np.arctan2(normals[:, 0], normals[:, 2]))
    expected = (abs(pan) <= 60) & (tilt >= -30) & (tilt <= 45)
    assert np.array_equal(reached, expected)
    assert 0 < reached.sum() < len(normals)
    assert np.allclose(np.degrees(angles[reached]), np.stack([pan, tilt], axis=1)[reached], atol=1e-6)


def test_one_axis_shows_a_great_circle_only():
    made = stage(axes=PAN_TILT["axes"][:1])
    angles = made.angles([[0, 0, 1], [math.sin(0.5), 0, math.cos(0.5)], [0, math.sin(0.5), math.cos(0.5)]])
    assert np.allclose(angles[:2, 0], [0, 0.5])
    assert np.isnan(angles[2]).all()


def test_a_third_axis_reaches_what_two_do_not():
    """Tilt and a turn of the coupon about its own normal do nothing more; a turn below them does."""
    base = {"name": "base", "direction": [0, 0, 1], "limits_deg": [-180, 180]}
    narrow = [{"name": "pan", "direction": [0, 1, 0], "limits_deg": [-1, 1]}, PAN_TILT["axes"][1]]
    normals = cap_directions(2, math.radians(40))
    two = np.isfinite(stage(axes=narrow).angles(normals)).all(axis=1)
    three = stage(axes=[base, *narrow])
    assert two.sum() < len(normals) / 2
    angles = three.angles(normals)
    assert np.isfinite(angles).all()
    assert np.abs(three.normals(angles) - normals).max() < 1e-6


@pytest.mark.parametrize(
    ("axis", "message"),
    [
        ({"name": "pan", "direction": [0, 0, 0], "limits_deg": [-10, 10]}, "not zero"),
        ({"name": "pan", "direction": [0, 1, 0], "limits_deg": [10, -10]}, "lower limit"),
        ({"name": "pan", "direction": [0, 1, 0]}, "limits_deg"),
    ],
)
def test_an_impossible_axis_is_refused(axis, message):
    with pytest.raises(InputError, match=message):
        stage(axes=[axis])


def test_a_coupon_without_a_direction_is_refused():
    with pytest.raises(InputError, match=r"normal.*not zero"):
        stage(axes=[{"name": "pan", "direction": [0, 1, 0], "limits_deg": [-10, 10]}], normal=[0, 0, 0])
