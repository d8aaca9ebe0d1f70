"""Captures that were spoiled in one way each are said to be, by what spoiled them; whole ones are not."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from pydantic import TypeAdapter
from scipy.ndimage import gaussian_filter, map_coordinates

from characterisation.files.errors import InputError
from characterisation.point_cloud import PointCloud
from mitsim.capture.capture import Capture
from mitsim.capture.decoding import Decoding
from mitsim.decoding import coded_images
from mitsim.decoding.checks import sanity
from mitsim.decoding.checks.checked_cloud import checked_cloud
from mitsim.decoding.checks.pair_sanity import Findings, row_error_warnings
from mitsim.decoding.checks.row_texture import measured_row_error
from mitsim.decoding.checks.sanity import code_findings, row_error_in_words, with_warnings
from mitsim.decoding.cloud import capture_cloud
from mitsim.decoding.coded_images import CodedImages
from mitsim.decoding.matching.stereo_geometry import stereo_geometry
from mitsim.decoding.structured_light import decoder, two_cameras
from mitsim.decoding.structured_light.decoder import decode_coordinates
from mitsim.sensor.camera import Camera, Rig, stereo_rectification
from mitsim.sensor.decoder_settings import DecoderSettings
from mitsim.sensor.image_sequence import ImageSequence
from mitsim.sensor.imager import Imager
from mitsim.sensor.light_code import GrayCode, GrayCodePhaseShift, LightCode, PhaseShift, roles
from mitsim.sensor.matcher import MatcherSettings
from mitsim.sensor.transforms import Transform
from tests.simulated_rigs import LINES, SPECKS, images_seen, surface_seen

SETTINGS = DecoderSettings(near_mm=50, far_mm=20000)
PATTERN = TypeAdapter(LightCode)
PAIRED = DecoderSettings(near_mm=50, far_mm=20000, triangulate="cameras")


def camera(x=0.0, turn=(0.0, 0.0, 0.0), y=0.0):
    K = np.array([[260.0, 0, 110.3], [0, 260, 84.6], [0, 0, 1]])
    place = Transform.from_degrees(turn, (x, y, 0.0))
    return Camera(K, np.array([-0.1, 0.03, 0.0, 0.0, 0.0]), 220, 170, place)


def larger(eye):
    """Return a camera with three times as many pixels, and a lens that distorts more."""
    matrix, bent = np.diag([3.0, 3.0, 1.0]) @ eye.matrix, np.array([-0.3, 0.1, 0.0, 0.0, 0.0])
    return replace(eye, matrix=matrix, width=3 * eye.width, height=3 * eye.height, distortion=bent)


def projector(position=(100.0, 3.0, 5.0), turn=(0.5, -11.0, 0.3)):
    K = np.array([[270.0, 0, 127.5], [0, 270, 95.5], [0, 0, 1]])
    return Camera(K, np.zeros(5), 256, 192, Transform.from_degrees(turn, position))


def gray(axis="columns", inverse="each", **other):
    return {"show": "gray", "axis": axis, "inverse": inverse} | other


def sequence(*groups):
    return ImageSequence(kind="image_sequence", images=[{"show": g} if isinstance(g, str) else g for g in groups])


BOTH = sequence(gray(), gray("rows"), "white", "black")
ALL = sequence("white", "black", gray(inverse="all"), gray("rows", "all"))
THRESHOLD = sequence("white", "black", gray(inverse="none"))
COARSER = sequence("white", "black", gray(bits=6, inverse="none"))
COMPLEMENTARY = sequence(
    {"show": "fringes", "period_px": 16, "steps": 4}, gray(stripe_px=8, inverse="none"), "white", "black"
)
CODES = {
    "both": BOTH,
    "all": ALL,
    "threshold": THRESHOLD,
    "six bits": COARSER,
    "complementary": COMPLEMENTARY,
    "gray": GrayCode(axis="both"),
    "coarse": GrayCode(bits=5),
    "phases": PhaseShift(periods_px=[260, 40, 16]),
    "gray and phase": GrayCodePhaseShift(period_px=16),
    "heterodyne": PhaseShift(periods_px=[20, 18.6], steps=5),
}


@lru_cache(maxsize=64)
def images_of(pattern, eye, beamer, seed, **other):
    """Images of a plane with a ball before it, for the code ``pattern`` as JSON, to be read alone."""
    stack = images_seen(PATTERN.validate_json(pattern), eye, beamer, surface_seen(eye), seed=seed, **other)
    stack.flags.writeable = False
    return stack


def taken(code, cameras=None, beamer=None, **other):
    """Capture of a plane with a ball before it."""
    cameras, beamer = cameras or {"camera": camera()}, beamer or projector()
    images = {
        name: images_of(code.model_dump_json(), eye, beamer, index, **other)
        for index, (name, eye) in enumerate(cameras.items())
    }
    return Capture(
        "rig",
        "structured_light",
        "device",
        Rig(cameras, beamer),
        images,
        decoding=Decoding(pattern=code),
    )


def pair():
    return {"left": camera(), "right": camera(60.0, (0.0, -6.0, 0.0))}


def capture_findings(capture, settings):
    return code_findings(CodedImages.of(capture, settings), capture.rig, capture.source == "device")


def said(capture, settings=SETTINGS):
    return " | ".join(capture_findings(capture, settings).warnings)


def with_images(capture, order):
    return replace(capture, images={name: stack[order] for name, stack in capture.images.items()})


@pytest.mark.parametrize("name", CODES)
def test_what_is_right_is_not_spoken_of(name):
    assert said(taken(CODES[name])) == ""
    if "columns" in str(CODES[name]) or name != "threshold":
        assert said(taken(CODES[name], pair()), PAIRED) == ""


@pytest.mark.parametrize("disturbed", [{"noise": 6.0}, {"gamma": 2.2}, {"full": 4095}])
def test_noise_gamma_and_bits_are_no_reason(disturbed):
    capture = replace(taken(BOTH, **disturbed), bits=12 if "full" in disturbed else 8)
    assert said(capture) == ""


@pytest.mark.parametrize(
    ("code", "gamma"),
    [
        (PhaseShift(periods_px=[260, 40, 16], steps=3), 2.6),
        (PhaseShift(periods_px=[20, 18.6], steps=3), 0.5),
        (PhaseShift(periods_px=[20, 18.6], steps=3), 2.2),
    ],
)
def test_a_gamma_is_told_from_images_in_another_order(code, gamma):
    capture = taken(code, gamma=gamma)
    assert f"in this order if projector and camera have a gamma {'over' if gamma > 1 else 'under'} 1" in said(capture)
    order = list(range(len(roles(code, 256, 192))))
    order[1], order[3] = order[3], order[1]
    assert "check that the images are in the order of [pattern]" in said(with_images(capture, order))


def test_white_and_black_exchanged():
    capture = taken(BOTH)
    count = len(capture.images["camera"])
    assert "is darker than the black one on 100 %" in said(with_images(capture, [*range(count - 2), -1, -2]))


@pytest.mark.parametrize("plain", [0, 3, 9])
def test_white_and_black_that_are_images_of_the_code(plain):
    """The folder begins with white and black, the pattern says that it ends with them; or another image is there."""
    capture = taken(BOTH)
    count = len(capture.images["camera"])
    assert "it is not white" in said(with_images(capture, [*range(count - 2), plain, plain + 1]))
    assert "it is not white" in said(with_images(capture, [-2, -1, *range(count - 2)]))


def bits_of(code, axis="columns"):
    every = roles(code, 256, 192)
    return [i for i, role in enumerate(every) if role.axis == axis and role.kind in ("gray", "gray_inverse")]


@pytest.mark.parametrize("name", ["both", "all", "threshold", "gray", "coarse"])
def test_bits_in_the_wrong_order(name):
    """Least significant first: nearly all pixels decode, to a wrong place each."""
    code = CODES[name]
    capture = taken(code)
    every, order = roles(code, 256, 192), list(range(len(capture.images["camera"])))
    own = bits_of(code)
    last = max(every[i].index for i in own)
    for i in own:
        order[i] = next(j for j in own if every[j].kind == every[i].kind and every[j].index == last - every[i].index)
    spoiled = with_images(capture, order)
    decoded = capture_cloud(spoiled, SETTINGS)
    assert np.isin(decoded.status, [0, 3]).any()
    assert "the columns" in said(spoiled)
    assert "they fit if the bits are in the reverse order" in said(spoiled)


@pytest.mark.parametrize(("code", "other"), [(BOTH, ALL), (ALL, BOTH)])
def test_complements_in_another_order(code, other):
    """Pairs that are none look as if the exposure had changed: the order is told."""
    capture, own = taken(code), bits_of(code)
    order = list(range(len(capture.images["camera"])))
    sources = own[::2] + own[1::2] if code is BOTH else [i for each in zip(own[:8], own[8:], strict=True) for i in each]
    for i, source in zip(own, sources, strict=True):
        order[i] = source
    assert 'the complements are in another order: change inverse between "each" and "all"' in said(
        with_images(capture, order)
    )


def test_every_bit_exchanged_with_its_complement():
    capture, order = taken(BOTH), list(range(34))
    for i in bits_of(BOTH)[::2]:
        order[i], order[i + 1] = i + 1, i
    assert "every bit is exchanged with its complement" in said(with_images(capture, order))


@pytest.mark.parametrize("bits", [5, 6, 7, 8])
def test_bits_exchanged_with_their_complements_whatever_their_number(bits):
    """Of seven bits the coordinate is even enough to pass, until another order is asked."""
    capture = taken(sequence(gray(bits=bits)))
    spoiled = with_images(capture, [number ^ 1 for number in range(2 * bits)])
    assert "every bit is exchanged with its complement" in said(spoiled)


def test_columns_and_rows_exchanged():
    code = sequence(gray("rows"), gray(), "white", "black")
    spoiled = replace(taken(BOTH), decoding=Decoding(pattern=code))
    assert "they fit if columns and rows are exchanged in [pattern]" in said(spoiled)


@pytest.mark.parametrize("name", ["both", "gray and phase", "phases"])
def test_an_image_too_many_at_the_beginning_shifts_all(name):
    capture = taken(CODES[name])
    assert said(with_images(capture, [0, *range(len(capture.images["camera"]) - 1)])) != ""


def test_fringes_that_move_the_other_way():
    capture = taken(COMPLEMENTARY)
    assert "the fringes move in the other direction" in said(with_images(capture, [3, 2, 1, 0, *range(4, 11)]))


def test_exposure_that_changes_from_image_to_image():
    capture = taken(BOTH)
    stack = capture.images["camera"].copy()
    stack[6:8] = stack[6:8] // 2
    assert "Check whether the exposure was automatic" in said(replace(capture, images={"camera": stack}))


def test_bits_that_the_camera_does_not_resolve():
    """A lens out of focus mixes stripes of 1 to 4 px."""
    import cv2

    capture = taken(BOTH)
    stack = np.stack([cv2.GaussianBlur(image, (0, 0), 5.0) for image in capture.images["camera"]])
    assert "does not resolve the 3 finest bits of the columns" in said(replace(capture, images={"camera": stack}))


def test_a_baseline_along_the_code():
    """A projector over the camera whose columns are decoded: 7 mm of 100 count."""
    above = projector((8.0, -100.0, 5.0), (-11.0, 0.5, 0.3))
    assert "only 7 mm of the 100 mm" in said(taken(GrayCode(axis="columns"), beamer=above))
    assert "Project rows" in said(taken(GrayCode(axis="columns"), beamer=above))
    assert said(taken(GrayCode(axis="rows"), beamer=above)) == ""
    assert said(taken(GrayCode(axis="both"), beamer=above)) == ""


def with_rig(capture, cameras=None, beamer=None):
    return replace(capture, rig=Rig(cameras or capture.rig.cameras, beamer or capture.rig.projector))


def test_a_calibration_of_another_scene_with_two_axes():
    assert "view rays miss the light" in said(with_rig(taken(BOTH), beamer=projector((100, 3, 5), (5.0, -11.0, 0.3))))


@pytest.mark.parametrize("way", ["inverted", "sign"])
def test_other_readings_of_r_and_t_are_tried(way):
    """A projector that is rolled by 8 deg; of one that is turned about y alone the mirrored rig has depths, too."""
    rolled = projector(turn=(0.5, -11.0, 8.0))
    right = rolled.sensor_from_camera
    read = {"inverted": right.inverse(), "sign": Transform(right.rotation, -right.translation)}[way]
    words = {"inverted": "they fit if R and T go from", "sign": "they fit if T has the opposite sign"}[way]
    capture = taken(BOTH, beamer=rolled)
    assert said(capture) == ""
    assert words in said(with_rig(capture, beamer=replace(rolled, sensor_from_camera=read)))


def test_a_projector_on_the_other_side():
    """Axes are parallel, and T has the other sign: the light is met behind the camera."""
    straight = Camera(projector().matrix, np.zeros(5), 256, 192, Transform.from_degrees((0, 0, 0), (100.0, 0, 0)))
    turned = replace(straight, sensor_from_camera=Transform.from_degrees((0, 0, 0), (-100.0, 0, 0)))
    assert said(taken(GrayCode(), beamer=straight)) == ""
    assert "meet their light behind the camera" in said(with_rig(taken(GrayCode(), beamer=straight), beamer=turned))


@pytest.mark.parametrize("turn", [0.0, -6.0])
def test_cameras_exchanged(turn):
    """Of parallel cameras all lies behind them. Of converging ones it has depths like any other, and other rows."""
    capture = taken(BOTH, {"left": camera(), "right": camera(60.0, (0.0, turn, 0.0))})
    images = dict(zip(capture.images, list(capture.images.values())[::-1], strict=True))
    assert "fit the calibration if they are exchanged" in said(replace(capture, images=images), PAIRED)


def test_a_second_camera_to_the_left():
    capture = taken(BOTH, pair())
    cameras = dict(zip(("left", "right"), list(pair().values())[::-1], strict=True))
    assert "name the left camera first; or R and T are inverted" in said(with_rig(capture, cameras), PAIRED)


@pytest.mark.parametrize("off", [-1.2, -0.5, -0.15, 0.15, 0.5, 1.2])
def test_rows_of_two_cameras_by_their_code(off):
    """The second camera has turned about its x axis by so many pixels: the image of a point moves down, or up."""
    cameras = pair()
    turned = camera(60.0, (np.degrees(off / 260.0), -6.0, 0.0))
    capture = with_rig(taken(BOTH, {"left": cameras["left"], "right": turned}), cameras)
    told = said(capture, PAIRED)
    assert (told == "") == (abs(off) < 0.3)
    if told:
        measured = float(told.partition("cameras are ")[2].partition(" px")[0])
        assert abs(measured - off) < 0.12


@pytest.mark.parametrize(
    ("name", "off"),
    [("coarse", off) for off in (-2.5, -0.6, -0.1, 0.1, 0.6, 2.5)]
    + [(name, off) for name in ("gray and phase", "phases", "six bits") for off in (-0.6, 0.1)],
)
def test_rows_of_two_cameras_without_a_code_of_rows(name, off):
    """By the print of the surface, where the code has columns alone."""
    cameras = pair()
    turned = camera(60.0, (np.degrees(off / 260.0), -6.0, 0.0))
    capture = with_rig(taken(CODES[name], {"left": cameras["left"], "right": turned}), cameras)
    found = capture_findings(capture, PAIRED)
    assert found.row_error_source == "by the texture of the surface"
    assert abs(found.row_error - off) < 0.06 + 0.05 * abs(off)  # it grows toward the upper and lower end
    assert bool(found.warnings) == (abs(off) > 0.3)


@pytest.mark.parametrize("noise", [0.3, 3.0])
def test_rows_of_a_blank_surface_are_not_known(noise):
    capture = taken(CODES["phases"], pair(), texture=0.0, noise=noise)
    found = capture_findings(capture, PAIRED)
    assert (found.warnings, np.isnan(found.row_error)) == ([], True)
    assert "unknown; the code has no rows" in row_error_in_words(capture, PAIRED, found, float("nan"))
    assert row_error_in_words(capture, SETTINGS, found, float("nan")) == ""


COLUMNS = {**{f"stripes of {128 >> n}": GrayCode(bits=n + 1) for n in (2, 3, 4, 5, 6)}, "phases": CODES["phases"]}


@pytest.mark.parametrize("name", COLUMNS)
def test_columns_alone_reveal_exchanged_cameras_and_another_rig(name):
    """All three have depths like any other: only the texture of the surface, in other rows, contradicts them."""
    capture = taken(COLUMNS[name], pair(), texture=SPECKS)
    found = capture_findings(capture, PAIRED)
    assert found.warnings == []
    assert abs(found.row_error) < 0.1
    images = dict(zip(capture.images, list(capture.images.values())[::-1], strict=True))
    assert "fit the calibration if they are exchanged" in said(replace(capture, images=images), PAIRED)
    for turn, place in (((9.0, -6.0, 0.0), 60.0), ((1.0, -12.0, 4.0), 90.0)):
        other = with_rig(capture, {"left": camera(), "right": camera(place, turn)})
        assert "check that the calibration belongs to these images" in said(other, PAIRED)


@pytest.mark.parametrize("name", ["stripes of 8", "phases"])
@pytest.mark.parametrize("noise", [0.3, 3.0])
def test_a_blank_surface_gives_no_reason_to_doubt_a_pair(name, noise):
    capture = taken(COLUMNS[name], pair(), texture=0.0, noise=noise)
    assert said(capture, PAIRED) == ""


@pytest.mark.parametrize("turn", [-6.0, -20.0])
@pytest.mark.parametrize("texture", [LINES, 0.25])
def test_prints_that_repeat_give_no_reason_to_doubt_a_pair(turn, texture):
    cameras = {"left": camera(), "right": camera(60.0 - 4.0 * turn, (1.5, turn, 2.0))}
    assert said(taken(COLUMNS["stripes of 4"], cameras, texture=texture), PAIRED) == ""


@pytest.mark.parametrize("off", [0.0, 1.2])
def test_rows_of_two_cameras_by_stripes_higher_than_the_rows_compared(off):
    """The median change of the projector row over a few rows is 0; it was divided by."""
    code = sequence(gray(bits=5), gray("rows", bits=3), "white", "black")
    cameras = pair()
    turned = camera(60.0, (np.degrees(off / 260.0), -6.0, 0.0))
    capture = with_rig(taken(code, {"left": cameras["left"], "right": turned}), cameras)
    found = capture_findings(capture, PAIRED)
    assert found.row_error_source == "by the code of the rows"
    assert abs(found.row_error - off) < 0.25
    assert bool(found.warnings) == (off > 0.3)


def test_a_calibration_of_another_pair():
    capture = with_rig(taken(BOTH, pair()), {"left": camera(), "right": camera(60.0, (12.0, -6.0, 0.0))})
    assert said(capture, PAIRED) != ""


def test_a_code_of_rows_alone_is_reported_by_the_decoder_of_a_pair():
    """The import of the capture warns of nothing; its columns were looked up without a check."""
    capture = taken(sequence(gray("rows"), "white", "black"), pair())
    capture = replace(capture, decoding=capture.decoding.model_copy(update={"decoder": PAIRED}))
    assert "warnings" not in with_warnings(capture).settings
    with pytest.raises(InputError, match="columns"):
        checked_cloud(capture, PAIRED, None)


@pytest.mark.parametrize("off", [-0.8, 0.0, 0.6])
def test_rows_of_two_cameras_by_the_texture(off):
    """Two images of a textured plane, whose depth is known: what a matcher's pair is asked."""
    cameras = pair()
    turned = camera(60.0, (np.degrees(off / 260.0), -6.0, 0.0))

    def look(eye):
        x, y, _ = np.moveaxis(surface_seen(eye, ball=False, tilt=0.0), -1, 0)
        waves = np.sin(x / 4.1) * np.cos(y / 3.7) + np.sin((x + y) / 5.3) + np.cos((x - 2 * y) / 7.9)
        return np.rint(120 + 30 * waves).astype(np.uint8)

    geometry = stereo_geometry(Rig(cameras))
    rays = geometry.grid.rays_at(*np.meshgrid(np.arange(220), np.arange(170)))
    points = geometry.grid.origin + rays * (500.0 / rays[..., 2:])
    status = np.where(geometry.seen_left, 0, 1).astype(np.uint8)
    points[status > 0] = np.nan
    cloud = PointCloud(points.astype(np.float32), status, geometry.grid, "rig", "device", geometry.baseline)
    found = measured_row_error((look(cameras["left"]), look(turned)), geometry, cloud)
    assert abs(found - off) < 0.1
    assert bool(row_error_warnings(found)) == (abs(off) > 0.3)


