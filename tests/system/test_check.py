"""mitsim check: every surprise that it knows, on scenes that have it; its output; its picture."""

from __future__ import annotations

import json

import numpy as np
import pytest
import trimesh
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.image import imread

from characterisation.files.errors import InputError
from mitsim.report.scene_preview import preview_figure, without_leaks
from mitsim.report.scene_table import as_data, as_text
from mitsim.report.style import write_png
from mitsim.scene.authoring.check import findings, open_borders
from mitsim.scene.authoring.check_task import read_features
from mitsim.scene.inspect import inspect
from mitsim.scene.load import load_scene
from mitsim.scene.visible_surfaces import visible_surfaces
from mitsim.sensor.working_volume import common_view, field_of_view, in_image, in_working_volume, pose_at, usual_place
from tests.shell import ROOT, mitsim_here
from tests.small_study import small_study
from tests.smaller_sensors import binned

METAL = """<bsdf type="machined_metal"><string name="metal" value="aluminium"/>
    <string name="process" value="ground"/><float name="Ra" value="0.4"/></bsdf>"""
PLATE = '<transform name="to_world"><scale x="60" y="40"/></transform>'
TURN = '<rotate x="1" angle="180"/>'
BALL = '<float name="radius" value="30"/>'


class Checked:
    """A scene with everything that was found about it."""

    def __init__(self, file, sensor, position=None, task=None, target=(0.0, 0.0, 0.0), seen_by=None):
        self.scene = load_scene(file, sensor.wavelength_nm)
        self.facts = inspect(self.scene)
        place = usual_place(sensor, self.scene.centre) if position is None else np.asarray(position, float)
        aim = self.scene.centre if position is None else np.asarray(target, float)
        self.pose = pose_at(sensor, place, aim)
        self.visible = visible_surfaces(self.scene, (seen_by or sensor).rig, self.pose)
        self.task = task
        self.found = findings(self.facts, sensor, self.pose, self.visible, position is not None, task)

    def says(self, severity, about, text):
        return any(f.severity == severity and f.about == about and text in f"{f.what}. {f.advice}" for f in self.found)


@pytest.fixture(scope="module")
def coarse(n10):
    """The sensor with a quarter of its pixels, which is enough to see what stands before it."""
    return binned(n10, 2)


@pytest.fixture
def check(tmp_path, n10, coarse):
    def run(body, **options):
        file = tmp_path / "mine.xml"
        file.write_text(f'<scene version="3.0.0">{body}</scene>')
        if "task" in options:
            (tmp_path / "task.toml").write_text(options["task"])
            options["task"] = read_features(tmp_path / "task.toml")
        return Checked(file, n10, seen_by=coarse, **options)

    return run


@pytest.mark.parametrize("scene", ["two_pillars/two_pillars.xml", "coupon/coupon.xml", "coupon/matt_white.xml"])
def test_the_shipped_scenes_hold_no_surprise(scenes, n10, coarse, scene):
    task = read_features(scenes / "two_pillars/task.toml") if "pillars" in scene else None
    assert [str(f) for f in Checked(scenes / scene, n10, task=task, seen_by=coarse).found] == []


