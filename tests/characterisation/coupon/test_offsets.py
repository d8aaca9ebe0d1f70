"""Noise area and persistent noise against fields whose covariance is known."""

import numpy as np
import pytest
import xarray as xr
from scipy.ndimage import gaussian_filter

from characterisation.coupon.discs import disc_offsets
from characterisation.coupon.offsets import LEAST_SHARE, known_offset, neighbour_products, noise_area
from characterisation.maps.pooled_offsets import pool_offsets

RADIUS, SIDE = 6.0, 150


def lattice() -> np.ndarray:
    """Centres (p, 2) of touching discs, hexagonal, as patches lie."""
    rows = np.arange(RADIUS, SIDE - RADIUS, 2 * RADIUS * np.sqrt(3) / 2)
    places = [
        (row, column)
        for k, row in enumerate(rows)
        for column in np.arange(RADIUS + RADIUS * (k % 2), SIDE - RADIUS, 2 * RADIUS)
    ]
    return np.rint(places).astype(int)


def products(fields: list[np.ndarray], keep: float, rng: np.random.Generator) -> tuple[float, float, float]:
    """K_0, K_1, K_2 of fields, of whose pixels a share is there."""
    centres, offsets = lattice(), disc_offsets(RADIUS)
    pixels = centres[:, None] + offsets
    sums: list[list[float]] = [[], [], []]
    for field in fields:
        there = rng.random(field.shape) < keep
        values, present = field[tuple(pixels.T)].T, there[tuple(pixels.T)].T
        offset = np.where(present, values, 0).sum(1) / present.sum(1)
        touching, apart = neighbour_products(offset, centres, RADIUS)
        for total, each in zip(sums, (offset**2, touching, apart), strict=True):
            total.append(float(np.nanmean(each)))
    return tuple(float(np.mean(total)) for total in sums)  # type: ignore[return-value]


@pytest.mark.parametrize("keep", [1.0, 0.6])
def test_of_independent_pixels_the_noise_area_is_one_over_the_fraction(keep: float) -> None:
    rng = np.random.default_rng(1)
    fields = [rng.normal(size=(SIDE, SIDE)) for _ in range(60)]
    area, persistent = noise_area(*map(np.asarray, products(fields, keep, rng)), RADIUS)
    # K_0 of 60 x 160 discs is known to 1.5 %, and 6 K_1 adds 124.7 * 6 / 113 / sqrt(60 * 480) = 4 %: three of both
    assert area == pytest.approx(1 / keep, rel=0.13)
    assert persistent < 1e-3


@pytest.mark.parametrize("spread", [1.5, 2.5, 4.0])
def test_the_area_of_a_correlated_field_is_found(spread: float) -> None:
    rng = np.random.default_rng(2)
    fields = [gaussian_filter(rng.normal(size=(SIDE, SIDE)), spread, mode="wrap") for _ in range(80)]
    sigma = np.sqrt(np.mean([f.var() for f in fields]))
    truth = 4 * np.pi * spread**2  # a Gaussian kernel of that spread
    area, _ = noise_area(*map(np.asarray, products([f / sigma for f in fields], 1.0, rng)), RADIUS)
    # chance: about 2 / sqrt(80 * SIDE^2 / truth) of the sums, at most 2 % here; the rest is the method's own
    assert area == pytest.approx(truth, rel=0.12)


def test_what_a_whole_capture_has_in_common_is_persistent_and_not_area() -> None:
    rng = np.random.default_rng(3)
    shift = rng.normal(0, 0.3, 400)
    shift *= 0.3 / np.sqrt(np.mean(shift**2))
    area, persistent = noise_area(
        *map(np.asarray, products([rng.normal(size=(SIDE, SIDE)) + s for s in shift], 1.0, rng)), RADIUS
    )
    assert np.sqrt(persistent) == pytest.approx(0.3, rel=0.02)
    assert area == pytest.approx(1.0, rel=0.15)


