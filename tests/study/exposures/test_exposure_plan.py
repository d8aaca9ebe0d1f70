"""Plans of exposures for features of known brightness, and the figures of a feature against closed forms."""

import json
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from characterisation.features.surfaces import Plane
from characterisation.point_cloud import PointCloud, ViewGrid
from mitsim.sensor.exposure import PlannedExposure
from mitsim.study.exposures.exposure_plan import PlanRules, plan_exposures, shortfall
from mitsim.study.exposures.exposure_sweep import ExposureResult, FeatureResult, feature_result
from mitsim.study.exposures.planned import plan_document, plan_in_words, plan_table

POINTS = 4000

LIMITS = SimpleNamespace(limits_s=(1e-5, 1.0))


def sensor_of(brightness: dict[str, tuple[float, float]], dark: float = 0.1, full: float = 1.0):
    """Return a function that gives the results of exposures.

    The points of a feature have a brightness per second from low to high, in equal ratios. A point is recovered if some
    exposure brings it between ``dark`` and ``full``.
    """
    rates = {name: np.geomspace(low, high, POINTS) for name, (low, high) in brightness.items()}

    def evaluate(exposure: PlannedExposure, noise: int, draws: int) -> ExposureResult:
        results, recovered = {}, {}
        for name, rate in rates.items():
            levels = np.multiply.outer(np.array(exposure.exposures_s) * exposure.power, rate)
            recovered[name] = ((levels >= dark) & (levels <= full)).any(axis=0)
            count = int(recovered[name].sum())
            u = 1 / math.sqrt(count) if count >= 100 else math.inf
            results[name] = FeatureResult(float(count), count / POINTS, u, 1.0)
        return ExposureResult(exposure, results, recovered)

    return evaluate


def planned(brightness, own=0.01, limits=(1e-5, 1.0), **rules):
    evaluate = sensor_of(brightness)
    return plan_exposures(evaluate, PlannedExposure((own,)), limits, PlanRules(**rules)), evaluate


def test_features_alike_take_one_exposure_that_brings_all():
    plan, _ = planned({"a": (20, 60), "b": (30, 100)})
    (seconds,) = plan.exposure.exposures_s
    assert plan.reached and plan.exposure.power == 1 and plan.unseen == ()
    # all of both: 0.1 / 20 s at least, 1 / 100 s at most; a tenth of the points may be missing
    assert 0.0045 <= seconds <= 0.012
    assert min(one.points for one in plan.added[0][1].features.values()) >= POINTS / 1.1


def test_a_bright_and_a_dark_feature_take_two():
    plan, evaluate = planned({"bright": (1000, 4000), "dark": (10, 40)})
    assert plan.reached and len(plan.exposure.exposures_s) == 2
    short, long_ = plan.exposure.exposures_s
    assert short < 1 / 1000 and long_ > 0.1 / 40
    assert all(one.points >= POINTS / 1.1 for one in evaluate(plan.exposure, 0, 1).features.values())
    first, second = (step[1] for step in plan.added)
    assert min(one.points for one in first.features.values()) == 0
    assert min(one.points for one in second.features.values()) >= POINTS / 1.1


def test_of_sets_that_reach_the_limits_the_shortest_is_planned():
    """Whatever set of one exposure on the grid reaches them, none is shorter."""
    brightness = {"a": (20, 60)}
    plan, evaluate = planned(brightness)
    grid = [0.01 * math.sqrt(2) ** k for k in range(-12, 13)]
    sufficient = [t for t in grid if shortfall(evaluate(PlannedExposure((t,)), 0, 1), plan.limits) <= 0.1]
    assert plan.exposure.exposures_s[0] == pytest.approx(min(sufficient), rel=0.01)


