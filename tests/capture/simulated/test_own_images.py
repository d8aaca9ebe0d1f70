"""Projector images of the user's own: the light of a known code where they equal it, and a cloud from a new code."""

from __future__ import annotations

import re
import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import mitsim as ms
from characterisation.point_cloud import Status
from mitsim.capture.folder import read_capture, write_capture
from mitsim.capture.recordings.image_folder import read_image_folder
from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.cli.program import app
from mitsim.decoding.cloud import capture_cloud, decoder_settings, sensor_geometry
from mitsim.decoding.structured_light.decoder import decode_coordinates
from mitsim.sensor.pattern import another_mask
from mitsim.sensor.png import encode_png
from mitsim.sensor.projector_images import ProjectorImages, checked_images
from mitsim.sensor.transforms import look_at

ROOT = Path(__file__).resolve().parents[3]
STEREO = (ROOT / "tests/interface/small.toml").read_text(encoding="utf-8")
POSE = look_at((0, -300, 400), (0, 0, 20), (0, 0, 1))

GRAY = '[pattern]\nkind = "gray_code"\naxis = "columns"\n'
OWN = '[pattern]\nkind = "images"\nfolder = "code"\n'


def coded(pattern: str) -> str:
    """The small camera's left eye and its projector, as a structured-light sensor."""
    text = re.sub(r"(?ms)^\[cameras\.right\].*?(?=^\[)|^\[pattern\].*?(?=^\[)|^\[matcher\].*", "", STEREO)
    text = text.replace("active_stereo", "structured_light").replace("pixel_gap", "# pixel_gap")
    return f"{text}\n{pattern}\n[decoder]\nnear_mm = 330\nfar_mm = 950\n"


def written(folder: Path, text: str) -> Path:
    path = folder / "sensor.toml"
    path.write_text(text, encoding="utf-8")
    return path


def shot(sensor, **options):
    scene = ms.load_scene(ROOT / "scenes/two_pillars/matt_white.xml", sensor)
    return ms.render(scene, sensor, POSE, samples=2, depth=1, check=False, **options)


@pytest.fixture
def gray(tmp_path):
    return ms.load_sensor(written(tmp_path, coded(GRAY)))


def equal_images(one, other) -> bool:
    return one.images.keys() == other.images.keys() and all(
        np.array_equal(one.images[name], other.images[name]) for name in one.images
    )


def test_the_images_of_a_code_give_the_bytes_of_the_code_from_python_and_from_a_folder(gray, tmp_path):
    patterns = gray.patterns()
    folder = tmp_path / "code"
    folder.mkdir()
    for number, image in enumerate(patterns):  # 22 images: image_10 comes after image_9
        (folder / f"image_{number}.png").write_bytes(encode_png((255 * image).astype(np.uint8)))
    (folder / "read me.txt").write_text("of no concern")
    from_folder = ms.load_sensor(written(tmp_path, coded(OWN)))
    wide = (65535 * patterns).astype(np.uint16)
    known = shot(gray)
    assert len(known.images["left"]) == len(patterns) > 10
    for own in (from_folder, gray.with_patterns(patterns), gray.with_patterns(wide), gray.with_patterns(patterns > 0)):
        capture = shot(own)
        assert equal_images(capture, known)
        assert capture.decoding.pattern == from_folder.pattern.description
        assert own.pattern == from_folder.pattern


def test_an_own_mask_replaces_the_dots_of_two_cameras_and_decodes_as_they_do(tmp_path):
    sensor = ms.load_sensor(written(tmp_path, STEREO))
    own = sensor.with_patterns(sensor.patterns()[0])
    known, capture = shot(sensor), shot(own)
    assert equal_images(capture, known)
    np.testing.assert_array_equal(ms.decode(capture).points, ms.decode(known).points)
    write_capture(capture, tmp_path / "kept")  # the folder alone is decoded, too
    kept = read_capture(tmp_path / "kept")
    assert kept.decoding.pattern.kind == "images" and kept.decoding.pattern.count == 1
    np.testing.assert_array_equal(ms.decode(kept).points, ms.decode(known).points)
    other = sensor.with_patterns(np.roll(sensor.patterns()[0], 50, axis=1))
    assert other.pattern != own.pattern
    assert not equal_images(shot(other), known)


def reference_stereo() -> str:
    """The small camera's left eye and its projector, matched to a stored image."""
    text = re.sub(r"(?ms)^\[cameras\.right\].*?(?=^\[)|^\[matcher\].*", "", STEREO)
    matcher = '[matcher]\nmethod = "correlation"\nnear_mm = 330\nfar_mm = 950\nblock_size = 9\nreference_mm = 600\n'
    return text.replace("active_stereo", "reference_stereo") + matcher


