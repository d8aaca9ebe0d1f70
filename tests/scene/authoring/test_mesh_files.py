"""Files of meshes as other programs write them, against the box that they hold."""

from __future__ import annotations

import base64
import json
import zipfile

import numpy as np
import pytest

from characterisation.files.errors import InputError
from mitsim.scene.authoring.read_mesh import read_mesh

#: corners of a box [mm], and its six sides, counter-clockwise as seen from outside
CORNERS = np.array([[x, y, z] for x in (5.0, 35.0) for y in (7.0, 27.0) for z in (9.0, 19.0)])
SIDES = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]


def volume_and_area(vertices, triangles):
    """Of a closed surface whose normals point outward."""
    a, b, c = np.moveaxis(vertices[triangles], 1, 0)
    across = np.cross(b - a, c - a)
    return np.einsum("ij,ij->", a, across) / 6, np.linalg.norm(across, axis=1).sum() / 2


def assert_is_the_box(path):
    mesh = read_mesh(path)
    used = mesh.vertices[np.unique(mesh.triangles)]
    np.testing.assert_allclose([used.min(axis=0), used.max(axis=0)], [CORNERS[0], CORNERS[-1]], atol=1e-4)
    assert volume_and_area(mesh.vertices, mesh.triangles) == pytest.approx((6000, 2200), rel=1e-5)


def vertex(corner):
    return "v {:g} {:g} {:g}\n".format(*CORNERS[corner])


def numbered(side, before="f ", between=" "):
    return before + between.join(str(corner + 1) for corner in side) + "\n"


ALL = "".join(map(vertex, range(8)))
OBJ = {
    "each side after its corners": "".join("".join(map(vertex, side)) + "f -4 -3 -2 -1\n" for side in SIDES),
    "one side from the end": ALL + "f -8 -7 -5 -6\n" + "".join(map(numbered, SIDES[1:])),
    "a later vertex": vertex(0)
    + "".join(f"v{vertex(n)[1:]}" for n in range(1, 8))
    + "".join(f"f {' '.join(f'{n - 8}/-1' for n in side)}\n" for side in SIDES)
    + "vt 0 0\nv 99 99 99\n",
    "indented": ALL.replace("v", "  v") + numbered(SIDES[0], "\tf\t", "\t") + "".join(map(numbered, SIDES[1:])),
    "comments": ALL.replace("\n", " # f 1 2 3\r\n") + "".join(numbered(one).replace("\n", "#\r\n") for one in SIDES),
    "continued": ALL + "".join(numbered(side, between=" \\\r\n") for side in SIDES),
}


@pytest.mark.parametrize("name", OBJ)
def test_an_obj_file_counts_from_where_it_says(tmp_path, name):
    (tmp_path / "box.obj").write_bytes(OBJ[name].encode())
    assert_is_the_box(tmp_path / "box.obj")


@pytest.mark.parametrize("number", [0, -9, 9])
def test_a_side_without_a_corner_is_refused(tmp_path, number):
    (tmp_path / "box.obj").write_text(f"{ALL}f 1 2 {number}\nv 1 1 1\n" if number != 9 else f"{ALL}f 1 2 9\n")
    with pytest.raises(InputError, match="triangles without vertices"):
        read_mesh(tmp_path / "box.obj")


def gltf(path, places=None, primitives=None, indices=None, **document):
    """The box in metres with y up: a corner (x, y, z) of the part is (x, z, -y) in glTF, whose front is its z."""
    points = (CORNERS[:, [0, 2, 1]] * [1, 1, -1] / 1000).astype("<f4").tobytes()
    fans = [corner for a, b, c, d in SIDES for corner in (a, b, c, a, c, d)]
    numbers = np.array(fans if indices is None else indices, "<u2").tobytes()
    position = {"bufferView": 0, "componentType": 5126, "count": 8, "type": "VEC3"} | (places or {})
    whole = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "scene": 0,
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": primitives or [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            position,
            {"bufferView": 1, "componentType": 5123, "count": 36 if indices is None else 6, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteLength": 96},
            {"buffer": 0, "byteOffset": 96, "byteLength": len(numbers)},
        ],
        "buffers": [{"byteLength": 96 + len(numbers), "uri": "data:application/octet-stream;base64,"}],
    } | document
    whole["buffers"][0]["uri"] += base64.b64encode(points + numbers).decode()
    text = json.dumps(whole).encode()
    text += b" " * (-len(text) % 4)
    size = len(text).to_bytes(4, "little")
    head = b"glTF" + (2).to_bytes(4, "little") + (20 + len(text)).to_bytes(4, "little") + size + b"JSON"
    path.write_bytes(head + text if path.suffix == ".glb" else text)
    return path


