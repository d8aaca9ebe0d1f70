"""Capture folders: what is written is read back, and what is damaged is refused in words."""

import hashlib
import io
import json
import shutil
import tempfile
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from characterisation.files import atomic_io, checked_files
from characterisation.files.checked_files import content_checksum
from characterisation.files.errors import InputError
from characterisation.region_of_interest import Roi
from mitsim.capture import folder
from mitsim.capture.capture import Capture
from mitsim.capture.capture_document import capture_schema, schema_text
from mitsim.capture.decoding import Decoding
from mitsim.capture.folder import read_capture, write_capture
from mitsim.capture.npy import decode_npy, encode_npy
from mitsim.sensor.camera import Camera, Rectification, Rig
from mitsim.sensor.png import decode_png, encode_png
from mitsim.sensor.transforms import Transform

WIDTH, HEIGHT = 24, 16


def example(dtype=np.uint8, bits: int = 8) -> Capture:
    rng = np.random.default_rng(1)
    K = np.array([[30.1, 0.02, 11.7], [0, 30.3, 8.1], [0, 0, 1]])
    right = Transform.from_degrees([0.1, -5, 0.2], [60.0, 0.3, 2.5])
    left = Camera(K, np.array([-0.2, 0.1, 1e-4, 2e-4, 0.01]), WIDTH, HEIGHT)
    cameras = {"left": left, "right": replace(left, sensor_from_camera=right)}
    projector = Camera(K, np.zeros(0), 100, 80, Transform.identity(), "perspective")
    rectification = Rectification(K * [1, 0, 1] + np.diag([0, 30.3, 0]), K, np.eye(3), right.rotation.T, 60.1, 24, 16)
    images = {n: rng.integers(0, 2**bits, (2, HEIGHT, WIDTH)).astype(dtype) for n in cameras}
    return Capture(
        "test-sensor",
        "active_stereo",
        "emulator",
        Rig(cameras, projector, rectification),
        images,
        bits,
        Decoding(exposure_s=0.1 + 0.2, pattern=None, read_out={"left": Roi(1, 2, 16, 8)}, near_mm=250.0),
        {"projector_on": True, "note": "µm", "list": [1, None]},
        Transform.from_degrees([10, 20, 30], [1, 2, 1e-3]),
        "42",
        maps(),
    )


def maps() -> dict[str, np.ndarray]:
    """One map of each kind, with a hole in it."""
    rng = np.random.default_rng(2)
    depth, disparity = (rng.uniform(1, 1000, (HEIGHT, WIDTH)).astype(np.float32) for _ in range(2))
    points = rng.normal(size=(HEIGHT, WIDTH, 3)).astype(np.float32)
    for values in (depth, disparity, points):
        values[3, 4] = np.nan
    return {"depth": depth, "disparity": disparity, "points": points}


def assert_same(a: Capture, b: Capture) -> None:
    for name in ("sensor", "technology", "source", "bits", "decoding", "settings", "serial"):
        assert getattr(a, name) == getattr(b, name)
    assert (a.world_from_sensor is None) == (b.world_from_sensor is None)
    if a.world_from_sensor and b.world_from_sensor:
        np.testing.assert_array_equal(a.world_from_sensor.matrix(), b.world_from_sensor.matrix())
    assert list(a.derived) == list(b.derived)
    for name, values in a.derived.items():
        assert b.derived[name].dtype == np.float32
        np.testing.assert_array_equal(values, b.derived[name])
    assert list(a.images) == list(b.images)
    for name, stack in a.images.items():
        assert stack.dtype == b.images[name].dtype
        np.testing.assert_array_equal(stack, b.images[name])
    assert list(a.rig.cameras) == list(b.rig.cameras)
    pairs = [*zip(a.rig.cameras.values(), b.rig.cameras.values(), strict=True), (a.rig.projector, b.rig.projector)]
    for one, other in pairs:
        assert (one is None) == (other is None)
        if one and other:
            assert (one.width, one.height, one.model) == (other.width, other.height, other.model)
            np.testing.assert_array_equal(one.matrix, other.matrix)
            np.testing.assert_array_equal(one.distortion, other.distortion)
            np.testing.assert_array_equal(one.sensor_from_camera.matrix(), other.sensor_from_camera.matrix())
    assert (a.rig.rectification is None) == (b.rig.rectification is None)
    if a.rig.rectification and b.rig.rectification:
        for name, value in vars(a.rig.rectification).items():
            np.testing.assert_array_equal(value, getattr(b.rig.rectification, name))