def test_an_own_mask_of_one_camera_is_decoded_with_the_sensor_that_has_it(tmp_path):
    path = written(tmp_path, reference_stereo())
    sensor = ms.load_sensor(path)
    mask = (255 * sensor.patterns()[0]).astype(np.uint8)
    (tmp_path / "code").mkdir()
    (tmp_path / "code" / "mask.png").write_bytes(encode_png(mask))
    own_path = tmp_path / "own.toml"
    own_path.write_text(re.sub(r"(?ms)^\[pattern\].*?(?=^\[)", OWN + "\n", reference_stereo()), encoding="utf-8")
    own = ms.load_sensor(own_path)
    known, capture = shot(sensor), shot(own)
    expected = capture_cloud(known, sensor.settings)
    assert expected.valid.sum() > 3000
    found = capture_cloud(capture, own.settings, sensor_geometry(own))
    both = found.valid & expected.valid
    assert both.sum() > 0.95 * expected.valid.sum()  # the mask was rounded to 8 bit
    depth = np.abs(found.points - expected.points)[both][:, 2]
    assert np.median(depth) < 0.3
    np.testing.assert_array_equal(ms.decode(capture, sensor=own_path).points, found.points)
    with pytest.raises(ms.InputError, match="--sensor"):
        ms.decode(capture)
    with pytest.raises(ms.InputError, match="one, the mask"):
        own.with_patterns(np.stack([mask, mask]))


@pytest.mark.parametrize("technology", ["reference_stereo", "structured_light"])
def test_the_next_step_after_a_rendering_can_be_taken(technology, tmp_path):
    """It named a command that fails on images of one's own."""
    (tmp_path / "code").mkdir()
    text = coded(OWN)
    if technology == "reference_stereo":
        text = re.sub(r"(?ms)^\[pattern\].*?(?=^\[)", OWN + "\n", reference_stereo())
    scene = ROOT / "scenes/two_pillars/matt_white.xml"
    size = ms.load_sensor(written(tmp_path, coded(GRAY))).patterns().shape[1:]
    path = written(tmp_path, text)
    (tmp_path / "code" / "1.png").write_bytes(encode_png((np.indices(size).sum(axis=0) % 7 < 3).astype(np.uint8) * 255))
    command = f"render {scene} --sensor {path} --position 0 -300 400 --samples 1 --depth 1 -o {tmp_path}/one"
    done = CliRunner().invoke(app, command.split(), catch_exceptions=False)
    step = re.search("next: (.*)", done.stderr).group(1)
    if technology == "structured_light":
        assert step.startswith("ms.triangulate(capture, columns)")
        return
    assert step.startswith("mitsim decode ")
    taken = shlex.split(step)[1:-1]
    assert CliRunner().invoke(app, [*taken, f"{tmp_path}/cloud.ply"], catch_exceptions=False).exit_code in (0, 1)


def test_units_of_one_camera_know_their_own_masks(tmp_path):
    """One geometry, prepared for the mask of the file, decodes the captures of every unit."""
    sensor = ms.load_sensor(written(tmp_path, reference_stereo()))
    simulated, geometry = SimulatedSensor(sensor), sensor_geometry(sensor)
    scene = ms.load_scene(ROOT / "scenes/two_pillars/matt_white.xml", sensor)
    clouds = []
    for seed in (0, 21, 22):
        mask = another_mask(sensor.pattern, seed) if seed else None
        unit = simulated.recalibrated(sensor.rig, mask=mask)
        capture = unit.capture(scene, POSE, seed=1)
        assert capture.decoding.pattern.seed == (seed or sensor.pattern.seed)
        clouds.append(capture_cloud(capture, sensor.settings, geometry))
    first = clouds[0]
    for other in clouds[1:]:
        both = first.valid & other.valid
        assert both.sum() > 0.8 * first.valid.sum()
        off = (other.points - first.points)[both][:, 2]
        assert np.median(np.abs(off)) > 0 and abs(np.median(off)) < 0.2
        assert np.median(np.abs(off)) < 2  # 0.4 px at 500 mm
    assert (clouds[1].points[both] != clouds[2].points[both]).any()


def test_several_masks_are_matched_by_correlation_alone(tmp_path):
    sensor = ms.load_sensor(written(tmp_path, STEREO))
    masks = np.stack([np.roll(sensor.patterns()[0], 37 * k, axis=0) for k in range(3)])
    with pytest.raises(
        ms.InputError, match=r'3 images, for matcher.method sgbm; allowed: one. set method = "correlation"'
    ):
        sensor.with_patterns(masks)
    several = replace(sensor, matcher=sensor.matcher.model_copy(update={"method": "correlation"})).with_patterns(masks)
    capture = shot(several)
    assert len(capture.images["left"]) == 3
    assert ms.decode(capture).valid.sum() > 5000


