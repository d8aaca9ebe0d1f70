"""One camera against a reference, with images drawn by ray casting onto planes that the decoder knows nothing of."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from characterisation.files.errors import InputError
from characterisation.point_cloud import Status
from mitsim.decoding.image_context import ImageContext
from mitsim.decoding.matching.reference_matching import decode_reference, reference_geometry
from mitsim.sensor.camera import Camera, Rig
from mitsim.sensor.matcher import MatcherSettings
from mitsim.sensor.pattern import DiffractionSpots, another_mask, dot_frames
from mitsim.sensor.transforms import Transform

WIDTH, HEIGHT, FOCAL, BASELINE, REFERENCE = 200, 120, 300.0, 75.0, 700.0
PATTERN = DiffractionSpots(kind="diffraction_spots", cell_px=9, places=3, spot_px=2.0, seed=3)
SETTINGS = MatcherSettings(
    near_mm=400, far_mm=1500, method="correlation", block_size=9, reference_mm=REFERENCE, minimum_contrast_dn=0.5
)


def make_rig(distortion=(), turn=(0.0, 0.0, 0.0)) -> Rig:
    K = np.array([[FOCAL, 0, 99.0], [0, FOCAL, 61.0], [0, 0, 1]])
    wide = np.array([[800.0, 0, 399.5], [0, 800.0, 259.5], [0, 0, 1]])
    place = Transform.from_degrees(list(turn), [BASELINE, 1.0, -2.0] if any(turn) else [BASELINE, 0.0, 0.0])
    camera = Camera(K, np.array([*distortion, *[0.0] * (5 - len(distortion))]), WIDTH, HEIGHT)
    return Rig({"infrared": camera}, Camera(wide, np.zeros(5), 800, 520, place))


def drawn(rig: Rig, normal, distance: float, pattern=PATTERN) -> np.ndarray:
    """What the camera sees of a plane n . x = n_z distance that the projector lights, 16 rays a pixel, 10 bit."""
    camera, projector = rig.reference, rig.projector
    n = np.array(normal) / np.linalg.norm(normal)
    field = dot_frames(pattern, projector.width, projector.height)[0]
    total = np.zeros((HEIGHT, WIDTH))
    for right in (np.arange(4) - 1.5) / 4:
        for down in (np.arange(4) - 1.5) / 4:
            rays = camera.rays(camera.pixel_grid() + np.array([right, down]))
            u, v = np.moveaxis(projector.project(rays * (n[2] * distance / (rays @ n))[..., None]), -1, 0)
            total += map_coordinates(field, [v, u], order=1, mode="constant")
    return np.rint(40 + 800 * total / 16).astype(np.uint16)


def decode(rig, image, settings=SETTINGS):
    geometry = reference_geometry(rig, PATTERN, REFERENCE)
    return decode_reference(image, geometry, settings, ImageContext("drawn", "simulated", 1023)), geometry


@pytest.mark.parametrize("rig", [make_rig(), make_rig((-0.1, 0.03), (0.5, -2.0, 0.3))], ids=["ideal", "real"])
@pytest.mark.parametrize(("normal", "distance"), [((0, 0, 1), 700.0), ((0, 0, 1), 930.0), ((0.2, -0.3, 1), 560.0)])
def test_planes_come_back_where_they_are(rig, normal, distance):
    cloud, geometry = decode(rig, drawn(rig, normal, distance))
    points = cloud.points[cloud.valid].astype(float)
    n = np.array(normal) / np.linalg.norm(normal)
    assert cloud.valid.mean() > 0.6  # what the reference shows at one edge and the image at the other is lost
    true = points * (n[2] * distance / (points @ n))[:, None]
    pair = geometry.pair.rectification
    axis = cloud.grid.rotation[:, 2]
    off = pair.disparity(points @ axis) - pair.disparity(true @ axis)
    kept = np.abs(off) < 0.5
    assert kept.mean() > 0.99
    # at one distance all pixels stand at one fraction of a pixel; half a step of the devices is 0.0625 px
    assert abs(off[kept].mean()) < 0.0625
    assert off[kept].std() < 0.12  # spots of less than a pixel, and a block that sees the plane squarely


def test_the_mask_of_another_device_is_decoded_by_its_own_reference():
    rig, own = make_rig(), another_mask(PATTERN, 8)
    nominal = reference_geometry(rig, PATTERN, REFERENCE)
    image, context = drawn(rig, (0, 0, 1), 930.0, own), ImageContext("drawn", "simulated", 1023)
    known = decode_reference(image, nominal.showing(own), SETTINGS, context)
    depth = known.points[known.valid][:, 2]
    assert known.valid.mean() > 0.6
    assert np.median(depth) == pytest.approx(930, abs=930**2 / (FOCAL * BASELINE) * 0.0625)
    other = decode_reference(image, nominal, SETTINGS, context)
    right = np.abs(other.points[other.valid][:, 2] - 930) < 20
    assert right.sum() < 0.1 * known.valid.sum()  # unrelated masks match by chance
    again = reference_geometry(rig, own, REFERENCE)
    np.testing.assert_array_equal(nominal.showing(own).reference, again.reference)
    assert nominal.showing(PATTERN) is nominal


def test_the_reference_plane_is_the_disparity_nought():
    rig = make_rig()
    cloud, geometry = decode(rig, drawn(rig, (0, 0, 1), REFERENCE))
    depth = cloud.points[cloud.valid][:, 2]
    assert geometry.pair.rectification.disparity(REFERENCE) == pytest.approx(0, abs=1e-9)
    assert np.median(depth) == pytest.approx(REFERENCE, abs=0.3)


def test_depths_come_in_steps_of_the_disparity_to_the_reference():
    rig = make_rig()
    cloud, _ = decode(rig, drawn(rig, (0.3, 0, 1), 800.0), SETTINGS.model_copy(update={"disparity_step": 0.125}))
    steps = 8 * FOCAL * BASELINE * (1 / cloud.points[cloud.valid][:, 2].astype(float) - 1 / REFERENCE)
    assert len(np.unique(np.rint(steps))) > 10
    np.testing.assert_allclose(steps, np.rint(steps), atol=1e-3)


def test_what_the_projector_does_not_reach_is_shadowed_or_dark_and_never_hidden():
    rig = make_rig()
    image = drawn(rig, (0, 0, 1), 700.0)
    image[:, 80:120] = 40  # a shadow: nothing there but the dark
    cloud, _ = decode(rig, image)
    assert not (cloud.status == Status.HIDDEN).any()
    shadow = cloud.status[20:100, 86:114]
    assert np.isin(shadow, [Status.SHADOWED, Status.LOW_MODULATION]).all()
    assert cloud.valid[20:100, 130:170].mean() > 0.95


def test_a_rig_that_cannot_do_it_is_refused():
    rig = make_rig()
    with pytest.raises(InputError, match="projector"):
        reference_geometry(replace(rig, projector=None), PATTERN, REFERENCE)
    to_the_left = replace(rig.projector, sensor_from_camera=Transform(np.eye(3), np.array([-75.0, 0, 0])))
    with pytest.raises(InputError, match="right"):
        reference_geometry(replace(rig, projector=to_the_left), PATTERN, REFERENCE)
    away = replace(rig.projector, sensor_from_camera=Transform.from_degrees([0, 120, 0], [75.0, 0, 0]))
    with pytest.raises(InputError, match="lights"):
        reference_geometry(replace(rig, projector=away), PATTERN, REFERENCE)