@pytest.mark.parametrize(("dtype", "bits"), [(np.uint8, 8), (np.uint16, 12), (np.uint16, 16)])
def test_round_trip(tmp_path, dtype, bits):
    capture = example(dtype, bits)
    written = write_capture(capture, tmp_path / "a" / "capture_0007")
    assert_same(capture, read_capture(written))
    assert sorted(p.name for p in (tmp_path / "a").iterdir()) == ["capture_0007"]  # nothing left beside it


def test_what_is_not_known_stays_unknown(tmp_path):
    capture = replace(
        example(),
        world_from_sensor=None,
        serial="",
        rig=Rig(example().rig.cameras),
        settings={},
        derived={},
    )
    assert_same(capture, read_capture(write_capture(capture, tmp_path / "c")))


def test_vendor_files_are_kept_as_they_are(tmp_path):
    original = bytes(range(256))
    written = write_capture(example(), tmp_path / "c", vendor={"1_left.png": original, "sub/a.json": b"{}"})
    assert (written / "vendor" / "1_left.png").read_bytes() == original
    assert (written / "vendor" / "sub" / "a.json").read_bytes() == b"{}"
    assert_same(example(), read_capture(written))


@pytest.mark.parametrize("name", ["../a", "/etc/a", "a/../../b", "", "a b", "..", ".hidden"])
def test_vendor_names_stay_inside(tmp_path, name):
    with pytest.raises(InputError):
        write_capture(example(), tmp_path / "c", vendor={name: b""})
    assert list(tmp_path.iterdir()) == []


def test_a_capture_is_replaced_only_when_told(tmp_path):
    first, second = example(), replace(example(), serial="43")
    path = write_capture(first, tmp_path / "c")
    with pytest.raises(InputError, match="an existing capture"):
        write_capture(second, path)
    assert_same(first, read_capture(path))
    write_capture(second, path, overwrite=True)
    assert_same(second, read_capture(path))
    assert [p.name for p in tmp_path.iterdir()] == ["c"]


def test_what_is_no_capture_is_never_replaced(tmp_path):
    precious = tmp_path / "c" / "thesis.txt"
    precious.parent.mkdir()
    precious.write_text("years")
    with pytest.raises(InputError, match="not a capture"):
        write_capture(example(), tmp_path / "c", overwrite=True)
    assert precious.read_text() == "years"
    with pytest.raises(InputError, match="not a capture"):
        write_capture(example(), precious, overwrite=True)


