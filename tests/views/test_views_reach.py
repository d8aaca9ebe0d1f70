"""Stages that turn a part: angles for a view, against the chain of turns written out in matrices."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from characterisation.coupon.orientations import cap_directions, sphere_directions
from characterisation.files.documents import validate
from characterisation.files.errors import InputError
from characterisation.stage.angles import Stage
from mitsim.sensor.transforms import Transform
from mitsim.views.reach import reach_directions, reach_rotations, stage_from_part, stage_from_sensor
from mitsim.views.table import PartStage

PAN = {"name": "pan", "direction": [0, 1, 0], "limits_deg": [-60, 60]}
TILT = {"name": "tilt", "direction": [1, 0, 0], "limits_deg": [-30, 45]}
TURN = {"name": "turn", "direction": [0, 0, 1], "limits_deg": [0, 360]}


def stage(*axes, **more):
    return validate("stage", {"axes": list(axes), **more}, PartStage)


def forward(made, angles):
    """``stage_from_part`` (4, 4), by homogeneous matrices alone: the independent implementation."""
    out = np.eye(4)
    for axis, angle in zip(made.axes, angles, strict=True):
        there, back, turn = np.eye(4), np.eye(4), np.eye(4)
        there[:3, 3], back[:3, 3] = axis.point_mm, np.negative(axis.point_mm)
        unit = np.array(axis.direction) / np.linalg.norm(axis.direction)
        cross = np.cross(np.eye(3), unit)
        turn[:3, :3] = np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross
        out = out @ there @ turn @ back
    rest = np.eye(4)
    rest[:3, :3] = Rotation.from_euler("xyz", made.part_rotation_deg, degrees=True).as_matrix()
    rest[:3, 3] = made.part_position_mm
    return out @ rest


component = st.floats(-1, 1).map(lambda x: round(x, 3))
unit = st.tuples(component, component, component).filter(lambda v: np.linalg.norm(v) > 0.1)
place = st.tuples(*[st.floats(-200, 200)] * 3)
turn = st.tuples(*[st.floats(-180, 180)] * 3)
angle = st.floats(-6.2, 6.2)
FREE = [-360, 360]


@st.composite
def any_stage(draw, count):
    axes = [
        {"name": str(i), "direction": draw(unit), "limits_deg": FREE, "point_mm": draw(place)} for i in range(count)
    ]
    made = stage(*axes, part_rotation_deg=draw(turn), part_position_mm=draw(place))
    units = [axis.unit() for axis in made.axes]
    for one, other in itertools.pairwise(units):
        assume(np.linalg.norm(np.cross(one, other)) > 0.05)  # nearly parallel axes are one, and badly conditioned
    return made


@given(any_stage(3), st.lists(angle, min_size=3, max_size=3))
def test_any_stage_of_three_axes_finds_a_pose_that_it_can_show(made, angles):
    """Pose -> angles, perhaps others -> pose, by the chain written out."""
    assert np.abs(stage_from_part(made, np.zeros(3), np.array(angles)).matrix() - forward(made, angles)).max() < 1e-9
    wanted = forward(made, angles)[:3, :3]
    reach = reach_rotations(made, wanted[None])
    assert reach.reasons == [""]
    again = forward(made, reach.angles[0])[:3, :3]
    # where the three axes come to lie in one plane an angle is the root of a rounding
    units = [axis.unit() for axis in made.axes]
    turned = Rotation.from_rotvec(units[1] * angles[1]).apply(units[2])
    apart = abs(np.cross(units[0], units[1]) @ turned)
    assert np.abs(again - wanted).max() < (1e-9 if apart > 1e-3 else 1e-6)


@given(any_stage(2), st.lists(angle, min_size=2, max_size=2))
def test_any_stage_of_two_axes_finds_a_direction_that_it_can_show(made, angles):
    direction = forward(made, angles)[2, :3]  # what is turned to z
    reach = reach_directions(made, direction[None])
    assert reach.reasons == [""]
    # at the rim of what two axes reach, an angle is the root of a rounding
    assert np.linalg.norm(forward(made, reach.angles[0])[:3, :3] @ direction - [0, 0, 1]) < 1e-6


def test_pan_and_tilt_have_the_closed_form():
    directions = sphere_directions(3)
    reach = reach_directions(stage(PAN, TILT), directions)
    # R_y(pan) R_x(tilt) d = z  ->  d = (-sin pan, cos pan sin tilt, cos pan cos tilt)
    pan = -np.degrees(np.arcsin(np.clip(directions[:, 0], -1, 1)))
    tilt = np.degrees(np.arctan2(directions[:, 1], directions[:, 2]))
    reached = np.isfinite(reach.angles).all(axis=1)
    assert np.array_equal(reached, (abs(pan) <= 60 + 1e-6) & (tilt >= -30 - 1e-6) & (tilt <= 45 + 1e-6))
    assert 50 < reached.sum() < 300
    assert np.allclose(np.degrees(reach.angles[reached]), np.stack([pan, tilt], axis=1)[reached], atol=1e-6)
    assert [not reason for reason in reach.reasons] == reached.tolist()


def test_what_is_out_of_reach_names_the_axis_that_is_too_short():
    tilted = [[0, math.sin(angle), math.cos(angle)] for angle in np.radians([20, 50, -75])]
    reach = reach_directions(stage(PAN, TILT), np.array(tilted))
    assert reach.reasons == ["", "stage: tilt 50.0 deg beyond -30 to 45", "stage: tilt -75.0 deg beyond -30 to 45"]
    assert np.isnan(reach.angles[1:]).all()
    skew = stage(PAN, {"name": "skew", "direction": [0, 1, 1], "limits_deg": FREE})
    assert (
        reach_directions(skew, np.array([[0, 1, 1], [0, -1, -1]]) / math.sqrt(2)).reasons
        == ["stage: no angles of its axes show this view"] * 2
    )


def test_a_turntable_may_count_from_0_to_360():
    """Angles are the same a whole turn on: nothing is lost that -180 to 180 reaches."""
    cradle = {"name": "cradle", "direction": [1, 0, 0], "limits_deg": [0, 60]}
    directions = cap_directions(2, math.radians(59))
    symmetric = {**TURN, "limits_deg": [-180, 180]}
    both = [reach_directions(stage(cradle, table), directions) for table in (TURN, symmetric)]
    assert all(not reason for reach in both for reason in reach.reasons)
    assert (both[0].angles[:, 1] >= -1e-9).all() and (both[1].angles[:, 1] < -0.1).any()
    # a campaign's stage reads its limits in the same way
    coupon = {"name": "pan", "direction": [0, 1, 0], "limits_deg": [300, 360]}
    found = validate("stage", {"axes": [coupon]}, Stage).angles([[-math.sin(0.5), 0, math.cos(0.5)]])
    assert np.isclose(found[0, 0], 2 * math.pi - 0.5)


def test_limits_of_less_than_a_turn_are_kept_where_an_axis_may_stand_as_it_likes():
    """The second axis lies along the direction: any angle shows it, but not all are allowed."""
    cradle = {"name": "cradle", "direction": [1, 0, 0], "limits_deg": [-60, 60]}
    table = {**TURN, "limits_deg": [20, 50]}
    reach = reach_directions(stage(cradle, table), np.array([[0.0, 0.0, 1.0]]))
    assert reach.reasons == [""] and np.allclose(np.degrees(reach.angles[0]), [0, 20])


@given(st.floats(-59, 59), st.floats(-59, 59))
def test_two_axes_of_three_along_one_another_share_the_turn(first, last):
    """Gimbal lock: either alone could not turn so far."""
    axes = [
        {**PAN, "name": name, "direction": d} for name, d in zip("abc", ([0, 1, 0], [1, 0, 0], [0, 1, 0]), strict=True)
    ]
    made = stage(*axes, part_position_mm=[0, 0, 0])
    wanted = forward(made, np.radians([first, 0.0, last]))[:3, :3]
    reach = reach_rotations(made, wanted[None])
    assert reach.reasons == [""]
    assert (np.abs(np.degrees(reach.angles)) <= 60 + 1e-6).all()
    assert np.abs(forward(made, reach.angles[0])[:3, :3] - wanted).max() < 1e-6


def test_the_sensor_stands_on_the_z_axis_with_its_baseline_along_x(n10):
    pose = stage_from_sensor(n10, 500.0)
    camera = pose @ n10.rig.reference.sensor_from_camera
    assert np.allclose(camera.translation, [0, 0, 500]) and np.allclose(camera.rotation[:, 2], [0, 0, -1])
    baseline = pose.rotation @ n10.rig.baseline_direction
    assert abs(baseline[1]) < 1e-12 and baseline[0] > 0.9
    assert camera.rotation[1, 1] < -0.999  # y of the stage frame is up in the image
    assert isinstance(pose, Transform)


@pytest.mark.parametrize(
    ("change", "field", "message"),
    [
        ({"axes": [PAN]}, "axes", "at least 2"),
        ({"axes": [PAN, TILT, TURN, {**TURN, "name": "more"}]}, "axes", "at most 3"),
        ({"axes": [PAN, PAN]}, "axes", "axes with different names"),
        ({"axes": [PAN, {**TILT, "limits_deg": [10, -10]}]}, "axes.1", "lower limit"),
        ({"axes": [PAN, {**TILT, "point": [0, 0, 0]}]}, "axes.1.point", "unknown key"),
        ({"part_rotation": [0, 0, 0]}, "part_rotation", "did you mean 'part_rotation_deg'"),
    ],
)
def test_an_impossible_stage_is_refused(change, field, message):
    with pytest.raises(InputError, match=message) as caught:
        validate("stage", {"axes": [PAN, TILT], **change}, PartStage)
    assert caught.value.field == field