def test_the_offset_is_along_the_rays_and_in_millimetres() -> None:
    rng = np.random.default_rng(4)
    normal, reach = np.array([0.3, 0.1, -1.0]) / np.linalg.norm([0.3, 0.1, -1.0]), -500.0
    rays = rng.normal([0, 0, 1], [0.05, 0.05, 0], (5, 113, 3))
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    away = rng.normal(size=(5, 1))
    points = rays * (reach / (rays @ normal) + away)[..., None]
    there = rng.random((5, 113)) < 0.8
    there[4] = np.arange(113) < LEAST_SHARE * 113 - 1
    offset = known_offset(points, there, normal, reach)
    assert np.allclose(offset[:4], away[:4, 0], atol=1e-9)
    assert np.isnan(offset[4])


def test_patches_without_offsets_or_neighbours_have_no_products() -> None:
    touching, apart = neighbour_products(np.array([np.nan, 0.2, 0.3]), np.array([[0, 0], [0, 12], [0, 200]]), RADIUS)
    assert np.isnan(touching).all() and np.isnan(apart).all()
    touching, apart = neighbour_products(np.array([0.5, 0.2]), np.array([[0, 0], [0, 12]]), RADIUS)
    assert np.allclose(touching, 0.1) and np.isnan(apart).all()


def test_pooling_answers_where_captures_are_and_takes_old_tables() -> None:
    number = 50
    columns = {
        name: ("patch", np.full(number, value))
        for name, value in {
            "ray_noise_inliers": 0.5,
            "ray_offset": 0.1,
            "offset_product_touching": 0.004,
            "offset_product_apart": 0.0025,
            "normal_x": 0.3,
            "normal_y": 0.0,
        }.items()
    }
    table = xr.Dataset(columns | {"orientation": ("patch", np.zeros(number, int))})
    found = pool_offsets(table, np.array([[0.31, 0.0], [-0.5, 0.0]]))
    cell = np.sqrt(3) / 2 * 144
    assert found.area[0] == pytest.approx((len(disc_offsets(RADIUS)) * 0.0075 + 6 * cell * 0.0015) / 0.25)
    # one capture says nothing of what captures have in common
    assert found.persistent[0] == pytest.approx(0.05 / 0.5) and found.bias[0] == 0
    assert np.isnan([found.area[1], found.persistent[1], found.bias[1]]).all()


@pytest.mark.parametrize(("bias", "lasting"), [(0.0, 0.2), (-0.3, 0.1), (0.3, 0.0)])
def test_what_captures_share_is_told_from_what_lasts_in_each(bias: float, lasting: float) -> None:
    rng = np.random.default_rng(6)
    sigma, captures, each = 0.02, 40, 25
    found = []
    for _ in range(60):
        of_capture = sigma * np.repeat(bias + rng.normal(0, lasting, captures), each)
        offset = of_capture + rng.normal(0, 0.1 * sigma, captures * each)
        turned = np.repeat(rng.uniform(-0.05, 0.05, (captures, 2)), each, axis=0)
        table = xr.Dataset(
            {
                name: ("patch", values)
                for name, values in {
                    "ray_noise_inliers": np.full(len(offset), sigma),
                    "ray_offset": offset,
                    "offset_product_touching": of_capture**2,
                    "offset_product_apart": of_capture**2,
                    "normal_x": turned[:, 0],
                    "normal_y": turned[:, 1],
                    "orientation": np.repeat(np.arange(captures), each),
                }.items()
            }
        )
        pooled = pool_offsets(table, np.zeros((1, 2)))
        found.append((pooled.bias[0], pooled.persistent[0] ** 2))
    (mean, square), spread = np.mean(found, axis=0), np.std(found, axis=0) / np.sqrt(len(found))
    assert mean == pytest.approx(bias, abs=3 * spread[0] + 1e-3)
    assert square == pytest.approx(lasting**2, abs=3 * spread[1] + 0.01 * (bias**2 + lasting**2))
