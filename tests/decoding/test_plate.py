"""Dots of a plate: the pitch that a cloud has them at, whatever the matcher leaves of each dot."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from characterisation.features.robust_fit import FitError
from characterisation.point_cloud import ViewGrid
from mitsim.decoding.dot_centres import dot_centres
from mitsim.decoding.plate import Plate, PlateDots, measure_plate, plate_dots, plate_scale
from tests.seen_shapes import cloud_of, plane

GRID = ViewGrid(900.0, 900.0, 189.5, 179.5, 380, 360)
PITCH, COUNT = 18.75, 7
FINE = 4


def drawn(turn, distance=500.0, count=COUNT):
    """Image of a plate of dark dots, 3/5 of the pitch wide, as a pinhole sees it, and its plane's normal."""
    steps = (np.arange(count) - (count - 1) / 2) * PITCH
    centres = np.stack([*np.meshgrid(steps, steps), np.zeros((count, count))], -1).reshape(-1, 3)
    around = 0.3 * PITCH * np.array([(np.cos(t), np.sin(t), 0) for t in np.linspace(0, 2 * np.pi, 60)[:-1]])
    fine = np.full((GRID.height * FINE, GRID.width * FINE), 220, np.uint8)
    for centre in centres:
        place = (centre + around) @ turn.T + np.array([0, 0, distance])
        at = (GRID.project(place) + 0.5) * FINE - 0.5
        cv2.fillPoly(fine, [np.rint(at * 256).astype(np.int32)], 30, shift=8)
    return cv2.resize(fine, (GRID.width, GRID.height), interpolation=cv2.INTER_AREA), turn[:, 2]


@pytest.mark.parametrize("angles", [(0, 0, 0), (25, 0, 10), (-15, 30, 45)])
def test_the_pitch_is_that_of_the_cloud(angles, rng):
    """A cloud that is 1 % too large has the dots 1 % too far apart, at any lean and turn."""
    image, normal = drawn(Rotation.from_euler("xyz", angles, degrees=True).as_matrix())
    distance = plane([0, 0, 500], normal, GRID)
    results = {}
    for scale in (1.0, 1.01):
        cloud = cloud_of(scale * distance, 0.1, rng, GRID)
        results[scale] = measure_plate("plate", Plate(None, PITCH), cloud, image)[0]
        assert results[scale].points == 49
        # a hundredth of a pixel is 0.006 mm here; the centre of an ellipse is not that of its circle
        assert results[scale].value == pytest.approx(scale * PITCH, abs=0.004)
    assert results[1.01].value / results[1.0].value == pytest.approx(1.01, abs=2e-4)


def test_points_on_the_rims_of_dots_alone_are_enough(rng):
    image, normal = drawn(Rotation.from_euler("x", 20, degrees=True).as_matrix())
    distance = plane([0, 0, 500], normal, GRID)
    edge = cv2.morphologyEx(image, cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)) > 60
    distance = np.where(edge, distance, np.nan)
    wrong = edge & (rng.random(edge.shape) < 0.2)
    cloud = cloud_of(np.where(wrong, rng.uniform(200, 3000, edge.shape), distance), 0.2, rng, GRID)
    pitch, *_ = measure_plate("plate", Plate(None, PITCH), cloud, image)
    assert pitch.points >= 45
    assert abs(pitch.value - PITCH) < 0.01


def test_rows_and_columns_are_those_of_the_plate():
    image, normal = drawn(Rotation.from_euler("xyz", (10, 20, 30), degrees=True).as_matrix())
    cloud = cloud_of(plane([0, 0, 500], normal, GRID), grid=GRID)
    dots = plate_dots("plate", Plate(None, PITCH), cloud, image)
    assert np.array_equal(np.ptp(dots.indices, axis=0), [6, 6])
    assert len({tuple(index) for index in dots.indices}) == 49
    assert len(dots.distances) == 2 * 7 * 6


