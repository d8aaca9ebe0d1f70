"""Features of a task against the shapes of a scene: places and sizes that do not belong to the part."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from characterisation.tasks.task_reading import read_task
from mitsim.scene.authoring.check_task import read_features, report_geometry, task_findings
from mitsim.scene.authoring.part_folder import Finishing, write_part
from mitsim.scene.inspect import inspect
from mitsim.scene.load import load_scene

RIM = '[features.rim]\nkind = "circle"\nof = ["top"]\npoint_mm = [0, 0, 5]\nradius_mm = 4\n'
EDGE = (
    '[features.edge]\nkind = "edge_point"\nof = ["top"]\npoint_mm = [20, 0, 5]\ndirection = [1, 0, 0]\nreach_mm = 2\n'
)
SIZE = '[measurements.size]\nkind = "diameter"\nfeatures = ["bore_8mm"]\nnominal = 8\nunit = "mm"\n'


@pytest.fixture(scope="module")
def washer(tmp_path_factory):
    """A washer of radii 4 and 20 mm, 10 mm high: its scene, and the task of mitsim part with two figures."""
    folder = tmp_path_factory.mktemp("washer")
    trimesh.creation.annulus(4.0, 20.0, 10.0, sections=128).export(folder / "washer.stl")
    write_part(folder / "washer.stl", folder / "washer", finishing=Finishing(named="matt_white"))
    return load_scene(folder / "washer/washer.xml", 850), (folder / "washer/task.toml").read_text() + RIM + EDGE + SIZE


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("radius_mm = 4\n", "radius_mm = 8\n", "the circle is 4 mm off the edge of top"),
        ("point_mm = [0, 0, 5]", "point_mm = [9, 0, 5]", "off the edge of top"),
        ("radius_mm = 4\n", "radius_mm = 4.2\n", "the circle is 0.2 mm off the edge of top"),
        ("point_mm = [20, 0, 5]", "point_mm = [14, 0, 5]", "the edge point is 6 mm off the edge of top"),
        ("radius_mm = 20.0", "radius_mm = 22.0", "the shape is up to 2 mm off the nominal cylinder"),
        ("radius_mm = 20.0", "radius_mm = 20.5", "the shape is up to 0.5 mm off the nominal cylinder"),
        (
            "[0.0, 0.0, 5.0]]",
            "[0.0, 0.0, 50.0]]",
            "outline_mm spans 55 mm in a direction in which the shape has 10 mm",
        ),
        ("[0.0, 0.0, 5.0]]", "[0.0, 0.0, -4.6]]", "outline_mm spans 0.4 mm"),
    ],
)
def test_geometry_that_is_not_that_of_the_scene_is_told(washer, tmp_path, capsys, old, new, says):
    scene, text = washer
    path = tmp_path / "task.toml"
    path.write_text(text)
    report_geometry(read_task(path), scene)
    assert capsys.readouterr().err == ""
    assert old in text
    path.write_text(text.replace(old, new))
    report_geometry(read_task(path), scene)
    assert says in capsys.readouterr().err


def test_the_end_of_a_slot_is_on_the_edge_of_its_face(tmp_path, capsys):
    """Half of its circle is."""
    half = trimesh.creation.annulus(4.0, 20.0, 10.0, sections=128)
    half.update_faces(half.triangles_center[:, 0] > 0)
    half.export(tmp_path / "half.stl")
    made = write_part(tmp_path / "half.stl", tmp_path / "half", finishing=Finishing(named="matt_white"))
    assert "top" in {face.name for face in made.faces}
    path = tmp_path / "task.toml"
    size = SIZE.replace("bore_8mm", "rim")
    path.write_text((tmp_path / "half/task.toml").read_text() + RIM + size)
    report_geometry(read_task(path), load_scene(tmp_path / "half/half.xml", 850))
    assert "rim" not in capsys.readouterr().err


@pytest.mark.parametrize(("quarters", "noted"), [(4, True), (1, False)])
def test_a_fillet_is_no_bore(tmp_path, quarters, noted):
    """The wall of a quarter of a washer spans 90 deg, as a fillet does: a camera sees all of it."""
    part = trimesh.creation.annulus(4.0, 20.0, 10.0, sections=128)
    x, y, _ = part.triangles_center.T
    part.update_faces((x > 0) & (y > 0) if quarters == 1 else np.ones(len(x), bool))
    part.export(tmp_path / "part.stl")
    made = write_part(tmp_path / "part.stl", tmp_path / "part", finishing=Finishing(named="matt_white"))
    (wall,) = [face.name for face in made.faces if face.name.startswith(("bore", "fillet"))]
    path = tmp_path / "task.toml"
    path.write_text((tmp_path / "part/task.toml").read_text() + SIZE.replace("bore_8mm", wall))
    facts = inspect(load_scene(tmp_path / "part/part.xml", 850))
    told = [one for one in task_findings(facts, read_features(path)) if "wall of this bore" in one.what]
    assert bool(told) is noted
