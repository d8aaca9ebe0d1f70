"""Folders of images of any rig: what is read, in which order, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from characterisation.files.errors import InputError
from mitsim.capture.folder import read_capture, write_capture
from mitsim.capture.grey_image import CHANNELS, read_grey
from mitsim.capture.recordings.image_folder import advice_on_number, read_image_folder
from mitsim.cli.program import app
from mitsim.decoding.cloud import capture_cloud, decoder_settings
from mitsim.sensor.light_code import patterns, value
from mitsim.sensor.preset import load_sensor
from mitsim.sensor.projector_images import counted, gap_in, read_images

HEAD = """
name = "rig"
technology = "structured_light"
wavelength_nm = 550
working_range_mm = [300, 900]
"""
CAMERA = "width = 64\nheight = 48\nfocal_px = [80.0, 80.0]\nprincipal_px = [31.5, 23.5]\n"
TAIL = """
[projector]
width = 128
height = 96
focal_px = [150.0, 150.0]
principal_px = [63.5, 47.5]
position_mm = [100.0, 0.0, 0.0]
rotation_deg = [0, -10, 0]
flux_w = 1.0

[imager]
pixel_um = 5
quantum_efficiency = 0.5
full_well_e = 10000
read_noise_e = 5
bits = BITS
f_number = 4

[exposure]
rule = "fixed"
exposure_s = 0.01

