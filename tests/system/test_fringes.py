"""The whole chain of a structured-light sensor: render, expose, decode, measure."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from characterisation.features.fits import fit_sphere
from characterisation.files.errors import InputError
from characterisation.point_cloud import Status
from mitsim.capture.folder import read_capture, write_capture
from mitsim.capture.simulated.rendering import Rendering
from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.decoding.cloud import capture_cloud, sensor_geometry
from mitsim.decoding.structured_light.phase_shift import fit_phases
from mitsim.scene.backend import mi
from mitsim.scene.load import scene_from_dict
from mitsim.sensor.light_code import PhaseShift
from mitsim.sensor.noise_sources import Noise
from mitsim.sensor.preset import load_sensor
from mitsim.sensor.transforms import look_at

FRINGES = Path(__file__).parents[1] / "data/fringes.toml"


@pytest.fixture(scope="module")
def sensor():
    return load_sensor(FRINGES)


@pytest.fixture(scope="module")
def simulated(sensor):
    return SimulatedSensor(sensor)


@pytest.fixture(scope="module")
def geometry(sensor):
    return sensor_geometry(sensor)


def plate(size=150.0):
    to_world = mi.ScalarTransform4f().scale([size, size, 1])
    return scene_from_dict({"plate": {"type": "rectangle", "to_world": to_world, "bsdf": {"type": "matt_white"}}}, 460)


def exposed(sensor, seconds):
    return replace(sensor, exposure=replace(sensor.exposure, base_s=seconds))


def test_sphere_through_the_phase_code(sensor, simulated, geometry):
    """Radius 100 mm at 600 mm, both lenses distorted, without noise: the floor of render, code and decoder."""
    scene = scene_from_dict({"sphere": {"type": "sphere", "radius": 100.0, "bsdf": {"type": "matt_white"}}}, 460)
    pose = look_at([40, -590, 100], [0, 0, 0], [0, 0, 1])
    dimmer = SimulatedSensor(exposed(sensor, 0.5 * sensor.exposure.base_s))  # the sphere stands nearer than the rule's
    cloud = capture_cloud(dimmer.capture(scene, pose, seed=1, noise=Noise.none()), sensor.settings, geometry)
    points = cloud.points[cloud.valid].astype(float)
    fit = fit_sphere(points, viewpoint=np.zeros(3))
    assert len(points) > 60000
    assert abs(fit.radius - 100.0) < 0.01
    assert np.linalg.norm(fit.centre - pose.inverse().points(np.zeros(3))) < 0.01
    assert fit.residual_std < 0.01
    print(
        f"sphere through the phase code: radius error {1000 * (fit.radius - 100):.2f} um, "
        f"residual {1000 * fit.residual_std:.2f} um"
    )


@pytest.mark.parametrize(("steps", "exposure"), [(n, e) for n in (3, 4, 8) for e in (0.1, 1.0)])
def test_phase_noise_is_the_closed_form_over_a_decade_of_exposure(sensor, steps, exposure):
    """sigma_phi = sqrt(2 / N) sigma_I / B, each pixel with its own sigma_I and B, from capture to phase.

    sigma_I^2 is the mean over the steps of the variance K^2 (mu + read^2) + 1/12: a pixel's own phase changes how shot
    noise weighs in, the mean over all phases does not.
    """
    period = 24.0
    code = PhaseShift(periods_px=[period], steps=steps)
    own = exposed(replace(sensor, pattern=code), exposure * sensor.exposure.base_s)
    simulated, scene, pose = SimulatedSensor(own), plate(), look_at([0, 0, 600], [0, 0, 0], [0, 1, 0])
    sources = Noise.only("shot", "read", "quantisation")
    per_radiance = own.electrons() * own.exposure.base_s
    light = simulated.radiance(scene, pose, "camera", Rendering(samples=16, depth=1), seed=1) * per_radiance
    lit = light.min(axis=0) > 0
    assert lit.sum() > 100000
    shifts = [2 * np.pi * np.arange(steps) / steps]
    imager = own.imager
    true = fit_phases(light.astype(np.float32), shifts)
    variance = (imager.gain**2 * (light.mean(axis=0) + imager.read_noise**2) + 1 / 12)[lit]
    expected = np.sqrt(2 / steps * variance) / (imager.gain * true.modulation[0][lit])
    found = fit_phases(simulated.capture(scene, pose, seed=2, noise=sources).images["camera"], shifts)
    off = np.angle(np.exp(1j * (found.phase - true.phase)[0][lit])) / expected
    assert abs(off.mean()) < 0.02
    assert abs(off.std() - 1) < 0.05


def test_a_capture_on_disk_knows_its_code(sensor, simulated, geometry, tmp_path):
    capture = simulated.capture(plate(), look_at([0, 0, 600], [0, 0, 0], [0, 1, 0]), seed=1)
    assert capture.images["camera"].shape == (16, 480, 640)
    write_capture(capture, tmp_path / "capture")
    again = read_capture(tmp_path / "capture")
    one, other = (capture_cloud(each, sensor.settings, geometry) for each in (capture, again))
    np.testing.assert_array_equal(one.points, other.points)
    assert one.valid.sum() > 100000
    world = capture.world_from_sensor.points(one.points[one.valid].astype(float))
    assert abs(np.median(world[:, 2])) < 0.01
    told = capture_cloud(capture, sensor.settings, geometry, imager=sensor.imager)
    assert one.sigma is None
    assert np.isfinite(told.sigma[told.valid]).all()
    size = np.percentile(np.abs(world[:, 2] - np.median(world[:, 2])) / told.sigma[told.valid], 68.3)
    assert 0.9 < size < 1.2, size  # the plate faces the sensor: along the ray and along z are nearly one
    again = replace(again, decoding=again.decoding.model_copy(update={"pattern": None}))
    with pytest.raises(InputError, match="pattern"):
        capture_cloud(again, sensor.settings)


def test_metal_blinds_a_single_exposure_and_not_a_bracket(sensor, geometry, tmp_path):
    """A polished face at the mirror angle: saturated at one exposure; three of them, merged, bring it back."""
    to_world = mi.ScalarTransform4f().scale([60, 60, 1])
    metal = {"type": "machined_metal", "metal": "aluminium", "process": "ground", "Ra": 0.4}
    scene = scene_from_dict({"face": {"type": "rectangle", "to_world": to_world, "bsdf": metal}}, 460)
    pose = look_at([60, 0, 590], [0, 0, 0], [0, 1, 0])
    limits = "limits_s = [1e-6, 1.0]"
    text = FRINGES.read_text().replace(limits, f"{limits}\nbracket = {{count = 3, factor = 8}}")

    def reasons(own):
        capture = SimulatedSensor(own).capture(scene, pose, seed=1)
        cloud = capture_cloud(capture, own.settings, geometry)
        return capture, cloud

    (tmp_path / "bracketed.toml").write_text(text)
    bracketed = load_sensor(tmp_path / "bracketed.toml")
    _, single = reasons(sensor)
    capture, merged = reasons(bracketed)
    assert len(capture.images["camera"]) == 3 * 16
    assert np.allclose(np.array(capture.decoding.exposures_s) / sensor.exposure.base_s, [1 / 8, 1, 8])
    blinded = single.status == Status.SATURATED
    assert blinded.sum() > 500
    assert merged.valid[blinded].mean() > 0.9
    assert (merged.status == Status.SATURATED).sum() < 0.1 * blinded.sum()
    # what is too dark for the longest exposure alone is too dark for all, and nothing else: the levels that are merged
    # are the shortest's, 64 times fainter
    longest = replace(
        capture,
        images={"camera": capture.images["camera"][-16:]},
        decoding=capture.decoding.model_copy(update={"exposure_s": capture.decoding.exposures_s[-1:]}),
    )
    faint = [(c.status == Status.LOW_MODULATION) & ~blinded for c in (merged, capture_cloud(longest, sensor.settings))]
    assert (faint[0] ^ faint[1]).mean() < 0.01
    world = capture.world_from_sensor.points(merged.points[blinded & merged.valid].astype(float))
    assert np.abs(np.median(world[:, 2])) < 0.05


def test_automatic_exposure_fills_the_well_to_its_level(tmp_path):
    text = FRINGES.read_text()
    start = text.index("[exposure]")
    rule = '[exposure]\nrule = "automatic"\nlevel = 0.6\npercentile = 99.5\nlimits_s = [1e-6, 1.0]\n\n'
    (tmp_path / "automatic.toml").write_text(text[:start] + rule + text[text.index("[decoder]") :])
    own = load_sensor(tmp_path / "automatic.toml")
    simulated = SimulatedSensor(own)
    for distance in (450.0, 750.0):
        capture = simulated.capture(plate(300), look_at([0, 0, distance], [0, 0, 0], [0, 1, 0]), seed=1)
        image = capture.images["camera"]
        brightest = image[np.argmax(image.mean(axis=(1, 2)))].astype(float)
        level = (np.percentile(brightest, 99.5) - 64) / (4095 - 64)
        assert np.isclose(level, 0.6, atol=0.01)


def test_an_ambient_image_holds_the_scene_s_own_light(sensor):
    """The last image is as bright as the first without the projector, and decoding leaves it out."""
    own = replace(sensor, ambient_image=True)
    lamp = {"type": "point", "position": [0.0, 0.0, 900.0], "intensity": {"type": "uniform", "value": 0.2}}
    to_world = mi.ScalarTransform4f().scale([150, 150, 1])
    face = {"type": "rectangle", "to_world": to_world, "bsdf": {"type": "matt_white"}}
    scene = scene_from_dict({"plate": face, "lamp": lamp}, 460)
    pose = look_at([0, 0, 600], [0, 0, 0], [0, 1, 0])
    simulated = SimulatedSensor(own)
    capture = simulated.capture(scene, pose, seed=1, noise=Noise.none())
    images = capture.images["camera"].astype(float) - capture.decoding.black_level_dn
    assert len(images) == 17
    dark = replace(own, projector=replace(own.projector, flux=1e-12))
    alone = SimulatedSensor(dark).capture(scene, pose, seed=1, noise=Noise.none()).images["camera"]
    assert np.abs(images[-1] + capture.decoding.black_level_dn - alone[0]).max() <= 1
    assert 0 < np.median(images[-1]) < np.median(images[0])
    cloud = capture_cloud(capture, own.settings)
    assert cloud.valid.sum() > 100000