@pytest.mark.parametrize("bent", [True, False])
def test_undistorted_images_of_a_pair_contradict_its_lenses(bent):
    """The median row error is near 0, so that a plane at 600 mm was at 583 mm without a word."""
    cameras = {"left": larger(camera()), "right": larger(camera(60.0))}
    seen_by = cameras if bent else {name: replace(eye, distortion=np.zeros(5)) for name, eye in cameras.items()}
    specks = gaussian_filter(np.random.default_rng(0).normal(size=(1024, 1024)), 2.0, mode="wrap")
    images = {}
    for name, eye in seen_by.items():
        x, y, _ = np.moveaxis(surface_seen(eye, ball=False, tilt=0.0), -1, 0)
        printed = map_coordinates(specks / specks.std(), [y / 0.4 + 512, x / 0.4 + 512], order=1, mode="grid-wrap")
        images[name] = np.rint(np.clip(120 + 40 * printed, 0, 254)).astype(np.uint8)[None]
    settings = MatcherSettings(near_mm=400, far_mm=650)
    capture = Capture(
        "pair", "active_stereo", "device", Rig(cameras), images, decoding=Decoding(near_mm=400, far_mm=650)
    )
    found = checked_cloud(capture, settings, None).warnings
    assert bool(found) != bent, found
    assert bent or "not undistorted" in found[0]


