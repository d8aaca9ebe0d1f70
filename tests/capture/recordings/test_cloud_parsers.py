"""PLY, PCD and their compressions: what was written is read, and what is damaged is refused in words."""

from __future__ import annotations

import time

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from characterisation.files.errors import InputError
from mitsim.capture.recordings.pcd import decode_lzf, decode_pcd
from mitsim.capture.recordings.ply import decode_ply
from tests.capture.recordings.cloud_files_of_others import lzf, pcd, pinhole_cloud, ply

SMALL = pinhole_cloud(12, 9)
FORMS = ["ascii", "binary", "binary_compressed"]
#: bytes that repeat at all distances, as clouds do
TEXTS = st.lists(st.sampled_from([b"\x00" * 40, b"abc", b"abcd" * 9, b"\xff", bytes(range(50))]), max_size=60).map(
    b"".join
)


@given(TEXTS | st.binary(max_size=3000))
def test_lzf_of_anything_comes_back(data):
    assert decode_lzf(lzf(data), len(data)) == data


@given(st.binary(max_size=300), st.integers(0, 2000))
def test_lzf_of_any_bytes_is_refused_or_of_the_size(data, size):
    try:
        assert len(decode_lzf(data, size)) == size
    except ValueError:
        return


def test_lzf_bombs_stop_at_the_size_that_was_told():
    """Three bytes repeat 264; without a limit a file of 256 MiB would make 22 GiB."""
    bomb = b"\x00a" + b"\xe0\xff\x00" * 200_000
    begin = time.perf_counter()
    with pytest.raises(ValueError, match="instead of"):
        decode_lzf(bomb, 1000)
    assert time.perf_counter() - begin < 0.1


@pytest.mark.parametrize("extra", [False, True])
@pytest.mark.parametrize("form", FORMS)
def test_a_pcd_comes_back(form, extra):
    points, header = decode_pcd(pcd(SMALL, form, extra), "x.pcd")
    np.testing.assert_array_equal(points, SMALL)
    assert header["VIEWPOINT"] == "0 0 0 1 0 0 0"


@pytest.mark.parametrize("order", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize(
    ("grid", "before"), [("obj_info", False), ("camera", False), ("camera", True), ("range_grid", False)]
)
def test_a_ply_comes_back_with_its_grid(order, grid, before):
    read = decode_ply(ply(SMALL, order, grid, before), "x.ply")
    assert read.size == (12, 9)
    np.testing.assert_array_equal(read.points.reshape(9, 12, 3), SMALL)


def test_a_ply_without_a_grid_tells_none():
    assert decode_ply(ply(SMALL, grid="none"), "x.ply").size is None


@pytest.mark.parametrize("encoding", ["ascii", "binary"])
def test_a_ply_that_trimesh_wrote_is_read(encoding):
    """An independent writer; its mesh has faces after the vertices."""
    sphere = trimesh.creation.icosphere(2, 50.0)
    read = decode_ply(trimesh.exchange.ply.export_ply(sphere, encoding=encoding), "x.ply")
    np.testing.assert_allclose(read.points, sphere.vertices, rtol=1e-6, atol=1e-5)


FILES = [
    *((decode_pcd, pcd(SMALL, form, True)) for form in FORMS),
    *(
        (decode_ply, ply(SMALL, order, grid))
        for order, grid in (
            ("ascii", "range_grid"),
            ("binary_little_endian", "range_grid"),
            ("binary_big_endian", "camera"),
        )
    ),
]


@settings(max_examples=300)
@given(st.data())
def test_damaged_clouds_are_refused_or_read(data):
    decode, content = data.draw(st.sampled_from(FILES))
    if data.draw(st.booleans()):
        damaged = content[: data.draw(st.integers(0, len(content) - 1))]
    else:
        damaged = bytearray(content)
        head = content.find(b"DATA" if decode is decode_pcd else b"end_header")
        last = data.draw(st.sampled_from([head, len(content)])) - 1  # half of them in the header
        for _ in range(data.draw(st.integers(1, 4))):
            damaged[data.draw(st.integers(0, last))] ^= data.draw(st.integers(1, 255))
    try:
        decode(bytes(damaged), "x")
    except InputError as error:
        assert error.where == "x"


HEADS = [b"ply\nformat ascii 1.0\n", b"# .PCD v0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\n", b""]


@given(st.sampled_from(HEADS), st.binary(max_size=200))
def test_any_bytes_are_refused_in_words(head, data):
    for decode in (decode_ply, decode_pcd):
        with pytest.raises(InputError):
            decode(head + data, "x")


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (("WIDTH 12", "WIDTH 13"), "POINTS: found 108; allowed: 117"),
        (("WIDTH 12", "WIDTH -1"), "WIDTH"),
        (("WIDTH 12", "WIDTH 999999999"), "WIDTH, HEIGHT"),
        (("HEIGHT 9\n", ""), "HEIGHT: found nothing"),
        (("FIELDS x y z", "FIELDS x y w"), "x, y and z"),
        (("TYPE F F F", "TYPE F F X"), "TYPE, SIZE: found X 4 of z"),
        (("SIZE 4 4 4", "SIZE 4 4"), "as many as SIZE"),
        (("COUNT 1 1 1", "COUNT 1 1 2"), "x, y and z"),
        (("COUNT 1 1 1", "COUNT 1 1 99999999999999"), "COUNT"),
        (("DATA binary", "DATA binary_huffman"), "DATA"),
        (("VERSION", "EDITION"), "EDITION 0.7"),
        (("DATA binary\n", "DATA ascii\n"), "data that do not fit"),
    ],
)
def test_what_is_wrong_with_a_pcd_is_named(change, told):
    before, after = (text.encode() for text in change)
    content = pcd(SMALL, "binary")
    assert before in content
    with pytest.raises(InputError, match=told):
        decode_pcd(content.replace(before, after), "x.pcd")


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (("format binary_little_endian", "format binary_middle_endian"), "the line 'format binary_middle_endian"),
        (("element vertex 108", "element vertex 109"), "data that do not fit"),
        (("element vertex 108", "element vertex -3"), "the line"),
        (("element vertex 108", "element apex 108"), "vertices with x, y and z"),
        (("property float x", "property real x"), "the line 'property real x'"),
        (("property float x", "property float y"), "vertices with x, y and z"),
        (("property float x", "property list uchar int x"), "data that do not fit"),
        (("property float x", "property list float int x"), "a whole number of items"),
        (("end_header", "the_end"), "without the header"),
    ],
)
def test_what_is_wrong_with_a_ply_is_named(change, told):
    before, after = (text.encode() for text in change)
    content = ply(SMALL)
    assert before in content
    with pytest.raises(InputError, match=told):
        decode_ply(content.replace(before, after), "x.ply")


