"""Joined views: what the error of their poses does to measurements, against closed forms."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from characterisation.features.fitted import with_covariance
from characterisation.features.robust_fit import FitError
from characterisation.features.surfaces import Cone, Cylinder, Plane, Sphere
from characterisation.files.errors import InputError
from characterisation.scores.joining import (
    POSE_KNOWN,
    JoinedView,
    joined_covariance,
    joint_information,
    pose_covariance,
    rigid_derivatives,
)
from characterisation.scores.task_sets import SetJoining, choose_set
from characterisation.tasks.covariance import ExpectedFit
from characterisation.tasks.measurement_model import InputQuantity
from characterisation.tasks.prediction import ExpectedInput, expected_measurement, joint_quadratic_form
from characterisation.tasks.task_file import Task
from tests.two_balls import TASK

# the distance of the balls has the derivative (-1, 0, 0) and (1, 0, 0) by their centres
LEFT, RIGHT = (InputQuantity("feature", (name,)) for name in ("left", "right"))
MIDDLE = np.zeros(3)
NOISE = 0.02


def seen(quantity: InputQuantity, sigma: float = NOISE, along_x: float = 0.0) -> ExpectedInput:
    """A ball whose centre and radius are known to sigma along each axis; a common cause moves it ``along_x``."""
    covariance = sigma**2 * np.eye(4)
    surface = TASK.features[quantity.features[0]].nominal()
    shared = np.zeros((4, 3))
    shared[0, 1] = along_x
    fit = ExpectedFit(covariance, shared, 1000.0, 1.0, surface.centre, sigma)
    return ExpectedInput(fit, with_covariance(surface, covariance))


UNSEEN = FitError("no points are expected")
BOTH = {LEFT: seen(LEFT), RIGHT: seen(RIGHT)}
ONLY_LEFT, ONLY_RIGHT = {LEFT: seen(LEFT), RIGHT: UNSEEN}, {LEFT: UNSEEN, RIGHT: seen(RIGHT)}
ROBOT = SetJoining(pose_covariance(0.3, 0.05), MIDDLE)


def reached(views, joining, limit=1.0):
    found = choose_set(TASK, views, {"apart": limit}, joining=joining)
    return found, float(found.uncertainty[0])


def test_features_of_different_views_have_exactly_the_variance_of_both_poses():
    found, u = reached([ONLY_LEFT, ONLY_RIGHT], ROBOT)
    # shifts along x; turns move the balls across their distance, 40 mm from the middle along x
    assert found.views == (0, 1)
    assert u**2 == pytest.approx(2 * NOISE**2 + 2 * 0.3**2, rel=1e-6)


def test_a_turn_about_a_point_off_the_line_moves_the_distance_by_its_arm():
    about = np.array([0.0, 30.0, 0.0])
    turns = np.diag([0.0, 0.0, math.radians(0.05) ** 2, 0.0, 0.0, 0.0])  # about z
    _, u = reached([ONLY_LEFT, ONLY_RIGHT], SetJoining(turns, about))
    assert u**2 == pytest.approx(2 * NOISE**2 + 2 * (30 * math.radians(0.05)) ** 2, rel=1e-6)


@pytest.mark.parametrize("kind", POSE_KNOWN)
def test_a_set_of_one_view_is_as_sure_as_that_view_however_it_is_joined(kind):
    joining = SetJoining(pose_covariance(*POSE_KNOWN[kind]), MIDDLE, kind == "best_fit")
    found, u = reached([BOTH, ONLY_LEFT], joining)
    assert found.views == (0,)
    assert u == pytest.approx(expected_measurement(TASK, "apart", BOTH).uncertainty, rel=1e-5)
    assert u == pytest.approx(math.sqrt(2) * NOISE, rel=1e-5)


def test_one_feature_within_views_has_no_error_of_joining():
    found = choose_set(TASK, [BOTH, BOTH], {"radius": NOISE / math.sqrt(2) * 1.001}, joining=ROBOT)
    assert found.views == (0, 1)
    assert found.uncertainty[0] == pytest.approx(NOISE / math.sqrt(2), rel=1e-6)


def test_a_feature_seen_twice_from_one_pose_averages_noise_and_not_the_error_of_joining():
    """Two captures of one pose halve the variance of noise; what they share of their pose stays."""
    twice = {LEFT: UNSEEN, RIGHT: seen(RIGHT, NOISE / math.sqrt(2))}
    _, u = reached([ONLY_LEFT, twice], ROBOT)
    assert u**2 == pytest.approx(NOISE**2 * 1.5 + 2 * 0.3**2, rel=1e-6)


def test_both_features_in_both_views_average_noise_and_joining_does_not_matter():
    found, u = reached([BOTH, BOTH], ROBOT, NOISE * 1.001)
    assert found.views == (0, 1)
    assert u == pytest.approx(NOISE, rel=1e-5)  # sqrt(2) NOISE / sqrt(2)


def test_merged_points_carry_half_of_the_error_of_a_pose_that_only_one_feature_shares():
    """Left from both views, right from one: the mean of left moves by half of each pose, right by one of them."""
    _, u = reached([BOTH, ONLY_LEFT], ROBOT)
    assert u == pytest.approx(math.sqrt(2) * NOISE, rel=1e-5)  # one view is enough, and better
    known = pose_covariance(0.3, 0.0)
    rigid = [rigid_derivatives(one.estimate, MIDDLE) for one in (BOTH[LEFT], BOTH[RIGHT])]
    c = NOISE**2 * np.eye(4)
    merged = joined_covariance([JoinedView((c, c)), JoinedView((c, None))], rigid, known)
    g = joint_quadratic_form(TASK, "apart", BOTH)
    # left has (x1 + x2) / 2, right x1: their difference (x2 - x1) / 2, twice 0.3^2 / 4
    assert np.sum(g * merged) == pytest.approx(NOISE**2 * 1.5 + 0.3**2 / 2, rel=1e-6)
    best = np.linalg.inv(sum(joint_information(v, rigid, known) for v in (JoinedView((c, c)), JoinedView((c, None)))))
    assert np.sum(g * best) < np.sum(g * merged)
    # known best: left relative to right from view 1 alone, and what view 2 adds to it is worth 1 / (s^2 + 2 K)
    one = NOISE**2
    more = 1 / (1 / one + 1 / (one + 2 * 0.3**2))
    assert np.sum(g * best) == pytest.approx(one + more, rel=1e-6)


JOININGS = [SetJoining(np.zeros((6, 6)), MIDDLE), ROBOT, SetJoining(pose_covariance(2.0, 0.5), MIDDLE, best_fit=True)]


@pytest.mark.parametrize("joining", JOININGS, ids=["exact", "robot", "best_fit"])
def test_what_views_have_in_common_does_not_average_out(joining):
    """Both balls from each of two views; the calibration moves the right one away, alike or the other way."""
    away, back = ({LEFT: seen(LEFT), RIGHT: seen(RIGHT, along_x=sign * 0.05)} for sign in (1, -1))
    found, u = reached([away, away], joining, 0.0539)  # noise of one view makes 0.0574
    assert found.views == (0, 1) and u**2 == pytest.approx(NOISE**2 + 0.05**2, rel=1e-4)
    found, u = reached([away, back], joining, NOISE * 1.001)
    assert found.views == (0, 1) and u == pytest.approx(NOISE, rel=1e-4)  # it cancels


@pytest.mark.parametrize("joining", JOININGS, ids=["exact", "robot", "best_fit"])
def test_a_limit_below_what_all_views_have_in_common_is_out_of_reach(joining):
    away = {LEFT: seen(LEFT), RIGHT: seen(RIGHT, along_x=0.05)}
    found = choose_set(TASK, [away] * 30, {"apart": 0.05, "radius": NOISE / 2}, joining=joining)
    assert found.feasible.tolist() == [False, True]
    assert len(found.views) == 4 and found.exact  # noise of the radius over the root of four


def test_joining_that_is_worse_than_the_limit_leaves_it_out_of_reach():
    found, u = reached([ONLY_LEFT, ONLY_RIGHT], ROBOT, 0.2)
    assert not found.feasible[0]
    found, u = reached([ONLY_LEFT, ONLY_RIGHT], SetJoining(pose_covariance(0.05, 0.01), MIDDLE), 0.2)
    assert found.feasible[0] and u <= 0.2


def test_a_third_view_that_sees_both_is_chosen_alone_where_joining_would_spoil_two():
    found, _ = reached([ONLY_LEFT, ONLY_RIGHT, BOTH], ROBOT, 0.1)
    assert found.views == (2,) and found.exact


def test_a_pose_from_joined_views_and_a_measurement_that_there_is_not_are_refused():
    where = {"kind": "pose_position", "features": ["left", "right"], "nominal": 0.0, "unit": "mm"}
    task = Task.model_validate(
        {"features": TASK.model_dump(exclude_none=True)["features"], "measurements": {"where": where}}
    )
    with pytest.raises(InputError, match="a pose, from joined views"):
        choose_set(task, [BOTH], {"where": 1.0}, joining=ROBOT)
    with pytest.raises(InputError, match="no such measurement"):
        choose_set(TASK, [BOTH], {"nothing": 1.0})


MOTIONS = [
    np.array([1e-5, 0, 0, 0, 0, 0]),
    np.array([0, -2e-5, 1e-5, 0.003, 0, -0.002]),
    np.array([0, 0, 3e-5, 0, 0.004, 0.001]),
]


@pytest.mark.parametrize(
    "shape",
    [
        Plane(np.array([1.0, 2, 3]), np.array([0.0, 0.6, 0.8])),
        Cylinder(np.array([5.0, -2, 1]), np.array([0.0, 0.0, 1.0]), 8.0),
        Sphere(np.array([3.0, 2.0, 1.0]), 6.0),
        Cone(np.array([0.0, 4.0, 2.0]), np.array([1.0, 0.0, 0.0]), 9.0, 0.4),
    ],
    ids=lambda one: one.kind,
)
@pytest.mark.parametrize("x", MOTIONS)
def test_parameters_of_a_motion_place_a_surface_where_the_motion_does(shape, x):
    about = np.array([2.0, -3.0, 4.0])
    turn = Rotation.from_rotvec(x[:3]).as_matrix()
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = turn, about + x[3:] - turn @ about
    by_motion, by_parameters = shape.placed(motion), shape.moved(rigid_derivatives(shape, about) @ x)
    places = np.random.default_rng(1).normal(0, 10, (50, 3)) + np.array([1.0, 2.0, 3.0])
    one, other = (surface.meet(places, None).residual for surface in (by_motion, by_parameters))
    moved = np.abs(one - shape.meet(places, None).residual).max()
    assert np.abs(one - other).max() < 1e-3 * moved
