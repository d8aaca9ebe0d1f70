"""How fine a part is meshed: by what a face is for, within a number of triangles, without gaps, and with progress."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mitsim.scene.authoring import read_step as reading
from mitsim.scene.authoring.read_step import Fineness, read_step, step_installed
from mitsim.scene.authoring.step_mesh import chords, radius_uncertainty
from mitsim.scene.mesh_facts import mesh_facts
from tests.scene.authoring.bracket import write_step

needs_step = pytest.mark.skipif(not step_installed(), reason="OpenCASCADE, which reads STEP, is not installed")

KINDS = ["plane", "cylinder", "sphere", "torus", "freeform"]
COUNTS = np.array([40.0, 100.0, 4000.0, 900.0, 30.0])


def test_without_a_limit_each_face_has_the_chord_of_its_use():
    chord, planned = chords(KINDS, COUNTS, 16.0, 1.0, 10.0, 0)
    assert chord.tolist() == [1, 1, 1, 10, 10]
    assert planned == pytest.approx([160, 400, 64000, 1440, 48])


@pytest.mark.parametrize("most", [60_000, 20_000, 3_000, 600])
def test_the_largest_faces_become_coarser_until_all_fit(most):
    free, all_of_them = chords(KINDS, COUNTS, 16.0, 1.0, 10.0, 0)
    chord, planned = chords(KINDS, COUNTS, 16.0, 1.0, 10.0, most)
    assert most / 3 < planned.sum() <= most < all_of_them.sum()
    assert (chord >= free).all()
    if most > 10_000:  # the sphere alone, and not beyond the chord of the others
        assert np.flatnonzero(chord > free).tolist() == [2]
        assert chord[2] <= 10
    assert np.isfinite(chords(KINDS, COUNTS, 16.0, 1.0, 10.0, 1)[0]).all()


def sphere_cap(half_angle, count):
    """Unit normals (n, 3) of a cap around x, evenly by area, with the area of each."""
    along = 1 - (np.arange(count) + 0.5) / count * (1 - np.cos(half_angle))
    turn = np.pi * (1 + 5**0.5) * np.arange(count)
    around = np.sqrt(1 - along**2)
    area = 2 * np.pi * 9.0**2 * (1 - np.cos(half_angle))
    return np.stack([along, around * np.cos(turn), around * np.sin(turn)], axis=1), np.full(count, area / count)


@pytest.mark.parametrize(("half_angle", "factor"), [(np.pi, 1.0), (np.pi / 2, 2.0)])
def test_the_radius_of_a_whole_sphere_is_a_mean_and_that_of_a_half_is_twice_as_uncertain(half_angle, factor):
    """Sphere: <n> = 0. Hemisphere: <n> = (1/2, 0, 0) and <n n^T> = I / 3, so 1 - 3/4 is left of the variance."""
    normals, areas = sphere_cap(half_angle, 20_000)
    assert radius_uncertainty(normals, areas) == pytest.approx(factor / areas.sum() ** 0.5, rel=1e-3)


def test_the_radius_of_a_whole_cylinder_is_a_mean():
    turn = np.linspace(0, 2 * np.pi, 100, endpoint=False)
    normals = np.stack([np.cos(turn), np.sin(turn), np.zeros(100)], axis=1)
    assert radius_uncertainty(normals, np.full(100, 0.5)) == pytest.approx(50**-0.5)


def filleted_box(folder):
    """A box of 40 x 30 x 20 mm, all edges rounded by 3 mm: its corners are eighths of spheres."""
    from OCP.BRepFilletAPI import BRepFilletAPI_MakeFillet
    from OCP.BRepPrimAPI import BRepPrimAPI_MakeBox
    from OCP.TopAbs import TopAbs_EDGE
    from OCP.TopExp import TopExp_Explorer
    from OCP.TopoDS import TopoDS

    box = BRepPrimAPI_MakeBox(40.0, 30.0, 20.0).Shape()
    fillet, edges = BRepFilletAPI_MakeFillet(box), TopExp_Explorer(box, TopAbs_EDGE)
    while edges.More():
        fillet.Add(3.0, TopoDS.Edge_s(edges.Current()))
        edges.Next()
    return write_step([("box", fillet.Shape(), None)], folder / "box.step")


@needs_step
@pytest.mark.usefixtures("step_here")
def test_small_corners_are_coarser_than_measured_faces_and_shift_no_fit_by_more_than_asked(tmp_path):
    """One point of noise sigma on each mm^2: a corner of radius 3 has 14 of them."""
    sigma = 0.1
    path, asked = filleted_box(tmp_path), Fineness(0.01 * sigma, 0.1 * sigma, 400_000)
    alike = read_step(path, asked).faces
    drawn = read_step(path, replace(asked, fitted_mm2=0.1 / 0.75 * sigma))
    count, coarser = (
        sum(len(face.triangles) for face in faces if face.kind == "sphere") for faces in (alike, drawn.faces)
    )
    assert coarser < 0.2 * count
    assert mesh_facts(*joined(drawn.faces), 1e-6).closed
    assert not any("instead of" in one for one in drawn.remarks)
    corners = [face for face in drawn.faces if face.kind == "sphere"]
    assert len(corners) == 8
    for face in corners:
        vertices = face.vertices[face.triangles]
        across = np.cross(vertices[:, 1] - vertices[:, 0], vertices[:, 2] - vertices[:, 0])
        length = np.linalg.norm(across, axis=1)
        vertices, normals, areas = (one[length > 0] for one in (vertices, across / length.clip(1e-30)[:, None], length))
        # the mean over a triangle of a quadratic is that of the middles of its edges
        middles = (vertices + np.roll(vertices, 1, axis=1)) / 2
        short = 3.0 - np.linalg.norm(middles - face.surface.centre, axis=2).mean(axis=1)
        assert 0 < np.average(short, weights=areas) <= 0.1 * sigma * radius_uncertainty(normals, areas / 2)
        assert face.sag <= 0.1 * sigma


@pytest.fixture(scope="module")
def rounded(tmp_path_factory):
    """A pin of radius 12 whose upper edge is rounded by a torus of 3 mm, with a dome of radius 6 below."""
    from OCP.BRepAlgoAPI import BRepAlgoAPI_Fuse
    from OCP.BRepFilletAPI import BRepFilletAPI_MakeFillet
    from OCP.BRepPrimAPI import BRepPrimAPI_MakeCylinder, BRepPrimAPI_MakeSphere
    from OCP.gp import gp_Pnt
    from OCP.TopAbs import TopAbs_EDGE
    from OCP.TopExp import TopExp_Explorer
    from OCP.TopoDS import TopoDS

    pin = BRepPrimAPI_MakeCylinder(12.0, 20.0).Shape()
    fillet, edges = BRepFilletAPI_MakeFillet(pin), TopExp_Explorer(pin, TopAbs_EDGE)
    fillet.Add(3.0, TopoDS.Edge_s(edges.Current()))
    solid = BRepAlgoAPI_Fuse(fillet.Shape(), BRepPrimAPI_MakeSphere(gp_Pnt(0, 0, 0), 6.0).Shape()).Shape()
    return write_step([("pin", solid, None)], tmp_path_factory.mktemp("step") / "pin.step")


def joined(faces):
    """All triangles as one mesh."""
    start = np.cumsum([0, *(len(face.vertices) for face in faces)])
    vertices = np.concatenate([face.vertices for face in faces])
    return vertices, np.concatenate([face.triangles + at for face, at in zip(faces, start, strict=False)])


@needs_step
@pytest.mark.usefixtures("step_here")
def test_tori_are_coarser_than_measured_faces_and_leave_no_gap(rounded):
    alike, coarse = (read_step(rounded, asked).faces for asked in (Fineness(0.001), Fineness(0.001, 0.01)))
    count = {name: {face.kind: len(face.triangles) for face in faces} for name, faces in (("a", alike), ("b", coarse))}
    assert count["b"]["torus"] < 0.3 * count["a"]["torus"]
    assert count["b"]["sphere"] == pytest.approx(count["a"]["sphere"], rel=0.05)
    for face in coarse:
        assert face.sag <= (0.01 if face.kind == "torus" else 0.001)
    facts = mesh_facts(*joined(coarse), 1e-6)
    assert facts.closed
    assert facts.volume == pytest.approx(mesh_facts(*joined(alike), 1e-6).volume, rel=1e-3)


@needs_step
@pytest.mark.usefixtures("step_here")
def test_a_limit_of_triangles_is_kept_and_the_chord_is_told(rounded):
    free = sum(len(face.triangles) for face in read_step(rounded, Fineness(0.001, 0.01)).faces)
    drawn = read_step(rounded, Fineness(0.001, 0.01, free // 3))
    assert 0.4 < sum(len(face.triangles) for face in drawn.faces) / (free // 3) < 1.5
    assert mesh_facts(*joined(drawn.faces), 1e-6).closed
    told = next(one for one in drawn.remarks if "instead of 0.001 mm" in one)
    chord = float(told.split(" mm instead")[0].rsplit(" ", 1)[1])
    assert 0.001 < max(face.sag for face in drawn.faces if face.kind in ("sphere", "cylinder", "cone")) <= chord


@needs_step
def test_the_process_that_meshes_reports_its_progress(rounded, monkeypatch, capsys):
    monkeypatch.setattr(reading, "_LINE_EVERY_S", 0.0)
    read_step(rounded, Fineness(0.0005, 0.005, 400_000))
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "pin.step: reading and meshing its faces"
    assert len(lines) > 1
    assert all(" of about " in line and line.endswith(" s left") for line in lines[1:])