def test_grey_levels_between_black_and_white_are_shares_of_the_light(gray):
    """51 of 255 is a fifth of the light of white."""
    height, width = gray.patterns().shape[1:]
    levels = np.array([255, 51, 0], np.uint8)
    images = np.broadcast_to(levels[:, None, None], (3, height, width))
    white, fifth, black = shot(gray.with_patterns(images), noise="none").images["left"].astype(float)
    lit = white > 20_000  # without noise, an image has 16 bits
    assert lit.sum() > 1000
    np.testing.assert_allclose((fifth - black)[lit], (white - black)[lit] / 5, atol=2)  # roundings


@pytest.mark.parametrize("noise", ["all", "none", "no-quantisation"])
def test_the_stored_imager_has_the_levels_of_the_images(n10, noise):
    capture = shot(n10, noise=noise)
    imager = capture.decoding.imager
    assert (imager.bits, imager.black_level) == (capture.bits, capture.decoding.black_level_dn)
    assert decoder_settings(capture)[1] == imager


def test_an_unknown_code_is_refused_with_what_to_do(gray, tmp_path):
    own = gray.with_patterns(gray.patterns())
    capture = shot(own)
    write_capture(capture, tmp_path / "kept")
    hint = r"found 22 images of your own.*decode capture.images\[camera\].*ms.triangulate\(capture, columns\)"
    for one in (capture, read_capture(tmp_path / "kept")):
        with pytest.raises(ms.InputError, match=hint):
            ms.decode(one)
    with pytest.raises(ms.InputError, match=hint):
        sensor_geometry(own)


def test_a_coordinate_of_ones_own_becomes_the_cloud_of_mitsims_decoder(gray):
    """The same coordinate gives the same points, whichever code showed it."""
    known = shot(gray)
    settings, imager = decoder_settings(known)
    expected = capture_cloud(known, settings, imager=imager)
    size = gray.projector.optics.width, gray.projector.optics.height
    decoded = decode_coordinates(known.images["left"], gray.pattern, size, gray.settings, full_scale=255)["columns"]
    capture = shot(gray.with_patterns(gray.patterns()))
    cloud = ms.triangulate(capture, decoded.value, sigma=decoded.sigma)
    np.testing.assert_array_equal(cloud.points, expected.points)
    np.testing.assert_array_equal(cloud.sigma, expected.sigma)
    assert cloud.valid.sum() > 4000
    np.testing.assert_array_equal(cloud.status == Status.OUT_OF_RANGE, expected.status == Status.OUT_OF_RANGE)
    assert not cloud.valid[np.isnan(decoded.value)].any()


def test_the_true_coordinate_leads_back_to_the_true_surface(gray):
    capture, truth = shot(gray, truth=True)
    seen = truth["left"]
    cloud = ms.triangulate(capture, seen.projector[..., 0])
    there = cloud.valid & seen.lit
    assert there.sum() > 4000
    # float32 of a coordinate of 640 px is 3e-5 px: 1e-3 mm here
    assert np.abs(np.linalg.norm(cloud.points - cloud.grid.origin, axis=-1) - seen.distance)[there].max() < 0.02
    near = ms.triangulate(capture, seen.projector[..., 0], range_mm=(100, 460))
    np.testing.assert_array_equal(near.valid, cloud.valid & (cloud.points[..., 2] <= np.float32(460)))


def test_rows_tell_depth_where_the_projector_is_above(tmp_path):
    above = coded(GRAY.replace("columns", "rows")).replace(
        "position_mm = [50.0, 0.0, 0.0]", "position_mm = [0, -50, 0]"
    )
    above = above.replace("rotation_deg = [0.0, -4.0, 0.0]", "")
    capture, truth = shot(ms.load_sensor(written(tmp_path, above)), truth=True)
    seen = truth["left"]
    cloud = ms.triangulate(capture, seen.projector[..., 1], axis="rows")
    there = cloud.valid & seen.lit
    assert there.sum() > 4000
    assert np.abs(cloud.points[..., 2] - seen.depth)[there].max() < 0.02
    with pytest.raises(ms.InputError, match=r"axis: found 'columns'"):  # they do not change along a view ray
        ms.triangulate(capture, seen.projector[..., 0])


