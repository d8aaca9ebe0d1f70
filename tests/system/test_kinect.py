"""The preset kinect-v2 through the whole chain: exact without noise, as noisy as published, bent by multipath."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from characterisation.features.fits import fit_sphere
from characterisation.files.errors import InputError
from characterisation.point_cloud import Status
from characterisation.region_of_interest import Roi
from mitsim.capture.folder import read_capture, write_capture
from mitsim.capture.simulated.rendering import Rendering
from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.decoding.cloud import capture_cloud, decoder_settings, sensor_geometry
from mitsim.maps.campaign.acquire import in_turn, simulated_source
from mitsim.maps.campaign.plan import read_campaign
from mitsim.maps.campaign.run import run_campaign
from mitsim.scene.backend import mi
from mitsim.scene.light_transport.light_paths import LightPaths
from mitsim.scene.light_transport.projected_codes import ModulatedLight
from mitsim.scene.light_transport.transport import trace
from mitsim.scene.load import scene_from_dict
from mitsim.scene.ray_casting.camera_rays import CameraRays
from mitsim.sensor.camera import Camera
from mitsim.sensor.modulation import LIGHT_MM_S
from mitsim.sensor.noise_sources import Noise
from mitsim.sensor.preset import load_sensor
from mitsim.sensor.projector import Projector
from mitsim.sensor.transforms import Transform, look_at

ROOT = Path(__file__).parents[2]
PRESET = ROOT / "mitsim/sensor/presets/kinect-v2.toml"
WHITE = {"type": "matt_white"}


@pytest.fixture(scope="module")
def kinect():
    return load_sensor("kinect-v2")


@pytest.fixture(scope="module")
def simulated(kinect):
    return SimulatedSensor(kinect)


@pytest.fixture(scope="module")
def geometry(kinect):
    return sensor_geometry(kinect)


def plate(size, bsdf=WHITE):
    return scene_from_dict(
        {
            "plate": {
                "type": "rectangle",
                "to_world": mi.ScalarTransform4f().scale([size, size, 1]),
                "bsdf": bsdf,
            }
        },
        860,
    )


def tilted(distance, tilt_deg):
    tilt = np.radians(tilt_deg)
    return look_at([0, -distance * np.sin(tilt), distance * np.cos(tilt)], [0, 0, 0], [0, 1, 0])


def corners(size, pose):
    return pose.inverse().points(np.array([[x, y, 0.0] for x in (-size, size) for y in (-size, size)]))


def from_the_plane(cloud, pose, size):
    """Error along the ray (H, W) [mm] of points that lie well within a plate in z = 0, NaN elsewhere."""
    rays = pose.directions(cloud.grid.rays())
    distance = -pose.translation[2] / rays[..., 2]
    inside = (np.abs(pose.translation[:2] + rays[..., :2] * distance[..., None]) < 0.9 * size).all(axis=-1)
    return np.where(inside, np.linalg.norm(cloud.points, axis=-1) - distance, np.nan)


@pytest.mark.parametrize("distance", [600.0, 2500.0, 4300.0])
@pytest.mark.parametrize("tilt", [0.0, 20.0, 45.0])
def test_a_wall_is_exact_without_noise(kinect, simulated, geometry, distance, tilt):
    """The floor: 0.01 mm of transport and decoding, from the mean path within a pixel, and the steps of 16 bits."""
    size, pose = 0.15 * distance, tilted(distance, tilt)
    capture = simulated.capture(plate(size), pose, seed=1, noise=Noise.none(), around=corners(size, pose))
    # what is told of an imager that has nothing but its steps
    steps = replace(kinect.imager, full_well=1e30, read_noise=0.0)
    cloud = capture_cloud(capture, kinect.settings, geometry, imager=steps)
    off = from_the_plane(cloud, pose, size)
    there = np.isfinite(off)
    assert there.sum() > 7000
    # besides the difference both taps are rounded, to 61439 steps in a full well where the difference has 32767
    tap = 32767 / 61439
    # nine rounding errors, each up to sqrt(3) of its standard deviation, add up to sqrt(3 * 9) of their sum's at most
    assert (np.abs(off[there]) < 0.01 + np.sqrt(27) * (1 + 2 * tap) * cloud.sigma[there]).all()
    assert off[there].std() < 0.01 + 1.05 * np.sqrt((1 + 2 * tap**2) * np.mean(cloud.sigma[there] ** 2))
    print(f"{distance:g} mm, {tilt:g} deg: flatness {off[there].std():.4f} mm, mean {off[there].mean():+.4f} mm")


def test_a_sphere_at_mid_range(kinect, simulated, geometry):
    """Radius 250 mm at 2500 mm, without noise.

    A pixel sees 6.8 mm and a lens that blurs by 0.4 px: the mean path of a bulging patch is longer than that of its
    middle. Without the blur the error is half as large.
    """
    scene = scene_from_dict({"sphere": {"type": "sphere", "radius": 250.0, "bsdf": WHITE}}, 860)
    pose = look_at([0, 0, 2500], [0, 0, 0], [0, 1, 0])
    cloud = capture_cloud(simulated.capture(scene, pose, seed=1, noise=Noise.none()), kinect.settings, geometry)
    points = cloud.points[cloud.valid].astype(float)
    cap = points[pose.points(points)[:, 2] > 125.0]
    assert len(cap) > 3000
    fit = fit_sphere(cap, viewpoint=np.zeros(3))
    assert abs(fit.radius - 250.0) < 0.15
    assert fit.residual_std < 0.15
    print(f"sphere: radius error {1000 * (fit.radius - 250):.0f} um, residual {1000 * fit.residual_std:.0f} um")


def published(distance):
    """Axial noise [mm] of a Kinect V2 indoors at normal incidence (Fankhauser et al., ICAR 2015), of ``distance`` [mm].

    Temporal and spatial, with the device's own filters on.
    """
    z = distance / 1000
    return 1.5 - 0.5 * z + 0.3 * z**2


@pytest.mark.parametrize("distance", [600.0, 1000.0, 2000.0, 3000.0, 4400.0])
def test_noise_on_matt_white_is_the_published_one(kinect, simulated, geometry, distance):
    """Within 15 % of Fankhauser's fit from 0.6 to 4.4 m; and what differs between captures is what sigma tells."""
    size, pose = 0.15 * distance, tilted(distance, 0.0)
    scene = plate(size)
    clouds = [
        capture_cloud(
            simulated.capture(scene, pose, rendering=Rendering(samples=9), seed=seed, around=corners(size, pose)),
            kinect.settings,
            geometry,
            imager=kinect.imager,
        )
        for seed in (1, 2)
    ]
    off = [from_the_plane(cloud, pose, size) for cloud in clouds]
    there = np.isfinite(off[0]) & np.isfinite(off[1])
    assert there.sum() > 9000
    assert abs(off[0][there].std() / published(distance) - 1) < 0.15
    temporal = (off[0] - off[1])[there].std() / np.sqrt(2)
    # relative standard error of a standard deviation of 9000 pixels: 0.75 %; the noise of PRNU is in neither
    assert abs(temporal / np.sqrt(np.mean(clouds[0].sigma[there] ** 2)) - 1) < 4 * 0.0075
    print(
        f"{distance:g} mm: sigma {off[0][there].std():.2f} mm, published {published(distance):.2f}; "
        f"temporal {temporal:.2f}"
    )


