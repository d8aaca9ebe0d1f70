"""The laboratory's light has closed forms: a plane's irradiance, geometry of projector and camera, radiosity."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from characterisation.region_of_interest import Roi
from mitsim.scene import backend
from mitsim.sensor.camera import Camera
from mitsim.sensor.projector import Projector
from mitsim.sensor.transforms import Transform
from tests.proofs.laboratory.finishes import Surface
from tests.proofs.laboratory.optics import (
    IdealProjector,
    Lamp,
    RayBundle,
    independent,
    light_on,
    mean_radiance,
    room_light_on,
    tangents,
)
from tests.proofs.laboratory.part import LaboratoryPart

REFLECTANCE, DISTANCE = 0.6, 500.0

CAMERA = Camera(
    np.array([[300.0, 0, 60.0], [0, 310.0, 44.0], [0, 0, 1]]),
    np.array([-0.4, 0.2, 1e-3, -2e-3, 0.0]),
    128,
    96,
    Transform.from_degrees([1.0, 8.0, 3.0], [-70.0, 5.0, 2.0]),
)

#: beside its axis, with distortion and pixels that are no squares
OPTICS = Camera(
    np.array([[200.0, 0, 90.0], [0, 190.0, 70.0], [0, 0, 1]]), np.array([-0.1, 0.05, 0.0, 0.0, 0.0]), 160, 120
)


@pytest.fixture(scope="module", autouse=True)
def _started():
    backend.activate()


def part_of(shapes: str, ideal: IdealProjector, folder) -> LaboratoryPart:
    """A matt part of these shapes."""
    path = folder / "part.xml"
    path.write_text(f'<scene version="3.0.0">{shapes}</scene>', encoding="utf-8")
    names = [word.split('"')[1] for word in shapes.split(" id=")[1:]] or []
    return LaboratoryPart(path, {}, {name: Surface(REFLECTANCE) for name in names}, ideal.description())


PLANE = (
    f'<shape type="rectangle" id="plane"><transform name="to_world"><scale x="900" y="900"/>'
    f'<translate z="{DISTANCE}"/></transform></shape>'
)


def lit(tmp_path, projector: Projector, patterns, optics=OPTICS, paths=112):
    """The direct light on a plane across the axis of a projector at the origin, in the camera's image."""
    ideal = IdealProjector.around(optics)
    rays = {"camera": RayBundle.of(CAMERA, Transform.identity(), Roi(0, 0, CAMERA.width, CAMERA.height))}
    lamp = Lamp(projector, optics, patterns)
    part = part_of(PLANE, ideal, tmp_path)
    direct, more = light_on(part, ideal, lamp, rays, Transform.identity(), paths, 1)["camera"]
    assert np.abs(more).max() <= 1e-6 * direct.max()  # a plane does not light itself
    return direct.reshape(-1, CAMERA.height, CAMERA.width)


def seen_by_projector() -> np.ndarray:
    """The projector's image point of what the middle of each of the camera's pixels sees, by OpenCV alone."""
    pixels = CAMERA.pixel_grid().reshape(-1, 1, 2)
    ideal = cv2.undistortPointsIter(
        pixels, CAMERA.matrix, CAMERA.distortion, np.eye(3), np.eye(3), (3, 100, 1e-12)
    ).reshape(-1, 2)
    pose = CAMERA.sensor_from_camera
    rays = np.column_stack([ideal, np.ones(len(ideal))]) @ pose.rotation.T
    points = pose.translation + rays * ((DISTANCE - pose.translation[2]) / rays[:, 2])[:, None]
    shown, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), OPTICS.matrix, OPTICS.distortion)
    return shown.reshape(CAMERA.height, CAMERA.width, 2)


@pytest.mark.parametrize("aperture", [0.0, 4.0])
def test_a_matt_plane_across_the_axis_returns_rho_e_over_pi_z_squared(tmp_path, aperture):
    projector = Projector(OPTICS, 2.0, aperture_mm=aperture, focus_mm=400.0)
    image = lit(tmp_path, projector, np.ones((1, OPTICS.height, OPTICS.width), np.float32))[0]
    expected = REFLECTANCE / np.pi * (2.0 * 200.0 * 190.0 / (160 * 120)) / DISTANCE**2
    shown = seen_by_projector()
    inside = ((shown > 3) & (shown < np.array([160, 120]) - 4)).all(axis=-1)
    assert inside.mean() > 0.3
    np.testing.assert_allclose(image[inside], expected, rtol=2e-3)


