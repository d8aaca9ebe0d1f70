"""The data sheet of a sensor: what it says of a made-up sensor whose noise is known, and of clouds without any."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from mitsim.cli.program import app
from mitsim.decoding.cloud import capture_cloud
from mitsim.maps import data_sheet
from mitsim.maps.campaign import acquire
from mitsim.maps.data_sheet import correlation_length, gallery, measure_sensor
from mitsim.report.sheet_figures import (
    gallery_figure,
    image_on_grid,
    noise_figure,
    residual_figure,
    sheet_leaves_out,
    sheet_table,
)
from mitsim.report.style import write_png
from mitsim.sensor.preset import load_sensor
from mitsim.sensor.published_figures import PublishedNoise
from tests.smaller_sensors import binned

FRINGES = Path(__file__).parents[1] / "data" / "fringes.toml"


@pytest.fixture(scope="module")
def sheet():
    return measure_sensor(load_sensor(FRINGES))


def test_a_phase_code_has_a_small_floor_and_noise_that_its_decoder_predicts(sheet):
    near, far = sheet.sensor.working_range_mm
    assert math.isclose(sheet.mid_mm, math.sqrt(near * far))
    for plane in sheet.planes:
        assert plane.fraction > 0.99
        assert abs(plane.offset) < 1e-4 * sheet.mid_mm
        assert plane.flatness < 1e-4 * sheet.mid_mm
    assert abs(sheet.radius_error) < 1e-3 * sheet.radius_mm
    assert [point.distance for point in sheet.noise] == sorted(point.distance for point in sheet.noise)
    # set for matt white at 600 mm, the exposure saturates nearer than 490 mm, and the sheet says so
    assert sheet.noise[0].fraction == 0
    assert math.isnan(sheet.noise[0].sigma)
    known = sheet.noise[2:]
    assert all(point.fraction > 0.99 for point in known)
    # triangulation: sigma grows at least as the square of the distance where light falls off as well
    growth = np.diff(np.log([point.sigma for point in known])) / np.diff(np.log([point.distance for point in known]))
    assert (growth > 1.8).all()
    assert (growth < 4.5).all()
    # a phase has normal noise, independent from pixel to pixel
    assert sheet.residuals.correlation_px < 1.5
    assert abs(sheet.residuals.excess_kurtosis) < 0.5
    ground = [point for point in sheet.metal if point.finish.startswith("ground")]
    assert [point.tilt_deg for point in ground] == list(data_sheet.TILTS_DEG)


def test_the_sheet_is_numbers_a_table_and_pictures(sheet, tmp_path):
    told = json.loads(json.dumps(sheet.numbers()))
    assert told["sensor"] == "fringes"
    assert len(told["noise"]) == data_sheet.DISTANCES
    known = PublishedNoise(
        source="nobody: made up",
        distance_mm=[sheet.noise[2].distance, sheet.noise[-1].distance],
        sigma_mm=[2 * sheet.noise[2].spread, 2 * sheet.noise[-1].spread],
    )
    compared = replace(sheet, sensor=replace(sheet.sensor, published_noise=(known,)))
    table = sheet_table([sheet, compared])
    head, _, *rows = table.splitlines()
    assert len(rows) == 2
    assert {line.count("|") for line in (head, *rows)} == {9}
    assert "none in range" in rows[0]
    assert "| 2.0 |" in rows[1]
    david = replace(sheet, sensor=load_sensor("david-sls-3"))
    unknown, told_of_david = sheet_leaves_out([sheet, david]).splitlines()
    assert "mitsim calibrate" in unknown
    assert (
        "at 493 mm, 0.30 mm to a distance and 0.16 mm to a length" in told_of_david
    )  # docs/explanation/calibration.md
    for name, figure in (("noise", noise_figure([compared])), ("residuals", residual_figure([compared]))):
        assert write_png(figure, tmp_path / f"{name}.png").stat().st_size > 5000


def test_a_gallery_shows_every_finish_and_why_points_are_missing(tmp_path):
    seen = gallery(binned(load_sensor(FRINGES), 2))
    assert [finish for finish, *_ in seen] == list(data_sheet.FINISHES)
    valid = [int(cloud.valid.sum()) for _, _, cloud in seen]
    assert valid[0] > valid[2]
    assert write_png(gallery_figure("fringes", seen), tmp_path / "gallery.png").stat().st_size > 5000


def test_the_image_of_the_gallery_lies_on_the_pixels_of_the_status():
    """Of two cameras with lens distortion: the raw image was shown above the status of the rectified one."""
    sensor = binned(load_sensor("ensenso-n10"), 4)
    camera = sensor.rig.reference
    columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    (_, capture, cloud) = gallery(sensor)[0]
    for raw, axis in ((columns, 0), (rows, 1)):
        stack = {camera_name: np.stack([raw]) for camera_name in capture.images}
        shown = image_on_grid(replace(capture, images=stack), cloud)
        wanted = camera.project(cloud.points.astype(float))[..., axis]  # where each point is in the raw image
        inside = cloud.valid & np.isfinite(shown)
        assert inside.sum() > 1000 and np.abs(shown - wanted)[inside].max() < 0.05
        assert np.abs(wanted - raw)[inside].max() > 1  # the two images differ by more than that


@pytest.mark.parametrize("length", [0.0, 1.5, 4.0])
def test_correlation_length_of_smoothed_noise(rng, length):
    """White noise through a Gaussian of s pixels has the autocorrelation exp(-lag^2 / 4 s^2): 1/e at lag 2 s."""
    from scipy.ndimage import gaussian_filter

    image = rng.normal(size=(300, 300))
    if length:
        image = gaussian_filter(image, length)
    image[rng.random(image.shape) < 0.1] = np.nan
    assert abs(correlation_length(image) - (2 * length if length else 1 - math.exp(-1))) < 0.1 * max(length, 1)


def test_published_noise_is_read_between_its_distances_and_not_beyond():
    known = PublishedNoise(source="x", distance_mm=[100, 400], sigma_mm=[1, 16])
    assert np.allclose(known.at([100, 200, 400]), [1, 4, 16])  # a square law, in equal ratios
    assert np.isnan(known.at([99, 401])).all()
    assert np.isclose(PublishedNoise(source="x", distance_mm=[442], sigma_mm=[0.05]).at(442), 0.05)
    for wrong in ({"distance_mm": [1, 2], "sigma_mm": [1]}, {"distance_mm": [2, 1], "sigma_mm": [1, 1]}):
        with pytest.raises(ValidationError):
            PublishedNoise(source="x", **wrong)


def test_an_unknown_sensor_is_refused_before_anything_is_measured(tmp_path, monkeypatch):
    from typer.testing import CliRunner

    monkeypatch.setattr(data_sheet, "measure_sensor", None)
    done = CliRunner().invoke(app, ["map", "sheet", "ensenso-n11", "-o", str(tmp_path / "out")])
    assert done.exit_code != 0
    assert "ensenso-n1" in str(done.exception)
    assert not (tmp_path / "out").exists()


def test_a_plate_of_which_nothing_is_recovered_has_no_values(sheet, tmp_path):
    """Set for matt white at 600 mm, the exposure saturates at the near end of the range."""
    near, _ = sheet.sensor.working_range_mm
    targets = data_sheet._SimulatedTargets(sheet.sensor, 1)
    floor, residuals = targets.plane_floor(near, 0.0), targets.residuals(near)
    assert math.isnan(floor.offset) and math.isnan(floor.flatness) and floor.fraction == 0
    assert residuals.independent == 0 and math.isnan(residuals.skewness)
    empty = replace(sheet, planes=[floor, floor], metal=list(sheet.metal), residuals=residuals)
    empty.metal[0] = replace(empty.metal[0], fraction=math.nan)
    assert "nan" not in sheet_table([empty])
    assert write_png(residual_figure([empty]), tmp_path / "residuals.png").stat().st_size > 500
    assert json.loads(json.dumps(empty.numbers()))["planes"][0]["fraction"] == 0


def test_captures_without_noise_are_decoded_with_the_imager_that_took_them(sheet, monkeypatch):
    """They have 16 bits and no black level, where the sensor has 12 and one."""
    used = []

    def spied(capture, settings, geometry=None, roi=None, imager=None):
        used.append((capture.bits, imager))
        return capture_cloud(capture, settings, geometry, roi, imager)

    monkeypatch.setattr(acquire, "capture_cloud", spied)
    monkeypatch.setattr(data_sheet, "capture_cloud", spied)
    targets = data_sheet._SimulatedTargets(sheet.sensor, 1)
    targets.plane_floor(600.0, 0.0)
    targets.ball(600.0, 60.0)
    assert [bits for bits, _ in used] == [16, 16] and all(imager.bits == 16 for _, imager in used)
    targets.recovery("matt white", 600.0, 5.0)
    assert used[-1] == (sheet.sensor.imager.bits, sheet.sensor.imager)