@pytest.mark.parametrize(
    ("body", "severity", "about", "says"),
    [
        (f'<shape type="sphere">{BALL}{METAL}</shape>', "warning", "shape_0", "without an id"),
        (f'<shape type="sphere" id="s">{BALL}<bsdf type="conductor"/></shape>', "warning", "s", "black under"),
        (f'<shape type="sphere" id="s">{BALL}<bsdf type="dielectric"/></shape>', "warning", "s", "black under"),
        (f'<shape type="sphere" id="s">{BALL}<bsdf type="diffuse"/></shape>', "warning", "s", "no finish"),
        (f'<shape type="sphere" id="s">{BALL}{METAL.replace("0.4", "3.2")}</shape>', "warning", "s", "0.05 to 1.6 um"),
        (
            f'<shape type="sphere" id="s"><float name="radius" value="3"/>{METAL}</shape>',
            "warning",
            "",
            "modelled in inches it is 152.4 mm: scale by 25.4",
        ),
        (
            f'<shape type="sphere" id="s"><float name="radius" value="0.6"/>{METAL}</shape>',
            "warning",
            "",
            "modelled in metres it is 1200 mm: scale by 1000",
        ),
        (
            f'<shape type="sphere" id="s"><float name="radius" value="400"/>{METAL}</shape>',
            "warning",
            "",
            "several views",
        ),
        (
            f'<shape type="sphere" id="s"><boolean name="flip_normals" value="true"/>{BALL}{METAL}</shape>',
            "error",
            "s",
            "inward normals",
        ),
        (
            f'<shape type="cube" id="c"><boolean name="flip_normals" value="true"/>{PLATE}{METAL}</shape>',
            "error",
            "c",
            "inward normals: a closed mesh of -1.92e+04 mm^3",
        ),  # 120 x 80 x 2 mm
        (
            f'<shape type="rectangle" id="p">{PLATE.replace("<scale", TURN + "<scale")}{METAL}</shape>',
            "warning",
            "p",
            "shows only its black back in this view",
        ),
        (
            f'<shape type="sphere" id="s">{BALL}{METAL}</shape><shape type="sphere" id="in"><float name="radius" '
            'value="9"/>'
            f"{METAL}</shape>",
            "note",
            "in",
            "visible from nowhere",
        ),
        (
            f'<shape type="sphere" id="s">{BALL}{METAL}</shape><emitter type="point"><rgb name="intensity" value="2"/>'
            "</emitter>",
            "note",
            "",
            "25.1 W in all",
        ),
    ],
)
def test_each_surprise_is_told(check, body, severity, about, says):
    checked = check(body)
    assert checked.says(severity, about, says), [str(f) for f in checked.found]


def test_nothing_is_said_of_a_sound_part(check):
    assert check(f'<shape type="sphere" id="s">{BALL}{METAL}</shape>').found == []


def test_a_lay_needs_lengths_on_the_mesh(check, tmp_path):
    trimesh.creation.box((80, 80, 20)).export(tmp_path / "box.ply", vertex_normal=False)
    brushed = METAL.replace("</bsdf>", '<string name="lay" value="u"/></bsdf>')
    mesh = f'<shape type="ply" id="box"><string name="filename" value="box.ply"/>{brushed}</shape>'
    assert check(mesh).says("warning", "box", "direction is arbitrary")
    assert check(mesh.replace(brushed, METAL)).found == []


def test_faults_of_a_mesh_are_told(check, tmp_path):
    ball = trimesh.creation.icosphere(3, 30)
    mesh = f'<shape type="ply" id="ball"><string name="filename" value="ball.ply"/>{METAL}</shape>'
    trimesh.Trimesh(ball.vertices, ball.faces[4:]).export(tmp_path / "ball.ply")
    checked = check(mesh)
    assert checked.says("warning", "ball", "not watertight: 6 open edges")  # one triangle of the base, cut in four
    assert checked.says("note", "", "not closed (6 open edges)")
    trimesh.Trimesh(ball.vertices, np.vstack([ball.faces, ball.faces[:2]]), process=False).export(tmp_path / "ball.ply")
    assert check(mesh).says("warning", "ball", "0 triangles without area, 2 duplicates")
    ball.invert()
    ball.export(tmp_path / "ball.ply")
    assert check(mesh).says("error", "ball", "inward normals")


def test_a_long_edge_closes_the_short_ones_along_it(check, tmp_path):
    """A cone of which one edge of the wall is cut in eight on one side only, as CAD programs mesh a countersink."""
    angles = 2 * np.pi * np.arange(64) / 64
    rim = 30 * np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    tip = np.array([0.0, 0.0, 30.0])
    wall = [[rim[i], rim[(i + 1) % 64], tip] for i in range(1, 64)]
    cut = [rim[0] + share * (tip - rim[0]) for share in np.arange(9) / 8]
    wall += [[cut[i], rim[1], cut[i + 1]] for i in range(8)]
    base = [[rim[(i + 1) % 64], rim[i], np.zeros(3)] for i in range(64)]
    shapes = ""
    for name, triangles in (("wall", wall), ("base", base)):
        vertices = np.reshape(triangles, (-1, 3))
        trimesh.Trimesh(vertices, np.arange(len(vertices)).reshape(-1, 3)).export(tmp_path / f"{name}.ply")
        shapes += f'<shape type="ply" id="{name}"><string name="filename" value="{name}.ply"/>{METAL}</shape>'
    checked = check(shapes)
    assert checked.facts.merged_mesh.open_edges == 9
    assert [str(one) for one in checked.found] == []
    alone = check(shapes[: shapes.index("</shape>") + 8])
    assert sum(map(len, open_borders(alone.facts))) == 64


