"""The light of a whole sensor: the talk's findings on metal, the matcher's bias, speckle, the render's residual."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from characterisation.coupon.patches import measure_patches
from mitsim.capture.simulated.indirect_light import IndirectLight
from mitsim.capture.simulated.render_residual import render_residual, temporal_noise
from mitsim.capture.simulated.rendering import Rendering
from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.capture.simulated.surface_speckle import finish_contrast
from mitsim.decoding.cloud import capture_cloud, sensor_geometry
from mitsim.maps.campaign.acquire import coupon_cloud, simulated_source
from mitsim.maps.campaign.campaign_file import CampaignFile
from mitsim.maps.campaign.plan import plan_campaign
from mitsim.scene.backend import mi
from mitsim.scene.load import load_scene, scene_from_dict
from mitsim.scene.ray_casting.raycast import PixelRays, cast
from mitsim.sensor.noise_sources import Noise
from mitsim.sensor.transforms import look_at
from tests.smaller_sensors import narrow_search


@pytest.fixture(scope="module")
def simulated(n10):
    return SimulatedSensor(n10)


@pytest.fixture(scope="module")
def geometry(n10):
    return sensor_geometry(n10)


@pytest.fixture(scope="module")
def measured(n10, simulated, geometry, scenes):
    """Ra -> incidence [deg] -> (F, sigma [mm]) of ground aluminium at 600 mm, tilted across the baseline."""
    ground = (0.09, 0.37, 0.74)
    samples = [{"scene": "coupon.xml", "parameters": {"Ra": roughness}} for roughness in ground]
    bands = [{"up_to_deg": 60, "subdivisions": 0}]
    file = CampaignFile.model_validate({"distances_mm": [600], "orientations": bands, "samples": samples})
    campaign = plan_campaign(scenes / "coupon/campaign.toml", file, n10)
    take, found = simulated_source(simulated, 16), {}
    for series, roughness in zip(campaign.series, ground, strict=True):
        for incidence in (0, 10, 40, 50, 55):
            tilt = np.radians(incidence)
            shot = campaign.shot(series, np.array([0.0, np.sin(tilt), np.cos(tilt)]))
            coupon = series.sample.at(shot.sensor_from_coupon)
            cloud = coupon_cloud(take(shot), coupon, geometry, n10)
            patches = measure_patches(cloud, coupon)
            sigma = patches["ray_noise_inliers"].values
            fraction = float(patches["recovered_fraction"].mean())
            sigma = sigma[np.isfinite(sigma)]
            found[roughness, incidence] = fraction, float(np.median(sigma)) if len(sigma) else np.nan
    return found


def test_as_in_the_talk_ra_0_37_and_above_is_measurable_to_55_degrees(measured):
    for roughness in (0.37, 0.74):
        for incidence in (10, 40, 50, 55):
            assert measured[roughness, incidence][0] > 0.85


def test_as_in_the_talk_a_face_that_looks_at_the_sensor_blinds_it(measured):
    """A hole near the mirror direction, deeper the shinier."""
    assert measured[0.37, 0][0] < 0.8 < measured[0.37, 10][0]
    assert measured[0.09, 0][0] < 0.8


def test_as_in_the_talk_the_cone_of_ra_0_09_is_smaller_and_its_noise_grows(measured):
    assert measured[0.09, 10][0] > 0.85
    for incidence in (40, 50, 55):
        assert measured[0.09, incidence][0] < 0.2
    assert measured[0.09, 10][1] > 0.95 * measured[0.37, 10][1]
    assert measured[0.37, 55][1] > 1.5 * measured[0.37, 10][1]


@pytest.mark.parametrize(("distance", "tilt"), [(450, 0), (600, 20), (750, 0)])
def test_disparity_of_a_noise_free_plane_has_no_bias_but_pixel_locking(n10, simulated, geometry, distance, tilt):
    """SGBM pulls a disparity toward whole and half pixels, as everywhere; over all fractions its mean is right.

    The locking is the mean error in eighths of a pixel of the true fraction; it is 0.12 px at most, and odd about the
    half pixel, so it cancels.
    """
    to_world = mi.ScalarTransform4f().scale([900, 900, 1])
    scene = scene_from_dict({"plate": {"type": "rectangle", "to_world": to_world, "bsdf": {"type": "matt_white"}}}, 850)
    angle = np.radians(tilt)
    pose = look_at([0, -distance * np.sin(angle), distance * np.cos(angle)], [0, 0, 0], [0, 1, 0])
    searched = narrow_search(n10, 0.8 * distance, 1.25 * distance).settings
    cloud = capture_cloud(simulated.capture(scene, pose, seed=1, noise=Noise.none()), searched, geometry)
    grid, pair = cloud.grid, geometry.rectification
    surfaces = cast(scene, PixelRays.of_grid(grid), pose, np.empty((0, 3)))
    true = pair.disparity(surfaces.distance * (grid.rays() @ grid.rotation[:, 2]))
    off = pair.disparity((cloud.points - grid.origin) @ grid.rotation[:, 2]) - true
    inlier = np.isfinite(off) & (np.abs(np.where(np.isfinite(off), off, 9)) < 0.5)
    assert inlier.sum() > 0.999 * cloud.valid.sum()
    off, fraction = off[inlier], true[inlier] % 1.0
    locking = np.array([off[(fraction * 8).astype(int) == eighth].mean() for eighth in range(8)])
    assert abs(off.mean()) < 0.02
    assert abs(locking.mean()) < 0.02
    assert 0.05 < np.abs(locking).max() < 0.12
    print(f"{distance} mm, {tilt} deg: bias {off.mean():.4f} px, locking {np.round(locking, 3).tolist()}")


def flat(roughness, finish="machined_metal"):
    bsdf = {"type": finish, "metal": "aluminium", "process": "ground", "Ra": roughness}
    to_world = mi.ScalarTransform4f().scale([120, 120, 1])
    return scene_from_dict({"face": {"type": "rectangle", "to_world": to_world, "bsdf": bsdf}}, 850)


def test_speckle_has_its_contrast_and_is_one_draw_for_a_pose(n10, simulated):
    """Gain of image over image without speckle: standard deviation C, and the same for every image of the pose."""
    scene, pose = flat(0.4), look_at([0, -250, 540], [0, 0, 0], [0, 0, 1])
    camera = n10.rig.reference
    wanted = finish_contrast(scene.finishes[0], n10, camera)
    only = Noise.only("speckle")
    face = pose.inverse().points(np.array([[x, y, 0.0] for x in (-120, 120) for y in (-120, 120)]))

    def images(seed, noise):
        return simulated.capture(scene, pose, seed=seed, noise=noise, around=face).images

    one, again, other = (images(seed, only) for seed in (1, 1, 2))
    plain = images(1, Noise.none())
    assert np.array_equal(one["left"], again["left"])

    def gain(images, name):
        black = 4 * 65535 / 255
        light = plain[name][0] - black
        bright = (light > 5000) & (plain[name][0] < 50000)
        return ((images[name][0].astype(float) - black) / np.where(bright, light, 1))[bright], bright

    left, _ = gain(one, "left")
    # the code's shift and the converter add a little; C is known to 1/sqrt(2 n) = 1 %
    assert len(left) > 5000
    assert np.isclose(left.mean(), 1, atol=5 * wanted / np.sqrt(len(left)) + 0.002)
    assert np.isclose(left.std(), wanted, rtol=0.06)
    another, _ = gain(other, "left")
    assert abs(np.corrcoef(left, another)[0, 1]) < 5 / np.sqrt(len(left))
    middle = (slice(230, 250), slice(360, 390))
    sides = [(one[name][0] / np.maximum(plain[name][0], 1.0))[middle].ravel() for name in ("left", "right")]
    assert abs(np.corrcoef(*sides)[0, 1]) < 5 / np.sqrt(len(sides[0]))


def test_speckle_follows_linewidth_roughness_and_aperture(n10):
    camera = n10.rig.reference
    ground, rough, white = flat(0.4).finishes[0], flat(3.0).finishes[0], flat_white().finishes[0]
    led = finish_contrast(ground, n10, camera)
    assert finish_contrast(ground, replace(n10, linewidth_nm=None), camera) == 0
    assert finish_contrast(ground, replace(n10, linewidth_nm=0.01), camera) >= led
    assert finish_contrast(rough, n10, camera) < led
    assert finish_contrast(white, n10, camera) < 0.5 * led
    larger = replace(n10, projector=replace(n10.projector, aperture_mm=4 * n10.projector.aperture_mm))
    assert finish_contrast(ground, larger, camera) < 0.5 * led


def flat_white():
    return scene_from_dict(
        {
            "face": {
                "type": "rectangle",
                "bsdf": {"type": "matt_white"},
                "to_world": mi.ScalarTransform4f().scale([120, 120, 1]),
            }
        },
        850,
    )


@pytest.fixture
def ball(no_other_scenes):
    """A white floor and ball."""
    white = {"type": "matt_white"}
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale([100, 100, 1]), "bsdf": white}
    return scene_from_dict(
        {"floor": floor, "ball": {"type": "sphere", "radius": 40.0, "center": [0, 0, 40], "bsdf": white}}, 850
    )


def residual(simulated, scene, *rendering):
    """Of the 6600 pixels around the ball's foot, where most noise is: a ratio is known to 5 % there."""
    pose = look_at([0, -400, 300], [0, 0, 20], [0, 0, 1])
    around = pose.inverse().points(np.array([[x, y, 10.0] for x in (-45, 45) for y in (-45, 20)]))
    return render_residual(simulated, scene, pose, "left", Rendering(*rendering), seed=5, around=around)