def corner():
    """Two matt white walls, 1200 mm wide, that meet at 90 deg in the world's z axis."""
    turn = mi.ScalarTransform4f
    along_x = turn().translate([600, 0, 0]).rotate([1, 0, 0], -90).scale([600, 600, 1])
    along_y = turn().translate([0, 600, 0]).rotate([0, 1, 0], 90).scale([600, 600, 1])
    walls = {"a": along_x, "b": along_y}
    return scene_from_dict(
        {name: {"type": "rectangle", "to_world": place, "bsdf": WHITE} for name, place in walls.items()}, 860
    )


def test_multipath_pushes_the_corner_of_two_white_walls_away(kinect, simulated, geometry):
    """As it does with real devices; of direct light alone the corner is exact."""
    scene, pose = corner(), look_at([1500, 1500, 0], [0, 0, 0], [0, 0, 1])
    rays = pose.directions(geometry.grid.rays())
    with np.errstate(divide="ignore"):
        distances = -pose.translation[:2] / rays[..., :2]
    distance = distances.min(axis=-1, where=distances > 0, initial=np.inf)
    place = pose.translation + rays * distance[..., None]
    off_edge = np.abs(place[..., 0] - place[..., 1]) / np.sqrt(2)
    row = (np.abs(place[..., 2]) < 100) & (off_edge < 700)
    error = {}
    ends = np.array([[x, y, z] for x, y in ((0, 0), (1000, 0), (0, 1000)) for z in (-110, 110)])
    for depth in (1, 2, 3):
        rendering, around = Rendering(depth=depth), pose.inverse().points(ends.astype(float))
        capture = simulated.capture(scene, pose, rendering=rendering, seed=1, noise=Noise.none(), around=around)
        cloud = capture_cloud(capture, kinect.settings, geometry)
        assert cloud.valid[row].mean() > 0.99
        error[depth] = np.linalg.norm(cloud.points, axis=-1) - distance
    away = row & (off_edge > 15)  # but for the pixels that the edge itself is in, and the blur beside them
    assert np.abs(error[1][away]).max() < 0.2
    flank, foot = row & (off_edge > 100) & (off_edge < 300), row & (off_edge > 600)
    means = {depth: (np.nanmean(error[depth][flank]), np.nanmean(error[depth][foot])) for depth in (2, 3)}
    assert 30 < means[2][0] < means[3][0] < 100
    assert max(abs(means[2][1]), abs(means[3][1])) < 0.3 * means[2][0]
    edge = np.nanmean(error[3][row & (off_edge < 10)])
    assert edge < 0.5 * means[3][0]  # the edge itself stays: all its paths are equally long
    print(
        f"corner: direct within {np.abs(error[1][away]).max():.2f} mm; beside the edge {means[2][0]:.0f} mm deeper "
        f"with two surfaces, {means[3][0]:.0f} with three"
    )