def test_many_shapes_are_counted_and_findings_of_one_kind_share_a_line(check):
    balls = "".join(
        f'<shape type="sphere" id="b{i}"><point name="center" x="{20 * (i % 6)}" y="{20 * (i // 6)}" z="0"/>'
        f'<float name="radius" value="8"/><bsdf type="diffuse"/></shape>'
        for i in range(30)
    )
    task = ""
    for i in (25, 28):
        task += f"[features.b{i}]\nkind='sphere'\npoint_mm=[{20 * (i % 6)},{20 * (i // 6)},0]\nradius_mm=8\n"
        task += f"[measurements.r{i}]\nkind='radius'\nfeatures=['b{i}']\nnominal=8\nunit='mm'\n"
    checked = check(balls, task=task)
    parts = checked.facts, checked.visible, checked.found, checked.task.measured_shapes()
    lines = as_text(*parts).splitlines()
    rows = lines[1 : lines.index("and 10 more shapes; --all lists them")]
    assert [row.split()[0] for row in rows] == ["b25", "b28", *(f"b{i}" for i in range(18))]
    assert [line[:11] for line in lines if line.startswith("error: ")] == ["error: b25:", "error: b28:"]
    assert sum("b0, b1, b2 and 25 more: the BSDF diffuse has no finish" in line for line in lines) == 1
    every = as_text(*parts, every=True).splitlines()
    assert [row.split()[0] for row in every[1:31]] == ["b25", "b28", *(f"b{i}" for i in range(30) if i not in (25, 28))]
    assert [line for line in every if ": " in line] == [str(one) for one in checked.found]


TASK = '[features.ball]\nkind = "sphere"\npoint_mm = [0, 0, 0]\nradius_mm = 30\n'


@pytest.mark.parametrize(
    ("task", "severity", "about", "says"),
    [
        (TASK, "note", "task", "no measurements yet"),
        (TASK.replace("ball", "bal"), "error", "bal", "Did you mean 'ball'?"),
        (TASK.replace("ball", "thing"), "error", "thing", "The shapes are: ball"),
        (TASK.replace("30", "30.2"), "warning", "ball", "up to 0.2 mm off"),
        (TASK.replace("[0, 0, 0]", "[0, 0, 4]"), "error", "ball", "up to 4 mm off"),
    ],
)
def test_a_task_is_held_against_the_shapes(check, task, severity, about, says):
    checked = check(f'<shape type="sphere" id="ball">{BALL}{METAL}</shape>', task=task)
    assert checked.says(severity, about, says), [str(f) for f in checked.found]


def test_a_faceted_shape_is_told_from_a_misplaced_one(check, tmp_path):
    ball = trimesh.creation.icosphere(2, 30)
    ball.export(tmp_path / "ball.ply")
    sag = 30 - np.linalg.norm(ball.triangles_center, axis=1).min()
    mesh = f'<shape type="ply" id="ball"><string name="filename" value="ball.ply"/>{METAL}</shape>'
    checked = check(mesh, task=TASK)
    assert checked.says("warning", "ball", f"facets deviate by up to {sag:.2g} mm")
    assert not any("correct point_mm" in f.advice for f in checked.found)


def test_a_stock_material_on_a_measured_feature_is_an_error(check):
    checked = check(f'<shape type="sphere" id="ball">{BALL}<bsdf type="diffuse"/></shape>', task=TASK)
    assert checked.says("error", "ball", "no finish")
    assert checked.found[0].severity == "error"


@pytest.mark.parametrize(
    ("position", "severity", "says"),
    [
        ((0, -100, 200), "warning", "outside the working volume in this pose"),
        ((0, -900, 900), "warning", "the sensor works from 400 to 800 mm"),
        ((0, -300, 295), "note", "% of the facing area lies"),
    ],
)
def test_a_chosen_pose_is_held_against_the_working_volume(check, position, severity, says):
    ball = f'<shape type="sphere" id="ball">{BALL}{METAL}</shape>'
    checked = check(ball, position=position)
    assert checked.says(severity, "ball", says), [str(f) for f in checked.found]
    assert check(ball, position=(0, -400, 400)).found == []