def test_an_empty_folder_may_be_filled(tmp_path):
    (tmp_path / "c").mkdir()
    assert_same(example(), read_capture(write_capture(example(), tmp_path / "c")))


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_failure_in_the_middle_leaves_things_as_they_were(tmp_path, monkeypatch, overwrite):
    if overwrite:
        write_capture(example(), tmp_path / "c")
    write, calls = atomic_io._write_synced, []

    def fail_at_the_third(file, data):
        calls.append(file)
        if len(calls) == 3:
            raise OSError(28, "No space left on device")
        write(file, data)

    monkeypatch.setattr(atomic_io, "_write_synced", fail_at_the_third)
    with pytest.raises(OSError, match="No space left"):
        write_capture(replace(example(), serial="43"), tmp_path / "c", overwrite=overwrite)
    assert [p.name for p in tmp_path.iterdir()] == (["c"] if overwrite else [])
    if overwrite:
        assert_same(example(), read_capture(tmp_path / "c"))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"settings": {"a": float("nan")}}, "settings"),
        ({"settings": {"a": {1, 2}}}, "settings"),
        ({"settings": {"a": (1, 2)}}, "settings"),
        ({"settings": {1: 2}}, "settings"),
        ({"bits": 17}, "bits"),
        ({"bits": 5}, "pixel value"),
        ({"world_from_sensor": Transform(2 * np.eye(3), np.zeros(3))}, "world_from_sensor"),
        ({"world_from_sensor": Transform(np.eye(3), np.array([0, 0, np.nan]))}, "world_from_sensor"),
        ({"images": {"left": np.zeros((1, HEIGHT, WIDTH), np.int32)}}, "images.left"),
        ({"images": {"left": np.zeros((0, HEIGHT, WIDTH), np.uint8)}}, "images.left"),
        ({"derived": {"depth": np.full((2, 2), np.inf, np.float32)}}, "derived.depth"),
        ({"derived": {"depth": np.zeros((0, 2), np.float32)}}, "derived.depth"),
    ],
)
def test_what_could_not_be_read_back_is_not_written(tmp_path, change, message):
    with pytest.raises(InputError, match=message):
        write_capture(replace(example(), **change), tmp_path / "c")
    assert list(tmp_path.iterdir()) == []


def rewrite(folder: Path, name: str, change) -> None:
    """Change a JSON file of a capture as another program could, checksums and all."""
    table = json.loads((folder / name).read_text())
    change(table)
    (folder / name).write_text(json.dumps(table))
    reseal(folder)


def reseal(folder: Path) -> None:
    index = json.loads((folder / "capture.json").read_text())
    for entry in index["files"] if isinstance(index.get("files"), list) else []:
        file = folder / entry["path"]
        if file.is_file():
            entry["sha256"] = hashlib.sha256(file.read_bytes()).hexdigest()
    if "checksum" in index:
        index["checksum"] = content_checksum(index)
    (folder / "capture.json").write_text(json.dumps(index))


#: place of the last image among the files, three maps being written after it
LAST_IMAGE = -4


