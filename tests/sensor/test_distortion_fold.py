"""Pixels beyond the fold of a lens distortion have no ray, points there no pixel; all others are exact."""

from __future__ import annotations

import numpy as np
import pytest

from mitsim.sensor.camera import Camera
from mitsim.sensor.distortion_fold import inverse_fold_radii

K = np.array([[600.0, 0, 319.5], [0, 600, 239.5], [0, 0, 1]])


def camera(*distortion, model="perspective"):
    return Camera(K, np.array(distortion, float), 640, 480, model=model)


@pytest.mark.parametrize(
    ("distortion", "fold"),
    [
        ((-0.9, 0, 0, 0, 0), np.sqrt(1 / 2.7)),  # 1 + 3 k1 r^2 = 0
        ((0, -0.8, 0, 0, 0), 4.0**-0.25),  # 1 + 5 k2 r^4 = 0
        ((0, 0, 0, 0, -7.4), (1 / 51.8) ** (1 / 6)),  # 1 + 7 k3 r^6 = 0
        ((0, 0, 0, 0, 0, 0.5, 0, 0), np.sqrt(2)),  # of r / (1 + k4 r^2): k4 r^2 = 1
        ((0.3, 0, 0, 0, 0), np.inf),
        ((0, 0, 0, 0, 0), np.inf),
    ],
)
def test_the_fold_is_where_the_derivative_of_the_radius_vanishes(distortion, fold):
    np.testing.assert_allclose(1 / fold, inverse_fold_radii(np.array(distortion), "perspective"), rtol=1e-3)


def test_the_fold_of_a_fisheye():
    """1 + 3 k1 theta^2 = 0 at 0.8165 rad."""
    np.testing.assert_allclose(
        inverse_fold_radii(np.array([-0.5, 0, 0, 0]), "fisheye"), 1 / np.tan(np.sqrt(2 / 3)), 1e-3
    )


def test_pixels_beyond_the_fold_have_no_ray_and_all_before_it_have():
    """r (1 - 0.9 r^2) reaches 2/3 of its fold at 0.6086: 0.4057, a circle of 243.4 px."""
    eye = camera(-0.9, 0, 0, 0, 0)
    pixels = eye.pixel_grid()
    radius = np.linalg.norm(pixels - K[:2, 2], axis=-1)
    rays = eye.rays(pixels)
    known = np.isfinite(rays).all(axis=-1)
    assert known[radius < 243].all()
    assert not known[radius > 243.5].any()
    assert np.abs(eye.project(500 * rays)[known] - pixels[known]).max() < 1e-6
    assert np.hypot(rays[..., 0], rays[..., 1])[known].max() < np.sin(np.arctan(0.609))


@pytest.mark.parametrize(
    ("distortion", "model"),
    [
        ((-0.4, 0.1, 0.001, 0.002, -0.3), "perspective"),
        ((-1.4, 0.7, 0, 0, 0), "perspective"),
        ((-0.9, 0, 0, 0), "fisheye"),
    ],
)
def test_every_direction_has_the_pixel_whose_ray_it_is_or_none(distortion, model):
    """Also where the polynomial rises again beyond its fold, and the pixel has another, valid ray."""
    eye = camera(*distortion, model=model)
    x, y = np.meshgrid(np.linspace(-1.5, 1.5, 121), np.linspace(-1.5, 1.5, 121))
    points = np.stack([x, y, np.ones_like(x)], axis=-1)
    pixels = eye.project(points)
    shown = np.isfinite(pixels).all(axis=-1)
    assert 0.05 < shown.mean() < 0.95
    back = eye.rays(pixels[shown])
    known = np.isfinite(back).all(axis=-1)
    assert known.mean() > 0.999
    np.testing.assert_allclose((back / back[:, 2:])[known], points[shown][known], atol=1e-5)


def test_outlines_end_at_the_fold():
    eye = camera(-0.9, 0, 0, 0, 0)
    rays = eye.rays_to_fold(eye.pixel_grid()[::16, ::16])
    radius = np.hypot(rays[..., 0], rays[..., 1]) / rays[..., 2]
    assert np.isfinite(rays).all()
    assert abs(radius.max() - 0.6086) < 1e-3