def test_what_hides_is_told(check):
    body = (
        f'<shape type="sphere" id="ball">{BALL}{METAL}</shape><shape type="rectangle" id="screen"><transform '
        f'name="to_world"><scale value="150"/><translate z="60"/></transform>{METAL}</shape>'
    )
    checked = check(body, position=(0, 0, 550))
    assert checked.says("warning", "ball", "other faces occlude it")


def test_the_working_volume_is_that_of_all_eyes(n10, rng):
    """Against the pinhole geometry on the axis, and against projection by hand elsewhere."""
    centre = n10.rig.reference.matrix[:2, 2]
    assert common_view(n10, 600)[int(centre[1]), int(centre[0])]
    assert in_working_volume(n10, np.array([[0, 0, 399.0], [0, 0, 401], [0, 0, 799], [0, 0, 801]])).tolist() == [
        False,
        True,
        True,
        False,
    ]
    points = rng.uniform([-600, -600, 350], [700, 600, 850], (2000, 3))
    inside = in_working_volume(n10, points)
    assert 0.05 < inside.mean() < 0.9
    for camera in [*n10.rig.cameras.values(), n10.rig.projector]:
        pixels = camera.project(points[inside])
        assert (pixels > -0.5).all()
        assert (pixels < np.array([camera.width, camera.height]) - 0.5).all()
    # the middle of what all eyes see at 600 mm lies midway between the outer columns of the common view
    seen = common_view(n10, 600)
    columns = np.flatnonzero(seen[int(centre[1])])
    width, _ = field_of_view(n10, 600)
    rays = n10.rig.reference.rays(np.array([[c, centre[1]] for c in columns[[0, -1]]]))
    assert np.ptp(rays[:, 0] / rays[:, 2]) * 600 <= 1.02 * width


def test_a_point_far_beside_the_image_does_not_fold_back_into_it(n10):
    """The distortion polynomial of the preset turns back at wide angles: such pixels must not count."""
    angle = np.radians(np.arange(50, 89))
    points = 500 * np.stack([np.sin(angle), np.zeros_like(angle), np.cos(angle)], axis=-1)
    camera = n10.rig.reference
    assert np.isnan(camera.project(points)).any()
    assert not in_image(camera, points).any()


def test_text_and_data_say_the_same(scenes, n10):
    checked = Checked(scenes / "two_pillars/two_pillars.xml", n10)
    text = as_text(checked.facts, checked.visible, checked.found)
    data = as_data(checked.facts, checked.visible, checked.found)
    lines = text.splitlines()
    assert lines[0].split()[:2] == ["feature", "material"]
    assert lines[-1] == "no problems found"
    row = next(line for line in lines if line.startswith("pillar1 ")).split()
    assert row[1:3] == ["aluminium/ground", "0.37"]
    pillar = next(feature for feature in data["features"] if feature["name"] == "pillar1")
    assert row[-1] == str(pillar["pixels_seen_by_all"])
    assert pillar["bounds_mm"] == [[-55, -20, 0], [-15, 20, 60]]
    assert (pillar["triangles"], pillar["closed"], pillar["finish"]) == (None, None, "aluminium/ground")
    json.dumps(data, allow_nan=False)


def test_the_wall_of_a_bore_is_noted_until_its_rim_is_a_feature(check):
    wall = (
        '<shape type="cylinder" id="{name}"><point name="p0" x="{x}" y="0" z="-10"/>'
        '<point name="p1" x="{x}" y="0" z="0"/>'
        '<float name="radius" value="20"/><boolean name="flip_normals" value="{flip}"/>' + METAL + "</shape>"
    )
    body = wall.format(name="bore", x=-30, flip="true") + wall.format(name="pin", x=30, flip="false")
    task = "[features.top]\nkind='plane'\npoint_mm=[0,0,0]\ndirection=[0,0,1]\n"
    for name, x in (("bore", -30), ("pin", 30)):
        task += f"[features.{name}]\nkind='cylinder'\npoint_mm=[{x},0,0]\ndirection=[0,0,1]\nradius_mm=20\n"
        task += f"[measurements.{name}_d]\nkind='diameter'\nfeatures=['{name}']\nnominal=40\nunit='mm'\n"
    checked = check(body, task=task)
    assert checked.says("note", "bore", "measure its rim") and not checked.says("note", "pin", "measure its rim")
    rim = "[features.rim]\nkind='circle'\nof=['top']\npoint_mm=[-30,0,0]\nradius_mm=20\n"
    assert not check(body, task=task + rim).says("note", "bore", "measure its rim")