def test_a_range_grid_that_names_what_is_not_there_is_refused():
    content = ply(SMALL, "ascii", "range_grid")
    with pytest.raises(InputError, match="range_grid: found a vertex number out of range"):
        decode_ply(content[: content.rindex(b"1 ")] + b"1 999\n", "x.ply")


@pytest.mark.parametrize("order", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("place", ["before", "after", "between"])
def test_faces_with_lists_colours_and_names_twice_leave_the_vertices(order, place):
    """Faces with two lists and a number, as VCGLIB writes them; vertices with two properties of one name, as PCL does.

    The element of PCL's camera, which holds the grid, stands after all.
    """
    sign = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}[order]
    rows = SMALL.reshape(-1, 3)

    def packed(*parts):
        if order == "ascii":
            return (" ".join(f"{value!r}" for _, values in parts for value in values) + "\n").encode()
        return b"".join(np.array(values, sign + kind).tobytes() for kind, values in parts)

    vertex = [
        f"element vertex {len(rows)}",
        *(f"property float {axis}" for axis in "xyz"),
        "property uchar _",
        "property uchar _",
    ]
    vertices = b"".join(packed(("f4", row.tolist()), ("u1", [1, 2])) for row in rows)
    face = [
        "element face 2",
        "property list uchar int vertex_indices",
        "property uchar red",
        "property list uchar float texcoord",
        "property int texnumber",
    ]
    faces = b"".join(
        packed(("u1", [3]), ("i4", [0, 1, 2]), ("u1", [9]), ("u1", [count]), ("f4", [0.5] * count), ("i4", [0]))
        for count in (6, 2)
    )
    camera = ["element camera 1", "property int viewportx", "property int viewporty"]
    seen = packed(("i4", [SMALL.shape[1], SMALL.shape[0]]))
    order_of = {
        "before": [(face, faces), (vertex, vertices), (camera, seen)],
        "after": [(vertex, vertices), (camera, seen), (face, faces)],
        "between": [(vertex, vertices), (face, faces), (camera, seen)],
    }[place]
    head = ["ply", f"format {order} 1.0", *(line for lines, _ in order_of for line in lines), "end_header\n"]
    read = decode_ply("\n".join(head).encode() + b"".join(data for _, data in order_of), "x.ply")
    assert read.size == SMALL.shape[1::-1]
    np.testing.assert_allclose(read.points.reshape(SMALL.shape), SMALL, rtol=1e-6)


def test_vertices_with_a_list_of_their_own_are_read():
    head = (
        "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty list uchar int seen\nproperty float y\n"
        "property float z\nend_header\n"
    )
    read = decode_ply(f"{head}1 2 7 8 2 3\n4 0 5 6\n".encode(), "x.ply")
    assert read.points.tolist() == [[1, 2, 3], [4, 5, 6]]


SPELLINGS = ["nan", "-nan", "-nan(ind)", "nan(snan)", "NaN", "1.#QNAN", "-1.#IND", "1.#QNAN0", "-1.#IND00", "nan(0x8)"]


@pytest.mark.parametrize("nan", SPELLINGS)
def test_nan_of_every_c_library_is_nan(nan):
    body = f"1 2 3\n{nan} {nan} {nan}\n-1.#INF00 1.#INF 2\n".encode()
    head = "\n".join(f"property float {axis}" for axis in "xyz")
    read = decode_ply(f"ply\nformat ascii 1.0\nelement vertex 3\n{head}\nend_header\n".encode() + body, "x.ply").points
    fields = "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 3\nHEIGHT 1\nDATA ascii\n"
    for points in (read, decode_pcd(fields.encode() + body, "x.pcd")[0][0]):
        np.testing.assert_array_equal(points, [[1, 2, 3], [np.nan] * 3, [-np.inf, np.inf, 2]])
