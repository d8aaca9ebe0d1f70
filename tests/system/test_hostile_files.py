"""Files that once ended in a traceback, a crash, a hang or gigabytes: each ends in one message, in little time."""

import contextlib
import os
import struct
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pytest

from characterisation.cloud_files import read_cloud, write_cloud
from characterisation.files.documents import Document, read_toml
from characterisation.files.errors import InputError
from characterisation.maps.shipped import map_path
from characterisation.point_cloud import PointCloud, Status, ViewGrid
from mitsim.capture.grey_image import read_grey
from mitsim.capture.recordings.ply import decode_ply
from mitsim.report.choice_page import write_choice_page
from mitsim.scene.authoring.read_mesh import read_mesh
from mitsim.scene.surface.measured import read_height_map, read_profile
from mitsim.scene.xml_check import checked_trees
from mitsim.sensor.calibration_tree import read_tree
from mitsim.sensor.projector_images import counted
from mitsim.study.scene_geometry import read_scene_geometry
from mitsim.study.virtual.trials import Outcome, TrialFolder
from mitsim.study.virtual.world import Trial
from tests.report.choice_run import write_choice

SCENE = "<scene version='3.0.0'>{}</scene>"


class Number(Document):
    a: int = 0


def refused(read, *arguments, match=None):
    with pytest.raises(InputError, match=match) as caught:
        read(*arguments)
    assert len(str(caught.value)) < 2000
    return caught.value


@pytest.mark.parametrize(
    "text",
    [
        "a = " + "9" * 5000,
        "a = 18446744073709551616",
        "a = " + "[" * 5000 + "]" * 5000,
        "a = " + "{a=" * 3000,
        ".".join(["a"] * 200_000) + " = 1",
        ".".join(['"a"'] * 200_000) + " = 1",
        "a" * 2_000_000,
        "a = '\0'",
        "x" * 5_000_000,
    ],
    ids=["digits", "2^64", "arrays", "tables", "dotted", "quoted", "long", "null", "large"],
)
@pytest.mark.timeout(20)
def test_toml(tmp_path, text):
    (tmp_path / "a.toml").write_text(text, encoding="utf-8")
    refused(read_toml, tmp_path / "a.toml", Number)


@pytest.mark.parametrize("name", ["x" * 5000, "a\0b", "/dev/zero"])
def test_names_of_maps_and_documents(name):
    refused(map_path, name)
    refused(read_toml, Path(name), Number)


@pytest.mark.skipif(os.name != "posix", reason="pipes and devices by name are POSIX's")
@pytest.mark.timeout(20)
@pytest.mark.parametrize("kind", ["pipe", "device", "folder"])
def test_what_is_no_file_is_not_read(tmp_path, kind):
    place = tmp_path / "thing"
    if kind == "pipe":
        os.mkfifo(place)
    elif kind == "folder":
        place.mkdir()
    else:
        place = Path("/dev/zero")
    readers = [
        lambda p: read_toml(p, Number),
        read_cloud,
        read_grey,
        checked_trees,
        read_profile,
        lambda p: read_tree([p]),
        lambda p: read_height_map(p, 1.0),
    ]
    for read in readers:
        refused(read, place)


@pytest.mark.parametrize(
    ("inside", "told"),
    [
        ("<a>" * 10_000 + "</a>" * 10_000, "nested over"),
        ("<bsdf type='twosided'>" * 32 + "</bsdf>" * 32, "BSDFs within BSDFs"),
        ("<texture type='bitmap'/>", "no filename"),
        ("<shape type='ply'/>", "no filename"),
        ("<include filename='scene.xml'/>", "include one another"),
        ("<a>", "does not parse"),
    ],
)
def test_scenes_that_mitsuba_would_not_survive(tmp_path, inside, told):
    (tmp_path / "scene.xml").write_text(SCENE.format(inside), encoding="utf-8")
    refused(checked_trees, tmp_path / "scene.xml", match=told)