def test_the_picture_shows_every_feature_in_a_colour_of_its_own(scenes, n10, tmp_path):
    checked = Checked(scenes / "two_pillars/two_pillars.xml", n10)
    figure = preview_figure(checked.scene, checked.facts, n10, checked.pose, checked.visible, ["pillar1"])
    image = imread(write_png(figure, tmp_path / "preview.png"))[..., :3]
    assert image.shape[1] == 1200
    labels = [text.get_text() for legend in figure.legends for text in legend.get_texts()]
    assert labels[:2] == ["plane  aluminium/ground, Ra 0.74 µm", "pillar1  aluminium/ground, Ra 0.37 µm"]
    colours = [patch.get_facecolor()[:3] for patch in figure.legends[0].get_patches()]
    assert len(set(colours)) == 5
    for colour in colours:  # in the legend, and shaded in at least one view: same proportions of red, green and blue
        brightness = image.sum(-1) / sum(colour)
        alike = np.abs(image - brightness[..., None] * np.array(colour)).max(-1) < 0.02
        assert (alike & (brightness > 0.4) & (brightness < 0.999)).sum() > 300, colour
    FigureCanvasAgg(figure).draw()
    texts = [t.get_window_extent() for legend in figure.legends for t in legend.get_texts()]
    for i, one in enumerate(texts):
        assert one.x1 < figure.bbox.width
        assert not any(one.overlaps(other) for other in texts[i + 1 :])


def test_the_part_fills_the_picture_and_faces_without_a_measurement_are_grey(scenes, coarse, tmp_path):
    (tmp_path / "task.toml").write_text(
        "[features.plane]\nkind = 'plane'\npoint_mm = [0, 0, 0]\ndirection = [0, 0, 1]\n"
        "[features.pillar1]\nkind = 'cylinder'\npoint_mm = [-35, 0, 0]\ndirection = [0, 0, 1]\nradius_mm = 20\n"
        "[features.hole]\nkind = 'circle'\nof = ['plane']\npoint_mm = [0, 0, 0]\nradius_mm = 2\n"
        "[measurements.d]\nkind = 'diameter'\nfeatures = ['hole']\nnominal = 4\nunit = 'mm'\n"
    )
    task = read_features(tmp_path / "task.toml")
    assert task.measured_shapes() == ("plane",)  # the circle lies in it, and the pillar is not measured
    checked = Checked(scenes / "two_pillars/two_pillars.xml", coarse, task=task)
    shown = preview_figure(
        checked.scene, checked.facts, coarse, checked.pose, checked.visible, (), task.measured_shapes()
    )
    labels = [text.get_text() for text in shown.legends[0].get_texts()]
    assert labels[0].startswith("plane") and labels[1:] == ["4 not measured"]
    left = shown.axes[0]
    rows, columns = np.nonzero(checked.visible.shape >= 0)
    (x0, x1), (y1, y0) = left.get_xlim(), left.get_ylim()
    assert x0 < columns.min() and columns.max() < x1 and y0 < rows.min() and rows.max() < y1
    filled = max(np.ptp(columns) / (x1 - x0), np.ptp(rows) / (y1 - y0))
    assert 0.85 < filled < 0.95


def test_a_part_out_of_sight_and_one_of_many_shapes_are_drawn_too(check, coarse, tmp_path):
    row = "".join(
        f'<shape type="sphere" id="ball_{i}"><point name="center" x="{30 * i}" y="0" z="0"/>'
        f'<float name="radius" value="{10 + 0.1 * i}"/>{METAL}</shape>'
        for i in range(12)
    )
    for options in ({}, {"position": (0, -500, 900), "target": (0, -900, 900)}):
        checked = check(row, **options)
        figure = preview_figure(checked.scene, checked.facts, coarse, checked.pose, checked.visible)
        write_png(figure, tmp_path / "row.png")
        labels = [text.get_text() for text in figure.legends[0].get_texts()]
        assert labels[-1] == "5 more shapes"
        assert len(labels) == 8