def set_to(key, value):
    return lambda table: table.__setitem__(key, value)


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("capture.json", set_to("schema_version", 3), "update mitsim"),
        ("capture.json", set_to("schema_version", "1"), "schema_version"),
        ("capture.json", set_to("source", "dreamt"), "source.*'simulated', 'device'"),
        ("capture.json", lambda t: t.pop("source"), "source: found nothing"),
        ("capture.json", set_to("bits", 99), "bits"),
        ("capture.json", set_to("colour", "red"), "colour: found an unknown key"),
        ("capture.json", lambda t: t["files"].pop(0), "0 files of role calibration"),
        ("capture.json", lambda t: t["files"].append(t["files"][0]), "each file once"),
        ("capture.json", lambda t: t["files"][0].update(path="../calibration.json"), "inside the folder"),
        ("capture.json", lambda t: t["files"][0].update(path="/etc/passwd"), "inside the folder"),
        ("capture.json", lambda t: t["files"][0].update(path="images/../../x"), "inside the folder"),
        ("capture.json", lambda t: t["files"][LAST_IMAGE].update(camera="middle"), r"files\.\d+\.camera: found middle"),
        ("capture.json", lambda t: t["files"][LAST_IMAGE].update(frame=7), r"files\.\d+\.frame"),
        ("capture.json", lambda t: t["files"][LAST_IMAGE].update(dtype="uint16"), r"files\.\d+: found uint16"),
        ("capture.json", lambda t: t["files"][-1].update(role="joke"), "role"),
        ("capture.json", lambda t: t["files"][-1].update(name="depth"), r"files\.\d+\.name: found 'depth'"),
        ("capture.json", lambda t: t["files"][-1].update(name="heat"), r"files\.\d+\.name"),
        ("capture.json", lambda t: t["files"][-1].update(unit="px"), r"files\.\d+\.unit: found 'px'; allowed: mm"),
        ("capture.json", lambda t: t["files"][-1].update(scale=None), r"files\.\d+\.scale"),
        ("capture.json", lambda t: t["files"][-1].update(shape=[3, 3]), r"files\.\d+: found float32 \(3, 3\)"),
        ("capture.json", lambda t: t["files"][-1].update(dtype="uint16"), r"files\.\d+: found uint16"),
        ("calibration.json", lambda t: t["cameras"][0].update(width=25), "size: found 24 x 16 px"),
        ("calibration.json", lambda t: t["cameras"][0].update(width=10**6), "cameras.0.width"),
        ("calibration.json", lambda t: t["cameras"][0].update(model="magic"), "cameras.0.model"),
        ("calibration.json", lambda t: t["cameras"][0]["matrix"][0].__setitem__(0, -30.0), "cameras.0.matrix"),
        (
            "calibration.json",
            lambda t: t["cameras"][0]["sensor_from_camera"][0].__setitem__(0, 3),
            "sensor_from_camera",
        ),
        ("calibration.json", lambda t: t["cameras"][0].update(distortion=[0] * 15), "distortion"),
        ("calibration.json", lambda t: t["cameras"][0].update(distortion=[0] * 6), "4 or 5 or 8"),
        ("calibration.json", lambda t: t["cameras"][0].update(model="fisheye"), "fisheye camera with 4"),
        ("calibration.json", lambda t: t["cameras"][1].update(name="left"), "different names"),
        ("calibration.json", set_to("cameras", []), "cameras"),
        ("pose.json", set_to("world_from_sensor", [[1, 2], [3, 4]]), "world_from_sensor"),
    ],
)
def test_what_another_program_got_wrong_is_named(tmp_path, name, change, message):
    path = write_capture(example(), tmp_path / "c")
    rewrite(path, name, change)
    with pytest.raises(InputError, match=message):
        read_capture(path)


@pytest.mark.parametrize(("dtype", "invalid", "scale"), [(np.uint16, 0, 0.1), (np.int16, -32768, 1 / 16)])
def test_maps_of_other_programs_are_scaled_and_their_holes_are_nan(tmp_path, dtype, invalid, scale):
    """What a device counts in: uint16 tenths of mm with 0 for nothing; sixteenths of px with -32768."""
    stored = np.arange(1, WIDTH * HEIGHT + 1).reshape(HEIGHT, WIDTH).astype(dtype)
    stored[2, 5] = invalid
    path = write_capture(replace(example(), derived={"disparity": maps()["disparity"]}), tmp_path / "c")
    (path / "derived" / "disparity.npy").write_bytes(encode_npy(stored))
    stored_as = {"dtype": str(stored.dtype), "scale": scale, "invalid": invalid}
    rewrite(path, "capture.json", lambda table: table["files"][-1].update(stored_as))
    found = read_capture(path).derived["disparity"]
    assert np.isnan(found[2, 5]) and np.isnan(found).sum() == 1
    known = ~np.isnan(found)
    np.testing.assert_array_equal(found[known], stored[known].astype(np.float32) * np.float32(scale))


def test_an_absurd_size_is_refused_before_it_is_read(tmp_path, monkeypatch):
    path = write_capture(example(), tmp_path / "c")
    total = sum(file.stat().st_size for file in path.rglob("*") if file.is_file() and file.name != "capture.json")
    monkeypatch.setattr(folder, "LARGEST_CAPTURE", total - 1)
    with pytest.raises(InputError, match=f"files: found over {total} bytes; allowed: up to {total - 1} bytes in all"):
        read_capture(path)
    with pytest.raises(InputError, match=r"size: found \d+ bytes; allowed: up to 100 bytes"):
        checked_files.read_bounded(path / "capture.json", largest=100)