@pytest.mark.parametrize("encoding", ["gb18030", "latin-1", "utf-16"])
def test_scenes_in_other_encodings(tmp_path, encoding):
    text = f"<?xml version='1.0' encoding='{encoding}'?>" + SCENE.format("<!-- ü -->")
    (tmp_path / "scene.xml").write_bytes(text.encode(encoding))
    refused(checked_trees, tmp_path / "scene.xml", match="UTF-8")


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.json", '{"a":' + "[" * 100_000),
        ("a.xml", "<?xml version='1.0'?><opencv_storage>" + "<a>" * 100_000),
        ("a.yml", "%YAML:1.0\n---\na: " + "[" * 100_000),
        ("b.yml", "%YAML:1.0\n---\na: " + "- " * 100_000),
        ("c.yml", "%YAML:1.0\n---\n" + "".join(f"{' ' * k}a:\n" for k in range(2000))),
    ],
)
def test_calibrations_nested_deep(tmp_path, name, text):
    (tmp_path / name).write_text(text, encoding="utf-8")
    refused(read_tree, [tmp_path / name], match="nested over|maximum nesting|sequence entries are not allowed")


@pytest.mark.timeout(60)
def test_a_calibration_with_a_line_left_of_its_first_key_ends(tmp_path):
    """OpenCV would read such a line without end."""
    path = tmp_path / "a.yml"
    path.write_text("%YAML:1.0\n---\n   rows: 3\n   cols: 3\nD1:-matrix\n   rows: 3\n", encoding="utf-8")
    refused(read_tree, [path], match="not YAML .*in line 5")
    path.write_text("%YAML:1.0\n# optics\n---\n   rows: 3\n\n   cols: 4\n...\n", encoding="utf-8")
    assert read_tree([path]).find("cols").value == 4


def test_a_packed_calibration_does_not_unpack_to_gigabytes(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED) as packed:
        for number in range(3):
            packed.writestr(f"{number}.npy", bytes(60_000_000))
    refused(read_tree, [tmp_path / "a.npz"], match="unpacked")


def test_an_image_of_more_pixels_than_are_believed(tmp_path):
    def chunk(kind, body):
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    head = struct.pack(">IIBBBBB", 16384, 16384, 8, 0, 0, 0, 0)
    rows = zlib.compress(bytes(1000))
    data = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")
    (tmp_path / "a.png").write_bytes(data)
    refused(read_grey, tmp_path / "a.png", match="pixels")


@pytest.mark.parametrize("value", [np.inf, np.nan, 1e30])
def test_clouds_with_points_at_infinity(tmp_path, value):
    grid = ViewGrid(40.0, 40.0, 1.5, 1.5, 4, 4)
    points, status = np.full((4, 4, 3), np.nan, np.float32), np.full((4, 4), Status.NO_SURFACE, np.uint8)
    points[1, 1], status[1, 1] = (0.0, 0.0, 500.0), Status.VALID
    write_cloud(PointCloud(points, status, grid, "s", "simulated"), tmp_path / "a.ply")
    data = (tmp_path / "a.ply").read_bytes()
    old = np.float32(500.0).tobytes()
    assert data.count(old) == 1
    (tmp_path / "a.ply").write_bytes(data.replace(old, np.float32(value).tobytes()))
    refused(read_cloud, tmp_path / "a.ply")
    (tmp_path / "b.ply").write_bytes(data.replace(b'"fx": 40.0', b'"fx": 1e999'))
    refused(read_cloud, tmp_path / "b.ply")