def test_the_light_s_own_noise_is_none_at_depth_1_and_falls_with_samples_at_depth_3(simulated, ball, scenes):
    """No noise of direct light; that of interreflections falls as the root of the samples."""
    coarse, fine = residual(simulated, ball, 4, 1), residual(simulated, ball, 16, 1)
    assert coarse.noise == fine.noise == 0
    assert 0 < fine.quadrature < min(coarse.quadrature, 0.2)
    few, many = residual(simulated, ball, 1, 3), residual(simulated, ball, 4, 3)
    assert few.noise > 0
    assert np.isclose(few.noise / many.noise, 2, rtol=0.15)
    part = load_scene(scenes / "two_pillars/two_pillars.xml", 850)
    assert residual(simulated, part, 16, 1).worst < 0.2


def test_the_noise_of_interreflections_that_are_rendered_apart_falls_with_their_own_samples(simulated, ball):
    """Four times the paths halve it; with the samples of direct light it does not change."""
    few, many_paths, many_samples = (
        residual(simulated, ball, samples, 2, IndirectLight(paths, 1.5)).noise
        for samples, paths in ((1, 1), (1, 4), (4, 1))
    )
    assert few > 0.1
    assert many_paths == pytest.approx(few / 2, rel=0.15)
    assert many_samples == pytest.approx(few, rel=0.15)


@pytest.mark.usefixtures("no_other_scenes")
def test_a_flat_face_has_no_noise_of_its_own_at_depth_3(simulated):
    """With interreflections the render has noise of its own: on a coupon there are none, so there is none."""
    scene, pose = flat_white(), look_at([100, 180, 560], [0, 0, 0], [0, 0, 1])
    one, other = (simulated.radiance(scene, pose, "left", Rendering(16, 3), seed=seed)[0] for seed in (1, 2))
    assert one.max() > 0
    assert np.abs(one - other).max() == 0


def test_temporal_noise_is_what_the_imager_adds(n10, rng):
    from mitsim.sensor.image_formation import expose

    imager = replace(n10.imager, row_noise=0.0)
    images = expose(np.full((1, 300, 400), 5000.0), imager, None, Noise(), rng)
    assert np.isclose(images.std() / imager.gain, temporal_noise(np.array([5000.0]), imager)[0], rtol=0.01)