@pytest.mark.parametrize("paired", [False, True])
def test_cloud_and_checks_decode_the_images_once(monkeypatch, paired):
    """The cloud is that of the images alone, and no stack is decoded a second time."""
    capture = taken(BOTH, pair() if paired else None)
    settings = PAIRED if paired else SETTINGS
    alone, stacks = capture_cloud(capture, settings), []

    def counted(stack, *rest, **options):
        stacks.append(stack.shape)
        return decode_coordinates(stack, *rest, **options)

    for module in (coded_images, decoder, two_cameras):
        monkeypatch.setattr(module, "decode_coordinates", counted)
    decoded = checked_cloud(capture, settings, None)
    assert stacks == [stack.shape for stack in capture.images.values()]
    assert decoded.warnings == ()
    np.testing.assert_array_equal(decoded.cloud.points, alone.points)
    np.testing.assert_array_equal(decoded.cloud.status, alone.status)


@pytest.mark.parametrize("technology", ["structured_light", "active_stereo"])
def test_cloud_and_checks_share_the_geometry_of_a_pair(monkeypatch, technology):
    """Maps of rectified images take longer than some decoders."""
    capture, settings = taken(BOTH, pair()), PAIRED
    if technology == "active_stereo":
        images = {name: stack[:1] for name, stack in capture.images.items()}
        capture = replace(capture, technology=technology, images=images, decoding=Decoding())
        settings = MatcherSettings(near_mm=300, far_mm=2000)
    prepared = []
    patched = "mitsim.decoding.matching.stereo_geometry.stereo_rectification"
    monkeypatch.setattr(patched, lambda *eyes: prepared.append(1) or stereo_rectification(*eyes))
    checked_cloud(capture, settings, None)
    assert len(prepared) == 1


def test_an_import_checks_with_the_noise_of_the_imager_of_its_settings(monkeypatch):
    imager = Imager(5, 0.5, 10000, 12, bits=8, f_number=4)
    stated = Decoding(pattern=CODES["phases"], decoder=SETTINGS, imager=imager)
    capture, used = replace(taken(CODES["phases"]), decoding=stated), []
    monkeypatch.setattr(sanity, "code_findings", lambda images, *rest: used.append(images.noise) or Findings())
    with_warnings(capture)
    assert used == [imager]