def test_missing_folder_and_files(tmp_path):
    with pytest.raises(InputError, match="no such folder"):
        read_capture(tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"capture\.json: found no such file.* mitsim import .*empty"):
        read_capture(tmp_path / "empty")
    path = write_capture(example(), tmp_path / "c")
    (path / "images" / "right_001.png").unlink()
    with pytest.raises(InputError, match=r"right_001\.png: found no such file"):
        read_capture(path)


def test_a_link_out_of_the_folder_is_not_followed(tmp_path):
    path = write_capture(example(), tmp_path / "c")
    image = path / "images" / "left_000.png"
    image.rename(tmp_path / "elsewhere.png")
    image.symlink_to(tmp_path / "elsewhere.png")
    with pytest.raises(InputError, match="not a link"):
        read_capture(path)


@pytest.mark.parametrize("text", ["", "{", "[]", "null", '{"a": NaN}', "[" * 100_000, "\xff", "9" * 5000])
def test_text_that_is_no_index(tmp_path, text):
    path = write_capture(example(), tmp_path / "c")
    (path / "capture.json").write_bytes(text.encode("latin-1"))
    with pytest.raises(InputError, match=r"capture\.json"):
        read_capture(path)


def test_changed_setting_is_noticed(tmp_path):
    path = write_capture(example(), tmp_path / "c")
    (path / "settings.json").write_text((path / "settings.json").read_text().replace("true", "false"))
    with pytest.raises(InputError, match=r"settings\.json: sha256"):
        read_capture(path)
    path = write_capture(example(), tmp_path / "d")
    (path / "capture.json").write_text((path / "capture.json").read_text().replace("emulator", "device"))
    with pytest.raises(InputError, match=r"capture\.json: checksum"):
        read_capture(path)


def test_cut_png_is_refused_even_with_a_right_checksum(tmp_path):
    path = write_capture(example(), tmp_path / "c")
    image = path / "images" / "left_000.png"
    image.write_bytes(image.read_bytes()[:-20])
    reseal(path)
    with pytest.raises(InputError, match=r"left_000\.png: found a PNG cut off"):
        read_capture(path)