def test_the_command_prints_writes_and_judges(tmp_path):
    scene, task = "scenes/two_pillars/two_pillars.xml", "scenes/two_pillars/task.toml"
    done = mitsim_here("check", scene, "--task", task, "-D", "pillar_Ra=2.5", "--json", "-o", tmp_path / "two.png")
    data = json.loads(done.stdout)
    assert [f["about"] for f in data["findings"]] == ["pillar1", "pillar1_top", "pillar2", "pillar2_top"]
    assert data["features"][1]["Ra_um"] == 2.5
    assert "--position 0 -424.3 454.3 --target 0 0 30" in done.stderr
    assert (tmp_path / "two.png").read_bytes()[:4] == b"\x89PNG"
    (tmp_path / "other.toml").write_text((ROOT / task).read_text().replace("pillar2", "pillar3"))
    done = mitsim_here("check", scene, "--task", tmp_path / "other.toml", code=1)
    assert "error: pillar3: a feature of the task without a shape in the scene. Did you mean" in done.stdout


def test_a_nominal_value_that_the_part_does_not_have_is_an_error_of_check_and_stops_a_study(tmp_path):
    scene, task = "scenes/two_pillars/two_pillars.xml", tmp_path / "task.toml"
    task.write_text((ROOT / "scenes/two_pillars/task.toml").read_text().replace("nominal = 70.0", "nominal = 35.0", 1))
    done = mitsim_here("check", scene, "--task", task, code=1)
    assert "error: point1_point2_distance: the nominal value is 35; allowed: 70 mm, from the geometry of" in done.stdout
    study = tmp_path / "study.toml"
    study.write_text(small_study("{}", task=task))
    done = mitsim_here("study", "score", study, "-o", tmp_path / "scores", code=2)
    assert "measurements.point1_point2_distance.nominal: found 35; allowed: 70 mm" in done.stderr
    assert not list(tmp_path.glob("scores/*"))


def test_bad_input_is_told_with_code_2(tmp_path):
    (tmp_path / "mine.xml").write_text('<scene version="3.0.0"><shape type="spere" id="a"/></scene>')
    done = mitsim_here("check", tmp_path / "mine.xml", code=2)
    assert "did you mean 'sphere'" in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "features"),
        (
            TASK + '[measurements.r]\nkind = "radius"\nfeatures = ["bal"]\nnominal = 1\nunit = "mm"\n',
            "did you mean 'ball'",
        ),
        (TASK + "[measurement.r]\n", "did you mean 'measurements'"),
    ],
)
def test_a_bad_task_is_told(tmp_path, text, says):
    (tmp_path / "task.toml").write_text(text)
    with pytest.raises(InputError, match=says):
        read_features(tmp_path / "task.toml")


def test_a_leaked_ray_takes_the_colour_of_its_neighbours_and_edges_stay():
    shape = np.zeros((6, 8), np.int16)
    shape[:, 5:] = 1
    front = np.ones(shape.shape, bool)
    shape[2, 2], front[4, 6] = -1, False  # through a crack: nothing, or the back of another face
    source = without_leaks(shape, front)
    healed = shape.reshape(-1)[source]
    assert (healed == np.where(np.arange(8) >= 5, 1, 0)).all() and front.reshape(-1)[source].all()
    shape[1:4, 1:4] = 2  # a small face stays
    assert (shape.reshape(-1)[without_leaks(shape, np.ones(shape.shape, bool))] == shape).all()


def test_the_pose_of_a_run_is_that_of_the_picture(tmp_path):
    (tmp_path / "scene.xml").write_text(
        f'<scene version="3.0.0"><shape type="sphere" id="s">{BALL}{METAL}</shape></scene>', encoding="utf-8"
    )
    wanted = np.diag([1.0, -1.0, -1.0, 1.0])
    wanted[:3, 3] = [5.0, -10.0, 500.0]
    (tmp_path / "statement.json").write_text(json.dumps({"world_from_sensor": wanted.tolist()}), encoding="utf-8")
    asked = ["check", tmp_path / "scene.xml", "--pose", tmp_path / "statement.json", "--json"]
    said = mitsim_here(*asked)
    assert json.loads(said.stdout)["world_from_sensor"] == wanted.tolist() and "no position" not in said.stderr
    both = mitsim_here(*asked, "--position", "0", "0", "500", code=2)
    assert both.stderr.startswith("mitsim: --pose: found --position too")
