"""F of a comparison is F of a coupon: points on the specimen over its pixels."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace
from types import SimpleNamespace

import numpy as np

from characterisation.coupon.discs import disc_offsets
from characterisation.coupon.patches import Coupon, measure_patches
from mitsim.sensor.transforms import look_at
from mitsim.twin.compare.compared_quantities import _level
from mitsim.twin.compare.plain_image import median_level
from mitsim.twin.compare.specimen_patches import _histograms, points_on_specimen
from mitsim.twin.finish.specimen import Bend, known_specimen
from tests.seen_shapes import GRID, cloud_of, plane


def test_one_definition_of_f_for_comparisons_and_coupons(rng):
    """Before, a comparison counted false points as recovered, and an acceptance test of the same cloud did not."""
    truth = look_at((150.0, -100.0, 580.0), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), 0.0)
    from_sensor = known_specimen(truth, 4000.0, 4000.0)
    at, normal = truth.inverse().points(np.zeros(3)), truth.inverse().directions(np.array([0.0, 0.0, 1.0]))
    on_it = plane(at, normal)
    shift = rng.choice([-0.011, -0.009, 0.0, 0.009, 0.011, np.nan], on_it.shape)
    cloud = cloud_of(on_it * (1 + shift))
    recovered = points_on_specimen(cloud, from_sensor)
    np.testing.assert_array_equal(recovered, np.abs(shift) < 0.01)
    across = np.cross(normal, [0.0, 1.0, 0.0])
    coupon = Coupon(at, normal, across / np.linalg.norm(across), 4000.0, 4000.0)
    patches = measure_patches(cloud, coupon)
    discs = recovered.ravel()[pixels_of(patches["row"].values, patches["column"].values)]
    np.testing.assert_array_equal(patches["points"].values, discs.sum(axis=-1))
    # a sheet that bends away from its plane is no false match
    low, half = np.array([0.0, 0.0]), np.array([300.0, 300.0])
    bend = Bend(low, half, 1, np.array([20.0, 0.0, 0.0]), 20.0)
    bent = cloud_of(plane(at + 20.0 * normal, normal))
    assert points_on_specimen(bent, replace(from_sensor, bend=bend)).all()
    assert not points_on_specimen(bent, from_sensor).any()


def pixels_of(rows, columns, radius=6.0):
    offsets = disc_offsets(radius)
    return (rows[:, None] + offsets[:, 0]) * GRID.width + columns[:, None] + offsets[:, 1]


def test_histograms_of_sixteen_bits_are_as_large_as_the_image():
    """Before, 2^16 numbers of every patch: 0.34 GB of 640, and 0.55 s of each of 400 draws."""
    levels = np.random.default_rng(0).integers(0, 2**16, (640, 1600)).astype(float)
    levels[:, ::7] = np.nan
    tracemalloc.start()
    histograms = _histograms(levels, 2**16)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 10 * levels.nbytes
    dense = np.zeros((640, 2**16))
    for tile, row in zip(levels, dense, strict=True):
        np.add.at(row, tile[np.isfinite(tile)].astype(int), 1)
    patches, draws = SimpleNamespace(levels=histograms), np.random.default_rng(1).integers(0, 640, (3, 640))
    expected = [median_level(dense[draw].sum(axis=0)) for draw in draws]
    assert np.array_equal(_level(patches, draws), expected)
