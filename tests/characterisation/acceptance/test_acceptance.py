"""VDI/VDE 2634-2: artefacts of known form, size and distance."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from characterisation.acceptance.vdi_2634 import flatness_error, plane_distances, probing_error, sphere_spacing_error
from characterisation.features.fits import fit_sphere
from characterisation.files.errors import InputError


def cap(count: int, half_angle_deg: float = 70.0) -> np.ndarray:
    """Directions (n, 3) evenly over a cap about -z, by a golden spiral."""
    k = np.arange(count) + 0.5
    z = -1 + k / count * (1 - np.cos(np.radians(half_angle_deg)))
    angle, across = k * np.pi * (3 - np.sqrt(5)), np.sqrt(1 - z**2)
    return np.stack([across * np.cos(angle), across * np.sin(angle), z], axis=-1)


def checkered(size: int = 40) -> np.ndarray:
    """Heights of +-1 that no plane can follow, on a square grid of even side."""
    row, column = np.mgrid[:size, :size]
    return (1.0 - 2.0 * ((row + column) % 2)).ravel()


def square(size: int = 40) -> np.ndarray:
    row, column = np.mgrid[:size, :size]
    return np.stack([column.ravel(), row.ravel(), 0 * row.ravel()], axis=-1).astype(float)


@given(st.floats(0, 60), st.floats(-180, 180), st.floats(0.001, 0.5))
def test_flatness_is_the_range_about_the_plane_wherever_it_lies(tilt, azimuth, height):
    points = square() + height * checkered()[:, None] * np.array([0, 0, 1])
    moved = points @ Rotation.from_euler("zx", [azimuth, tilt], degrees=True).as_matrix().T + [50, -20, 600]
    assert np.isclose(flatness_error(moved, 0.0), 2 * height, rtol=1e-3)


def test_flatness_leaves_a_few_per_mille_out_and_says_more_without_that():
    points = square()
    points[:, 2] = 0.01 * checkered()
    points[[3, 700, 1200, 1500], 2] = 1.0
    assert np.isclose(flatness_error(points, 0.003), 0.02, rtol=0.01)  # 4 of 1600
    assert flatness_error(points, 0.0) > 0.9


def test_the_range_of_gaussian_noise_grows_with_the_points(rng):
    """Why a range compares only with one over as many points: 2 sigma sqrt(2 ln n) is its leading term."""
    found = {}
    for count in (100, 10000):
        points = np.column_stack([rng.uniform(-100, 100, (count, 2)), rng.normal(0, 0.1, count)])
        found[count] = np.mean([flatness_error(rng.permuted(points, axis=0), 0.0) for _ in range(20)])
    # expected range of n normals: 5.02 sigma for 100, 7.70 for 10 000 (Tippett 1925)
    assert np.isclose(found[100], 0.502, rtol=0.2)
    assert np.isclose(found[10000], 0.770, rtol=0.2)


def test_distances_are_positive_away_from_the_sensor():
    points = np.vstack([square(), [20, 20, 3]]) + np.array([0, 0, 500])
    assert plane_distances(points)[-1] > 2.9


@pytest.mark.parametrize("radius", [12.5, 40.0])
def test_probing_errors_of_a_sphere_with_a_known_ripple(radius, rng):
    """A ripple with as many hills as valleys leaves the least-squares sphere where it is: PF is twice its height."""
    directions = cap(4000)
    ripple = 0.02 * np.sign(np.sin(40 * np.arctan2(directions[:, 1], directions[:, 0])))
    points = directions * (radius + 0.03 + ripple)[:, None] + [10, -5, 500]
    found = probing_error(points, 2 * radius, 0.0)
    assert np.isclose(found.form, 0.04, rtol=0.05)
    assert np.isclose(found.size, 0.06, atol=0.002)
    assert np.allclose(found.centre, [10, -5, 500], atol=0.002)


def test_the_sphere_is_that_of_the_fit_of_features(rng):
    points = cap(2000) * (20 + rng.normal(0, 0.05, (2000, 1))) + [0, 0, 400]
    ours, theirs = probing_error(points, 40.0, 0.0), fit_sphere(points)
    # theirs leaves out points beyond 4 robust sigmas, 6e-5 of Gaussian ones: at most one or two of 2000 here
    assert np.isclose(ours.size / 2 + 20, theirs.radius, atol=0.002)
    assert np.allclose(ours.centre, theirs.centre, atol=0.002)


def test_a_stray_point_is_rejected_before_the_form_is_taken(rng):
    points = cap(1000) * 20 + [0, 0, 400]
    points[5] *= 1.01
    assert probing_error(points, 40.0).form < 1e-6
    assert probing_error(points, 40.0, 0.0).form > 3


@given(st.floats(-0.5, 0.5), st.floats(0, 360))
def test_spacing_error_is_measured_less_calibrated(error, angle):
    direction = np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle)), 0.2])
    direction /= np.linalg.norm(direction)
    first = cap(300) * 15 + [0, 0, 600]
    second = cap(300) * 15 + [0, 0, 600] + direction * (150 + error)
    assert np.isclose(sphere_spacing_error(first, second, 150.0), error, atol=1e-6)


@pytest.mark.parametrize("half_angle", [6, 20, 90])
def test_a_small_cap_still_gives_its_sphere(half_angle):
    found = probing_error(cap(1000, half_angle) * 20 + [0, 0, 400], 40.0, 0.0)
    assert abs(found.size) < 1e-6
    assert found.form < 1e-8


def test_missing_points_are_left_out():
    points = cap(500) * 20 + [0, 0, 400]
    points[::3] = np.nan
    assert probing_error(points, 40.0).form < 1e-6


@pytest.mark.parametrize(
    ("call", "field"),
    [
        (lambda: flatness_error(np.zeros((3, 3))), "points"),
        (lambda: flatness_error(np.zeros((9, 2))), "points"),
        (lambda: flatness_error(square(), 0.5), "rejected_share"),
        (lambda: probing_error(cap(4), 2.0), "points"),
        (lambda: probing_error(square(), 10.0), "points"),
        (lambda: probing_error(cap(100), 0.0), "calibrated_diameter"),
        (lambda: sphere_spacing_error(cap(100), cap(100), -1.0), "calibrated_distance"),
    ],
)
def test_what_cannot_be_judged_is_refused_by_name(call, field):
    with pytest.raises(InputError) as raised:
        call()
    assert raised.value.field == field