def test_rows_beside_a_projector_at_the_same_height_are_refused(tmp_path):
    """0.1 px of noise moved points by 44 mm (median), where those of columns move by 0.6 mm."""
    beside = coded(GRAY).replace("position_mm = [50.0, 0.0, 0.0]", "position_mm = [50.0, 0.5, 0.0]")
    capture, truth = shot(ms.load_sensor(written(tmp_path, beside)), truth=True)
    with pytest.raises(ms.InputError, match=r"axis: found 'rows', .* 0.5 of 50 mm apart; allowed: 5 mm .*'columns'"):
        ms.triangulate(capture, truth["left"].projector[..., 1], axis="rows")
    assert ms.triangulate(capture, truth["left"].projector[..., 0]).valid.sum() > 4000


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"camera": "lefft"}, "camera: found 'lefft'; allowed: left"),
        ({"axis": "columms"}, "axis: found 'columms'; allowed: columns, rows"),
        ({"coordinate": np.zeros((3, 4))}, r"coordinate: found shape \(3, 4\); allowed: \(240, 320\)"),
        ({"sigma": np.zeros((3, 4))}, r"sigma: found shape \(3, 4\)"),
        ({"range_mm": (500, 400)}, "near before far"),
    ],
)
def test_what_cannot_be_triangulated_is_refused(options, told, gray):
    capture = shot(gray)
    with pytest.raises(ms.InputError, match=told):
        ms.triangulate(capture, **({"coordinate": np.zeros((240, 320))} | options))


def test_recorded_images_of_an_own_code_are_imported_in_order(gray, tmp_path):
    own = gray.with_patterns(gray.patterns())
    recorded = tmp_path / "recorded"
    recorded.mkdir()
    stack = np.random.default_rng(1).integers(0, 200, (22, 240, 320), np.uint8)
    for number, image in enumerate(stack):
        (recorded / f"{number}.png").write_bytes(encode_png(image))
    capture = read_image_folder(recorded, own)
    np.testing.assert_array_equal(capture.images["left"], stack)
    assert capture.decoding.pattern == own.pattern.description
    (recorded / "21.png").unlink()
    with pytest.raises(ms.InputError, match=r"found 21, 0.png to 20.png; allowed: 22"):
        read_image_folder(recorded, own)


@pytest.mark.parametrize(
    ("images", "told"),
    [
        (np.zeros((2, 8, 9)), r"shape \(2, 8, 9\); allowed: \(images, 4, 6\)"),
        (np.zeros((0, 4, 6)), r"shape \(0, 4, 6\)"),
        (np.zeros(6), r"shape \(6,\)"),
        (np.full((4, 6), 1.01), "found 1.01 to 1.01; allowed: values from 0 to 1"),
        (np.full((4, 6), np.nan), "found nan to nan"),
        (np.full((4, 6), 200), "found values of int64; allowed: uint8 or uint16"),
        (np.zeros((257, 4, 6), np.uint8), "found 257 images of 6 x 4 px; allowed: up to 256"),
    ],
)
def test_images_that_are_none_are_refused(images, told):
    with pytest.raises(ms.InputError, match=told):
        checked_images(images, 6, 4, "here")


def test_a_sensor_keeps_its_images_when_the_callers_change():
    images = np.zeros((4, 6), np.uint8)
    kept = checked_images(images, 6, 4, "here")
    images[:] = 255
    assert kept.patterns().max() == 0
    assert isinstance(kept, ProjectorImages) and "values" not in repr(kept)


SMALL, SHALLOW = np.zeros((5, 8), np.uint8), np.zeros((480, 640), np.uint8)


@pytest.mark.parametrize(
    ("images", "told"),
    [
        ({}, "no PNG image"),
        ({"a.png": encode_png(SMALL)}, r"a.png: size: found 8 x 5 px; allowed: 640 x 480 px"),
        (
            {"a.png": encode_png(SHALLOW), "b.png": encode_png(SHALLOW.astype(np.uint16))},
            r"b.png: depth: found 16 bits; allowed: 8 bits, as a.png",
        ),
        ({"a.png": encode_png(SHALLOW)[:-20]}, r"a.png"),
    ],
)
def test_a_folder_that_cannot_be_read_is_refused(images, told, tmp_path):
    sensor = written(tmp_path, coded(OWN))
    with pytest.raises(ms.InputError, match="no such folder"):
        ms.load_sensor(sensor)
    (tmp_path / "code").mkdir()
    for name, data in images.items():
        (tmp_path / "code" / name).write_bytes(data)
    with pytest.raises(ms.InputError, match=told):
        ms.load_sensor(sensor)


def test_light_that_is_modulated_in_time_takes_no_images():
    sensor = ms.load_sensor("kinect-v2")
    optics = sensor.projector.optics
    with pytest.raises(ms.InputError, match=f"found images, for {sensor.technology}"):
        sensor.with_patterns(np.zeros((optics.height, optics.width)))
