"""What becomes of radiance on its way to grey levels: the lens, and noise that does not depend on who computes it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import correlate1d

from mitsim.capture.simulated.lens_blur import gaussian_blur
from mitsim.capture.simulated.render_residual import render_residual
from mitsim.capture.simulated.rendering import Rendering
from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.scene.backend import mi
from mitsim.scene.load import load_scene, scene_from_dict
from mitsim.sensor.point_spread import point_spread
from mitsim.sensor.preset import load_sensor
from mitsim.sensor.transforms import look_at
from tests.render_threads import threads

ROOT = Path(__file__).parents[3]


@given(st.integers(1, 40), st.integers(1, 40), st.floats(0.05, 3.0), st.integers(0, 2**32 - 1))
def test_the_lens_blurs_with_its_point_spread_as_scipy_does(height, width, sigma, seed):
    image = np.random.default_rng(seed).random((height, width), dtype=np.float32) + np.float32(0.1)
    expected = image.astype(float)
    for axis in (0, 1):
        expected = correlate1d(expected, point_spread(sigma), axis)
    found = gaussian_blur(image, sigma)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, expected, rtol=1e-6)


@given(st.integers(0, 30), st.integers(0, 40), st.integers(13, 30), st.integers(13, 40), st.floats(0.05, 1.3))
def test_a_blur_keeps_a_part_of_an_image_as_it_is_in_the_whole(row, column, height, width, sigma):
    image = np.random.default_rng(1).random((60, 80), dtype=np.float32)
    part = gaussian_blur(image[row : row + height, column : column + width], sigma)
    whole = gaussian_blur(image, sigma)[row : row + height, column : column + width]
    np.testing.assert_array_equal(part[6:-6, 6:-6], whole[6:-6, 6:-6])  # the reach of 1.3 px


@pytest.mark.parametrize("path", [ROOT / "tests/data/fringes.toml", "kinect-v2"])
def test_the_bytes_of_a_seed_do_not_depend_on_the_number_of_threads(path, monkeypatch):
    sensor = load_sensor(path)
    simulated = SimulatedSensor(sensor)
    scene = load_scene(ROOT / "scenes/coupon/coupon.xml", sensor.wavelength_nm)
    pose = look_at([150, -100, 560], [0, 0, 0], [0, 1, 0])
    corners = pose.inverse().points(40.0 * np.array([[a, b, 0] for a in (-1, 1) for b in (-1, 1)]))
    taken = {}
    for count in (1, 3):
        monkeypatch.setenv("OMP_NUM_THREADS", str(count))
        with threads(count):
            taken[count] = simulated.capture(scene, pose, rendering=Rendering(samples=1), seed=5, around=corners).images
    other = simulated.capture(scene, pose, rendering=Rendering(samples=1), seed=6, around=corners).images
    for name, images in taken[1].items():
        assert images.tobytes() == taken[3][name].tobytes()
        assert images.tobytes() != other[name].tobytes()


@pytest.mark.parametrize("name", ["ensenso-n10", "kinect-v2"])
def test_the_light_of_a_plate_falls_off_toward_the_corners_as_cosines_do(name):
    """Radiance behind the lens over that of a lens without loss, pixel by pixel, on a plate that fills the image."""
    sensor = load_sensor(name)
    even = replace(sensor, imager=replace(sensor.imager, corner_illumination=1.0))
    plate = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().scale([3000, 3000, 1]),
        "bsdf": {"type": "matt_white"},
    }
    scene = scene_from_dict({"plate": plate}, sensor.wavelength_nm)
    pose = look_at([0, 0, sum(sensor.working_range_mm) / 2], [0, 0, 0], [0, 1, 0])
    camera = next(iter(sensor.rig.cameras))
    seen, flat = (
        SimulatedSensor(each).radiance(scene, pose, camera, Rendering(samples=1, depth=1), seed=1)[0]
        for each in (sensor, even)
    )
    (fx, _, cx), (_, fy, cy), _ = sensor.rig.cameras[camera].matrix
    rows, columns = np.mgrid[: seen.shape[0], : seen.shape[1]]
    law = (1 + ((columns - cx) ** 2 + (rows - cy) ** 2) / (fx * fy)) ** -2
    lit = flat > 0
    assert lit.mean() > 0.7
    np.testing.assert_allclose(seen[lit] / flat[lit], law[lit], rtol=1e-4)


def test_a_rendering_is_judged_at_the_longest_exposure_that_saturates_no_pixel():
    sensor = load_sensor(ROOT / "tests/data/fringes.toml")
    scene = load_scene(ROOT / "scenes/coupon/coupon.xml", sensor.wavelength_nm)
    pose = look_at([150, -100, 560], [0, 0, 0], [0, 1, 0])
    corners = pose.inverse().points(20.0 * np.array([[a, b, 0] for a in (-1, 1) for b in (-1, 1)]))

    def residual(*exposures):
        policy = SimpleNamespace(exposures=lambda *_: exposures)
        simulated = SimulatedSensor(replace(sensor, exposure=policy))
        camera = next(iter(sensor.rig.cameras))
        return render_residual(simulated, scene, pose, camera, Rendering(1, 1), seed=1, around=corners)

    usual = sensor.exposure.exposures(None, sensor.imager.full_well)[0]
    short, long = usual / 64, usual / 8
    assert residual(long).quadrature > 2 * residual(short).quadrature > 0
    assert residual(short, long) == residual(long)
    assert residual(short, 1e6 * usual) == residual(short)  # all pixels are saturated in the second