def test_path_lengths_of_two_bounces_are_those_of_an_independent_integration():
    """The light of path camera - wall a - wall b - lamp at 16, 80 and 120 MHz, against a sum over wall b in numpy."""
    scene, pose = corner(), look_at([1500, 1500, 0], [0, 0, 0], [0, 0, 1])
    matrix = np.array([[60.0, 0, 39.5], [0, 60.0, 29.5], [0, 0, 1]])
    camera = Camera(matrix, np.zeros(5), 80, 60)
    wide = np.array([[50.0, 0, 49.5], [0, 50.0, 39.5], [0, 0, 1]])
    optics = Camera(wide, np.zeros(5), 100, 80, Transform(np.eye(3), np.array([80.0, 0.0, 0.0])))
    projector = Projector(optics, 2.0)
    frequencies, delays = np.array([16e6, 80e6, 120e6]), np.array([0, 0.5 * np.pi, np.pi, 1.5 * np.pi])
    light = ModulatedLight(projector, np.repeat(frequencies, 4), np.tile(delays, 3), 1.0)
    # pixels on the wall y = 0, 100 to 500 mm from the edge
    rays = pose.directions(camera.rays(camera.pixel_grid()))
    hits = pose.translation - rays * (pose.translation[1] / rays[..., 1])[..., None]
    chosen = np.argwhere(
        (np.abs(hits[..., 2]) < 130) & (hits[..., 0] > 100) & (hits[..., 0] < 500) & (rays[..., 1] < 0)
    )
    assert len(chosen) >= 20

    (top, left), (bottom, right) = chosen.min(axis=0), chosen.max(axis=0)
    part = Roi(int(left), int(top), int(right - left) + 1, int(bottom - top) + 1)
    one, two = (
        trace(scene, CameraRays(camera), light, pose, LightPaths(samples=1024, seed=5, depth=depth), part).astype(float)
        for depth in (1, 2)
    )
    bounced = (two - one)[:, chosen[:, 0] - top, chosen[:, 1] - left].reshape(3, 4, -1)
    # sum of 2 e^(i phi) over the paths, and of 2
    phasor, total = bounced[:, 0] - bounced[:, 2] + 1j * (bounced[:, 1] - bounced[:, 3]), 0.5 * bounced.sum(axis=1)

    # the peer: midpoints of a fine grid on the wall x = 0, denser toward the edge, and four places in each pixel
    share = (np.arange(150) + 0.5) / 150
    y, width = 1200 * share**2, 1200 * 2 * share / 150
    z = -600 + 8 * (np.arange(150) + 0.5)
    wall = np.stack(np.broadcast_arrays(0.0, y[:, None], z), axis=-1).reshape(-1, 3)
    area = np.repeat(width * 8, 150)
    lamp = pose.points(optics.centre)
    to_lamp = lamp - wall
    from_lamp = np.linalg.norm(to_lamp, axis=1)
    pixels = optics.project(pose.inverse().points(wall))
    lit = ((pixels > -0.5) & (pixels < [99.5, 79.5])).all(axis=1)
    off_axis = -(to_lamp @ pose.rotation[:, 2]) / from_lamp
    irradiance = lit * projector.plane_irradiance / off_axis**3 * (to_lamp[:, 0] / from_lamp) / from_lamp**2
    albedo, gauss = 0.85 / np.pi, 0.5 / np.sqrt(3)
    peer, peer_total = np.zeros(phasor.shape, complex), np.zeros(len(chosen))
    for k, (row, column) in enumerate(chosen):
        for beside in ((-gauss, -gauss), (-gauss, gauss), (gauss, -gauss), (gauss, gauss)):
            ray = pose.directions(camera.rays(np.array([column, row]) + beside))
            point = pose.translation - ray * pose.translation[1] / ray[1]
            between = wall - point
            length = np.linalg.norm(between, axis=1)
            # out of wall a along y, into wall b along x
            coupling = between[:, 1] / length * -between[:, 0] / length / length**2 * area
            weight = 0.25 * albedo * coupling * albedo * irradiance
            path = np.linalg.norm(point - pose.translation) + length + from_lamp
            turns = np.exp(2j * np.pi * frequencies[:, None] * path / LIGHT_MM_S)
            peer[:, k] += 2 * turns @ weight
            peer_total[k] += 2 * weight.sum()
    phasor /= peer
    total /= peer_total
    # each pixel is another draw of the render's directions: their scatter tells the standard error of the mean
    count = len(chosen)
    assert np.abs(total.mean(axis=1) - 1).max() < 4 * total.std() / np.sqrt(count) + 1e-3
    assert np.abs(phasor.mean(axis=1) - 1).max() < 4 * phasor.std(axis=1).max() / np.sqrt(count) + 1e-3
    assert phasor.std(axis=1).max() / np.sqrt(count) < 0.01  # and the comparison is worth making
    path_error = np.angle(phasor.mean(axis=1)) / (2 * np.pi * frequencies) * LIGHT_MM_S
    print(
        "two bounces against numpy: light", np.round(total.mean(axis=1), 4), "path error [mm]", np.round(path_error, 2)
    )


