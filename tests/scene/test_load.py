"""Scenes: names, finishes, and what is wrong with one."""

from __future__ import annotations

import math
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from characterisation.files.errors import InputError
from mitsim.scene.load import bounds_of, load_scene, scene_from_dict
from mitsim.scene.ray_casting.triangles import hull_corners, triangles
from mitsim.scene.surface.scatter import Deviation

TWO = "two_pillars/two_pillars.xml"


def test_features_and_finishes_of_the_artefact(scenes):
    scene = load_scene(scenes / TWO, 850, {"pillar_Ra": "0.09"})
    finish = dict(zip(scene.names, scene.finishes, strict=True))
    assert scene.names == ("plane", "pillar1", "pillar1_top", "pillar2", "pillar2_top")
    assert (finish["plane"].name, finish["plane"].roughness) == ("aluminium/ground", 0.74)
    assert finish["pillar2"].roughness == 0.09
    assert np.allclose(scene.bounds, [[-90, -60, 0], [90, 60, 60]])
    assert np.array_equal(scene.bounds, bounds_of(scene.mitsuba))
    assert scene.only("pillar1").names == ("pillar1",)


@pytest.mark.skipif(sys.platform != "linux", reason="names of any bytes are of Linux")
def test_a_scene_in_a_folder_of_a_latin_1_name_is_read_from_inside(scenes, tmp_path, monkeypatch):
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/pr\xfcf"))
    shutil.copytree((scenes / TWO).parent, folder)
    with pytest.raises(InputError, match=r"a path that is not UTF-8; .*start mitsim in this folder"):
        load_scene(folder / "two_pillars.xml", 850)
    monkeypatch.chdir(folder)
    assert load_scene("two_pillars.xml", 850).names[0] == "plane"


def test_a_lamp_does_not_move_the_part(scenes, tmp_path):
    """Views are spread about the centre of the part, regions are those of its hull, and it must have a size."""
    plain = load_scene(scenes / TWO, 850)
    lamp = (
        '<shape type="rectangle" id="lamp"><transform name="to_world"><scale value="50"/><translate z="5000"/>'
        '</transform><emitter type="area"><rgb name="radiance" value="1"/></emitter></shape></scene>'
    )
    (tmp_path / "lit.xml").write_text((scenes / TWO).read_text().replace("</scene>", lamp))
    lit = load_scene(tmp_path / "lit.xml", 850)
    assert np.array_equal(lit.bounds, plain.bounds) and np.array_equal(lit.centre, plain.centre)
    assert np.array_equal(hull_corners(lit), hull_corners(plain))
    assert lit.only("plane", "lamp").bounds[1, 2] == 0 and lit.only("lamp").bounds[1, 2] == 5000
    assert len(triangles(lit)) > len(triangles(plain))  # it can still be in the sensor's way


def test_matt_white_has_no_roughness(scenes):
    finish = load_scene(scenes / "coupon/matt_white.xml", 850).finishes[0]
    assert finish.name == "matt_white"
    assert math.isnan(finish.roughness)


def test_shapes_of_a_dictionary_keep_their_own_finish():
    """Mitsuba gives all BSDFs under the key ``bsdf`` that id: finishes must not be those of the one made last."""
    turned = {"type": "machined_metal", "process": "turned", "Ra": 0.8}
    finishes = {"a": turned, "b": {"type": "matt_white"}, "c": {**turned, "Ra": 0.4}, "d": {"type": "matt_white"}}
    scene = scene_from_dict({name: {"type": "rectangle", "bsdf": one} for name, one in finishes.items()}, 850)
    assert [finish.name for finish in scene.finishes] == ["aluminium/turned", "matt_white"] * 2
    assert [scene.finishes[i].roughness for i in (0, 2)] == [0.8, 0.4]


