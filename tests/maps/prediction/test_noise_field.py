"""Correlated errors of predicted clouds against what they are drawn to have, by the metrics of a characterisation."""

from __future__ import annotations

import math

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st

from characterisation.coupon.offsets import noise_area, own_area
from characterisation.coupon.patches import Coupon, measure_patches
from characterisation.coupon.residual_field import autocorrelation
from characterisation.maps.building import NODES
from characterisation.maps.map_file import SCHEMA_VERSION
from characterisation.maps.performance_map import PerformanceMap
from characterisation.maps.tables import FIELDS
from mitsim.decoding.cloud import sensor_geometry
from mitsim.maps.prediction import CharacterisedScene, Predictor
from mitsim.maps.prediction.noise_field import averaging_field, own_field, persistent_field
from mitsim.scene.backend import mi
from mitsim.scene.load import scene_from_dict
from mitsim.sensor.transforms import look_at

SIDE = 200
SIGMA, FRACTION = 0.2, 0.9
PIXELS = np.argwhere(np.ones((SIDE, SIDE), bool))


@pytest.mark.parametrize("area", [1.0, 1.5, 3.0, 16.0, 23.0, 90.0])
def test_a_field_has_the_variance_the_noise_area_and_the_autocorrelation_asked_for(area: float) -> None:
    count = 12
    fields = [
        averaging_field(np.full(len(PIXELS), area), PIXELS, np.random.default_rng(seed)).reshape(SIDE, SIDE)
        for seed in range(count)
    ]
    # a product of a Gaussian field with itself decorrelates over half its area: pixels / (a / 2) are independent
    independent = count * SIDE**2 / max(area / 2, 1.0)
    assert np.mean([field.var() + field.mean() ** 2 for field in fields]) == pytest.approx(
        1, abs=4 * math.sqrt(2 / independent)
    )
    # the mean of the whole: var = a / pixels, of which ``count`` draws tell the standard deviation to 1 / sqrt(2 count)
    spread = math.sqrt(np.mean([field.mean() ** 2 for field in fields]))
    assert spread == pytest.approx(math.sqrt(area) / SIDE, rel=4 / math.sqrt(2 * count))
    rho = np.mean([autocorrelation(field, 12).values for field in fields], axis=0)
    row, column = np.mgrid[-12:13, -12:13]
    apart = row**2 + column**2
    expected = np.exp(-math.pi * apart / area) if area > 1 else (apart == 0).astype(float)
    # between two grades it is within 0.015 of the form, and the mean that is taken away lowers it by a / pixels;
    # 4.5 standard errors over 624 lags
    form = 0.0 if area == 1 else 0.015
    chance = 4.5 * math.sqrt(2 / independent)
    assert np.abs(rho - expected).max() < chance + form + area / SIDE**2


def test_a_field_whose_area_changes_over_the_image_has_unit_variance_everywhere() -> None:
    area = 2 ** (np.arange(SIDE) / 30.0)
    count = 60
    each = [
        averaging_field(np.tile(area, SIDE), PIXELS, np.random.default_rng(seed)).reshape(SIDE, SIDE)
        for seed in range(count)
    ]
    variance = np.mean([(field**2).mean(axis=0) for field in each], axis=0)
    independent = count * SIDE / np.maximum(np.sqrt(area / 2), 1.0)
    assert (np.abs(variance - 1) < 4 * np.sqrt(2 / independent)).all()
    neighbours = np.mean([(field[:-1] * field[1:]).mean(axis=0) for field in each], axis=0)
    expected = np.exp(-math.pi / area)
    high = area >= 2
    assert (np.abs(neighbours - expected) < 4 * np.sqrt(2 / independent) + 0.015)[high].all()


@given(
    area=st.floats(0.5, 4000),
    fraction=st.floats(1e-3, 1),
    missing=st.booleans(),
)
@settings(max_examples=60)
def test_strength_and_area_of_a_field_make_the_noise_area(area: float, fraction: float, missing: bool) -> None:
    given_area = math.nan if missing else area
    own, strength = own_field(np.array([given_area]), np.array([fraction]))
    correlated = 1.0 if missing else max(area + 1 - 1 / fraction, 1.0)
    assert own[0] >= 1
    assert strength[0] ** 2 * own[0] == pytest.approx(correlated, rel=1e-5)
    assert own[0] == pytest.approx(float(own_area(np.array(correlated), 6.0)))


def test_what_lasts_is_alike_where_pixels_are_near_and_turned_alike() -> None:
    turn = math.radians(10)
    places = np.array([[0, 0], [60, 0], [0, 0], [60, 60], [300, 300]])
    normals = np.array([[0, 0, 1.0], [0, 0, 1], [turn, 0, 1], [turn, 0, 1], [0, 0, 1]])
    draws = 4000
    drawn = np.stack([persistent_field(places, normals, np.random.default_rng(seed)) for seed in range(draws)])
    found = drawn.T @ drawn / draws
    step = ((places[:, None] - places) ** 2).sum(-1) / (2 * 60**2)
    tilt = ((normals[:, None] - normals) ** 2).sum(-1) / (2 * turn**2)
    expected = np.exp(-step - tilt)
    # products of two Gaussians of covariance k have the variance 1 + k^2
    assert (np.abs(found - expected) < 4 * np.sqrt((1 + expected**2) / draws)).all()


def test_of_nothing_there_is_no_noise() -> None:
    assert averaging_field(np.empty(0), np.empty((0, 2), int), np.random.default_rng(1)).shape == (0,)


