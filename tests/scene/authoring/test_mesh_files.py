"""Files of meshes as other programs write them, against the box that they hold."""

from __future__ import annotations

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