def test_when_time_ends_the_plan_is_the_best_single_exposure_so_far():
    """The dark feature needs 16 times the sensor's own exposure: eight steps of the sweep."""
    evaluate, tried = sensor_of({"bright": (20, 60), "dark": (1.25, 4)}), []

    def counted(exposure, noise, draws):
        tried.append(exposure)
        return evaluate(exposure, noise, draws)

    def plan_after(count):
        tried.clear()
        over = lambda: len(tried) >= count  # noqa: E731
        own = PlannedExposure((0.01,))
        return plan_exposures(counted, own, (1e-5, 1.0), PlanRules(), over=over)

    at_once, soon, whole = plan_after(0), plan_after(6), plan_after(10**6)
    assert at_once.exposure.exposures_s == (0.01,) and at_once.sets_tried == 1 and at_once.unseen == ("dark",)
    assert soon.sets_tried == 6 and soon.exposure.exposures_s[0] > 0.01 and len(soon.added) == 1
    assert [plan.finished for plan in (at_once, soon, whole)] == [False, False, True]
    assert "the best of 6 that time allowed" in plan_in_words(soon) and "time" not in plan_in_words(whole)
    study = SimpleNamespace(path="", sensor=SimpleNamespace(name="", exposure=LIMITS))
    assert not plan_document(study, soon)["finished"]


def test_one_exposure_is_planned_where_no_more_may_be_merged_and_the_limits_then_are_those_of_one():
    plan, _ = planned({"bright": (1000, 4000), "dark": (10, 40)}, most=1)
    assert len(plan.exposure.exposures_s) == 1 and not plan.reached


def test_the_limits_of_the_device_hold():
    plan, _ = planned({"a": (0.1, 0.4)}, limits=(1e-4, 0.05))
    assert not plan.limits or max(plan.exposure.exposures_s) <= 0.05
    plan, _ = planned({"a": (2, 8)}, limits=(1e-4, 0.05))  # half of it at the longest
    assert plan.exposure.exposures_s[-1] == 0.05


def test_power_is_lowered_only_where_the_shortest_exposure_is_too_bright():
    bright = {"a": (500, 2000)}  # 0.5 ms at the most
    plan, _ = planned(bright, limits=(1e-3, 1.0))
    assert plan.exposure.exposures_s == (1e-3,) and 0.2 <= plan.exposure.power <= 0.55 and plan.reached
    plan, _ = planned(bright, limits=(1e-5, 1.0))
    assert plan.exposure.power == 1 and plan.exposure.exposures_s[0] <= 5.5e-4
    evaluate = sensor_of(bright)
    plan = plan_exposures(evaluate, PlannedExposure((0.01,)), (1e-3, 1.0), PlanRules(), dimmable=False)
    assert plan.exposure.power == 1


def test_a_feature_that_no_exposure_brings_is_named_and_left_aside():
    plan, _ = planned({"a": (20, 60), "never": (1e-6, 2e-6)})
    assert plan.unseen == ("never",) and plan.reached
    assert "never" in plan_in_words(plan) and "not reached" in plan_table(plan)


def test_what_is_told_is_of_another_noise_than_what_was_chosen_on():
    evaluate, calls = sensor_of({"a": (20, 60)}), []

    def kept(exposure, noise, draws):
        calls.append((exposure, noise))
        return evaluate(exposure, noise, draws)

    plan = plan_exposures(kept, PlannedExposure((0.01,)), (1e-5, 1.0), PlanRules())
    noises = {noise for exposure, noise in calls if exposure == plan.exposure}
    assert len(noises) == 3


def test_a_difference_that_noise_explains_is_no_shortfall():
    limit = {"a": FeatureResult(1000, 0.5, 0.010, 1.0, 0.05)}
    worse = FeatureResult(1000, 0.5, 0.0125, 1.0, 0.08)
    result = ExposureResult(PlannedExposure((1.0,)), {"a": worse}, {})
    allowance = 1 + 2 * math.hypot(0.05, 0.08)
    assert shortfall(result, limit) == pytest.approx(1.25 / allowance - 1)
    sure = ExposureResult(result.exposure, {"a": replace(worse, error=0.0)}, {})
    assert shortfall(sure, {"a": replace(limit["a"], error=0.0)}) == pytest.approx(0.25)