@pytest.mark.parametrize("angles", [(0, 0, 0), (-15, 30, 45)])
def test_noise_along_the_rays_scatters_pitch_and_residuals_by_their_uncertainties(angles, rng, monkeypatch):
    """Its errors in the plane have one direction for each dot, and grow toward the rim of a plate seen from above."""
    image, normal = drawn(Rotation.from_euler("xyz", angles, degrees=True).as_matrix())
    found, runs = dot_centres(image), 150
    monkeypatch.setattr("mitsim.decoding.plate.dot_centres", lambda image, dark: found)
    distance, plate = plane([0, 0, 500], normal, GRID), Plate(None, PITCH)
    measured = [measure_plate("plate", plate, cloud_of(distance, 1.0, rng, GRID), image) for _ in range(runs)]
    for number, name in ((0, "plate pitch"), (3, "plate in-plane")):
        value, uncertainty = np.array([(one[number].value, one[number].uncertainty) for one in measured]).T
        assert measured[0][number].name == name
        assert np.sqrt(np.mean(uncertainty**2)) == pytest.approx(value.std(ddof=1), rel=3 / np.sqrt(2 * runs))


def test_the_uncertainty_of_the_scale_is_its_scatter(rng):
    """Dots with errors of 0.05 mm on every axis, 200 times: s / u within 1 +- 3 / sqrt(2 * 199)."""
    indices = np.stack(np.meshgrid(np.arange(7), np.arange(5)), -1).reshape(-1, 2)
    turn = Rotation.from_euler("xyz", (10, 20, 30), degrees=True).as_matrix()
    found = []
    for _ in range(200):
        centres = np.column_stack([indices * PITCH, np.zeros(35)]) @ turn.T + rng.normal(0, 0.05, (35, 3))
        found.append(plate_scale(PlateDots(centres, indices, np.empty(0), 35), PITCH)[:2])
    scale, uncertainty = np.array(found).T
    stated = np.sqrt(np.mean(uncertainty**2))
    assert abs(scale.std(ddof=1) / stated - 1) < 3 / np.sqrt(2 * 199)
    assert abs(scale.mean() - 1) < 4 * stated / np.sqrt(200)


def test_another_pitch_is_told_with_the_one_that_is_there():
    image, normal = drawn(np.eye(3))
    cloud = cloud_of(plane([0, 0, 500], normal, GRID), grid=GRID)
    with pytest.raises(FitError, match=r"median of 18\.[78]\d+ mm, not about 30 mm"):
        plate_dots("plate", Plate(None, 30.0), cloud, image)
    found = measure_plate("plate", Plate(None, 30.0), cloud, image)
    assert not any(one.possible for one in found)


@pytest.mark.parametrize("diameter", [7, 12, 25, 50])
def test_dots_of_any_size_are_found_to_a_fiftieth_of_a_pixel(diameter, rng):
    pitch = int(2 * diameter)
    true = np.stack(np.meshgrid(np.arange(1, 5), np.arange(1, 4)), -1).reshape(-1, 2) * pitch + rng.random((12, 2))
    size = (4 * pitch, 5 * pitch)
    ink = np.zeros((size[0] * 8, size[1] * 8))
    for x, y in true:
        top, left = (int(8 * (at - diameter / 2)) for at in (y, x))
        row, column = np.ogrid[top : top + 8 * diameter + 16, left : left + 8 * diameter + 16]
        ink[row, column] = 180 * (np.hypot(column / 8 - 7 / 16 - x, row / 8 - 7 / 16 - y) < diameter / 2)
    image = (220 - cv2.resize(ink, size[::-1], interpolation=cv2.INTER_AREA)).astype(np.uint8)
    for shown, dark in ((image, True), (255 - image, False)):
        found = dot_centres(shown, dark)
        assert len(found) == 12
        order = np.lexsort((np.rint(found[:, 0] / pitch), np.rint(found[:, 1] / pitch)))
        assert np.abs(found[order] - true).max() < 0.02