@pytest.mark.parametrize("suffix", [".gltf", ".glb"])
def test_gltf_has_y_up_and_a_part_z(tmp_path, suffix):
    path = gltf(tmp_path / f"box{suffix}")
    assert_is_the_box(path)
    assert read_mesh(path).remarks == (f"box{suffix} has y up, as glTF defines it: turned, so that z is up",)


ONE = {"attributes": {"POSITION": 0}, "indices": 1}
SPARSE = {"count": 1, "indices": {"bufferView": 1, "componentType": 5123}, "values": {"bufferView": 0}}


@pytest.mark.parametrize("suffix", [".gltf", ".glb"])
@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"places": {"sparse": SPARSE}}, "sparse accessors"),
        ({"places": {"componentType": 5122, "normalized": True}}, "normalised positions"),
        ({"primitives": [ONE, {"attributes": {"POSITION": 0}, "mode": 6}]}, "fans of triangles"),
        ({"nodes": [{"mesh": 0, "weights": [0.0, 0.5]}]}, "morphed meshes"),
        ({"nodes": [{"mesh": 0, "skin": 0}], "skins": [{"joints": [0]}]}, "skinned meshes"),
        ({"extensionsUsed": ["EXT_mesh_gpu_instancing"]}, "extension EXT_mesh_gpu_instancing"),
        ({"extensionsUsed": ["KHR_draco_mesh_compression"]}, "extension KHR_draco_mesh_compression"),
    ],
)
def test_geometry_of_gltf_that_would_be_passed_over_is_refused(tmp_path, suffix, change, says):
    with pytest.raises(InputError, match=says):
        read_mesh(gltf(tmp_path / f"box{suffix}", **change))


MODEL = '<model unit="millimeter" xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02" {}>{}</model>'
PRODUCTION = 'xmlns:p="http://schemas.microsoft.com/3dmanufacturing/production/2015/06"'


def box_object(number, kind="model", scale=1.0):
    vertices = "".join('<vertex x="{:g}" y="{:g}" z="{:g}"/>'.format(*(scale * corner)) for corner in CORNERS)
    fans = [triangle for a, b, c, d in SIDES for triangle in ((a, b, c), (a, c, d))]
    triangles = "".join('<triangle v1="{}" v2="{}" v3="{}"/>'.format(*triangle) for triangle in fans)
    mesh = f"<mesh><vertices>{vertices}</vertices><triangles>{triangles}</triangles></mesh>"
    return f'<object id="{number}" type="{kind}">{mesh}</object>'


def package(path, resources, items, **others):
    built = f"<resources>{resources}</resources><build>{items}</build>"
    with zipfile.ZipFile(path, "w") as packed:
        packed.writestr("3D/3dmodel.model", MODEL.format(PRODUCTION, built))
        for name, other in others.items():
            packed.writestr(f"3D/{name}.model", MODEL.format("", f"<resources>{other}</resources><build/>"))
    return path


def component(name, number, transform=""):
    return f'<component p:path="/3D/{name}.model" objectid="{number}" {transform}/>'


def test_a_3mf_package_of_several_files_is_read_where_its_objects_are_told_apart(tmp_path):
    whole = f'<object id="9"><components>{component("a", 1)}</components></object>'
    assert_is_the_box(package(tmp_path / "one.3mf", whole, '<item objectid="9"/>', a=box_object(1)))
    far = 'transform="1 0 0 0 1 0 0 0 1 100 0 0"'
    both = f'<object id="9"><components>{component("a", 1)}{component("b", 1, far)}</components></object>'
    files = {"a": box_object(1), "b": box_object(1, scale=0.5)}
    with pytest.raises(InputError, match="objects of one number in several files"):
        read_mesh(package(tmp_path / "two.3mf", both, '<item objectid="9"/>', **files))


@pytest.mark.parametrize("kind", ["support", "solidsupport", "other"])
def test_a_3mf_file_with_a_support_structure_is_refused(tmp_path, kind):
    items = '<item objectid="1"/><item objectid="2"/>'
    with pytest.raises(InputError, match=f"an object of the type {kind}"):
        read_mesh(package(tmp_path / "box.3mf", box_object(1) + box_object(2, kind, 0.5), items))