@pytest.fixture(scope="module")
def written():
    with tempfile.TemporaryDirectory() as place:
        yield write_capture(example(), Path(place) / "c", vendor={"original.bin": b"abc"})


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_damage_anywhere_is_refused_or_harmless(written, data):
    files = sorted(p.relative_to(written) for p in written.rglob("*") if p.is_file())
    name = data.draw(st.sampled_from(files))
    content = bytearray((written / name).read_bytes())
    if data.draw(st.booleans(), label="cut"):
        content = content[: data.draw(st.integers(0, len(content) - 1))]
    else:
        for _ in range(data.draw(st.integers(1, 3))):
            content[data.draw(st.integers(0, len(content) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    with tempfile.TemporaryDirectory() as place:
        copy = Path(place) / "c"
        shutil.copytree(written, copy)
        (copy / name).write_bytes(content)
        try:
            found = read_capture(copy)
        except InputError:
            return
        assert_same(example(), found)


PNG = encode_png(np.arange(WIDTH * HEIGHT, dtype=np.uint16).reshape(HEIGHT, WIDTH) * 100)


@settings(max_examples=200, deadline=None)
@given(st.integers(0, len(PNG) - 1), st.integers(1, 255), st.booleans())
def test_damaged_png_is_never_half_read(at, flip, cut):
    damaged = bytearray(PNG)
    damaged[at] ^= flip
    with pytest.raises(InputError):
        decode_png(PNG[:at] if cut else bytes(damaged), "x.png")


@given(st.binary(max_size=200))
def test_any_bytes_are_refused_in_words(data):
    for text in (data, PNG[:8] + data):
        with pytest.raises(InputError):
            decode_png(text, "x.png")


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize(
    "chosen",
    [cv2.IMWRITE_PNG_FILTER_NONE, cv2.IMWRITE_PNG_FILTER_SUB, cv2.IMWRITE_PNG_FILTER_UP, cv2.IMWRITE_PNG_ALL_FILTERS],
)
def test_images_with_any_filter_are_read(dtype, chosen):
    image = np.cumsum(np.random.default_rng(3).integers(0, 9, (20, 30)), axis=0).astype(dtype)
    done, data = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_FILTER, chosen])
    assert done
    np.testing.assert_array_equal(decode_png(data.tobytes(), "x.png"), image)


def test_colour_and_huge_pngs_are_refused():
    with pytest.raises(InputError, match="colour"):
        decode_png(encode_png(np.zeros((4, 4, 3), np.uint8)), "x.png")
    with pytest.raises(InputError, match="size"):
        decode_png(encode_png(np.zeros((1, 16385), np.uint8)), "x.png")


NPY = encode_npy(np.arange(24, dtype=np.float32).reshape(4, 2, 3))


def test_an_array_comes_back():
    by_columns = np.arange(6, dtype=np.int16).reshape(2, 3).T
    for values in (np.arange(6, dtype=np.uint16).reshape(2, 3), np.full((3, 2, 3), np.nan, np.float32), by_columns):
        np.testing.assert_array_equal(decode_npy(encode_npy(values), "x"), values)


@settings(max_examples=300)
@given(st.integers(0, len(NPY) - 1), st.integers(1, 255), st.booleans())
def test_a_damaged_array_is_refused_or_has_its_size(at, flip, cut):
    damaged = bytearray(NPY)
    damaged[at] ^= flip
    try:
        found = decode_npy(NPY[:at] if cut else bytes(damaged), "x.npy")
    except InputError:
        return
    assert not cut and found.nbytes == 96


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (np.zeros((2, 2)), "dtype: found <f8"),
        (np.zeros((2, 2), ">u2"), "dtype: found >u2"),
        (np.zeros(4, np.float32), "shape"),
        (np.zeros((1, 0), np.uint8), "shape"),
        (np.array([[None]]), "unreadable.*Object arrays"),
    ],
)
def test_other_arrays_are_refused(values, message):
    stream = io.BytesIO()
    np.save(stream, values, allow_pickle=True)
    with pytest.raises(InputError, match=message):
        decode_npy(stream.getvalue(), "x.npy")


@given(st.binary(max_size=200))
def test_bytes_that_are_no_array_are_refused(data):
    for text in (data, b"\x93NUMPY\x01\x00" + data):
        with pytest.raises(InputError):
            decode_npy(text, "x.npy")


def test_the_committed_schema_is_that_of_the_code():
    committed = Path(__file__).parents[2] / "docs/reference/capture.schema.json"
    assert committed.read_text(encoding="utf-8") == schema_text(), (
        "python -m mitsim.capture.capture_document > docs/reference/capture.schema.json"
    )


def test_a_written_index_has_no_key_that_the_schema_lacks(tmp_path):
    schema = capture_schema()
    index = json.loads((write_capture(example(), tmp_path / "c", vendor={"a": b""}) / "capture.json").read_text())
    assert set(schema["required"]) <= set(index) <= set(schema["properties"])
    entry = schema["$defs"]["FileEntry"]
    for file in index["files"]:
        assert set(entry["required"]) <= set(file) <= set(entry["properties"])
        for key, value in file.items():
            allowed = entry["properties"][key]
            choices = allowed.get("anyOf", [allowed])
            assert (
                any(value in choice["enum"] for choice in choices if "enum" in choice)
                or any(
                    {"string": str, "integer": int, "number": float, "null": type(None), "array": list}[choice["type"]]
                    is type(value)
                    for choice in choices
                    if "type" in choice
                )
                or value in [choice.get("const") for choice in choices]
            )
