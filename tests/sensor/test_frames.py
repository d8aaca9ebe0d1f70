"""Frames round-trip, and look_at aims as it says."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from characterisation.files.errors import InputError
from mitsim.sensor import poses
from mitsim.sensor.transforms import Transform, is_rotation, look_at

degrees = st.tuples(*[st.floats(-180, 180)] * 3)
place = st.tuples(*[st.floats(-1e4, 1e4)] * 3)


@given(degrees, place, place)
def test_a_transform_and_its_inverse_bring_a_point_back(rotation, position, point):
    transform = Transform.from_degrees(rotation, position)
    back = transform.inverse().points(transform.points(np.array(point)))
    assert np.allclose(back, point, atol=1e-7)


@given(degrees, place, degrees, place, place)
def test_chained_transforms_are_applied_right_to_left(r1, p1, r2, p2, point):
    a, b = Transform.from_degrees(r1, p1), Transform.from_degrees(r2, p2)
    point = np.array(point)
    assert np.allclose((a @ b).points(point), a.points(b.points(point)), atol=1e-6)
    assert np.allclose((a @ b).matrix(), a.matrix() @ b.matrix(), atol=1e-6)


@given(degrees, place)
def test_matrix_round_trip(rotation, position):
    transform = Transform.from_degrees(rotation, position)
    again = Transform.from_matrix(transform.matrix())
    assert np.array_equal(again.rotation, transform.rotation)
    assert np.array_equal(again.translation, transform.translation)


@given(place, st.floats(-180, 180))
def test_look_at_puts_the_target_on_the_axis_at_its_distance(position, roll):
    position, target = np.array(position), np.array([1.0, 2.0, 3.0])
    distance = np.linalg.norm(position - target)
    if distance < 1:
        return
    pose = look_at(position, target, [0, 0, 1], roll)
    assert np.allclose(pose.inverse().points(target), [0, 0, distance], atol=1e-6 * max(distance, 1))
    assert np.isclose(np.linalg.det(pose.rotation), 1)


def test_look_at_keeps_up_up_and_a_positive_roll_turns_x_toward_y():
    upright = look_at([0, -500, 0], [0, 0, 0], [0, 0, 1])
    assert np.allclose(upright.rotation[:, 1], [0, 0, -1])  # image down is world down
    rolled = look_at([0, -500, 0], [0, 0, 0], [0, 0, 1], 90)
    assert np.allclose(rolled.rotation[:, 0], upright.rotation[:, 1])


@given(degrees)
def test_a_rotation_is_one_up_to_a_tolerance(turn):
    rotation = Transform.from_degrees(turn, (0, 0, 0)).rotation
    assert is_rotation(rotation, 1e-12)
    assert not is_rotation(-rotation, 1e-12)  # a mirror
    assert is_rotation(1.0004 * rotation, 1e-3) and not is_rotation(1.0006 * rotation, 1e-3)
    assert not is_rotation(np.full((3, 3), np.nan), 1.0)


@pytest.mark.parametrize(
    ("given", "field"),
    [
        ({"position": (0, 0, "a")}, "position"),
        ({"position": ((1, 2), 3, 4)}, "position"),
        ({"position": (0, 0, 9), "up": (0, float("nan"), 1)}, "up"),
        ({"position": (0, 0, 9), "roll_deg": float("nan")}, "roll_deg"),
        ({"position": (0, 0, 9), "roll_deg": "much"}, "roll_deg"),
    ],
)
def test_what_is_no_place_or_angle_is_refused(given, field):
    """Before, a ValueError, or a pose of NaN."""
    with pytest.raises(InputError) as caught:
        poses.look_at(**given)
    assert caught.value.field == field


def test_only_rigid_motions_are_poses():
    """Before, a transform that scales passed, and text was a ValueError."""
    still = Transform.identity()
    assert poses.as_pose(still, "here") is still
    scaled, lost = Transform(2 * np.eye(3), np.zeros(3)), Transform(np.eye(3), np.full(3, np.nan))
    for wrong in (scaled, lost, scaled.matrix(), "text", [[1, 2], [3]]):
        with pytest.raises(InputError, match="here"):
            poses.as_pose(wrong, "here")