def a_map(area: float, share: float) -> PerformanceMap:
    """F, sigma, noise area and persistent share that are the same everywhere."""
    axis = np.linspace(-1, 1, NODES)
    values = (FRACTION, SIGMA, 0.01, 0.01, math.nan, math.nan, area, share)
    names = (*FIELDS, "noise_area", "persistent_share")
    fields = {
        n: (("sample", "distance", "b", "a"), np.full((1, 2, NODES, NODES), v))
        for n, v in zip(names, values, strict=True)
    }
    coordinates = {
        "finish": ("sample", ["matt_white"]),
        "roughness": ("sample", [math.nan]),
        "distance": [400.0, 900.0],
        "a": axis,
        "b": axis,
    }
    return PerformanceMap(xr.Dataset(fields, coordinates, {"name": "even", "schema_version": SCHEMA_VERSION}))


@pytest.fixture(scope="module")
def plane(n10):
    """A matt plate, tilted by 25 deg, that an N10 sees whole; its predictor, pose and coupon."""
    transform = mi.ScalarTransform4f().scale([180, 120, 1])
    scene = scene_from_dict(
        {"plate": {"type": "rectangle", "to_world": transform, "bsdf": {"type": "matt_white"}}}, 850
    )
    pose = look_at([0, -253, 544], [0, 0, 0], [0, 0, 1])
    sensor_from_world = pose.inverse()
    coupon = Coupon(
        sensor_from_world.points(np.zeros(3)),
        sensor_from_world.directions(np.array([0.0, 0, 1])),
        sensor_from_world.directions(np.array([1.0, 0, 0])),
        360.0,
        240.0,
    )
    return Predictor.of_sensor(n10, sensor_geometry(n10)), scene, pose, coupon


def measured(plane, performance_map: PerformanceMap, correlated: bool, seeds: int) -> np.ndarray:
    """sigma^2, K_0, K_1, K_2 in units of it, F and correlation length of each draw, (seeds, 6)."""
    predictor, scene, pose, coupon = plane
    characterised = CharacterisedScene(scene, performance_map)
    rows = []
    for seed in range(seeds):
        cloud = predictor.predict(characterised, pose, np.random.default_rng(seed), correlated)
        patches = measure_patches(cloud, coupon)
        square = float((patches["ray_noise_inliers"].values ** 2).mean())
        k = [
            float(np.nanmean(values)) / square
            for values in (
                patches["ray_offset"].values ** 2,
                patches["offset_product_touching"].values,
                patches["offset_product_apart"].values,
            )
        ]
        points = cloud.points - cloud.grid.origin
        reach = (coupon.centre - cloud.grid.origin) @ coupon.normal
        beyond = np.linalg.norm(points, axis=-1) * (1 - reach / (points @ coupon.normal))
        rows.append([square, *k, float(patches["recovered_fraction"].mean()), autocorrelation(beyond).length()])
    return np.array(rows)


def told(values: np.ndarray) -> tuple[float, float]:
    """Mean of draws, and four standard errors of it."""
    return float(values.mean()), 4 * float(values.std(ddof=1)) / math.sqrt(len(values))


@pytest.mark.parametrize("area", [12.0, 60.0])
def test_a_predicted_plane_has_the_sigma_and_the_noise_area_of_its_map(plane, area: float) -> None:
    square, k_0, k_1, k_2, fraction, length = measured(plane, a_map(area, 0.0), True, 10).T
    mean, chance = told(np.sqrt(square))
    assert mean == pytest.approx(SIGMA, abs=chance)
    found, _ = noise_area(k_0, k_1, k_2, 6.0)
    mean, chance = told(found)
    # the sum over touching discs alone is within 12 % for a correlation that reaches a radius (test_offsets)
    assert mean == pytest.approx(area, abs=chance + 0.12 * area)
    assert chance < 0.25 * area
    mean, chance = told(k_2)
    assert abs(mean) < chance
    mean, chance = told(fraction)
    assert mean == pytest.approx(FRACTION, abs=chance)
    # rho = 1/e at sqrt(a / pi)
    own = own_field(np.array([area]), np.array([FRACTION]))[0][0]
    mean, chance = told(length)
    assert mean == pytest.approx(math.sqrt(own / math.pi), abs=chance + 0.1)


def test_what_lasts_on_a_predicted_plane_is_what_its_map_says(plane) -> None:
    share = 0.4
    k_2 = measured(plane, a_map(12.0, share), True, 40)[:, 3]
    mean, chance = told(k_2)
    # discs 2 to 4 diameters apart: the mean of exp(-d^2 / (2 l^2)) between 24 and 48 px, l = 60 px
    alike = np.average(np.exp(-(np.arange(24, 49) ** 2) / (2 * 60**2)), weights=np.arange(24, 49))
    assert mean == pytest.approx(share**2 * alike, abs=chance)
    assert chance < 0.6 * share**2


@pytest.mark.parametrize(("area", "correlated"), [(math.nan, True), (60.0, False)])
def test_where_no_noise_area_is_known_or_asked_for_errors_are_independent(plane, area, correlated) -> None:
    square, k_0, k_1, k_2, _, length = measured(plane, a_map(area, area), correlated, 8).T
    mean, chance = told(np.sqrt(square))
    assert mean == pytest.approx(SIGMA, abs=chance)
    mean, chance = told(noise_area(k_0, k_1, k_2, 6.0)[0])
    assert mean == pytest.approx(1 / FRACTION, abs=chance)
    assert length.mean() == pytest.approx(1 - math.exp(-1), abs=0.03)