@pytest.mark.parametrize("axis", [0, 1])
def test_every_camera_pixel_sees_the_projector_coordinate_that_opencv_says(tmp_path, axis):
    extent = (160, 120)[axis]
    steps = np.arange(extent) / extent
    ramp = np.broadcast_to(steps if axis == 0 else steps[:, None], (120, 160))
    patterns = np.stack([np.ones((120, 160)), ramp]).astype(np.float32)
    white, coded = lit(tmp_path, Projector(OPTICS, 2.0, aperture_mm=3.0, focus_mm=400.0), patterns, paths=700)
    shown = seen_by_projector()
    inside = ((shown > 4) & (shown < np.array([160, 120]) - 5)).all(axis=-1)
    found = extent * coded[inside] / white[inside]
    error = found - shown[inside][:, axis]
    assert np.abs(error.mean()) < 2e-3 and np.abs(error).max() < 0.03


def test_a_plane_out_of_focus_sees_the_mean_over_the_disc_of_the_aperture(tmp_path):
    """A line of one pixel has the variance of its disc, diameter D f |1/z - 1/focus|: D^2 / 16, more than in focus."""
    line = np.zeros((1, 120, 160), np.float32)
    line[0, :, 80] = 1
    straight = replace(OPTICS, distortion=np.zeros(5))
    widths = []
    for aperture in (0.0, 30.0):
        image = lit(tmp_path, Projector(straight, 2.0, aperture_mm=aperture, focus_mm=250.0), line, straight, 700)[0]
        row = image[40:50].sum(axis=0)
        place = np.arange(len(row))
        mean = (place * row).sum() / row.sum()
        widths.append((row * (place - mean) ** 2).sum() / row.sum())
    per_pixel = 300.0 / 200.0  # camera pixels to one of the projector, at equal distance; the camera is turned a little
    disc = 30.0 * 200.0 * (1 / 250 - 1 / DISTANCE) * per_pixel
    assert widths[1] - widths[0] == pytest.approx(disc**2 / 16, rel=0.1)


def test_a_matt_plane_in_a_room_of_irradiance_one_returns_rho_over_pi(tmp_path):
    ideal = IdealProjector.around(OPTICS)
    part = part_of(PLANE, ideal, tmp_path)
    rays = {"camera": RayBundle.of(CAMERA, Transform.identity(), Roi(40, 30, 30, 20))}
    image = room_light_on(part, rays, 3)["camera"]
    assert image.mean() == pytest.approx(REFLECTANCE / np.pi, rel=0.01)


def test_light_of_two_faces_of_a_corner_is_that_of_radiosity(tmp_path):
    """Two infinite half planes at a right angle, evenly lit: B = E rho / (1 - rho / 2) at the edge of the corner."""
    ideal = IdealProjector.around(OPTICS)
    shapes = (
        '<shape type="rectangle" id="floor"><transform name="to_world"><scale x="3000" y="3000"/>'
        '<translate x="3000"/></transform></shape>'
        '<shape type="rectangle" id="wall"><transform name="to_world"><scale x="3000" y="3000"/>'
        '<rotate y="1" angle="90"/><translate z="3000"/></transform></shape>'
    )
    part = part_of(shapes, ideal, tmp_path)
    # rays of one pixel onto the floor, very near the edge; the room lights both faces with half of its irradiance
    count = 400
    rays = RayBundle(
        np.array([50.0, 0.0, 50.0]),
        np.tile(np.array([-0.99, 0.0, -1.0], np.float32), (count, 1)),
        np.zeros((count, 3), np.float32),
        np.zeros((count, 3), np.float32),
    )
    once, every = (mean_radiance(part.room, rays, 400, surfaces, 5).mean() for surfaces in (1, 12))
    assert once == pytest.approx(REFLECTANCE / np.pi / 2, rel=0.02)
    assert every / once == pytest.approx(1 / (1 - REFLECTANCE / 2), rel=0.03)


def test_images_that_are_sums_of_others_need_no_tracing():
    place = np.arange(96) * 2 * np.pi / 12
    steps = np.stack([0.5 + 0.4 * np.cos(place - 2 * np.pi * k / 8) for k in range(8)])
    bit = (np.arange(96) // 8 % 2).astype(float)
    patterns = np.stack([*steps, np.ones(96), np.zeros(96) + 0.0, bit, 1 - bit])
    images = np.repeat(patterns[:, None], 5, axis=1).astype(np.float32)
    chosen, weights = independent(images)
    assert len(chosen) == 4
    np.testing.assert_allclose(np.tensordot(weights, images[chosen], 1), images, atol=1e-5)


def test_rays_go_where_opencv_projects_back():
    pixels = CAMERA.pixel_grid().reshape(-1, 2)
    flat = tangents(CAMERA, pixels)
    back, _ = cv2.projectPoints(
        np.column_stack([flat, np.ones(len(flat))]), np.zeros(3), np.zeros(3), CAMERA.matrix, CAMERA.distortion
    )
    np.testing.assert_allclose(back[:, 0], pixels, atol=1e-6)