[decoder]
near_mm = 300
far_mm = 900
"""
PATTERN = """
[pattern]
kind = "image_sequence"
images = [
    { show = "gray", first = "least_significant", inverse = "all" },
    { show = "gray", axis = "rows", inverse = "each" },
    { show = "white" },
    { show = "black" },
]
"""


def rig(folder, *, extra="", bits=8, cameras=("camera",), pattern=PATTERN, tail=""):
    text = HEAD + "".join(
        f"[cameras.{name}]\n{CAMERA}position_mm = [{60.0 * index}, 0, 0]\n" for index, name in enumerate(cameras)
    )
    text += TAIL.replace("BITS", str(bits)) + tail + pattern + extra
    (folder / "rig.toml").write_text(text, encoding="utf-8")
    return load_sensor(folder / "rig.toml")


def see_plane(sensor, name="camera", depth=500.0):
    """Images (P, H, W) of a plane z = depth, by exact projection: no renderer."""
    camera, projector = sensor.rig.cameras[name], sensor.rig.projector
    rays = camera.rays(camera.pixel_grid())
    place = projector.project(camera.centre + rays * (depth / rays[..., 2:]))
    out = []
    for role in sensor.pattern.roles(projector.width, projector.height):
        at = place[..., 1 if role.axis == "rows" else 0]
        out.append(20 + 200 * value(sensor.pattern, role, at))
    return np.rint(out).astype(np.uint8)


def save(folder, stack, name="image_{}.png"):
    folder.mkdir(exist_ok=True, parents=True)
    for index, image in enumerate(stack):
        (folder / name.format(index)).write_bytes(cv2.imencode(Path(name).suffix, image)[1].tobytes())
    return folder


@pytest.mark.parametrize("suffix", ["png", "tif", "tiff", "bmp", "pgm", "PNG"])
def test_a_folder_becomes_a_capture_and_a_cloud(tmp_path, suffix):
    """Numbers without leading zeros: image_2 comes before image_10. A stripe of 1 px is worth about 22 mm of depth."""
    sensor = rig(tmp_path)
    stack = see_plane(sensor)
    folder = save(tmp_path / "images", stack, f"image_{{}}.{suffix}")
    (folder / "notes.txt").write_text("no image")
    capture = read_image_folder(folder, sensor)
    np.testing.assert_array_equal(capture.images["camera"], stack)
    assert capture.source == "device"
    write_capture(capture, tmp_path / "capture")
    again = read_capture(tmp_path / "capture")
    settings, imager = decoder_settings(again)
    assert settings == sensor.decoder
    assert imager is None
    cloud = capture_cloud(again, settings)
    assert cloud.valid.mean() > 0.9
    assert np.abs(cloud.points[cloud.valid][:, 2] - 500).max() < 22


def test_lossy_images_decode_to_the_same_place_but_for_single_stripes(tmp_path):
    sensor = rig(tmp_path)
    capture = read_image_folder(save(tmp_path / "images", see_plane(sensor), "image_{}.jpg"), sensor)
    cloud = capture_cloud(capture, sensor.settings)
    assert cloud.valid.mean() > 0.3
    assert np.median(np.abs(cloud.points[cloud.valid][:, 2] - 500)) < 22


def test_twelve_bits_come_in_files_of_sixteen(tmp_path):
    sensor = rig(tmp_path, bits=12)
    stack = see_plane(sensor).astype(np.uint16) * 16
    capture = read_image_folder(save(tmp_path / "images", stack), sensor)
    assert capture.bits == 12
    np.testing.assert_array_equal(capture.images["camera"], stack)
    left = read_image_folder(save(tmp_path / "left", stack * 16), sensor)
    np.testing.assert_array_equal(left.images["camera"], stack)
    assert left.settings["empty_bits"] == 4
    with pytest.raises(InputError, match=r"imager.bits is 12"):
        read_image_folder(save(tmp_path / "odd", stack * 16 + 1), sensor)
    with pytest.raises(InputError, match=r"image_0.png: depth: found 8 bits"):
        read_image_folder(save(tmp_path / "eight", see_plane(sensor)), sensor)


def test_grey_saved_as_colour_is_read_and_of_colour_one_channel_is_taken(tmp_path):
    sensor = rig(tmp_path)
    stack = see_plane(sensor)
    folder = save(tmp_path / "images", np.repeat(stack[..., None], 3, axis=3))
    capture = read_image_folder(folder, sensor)
    np.testing.assert_array_equal(capture.images["camera"], stack)
    assert "channel" not in capture.settings
    coloured = np.stack([stack // 3, stack, stack // 2], axis=-1)  # OpenCV's order: blue, green, red
    save(folder, coloured)
    capture = read_image_folder(folder, sensor)
    np.testing.assert_array_equal(capture.images["camera"], stack)
    assert capture.settings["channel"] == "green"
    capture = read_image_folder(folder, sensor, CHANNELS["red"])
    np.testing.assert_array_equal(capture.images["camera"], stack // 2)
    assert capture.settings["channel"] == "red"


def test_two_cameras_in_subfolders_or_by_name_or_as_listed(tmp_path):
    """The clouds of all three are the same, and the plane is where it is although nobody calibrated the projector."""
    code = '[pattern]\nkind = "gray_code_phase_shift"\nperiod_px = 16\n'
    tail = 'triangulate = "cameras"\n'
    sensor = rig(tmp_path, cameras=("left", "right"), pattern=code, tail=tail)
    projector = sensor.rig.projector
    stacks = {}
    for name, camera in sensor.rig.cameras.items():
        rays = camera.rays(camera.pixel_grid())
        place = projector.project(camera.centre + rays * (500.0 / rays[..., 2:]))[..., 0]
        shown = patterns(sensor.pattern, projector.width, projector.height)[:, 0, :]
        columns = np.arange(projector.width)
        stacks[name] = np.stack([np.interp(place, columns, row) for row in shown])
        stacks[name] = np.rint(20 + 200 * stacks[name]).astype(np.uint8)
        save(tmp_path / "subfolders" / name, stacks[name])
        save(tmp_path / "names", stacks[name], f"{name}_{{}}.png")
        save(tmp_path / "listed", stacks[name], f"cam{name[0]}-{{}}.png")
    listed = [f"caml-{index}.png" for index in range(len(stacks["left"]))]
    extra = f'[images]\nleft = {listed}\nright = "camr-*.png"\n'.replace("'", '"')
    own = rig(tmp_path, cameras=("left", "right"), pattern=code, tail=tail, extra=extra)
    for folder, with_sensor in (("subfolders", sensor), ("names", sensor), ("listed", own)):
        capture = read_image_folder(tmp_path / folder, with_sensor)
        for name, stack in stacks.items():
            np.testing.assert_array_equal(capture.images[name], stack)
    settings, _ = decoder_settings(capture)
    cloud = capture_cloud(capture, settings)
    assert cloud.valid.mean() > 0.3
    assert np.abs(cloud.points[cloud.valid][:, 2] - 500).max() < 5


def test_an_ambient_image_is_counted_and_kept(tmp_path):
    text = HEAD.replace("wavelength", "ambient_image = true\nwavelength")
    rig(tmp_path)
    path = tmp_path / "rig.toml"
    path.write_text(path.read_text().replace(HEAD, text))
    sensor = load_sensor(path)
    stack = see_plane(sensor)
    with pytest.raises(InputError, match=r"30, image_0.png to image_29.png; allowed: 31"):
        read_image_folder(save(tmp_path / "images", stack), sensor)
    capture = read_image_folder(save(tmp_path / "images", [*stack, stack[0]]), sensor)
    assert len(capture.images["camera"]) == 31
    assert capture_cloud(capture, sensor.settings).valid.mean() > 0.9


@pytest.fixture
def whole(tmp_path):
    sensor = rig(tmp_path)
    return sensor, save(tmp_path / "images", see_plane(sensor))


def damage_missing(folder):
    (folder / "image_7.png").unlink()


def damage_extra(folder):
    cv2.imwrite(str(folder / "preview.png"), np.zeros((48, 64), np.uint8))


def damage_size(folder):
    cv2.imwrite(str(folder / "image_4.png"), np.zeros((48, 63), np.uint8))


def damage_depth(folder):
    cv2.imwrite(str(folder / "image_4.png"), np.zeros((48, 64), np.uint16))


def damage_half(folder):
    data = (folder / "image_4.png").read_bytes()
    (folder / "image_4.png").write_bytes(data[: len(data) // 2])


def damage_text(folder):
    (folder / "image_4.png").write_text("no image")


def damage_empty(folder):
    (folder / "image_4.png").write_bytes(b"")


def damage_float(folder):
    cv2.imwrite(str(folder / "image_4.tif"), np.zeros((48, 64), np.float32))
    (folder / "image_4.png").unlink()


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (damage_missing, "29, image_0.png to image_29.png; allowed: 30.*number 7 is missing"),
        (damage_extra, "found 31, .*allowed: 30"),
        (damage_size, "image_4.png: size: found 63 x 48 px; allowed: 64 x 48 px"),
        (damage_depth, "image_4.png: depth: found 16 bits; allowed: 8"),
        (damage_half, "image_4.png"),
        (damage_text, "image_4.png: found a file that is not an image"),
        (damage_empty, "image_4.png: size: found 0 bytes"),
        (damage_float, "image_4.tif: depth: found float32"),
    ],
)
def test_what_is_wrong_with_a_folder_is_said_once_with_the_file(whole, damage, message):
    sensor, folder = whole
    damage(folder)
    with pytest.raises(InputError, match=message):
        read_image_folder(folder, sensor)


@pytest.mark.parametrize(
    ("files", "message"),
    [
        ('camera = "frame_*.png"', "no file that matches 'frame_.*the folder has: image_0.png"),
        ('camera = ["image_0.png", "image_99.png"]', "image_99.png: found no such file"),
        ('camera = ["image_0.png"]', "found 1, image_0.png to image_0.png; allowed: 30"),
        ('camera = "../*.png"', "a pattern inside the folder"),
        ('left = "*.png"', "images of left: the cameras are camera"),
    ],
)
def test_names_that_lead_nowhere_are_refused(whole, tmp_path, files, message):
    with pytest.raises(InputError, match=message):
        read_image_folder(whole[1], rig(tmp_path, extra=f"[images]\n{files}\n"))


def test_a_folder_that_is_not_there_and_a_sensor_without_a_code_are_refused(tmp_path):
    with pytest.raises(InputError, match="no such folder"):
        read_image_folder(tmp_path / "nowhere", rig(tmp_path))
    with pytest.raises(InputError, match=r"active_stereo.*without --sensor"):
        read_image_folder(tmp_path, load_sensor("ensenso-n10"))


def test_the_command_imports_with_a_sensor_file(whole, tmp_path):
    from typer.testing import CliRunner

    folder, out = whole[1], tmp_path / "capture"
    done = CliRunner().invoke(app, ["import", str(folder), "--sensor", str(tmp_path / "rig.toml"), "-o", str(out)])
    assert done.exit_code == 0, done.output
    done = CliRunner().invoke(app, ["decode", str(out), "-o", str(tmp_path / "cloud.ply")])
    assert done.exit_code == 0, done.output
    assert "valid" in done.output


@given(
    st.lists(st.integers(0, 10**6), unique=True, min_size=1), st.sampled_from(["a{}.png", "{}x.png", "i_{:04d}.png"])
)
def test_names_are_sorted_as_people_count(numbers, name):
    files = [Path(name.format(number)) for number in numbers]
    assert sorted(files, key=counted) == [Path(name.format(number)) for number in sorted(numbers)]


@given(st.binary(max_size=200))
def test_bytes_that_are_no_image_never_end_in_a_traceback(tmp_path_factory, data):
    path = tmp_path_factory.mktemp("bytes") / "image.png"
    path.write_bytes(data)
    with pytest.raises(InputError):
        read_grey(path)


@pytest.mark.parametrize(
    ("names", "told"),
    [
        ("{:02d}.png*19", "write ambient_image = true, if the last has no light; or correct"),
        ("{:02d}.png*18 cover.png", "cover.png differs in name from the 18 images needed: write"),
        ("{:02d}.png*9 11.png", "number 9, 10 is missing"),
        (
            "{:02d}.png*90",
            "correct [pattern], or name the files in [images] of the sensor file, or by --images camera=",
        ),
    ],
)
def test_another_number_of_images_is_explained(names, told):
    plain, *others = names.split(" ")
    shape, number = plain.split("*")
    found = [Path(shape.format(index)) for index in range(int(number))] + [Path(name) for name in others]
    assert advice_on_number(found, "camera", 18, ambient_image=False).startswith(told)


def test_a_gap_in_the_numbers_of_a_full_series_is_told(whole):
    sensor, folder = whole
    assert "warnings" not in read_image_folder(folder, sensor).settings
    (folder / "image_29.png").rename(folder / "image_30.png")
    (told,) = read_image_folder(folder, sensor).settings["warnings"]
    assert told == "images of camera: number 29 is missing"
    listed = replace(sensor, images={"camera": [*(f"image_{k}.png" for k in range(29)), "image_30.png"]})
    assert "warnings" not in read_image_folder(folder, listed).settings


def test_a_gap_in_the_images_of_a_projector_is_told(tmp_path, capsys):
    for number in (1, 2, 4):
        cv2.imwrite(str(tmp_path / f"{number}.png"), np.zeros((48, 64), np.uint8))
    assert read_images(tmp_path, 64, 48).count == 3
    assert "number 3 is missing among 3 images" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("names", "gap"),
    [
        ("a 1.png, a 3.png", "number 2 is missing"),
        ("a 1.png, a 2.png", ""),
        ("a 1.png, b 1.png, a 3.png", ""),  # two series
        ("black.png, a 1.png, a 3.png", ""),
        ("20261128235100.png, 20261129000200.png, 99999999999999999999.png", ""),  # times, not counts
    ],
)
def test_a_gap_is_that_of_a_count(names, gap):
    assert gap_in([Path(name) for name in names.split(", ")]) == gap


def test_a_folder_of_other_cameras_says_what_is_in_it(tmp_path):
    sensor = rig(tmp_path)
    (tmp_path / "images" / "cam0").mkdir(parents=True)
    with pytest.raises(InputError, match=r"found 0; allowed: 30.*the folder has: cam0/. name the files"):
        read_image_folder(tmp_path / "images", sensor)