def plane_cloud(sigma: float, seed: int, keep: np.ndarray | None = None, step: float = 0.0):
    """A plane 500 mm before a pinhole of 60 x 40 pixels, with noise along the rays, or of depths rounded to a step."""
    grid = ViewGrid(1000.0, 1000.0, 29.5, 19.5, 60, 40)
    rays = grid.rays().reshape(-1, 3)
    surface = Plane(np.array([0.0, 0.0, 500.0]), np.array([0.0, 0.0, -1.0]))
    points = rays * (500.0 / rays[:, 2:])
    noise = np.random.default_rng(seed).normal(0, sigma, len(points))
    measured = points + noise[:, None] * rays / np.linalg.norm(rays, axis=1, keepdims=True)
    if step:
        measured = rays * (500.0 + step * np.round(noise / step))[:, None] / rays[:, 2:]
    if keep is not None:
        measured[~keep] = np.nan
    derivatives = surface.linearised(np.zeros(3), points, rays / np.linalg.norm(rays, axis=1, keepdims=True))[1]
    cloud = PointCloud(
        measured.reshape(40, 60, 3).astype(np.float32),
        np.where(np.isfinite(measured[:, 0]), 0, 1).reshape(40, 60).astype(np.uint8),
        grid=grid,
        source="simulated",
        sensor="s",
    )
    return cloud, derivatives, surface


def test_u_of_a_feature_that_is_seen_whole_is_sigma_over_the_root_of_points_per_parameter():
    """Mean of g C g^T over the very points that were fitted is s^2 p / n, whatever g is: the trace of a projection."""
    uncertainties = []
    for seed in range(20):
        cloud, derivatives, surface = plane_cloud(0.05, seed)
        one, recovered = feature_result(cloud, np.arange(2400), derivatives, surface)
        assert one.points == 2400 and one.fraction == 1.0 and recovered.all()
        uncertainties.append(one.u)
    assert np.mean(uncertainties) == pytest.approx(0.05 * math.sqrt(3 / 2400), rel=0.02)


def test_most_of_the_depths_are_the_same_and_the_scatter_is_that_of_all():
    """Of 0.3 steps of noise, 90.4 % round to one depth; the rest is one step off: 0.309 steps."""
    cloud, derivatives, surface = plane_cloud(0.3, 1, step=1.0)
    one, _ = feature_result(cloud, np.arange(2400), derivatives, surface)
    assert one.scatter == pytest.approx(math.sqrt(2 * 0.04779), rel=0.1)
    assert one.u == pytest.approx(one.scatter * math.sqrt(3 / 2400), rel=0.05)


def test_a_half_that_is_lost_costs_more_than_half_of_the_points_lost_at_random():
    left = (np.arange(2400) % 60) < 30
    at_random = np.random.default_rng(0).permutation(left)
    results = []
    for keep in (left, at_random):
        cloud, derivatives, surface = plane_cloud(0.05, 1, keep)
        results.append(feature_result(cloud, np.arange(2400), derivatives, surface)[0])
    assert results[0].points == results[1].points == 1200
    assert results[1].u == pytest.approx(0.05 * math.sqrt(3 / 1200), rel=0.05)
    # fitted over x in [-1, 0] the tilt's share at x is 12 (x + 1/2)^2, 7 in the mean over [-1, 1]; offset and the other
    # tilt have 1 each
    assert results[0].u == pytest.approx(0.05 * math.sqrt(9 / 1200), rel=0.05)


def test_too_few_points_have_no_uncertainty():
    keep = np.arange(2400) < 60
    cloud, derivatives, surface = plane_cloud(0.05, 1, keep)
    one, _ = feature_result(cloud, np.arange(2400), derivatives, surface)
    assert one.points == 60 and one.u == math.inf


def test_a_plan_as_json_has_no_number_that_is_none():
    plan, _ = planned({"a": (20, 60), "never": (1e-6, 2e-6)})
    sensor = SimpleNamespace(name="s", exposure=SimpleNamespace(limits_s=(1e-5, 1.0)))
    text = json.dumps(plan_document(SimpleNamespace(path="study.toml", sensor=sensor), plan), allow_nan=False)
    assert json.loads(text)["added"][0]["features"]["never"]["u_mm"] is None