def test_a_scene_loads_with_plain_mitsuba_once_ours_is_there(scenes):
    code = (
        "from mitsim.scene import load, backend; load._prepare(); mi = backend.mi\n"
        "for _ in range(2):\n"
        f"    shapes = mi.load_file({str(scenes / TWO)!r}, optimize=False).shapes()\n"
        "    print(len(shapes), *sorted({shape.bsdf().id() for shape in shapes}))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    first, second = done.stdout.splitlines()
    assert first.split()[0] == "5"
    assert second == first  # ids too: nothing is left of what was loaded before


@pytest.mark.parametrize(
    ("old", "new", "field", "says"),
    [
        ('name="Ra" value="$plane_Ra"', 'name="Raa" value="$plane_Ra"', "Raa", "did you mean 'Ra'"),
        ('value="aluminium"', 'value="aluminum"', "metal", "did you mean 'aluminium'?"),
        ('value="ground"', 'value="sanded"', "process", "polished, lapped"),
        ('<default name="plane_Ra" value="0.74"/>', '<default name="plane_Ra" value="740"/>', "Ra", "0.005 to 10 um"),
        ('name="radius" value="20"', 'name="radios" value="20"', "shape cylinder: radios", "did you mean 'radius'?"),
        ("</scene>", "", "", "does not parse"),
        ('type="cylinder"', 'type="cylindre"', "type", "did you mean 'cylinder'?"),
        ('name="radius" value="20"', 'name="radius" value="nan"', "shape pillar1", "not a number"),
        ('name="p1" x="-35" y="0" z="60"', 'name="p1" x="-35" y="0" z="0"', "shape pillar1", "p0 and p1 that differ"),
        ('<scale x="90" y="60"/>', '<scale x="0.09" y="0.06"/><!--', "", "does not parse"),
    ],
)
def test_what_is_wrong_is_told(tmp_path, scenes, old, new, field, says):
    text = (scenes / TWO).read_text()
    assert old in text
    file = tmp_path / "mine.xml"
    file.write_text(text.replace(old, new, 1))
    with pytest.raises(InputError) as caught:
        load_scene(file, 850)
    assert caught.value.field == field
    assert says in str(caught.value)
    assert "mine.xml" in str(caught.value)


def test_a_part_in_metres_is_noticed(tmp_path):
    file = tmp_path / "small.xml"
    file.write_text(
        '<scene version="3.0.0"><shape type="cube" id="part"><transform name="to_world">'
        '<scale value="0.035"/></transform><bsdf type="matt_white"/></shape></scene>'
    )
    with pytest.raises(InputError, match="lengths are in mm"):
        load_scene(file, 850)


def test_missing_files_parameters_and_roots(tmp_path, scenes):
    with pytest.raises(InputError, match=r"did you mean 'two_pillars\.xml'"):
        load_scene(scenes / "two_pillars/two_pilars.xml", 850)
    with pytest.raises(InputError, match="did you mean 'plane_Ra'"):
        load_scene(scenes / TWO, 850, {"plan_Ra": "0.1"})
    (tmp_path / "other.xml").write_text("<html/>")
    with pytest.raises(InputError, match="<html>"):
        load_scene(tmp_path / "other.xml", 850)
    (tmp_path / "empty.xml").write_text('<scene version="3.0.0"/>')
    with pytest.raises(InputError, match="no shape"):
        load_scene(tmp_path / "empty.xml", 850)


@pytest.mark.parametrize(("used", "changeable"), [("plain", True), ("around", False)])
def test_only_finishes_inside_other_bsdfs_keep_a_scene_from_being_changed(tmp_path, used, changeable):
    metal = '<bsdf type="machined_metal" id="{}"><float name="Ra" value="0.4"/></bsdf>'
    bsdfs = metal.format("plain") + f'<bsdf type="twosided" id="around">{metal.format("nested")}</bsdf>'
    shape = f'<shape type="sphere"><float name="radius" value="20"/><ref id="{used}"/></shape>'
    file = tmp_path / "scene.xml"
    file.write_text(f'<scene version="3.0.0">{bsdfs}{shape}</scene>')
    assert load_scene(file, 850).changeable == changeable


def inline(tmp_path, *bsdfs, extra=""):
    """A scene of spheres beside one another, each with a BSDF of its own that has no id."""
    spheres = "".join(
        f'<shape type="sphere"><point name="center" x="{60 * k}" y="0" z="0"/>'
        f'<float name="radius" value="20"/>{bsdf}</shape>'
        for k, bsdf in enumerate(bsdfs)
    )
    file = tmp_path / "inline.xml"
    file.write_text(f'<scene version="3.0.0">{spheres}{extra}</scene>')
    return file


def test_finishes_without_an_id_have_the_same_names_in_each_loading_and_deviate_apart(tmp_path):
    """Before, a number of the process, while draws asked for no name: all shared one draw."""
    file = inline(
        tmp_path, *(f'<bsdf type="machined_metal"><float name="Ra" value="{Ra}"/></bsdf>' for Ra in (0.3, 0.4))
    )
    asked = []

    def deviation(name):
        asked.append(name)
        return Deviation(alpha=1.0 if name == "finish_1" else 0.0)

    plain, deviated = load_scene(file, 850), load_scene(file, 850, {}, deviation)
    names = [shape.bsdf().id() for shape in plain.shapes]
    assert names == [shape.bsdf().id() for shape in deviated.shapes] == ["finish_0", "finish_1"] == asked
    first, second = (
        other.scatter.alpha_v / one.scatter.alpha_v
        for one, other in zip(plain.finishes, deviated.finishes, strict=True)
    )
    assert first == 1.0 and second > 1.05


@pytest.mark.parametrize(
    ("element", "told"),
    [
        # half way between 800 and 900 nm; Mitsuba takes 0.261, the luminance
        (
            '<spectrum name="reflectance" value="400:0.1, 800:0.6, 900:0.8"/>',
            r'spectrum reflectance.*850 nm: value="0.7"',
        ),
        ('<spectrum name="reflectance" value="400:$low 700:0.6"/>', "'400:0.1 700:0.6'; allowed: one number.*850 nm$"),
        ('<spectrum name="reflectance" filename="paint.spd"/>', "'paint.spd'; allowed: one number"),
        ('<spectrum name="reflectance" type="blackbody"/>', "'blackbody'; allowed: one number"),
    ],
)
def test_a_spectrum_is_its_value_at_the_sensors_wavelength(tmp_path, element, told):
    """Of a function of the wavelength Mitsuba took the luminance, as the eye sees it: a lamp was off by factors."""
    text = '<scene version="3.0.0"><default name="low" value="0.1"/><shape type="disk"><bsdf type="diffuse">{}</bsdf>'
    (tmp_path / "scene.xml").write_text(
        text.format(element) + '<transform name="to_world"><scale value="9"/></transform></shape></scene>'
    )
    with pytest.raises(InputError, match=told):
        load_scene(tmp_path / "scene.xml", 850)


def test_a_metal_of_mitsuba_is_rejected(tmp_path):
    """Gold reflects 98 % at 850 nm (Johnson and Christy: n 0.16, k 5.3), and 82 % by the luminance of n and k."""
    text = (
        '<scene version="3.0.0"><shape type="sphere" id="ball"><float name="radius" value="9"/><bsdf type="conductor">'
    )
    index = '<spectrum name="eta" value="0.16"/><spectrum name="k" value="5.3"/>'
    refused = {
        '<string name="material" value="Au"/>': 'material: found .Au.; allowed: .*"eta" value="0.[12].*"k" value="5.',
        '<string name="material" value="nonesuch"/>': "material: found .nonesuch.; .*spectra eta and k at 850 nm",
    }
    for content in (*refused, "", '<string name="material" value="none"/>', index):
        (tmp_path / "scene.xml").write_text(f"{text}{content}</bsdf></shape></scene>")
        if content in refused:
            with pytest.raises(InputError, match=refused[content]):
                load_scene(tmp_path / "scene.xml", 850)
        else:
            assert load_scene(tmp_path / "scene.xml", 850).names == ("ball",)