def test_text_of_a_quarter_of_a_gigabyte(monkeypatch):
    monkeypatch.setattr("mitsim.capture.recordings.ply._LARGEST_TEXT", 1000)
    head = (
        b"ply\nformat ascii 1.0\nelement vertex 400\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    )
    refused(decode_ply, head + b"1 2 3\n" * 400, "a.ply", match="save it as binary")


@pytest.mark.parametrize(
    ("name", "data"),
    [
        ("a.npy", b"\x93NUMPY\x01\x00\x76\x00{'descr': '<f8', 'fortran_order': False, 'shape': (1e9,"),
        ("a.npy", b""),
        ("b.npy", b"\x93NUMPY\x01\x00\x10\x00{'descr': [[[[[[["),
        ("a.csv", b"1," * 100 + b"9" * 200_000),
        ("b.csv", b""),
        ("c.csv", b"# only a comment\n"),
        ("d.csv", '"²",2\n'.encode() * 100),
    ],
)
def test_height_maps_and_profiles(tmp_path, name, data):
    (tmp_path / name).write_bytes(data)
    refused(read_height_map, tmp_path / name, 1.0)
    refused(read_profile, tmp_path / name)


def test_a_superscript_is_no_digit_of_an_image():
    names = [Path(name) for name in ("a_10.png", "a_2.png", "a\N{SUPERSCRIPT TWO}.png")]
    assert [path.name for path in sorted(names, key=counted)][:2] == ["a_2.png", "a_10.png"]


@pytest.mark.parametrize("day", ["9" * 400, "1e999", "[]", "null", '"x"'])
def test_a_trial_that_is_none_is_made_again(tmp_path, day):
    trials = TrialFolder(tmp_path, "0123", ["a"])
    for number in range(3):
        trials.add(7, Trial(number), Outcome({"a": 0.5}))
    path = tmp_path / "view_0007.jsonl"
    lines = path.read_text().splitlines()
    for field in ('"day": 1', '"errors": [0.5]'):
        broken = field.replace("1" if "day" in field else "0.5", day)
        if broken == '"errors": [null]':
            continue  # a trial without a value
        path.write_text("\n".join([*lines[:2], lines[2].replace(field, broken), lines[3], ""]))
        assert set(TrialFolder(tmp_path, "0123", ["a"]).known(7)) == {Trial(0)}


def test_a_choice_whose_cells_do_not_belong_is_refused(tmp_path):
    for number, (old, new) in enumerate(
        [
            ('"fits", "fits_corrected"', '"sits", "fits_corrected"'),
            ('"radius <i>& co": {"by"', '"other": {"by"'),
            ("[0.0, 0.0, 0.0, 1.0]", "[0.0, 0.0, 1.0]"),
        ]
    ):
        folder = write_choice(tmp_path / str(number))
        text = (folder / "choice.json").read_text()
        assert old in text
        (folder / "choice.json").write_text(text.replace(old, new))
        refused(write_choice_page, folder)
    assert write_choice_page(write_choice(tmp_path / "sound")).exists()


def test_a_stand_that_is_damaged_or_swells_is_refused(tmp_path):
    folder = write_choice(tmp_path / "c")
    sound = (folder / "stand.npz").read_bytes()
    assert read_scene_geometry(folder) is not None
    for place in range(0, len(sound), 7):
        (folder / "stand.npz").write_bytes(sound[:place] + bytes([sound[place] ^ 16]) + sound[place + 1 :])
        with contextlib.suppress(InputError):
            read_scene_geometry(folder)
    with zipfile.ZipFile(folder / "stand.npz", "w", zipfile.ZIP_DEFLATED) as packed:
        packed.writestr("corners.npy", bytes(300 << 20))
    refused(read_scene_geometry, folder, match="unpacked")


def test_a_mesh_whose_vertices_have_two_numbers_is_refused(tmp_path):
    path = tmp_path / "part.obj"
    corners = [(x, y, z) for x in (0, 10) for y in (0, 10) for z in (0, 10)]
    lines = [f"v {x} {y} {z}" for x, y, z in corners] + ["f 1 2 3", "f 2 4 3", "f 5 7 6"]
    path.write_text("\n".join(lines))
    assert len(read_mesh(path).triangles) == 3
    path.write_text("\n".join([f"v {y} {z}" for x, y, z in corners] + lines[8:]))
    with pytest.raises(InputError, match="three numbers"):
        read_mesh(path)


def test_a_study_in_place_of_a_scene_is_told_from_a_damaged_scene(tmp_path):
    study = tmp_path / "study.toml"
    study.write_text('scene = "part.xml"\n')
    with pytest.raises(InputError, match="name the scene of the study here; `mitsim run`"):
        checked_trees(study)