def test_ground_metal_blinds_it_near_and_square(kinect, simulated, geometry):
    metal = {"type": "machined_metal", "metal": "aluminium", "process": "ground", "Ra": 0.4}
    shares = {}
    for distance, tilt in ((600.0, 0.0), (2500.0, 0.0), (2500.0, 20.0), (2500.0, 40.0)):
        size, pose = 0.15 * distance, tilted(distance, tilt)
        capture = simulated.capture(plate(size, metal), pose, seed=1, around=corners(size, pose))
        cloud = capture_cloud(capture, kinect.settings, geometry, imager=kinect.imager)
        rays = pose.directions(cloud.grid.rays())
        hits = pose.translation[:2] - rays[..., :2] * (pose.translation[2] / rays[..., 2])[..., None]
        inside = (np.abs(hits) < 0.95 * size).all(axis=-1)
        shares[distance, tilt] = cloud.valid[inside].mean()
        assert np.isin(cloud.status[inside & ~cloud.valid], [Status.SATURATED, Status.LOW_MODULATION]).all()
    assert shares[600.0, 0.0] < 0.3
    assert min(shares[2500.0, tilt] for tilt in (0.0, 20.0, 40.0)) > 0.95


def test_an_edge_shows_mixed_pixels(kinect, simulated, geometry):
    """A plate 150 mm before a wall: the pixels on its rim lie between the two, and are valid points like others."""
    turn = mi.ScalarTransform4f
    scene = scene_from_dict(
        {
            "wall": {"type": "rectangle", "to_world": turn().scale([700, 700, 1]), "bsdf": WHITE},
            "plate": {
                "type": "rectangle",
                "to_world": turn().translate([0, 0, 150]).scale([200, 200, 1]),
                "bsdf": WHITE,
            },
        },
        860,
    )
    pose = look_at([0, 0, 1500], [0, 0, 0], [0, 1, 0])
    cloud = capture_cloud(simulated.capture(scene, pose, seed=1, noise=Noise.none()), kinect.settings, geometry)
    height = pose.points(cloud.points[cloud.valid].astype(float))[:, 2]
    between = (height > 10) & (height < 140)
    # the plate's rim is 4 x 400 mm, a pixel there 3.7 mm: 430 pixels; one or two of each are mixed
    assert 200 < between.sum() < 1500
    assert (np.abs(height) < 1).sum() > 50_000


