"""How often a pose is taken and drawn, to hold a map against it."""

import math
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import kstest

from characterisation.files.errors import InputError
from characterisation.maps.performance_map import PerformanceMap
from characterisation.maps.shipped import map_path
from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.maps.campaign.acquire import simulated_source
from mitsim.maps.campaign.hold_out import (
    LARGEST_SIGMA_ERROR,
    MOST_REPEATS,
    _map,
    compared,
    distances_between,
    held_out_campaign,
    held_out_orders,
    held_out_shots,
    hold_out_order,
    random_normals,
)
from mitsim.maps.campaign.orders import PreparedSensor

MAPS = Path(__file__).parents[3] / "scenes" / "coupon" / "maps.toml"


@pytest.fixture(scope="module")
def shipped():
    return PerformanceMap.load(map_path("ensenso-n10"))


@pytest.fixture(scope="module")
def held(n10, shipped):
    """How a coupon of a roughness, tilted so far, is held against the map: the pair, and how often it was taken."""
    plan = held_out_campaign(MAPS, n10, shipped)
    source = simulated_source(SimulatedSensor(n10), plan.file.samples_per_pixel)
    prepared = PreparedSensor(n10)

    def hold(roughness, tilt_deg, repeats, distance=635):
        like = next(
            shot
            for shot in held_out_shots(plan, 1, seed=1)
            if abs(shot.series.distance - distance) < 1 and str(shot.series.sample.roughness) == str(roughness)
        )
        tilt = math.radians(tilt_deg)
        taken = []

        def take(shot):
            taken.append(shot.seed)
            return source(shot)

        shot = plan.shot(like.series, np.array([math.sin(tilt), 0.0, math.cos(tilt)]))
        pair = compared(shot, prepared, shipped, take, repeats)
        assert len(set(taken)) == len(taken)  # fresh noise
        return pair, len(taken)

    return hold


def test_where_all_points_come_back_a_pose_is_taken_as_often_as_was_asked(held):
    pair, taken = held(math.nan, 10, 2)
    assert taken == 2
    assert pair.measured.sigma_error < LARGEST_SIGMA_ERROR * pair.measured.sigma
    # as many clouds were drawn: the same points of each
    assert len(pair.predicted_residuals) == pytest.approx(len(pair.measured_residuals), rel=0.02)


def test_residuals_are_those_of_patches_that_the_map_knows(held, shipped):
    """At the far end of the map the farther half of a tilted coupon is unknown: nothing is predicted of it."""
    farthest = distances_between(shipped)[-1]
    pair, _ = held(math.nan, 60, 1, farthest)
    assert len(pair.predicted_residuals) == pytest.approx(len(pair.measured_residuals), rel=0.03)
    assert len(pair.measured_residuals) > 1000


def test_where_few_points_come_back_a_pose_is_taken_until_sigma_is_known(held):
    once, taken = held(0.09, 25, 1)
    assert 1 < taken <= MOST_REPEATS
    assert taken == MOST_REPEATS or once.measured.sigma_error <= LARGEST_SIGMA_ERROR * once.measured.sigma
    assert 0.01 < once.measured.fraction < 0.5


def test_where_nothing_comes_back_nothing_is_waited_for(held):
    pair, taken = held(0.09, 60, 1)
    assert taken == 1
    assert math.isnan(pair.measured.sigma)


def test_an_order_gives_what_this_process_gives(n10, shipped):
    plan = held_out_campaign(MAPS, n10, shipped)
    shots = [shot for shot in held_out_shots(plan, 1, seed=3) if abs(shot.series.distance - 635) < 1][:1]
    source = simulated_source(SimulatedSensor(n10), plan.file.samples_per_pixel)
    here = compared(shots[0], PreparedSensor(n10), shipped, source, 1)
    (order,) = held_out_orders(plan, shots, map_path("ensenso-n10"), 1)
    there = hold_out_order(pickle.loads(pickle.dumps(order)))
    assert there.measured == here.measured and there.predicted == here.predicted
    assert there.measured_residuals.tobytes() == here.measured_residuals.tobytes()
    assert there.predicted_residuals.tobytes() == here.predicted_residuals.tobytes()
    with pytest.raises(InputError, match="another content"):
        hold_out_order(replace(order, digest="0"))


def test_a_worker_reads_a_map_again_that_was_made_again(tmp_path, n10, shipped):
    """The map of a campaign lies where the former one did; a worker of a cluster has read that."""
    plan = held_out_campaign(MAPS, n10, shipped)
    shots = held_out_shots(plan, 1, seed=3)[:1]
    path = tmp_path / "map.nc"
    shipped.save(path)
    (before,) = held_out_orders(plan, shots, path, 1)
    assert "again" not in _map(before.map_path, before.digest).data.attrs
    PerformanceMap(shipped.data.assign_attrs(again="yes")).save(path)
    (after,) = held_out_orders(plan, shots, path, 1)
    assert _map(after.map_path, after.digest).data.attrs["again"] == "yes"


def test_random_normals_reach_every_part_of_the_cap():
    """One in each ring of equal area; and each is anywhere on the cap, whatever its number."""
    count, least = 48, math.cos(math.radians(80))
    first = []
    for seed in range(400):
        normals = random_normals(count, 80, np.random.default_rng(seed))
        assert np.allclose(np.linalg.norm(normals, axis=1), 1)
        share = (1 - normals[:, 2]) / (1 - least)
        assert np.array_equal(np.sort((share * count).astype(int)), np.arange(count))
        first.append((share[0], math.atan2(normals[0, 1], normals[0, 0]) / (2 * math.pi) % 1))
    for values in np.array(first).T:
        assert kstest(values, "uniform").pvalue > 1e-3