def test_a_capture_on_disk_knows_its_modulation(kinect, simulated, geometry, tmp_path):
    pose = tilted(1000.0, 10.0)
    capture = simulated.capture(plate(150), pose, seed=1, around=corners(150, pose))
    assert capture.images["depth"].shape == (9, 424, 512)
    assert (capture.technology, capture.bits) == ("time_of_flight", 15)
    write_capture(capture, tmp_path / "capture")
    again = read_capture(tmp_path / "capture")
    settings, imager = decoder_settings(again)
    assert (settings, imager) == (kinect.settings, kinect.imager)
    one = capture_cloud(capture, kinect.settings, geometry, imager=imager)
    other = capture_cloud(again, settings, imager=imager)
    np.testing.assert_array_equal(one.points, other.points)
    np.testing.assert_array_equal(one.status, other.status)
    assert np.isfinite(one.sigma[one.valid]).all()
    assert capture_cloud(again, settings).sigma is None
    again = replace(again, decoding=again.decoding.model_copy(update={"pattern": None}))
    with pytest.raises(InputError, match="pattern"):
        capture_cloud(again, settings)


def test_the_fixed_delays_are_the_device_s(kinect, simulated, geometry):
    """The same in every capture, gone without DSNU, and half their path in distance."""
    pose, size = tilted(1000.0, 0.0), 150.0

    def off(seed, noise):
        capture = simulated.capture(plate(size), pose, seed=seed, noise=noise, around=corners(size, pose))
        return from_the_plane(capture_cloud(capture, kinect.settings, geometry), pose, size)

    first, second = off(1, Noise.only("dsnu")), off(2, Noise.only("dsnu"))
    there = np.isfinite(first)
    assert np.abs(first - second)[there].max() == 0
    count = there.sum()
    wanted = kinect.pattern.delay_pattern_mm / 2
    # camera and lamp stand 80 mm apart: half the path is the distance within 0.2 %
    assert np.isclose(first[there].std(), wanted, rtol=4 / np.sqrt(2 * count) + 0.002)
    assert off(1, Noise.none())[there].std() < 0.05


@pytest.mark.timeout(120)
def test_a_campaign_takes_its_clouds(kinect, simulated, tmp_path):
    campaign = tmp_path / "campaign.toml"
    campaign.write_text(
        "distances_mm = [700]\nsamples_per_pixel = 4\norientations = [{ up_to_deg = 40, subdivisions = 0 }]\n"
        f'[[samples]]\nscene = "{(ROOT / "scenes/coupon/matt_white.xml").as_posix()}"\n'
    )
    plan = read_campaign(campaign, kinect)
    performance = run_campaign(plan, in_turn(simulated_source(simulated, 4), plan), tmp_path / "out")
    fraction, sigma = (performance.data[name].values for name in ("recovered_fraction", "ray_noise_std"))
    known = np.isfinite(fraction)
    assert known.any()
    assert np.nanmin(fraction) > 0.98
    assert 0.7 * published(700) < np.nanmedian(sigma) < 1.3 * published(700)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("frequencies_mhz = [16, 80, 120]", "frequencies_mhz = [80, 16, 120]", "frequencies that rise"),
        ("contrast = [0.67, 0.6, 0.5]", "contrast = [0.67, 0.6]", r"as many as there are frequencies \(3\)"),
        ("contrast = [0.67, 0.6, 0.5]", "contrast = 1.2", "less than or equal to 1"),
        ("steps = 3", "steps = 2", "greater than or equal to 3"),
        ("[demodulation]", "[decoder]", "decoder.minimum_amplitude_dn: found an unknown key"),
        ("near_mm = 400", "near_mm = 6000", "near_mm under far_mm"),
        ("black_level_dn = 16384", "black_level_dn = 0", "black_level_dn over 0, the level of a difference of 0"),
        ("black_level_dn = 16384", "black_level_dn = 70000", "black_level_dn under full scale, 32768 DN"),
        ("prnu = 0.01", "gamma = 2.2", "no ambient_image, bracket, gamma, companding"),
        ('kind = "amplitude_modulation"', 'kind = "amplitude_modulatoin"', "amplitude_modulation"),
        ('technology = "time_of_flight"', 'technology = "structured_light"', "are for time_of_flight"),
    ],
)
def test_what_is_wrong_in_the_file_is_told(tmp_path, old, new, message):
    text = PRESET.read_text()
    assert old in text
    file = tmp_path / "mine.toml"
    file.write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=message) as caught:
        load_sensor(file)
    assert str(file) in str(caught.value)
