"""A form tolerance is the default of the form deviation, which moves no feature and is not counted twice."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from characterisation.point_cloud import ViewGrid
from characterisation.tasks.task_file import Task
from mitsim.scene import backend
from mitsim.scene.load import scene_from_dict
from mitsim.scene.ray_casting.raycast import PixelRays, cast
from mitsim.sensor.transforms import look_at
from mitsim.study import SetTable
from mitsim.study.view_sets.joined import JoinedMeasurements
from mitsim.study.virtual.form import SeenFaces, drawn_form, form_deviation, forms_of_faces, measured_with_form
from mitsim.study.virtual.plan import measurements_of
from mitsim.study.virtual.race import Job
from mitsim.study.virtual.stated import budget_groups
from mitsim.study.virtual.study_unknowns import study_unknowns
from mitsim.study.virtual.world import Trial
from tests.seen_shapes import points_of
from tests.smaller_sensors import coarse_sensor
from tests.study.virtual.test_rendered import SCENES, study_of

FLAT = """
[measurements.flat]
kind = "flatness"
features = ["plane"]
nominal = 0
unit = "mm"
tolerance = 0.4
"""


@pytest.fixture(scope="module")
def flat(tmp_path_factory):
    """A study of the pillars under coarse fringes, with a tolerance of the plane's flatness, by unknowns."""
    folder = tmp_path_factory.mktemp("flat")
    sensor = str(coarse_sensor("david-sls-3", 3, folder))
    text = (SCENES / "task.toml").read_text()
    kept = re.split(r"(?m)^(?=\[measurements\.)", text)
    kept = [kept[0], *(one for one in kept[1:] if one.startswith("[measurements.plane_pillar1_angle]"))]
    (folder / "task.toml").write_text("".join(kept) + FLAT)
    return lambda **unknowns: study_of(sensor, task=str(folder / "task.toml"), unknowns=unknowns)


def test_a_quarter_of_the_tolerance_is_the_default_and_the_study_overrides_it(flat) -> None:
    assert drawn_form(flat().task, {}) == {"plane": 0.1}
    assert drawn_form(flat().task, {"plane": 0.0, "pillar1": 0.02}) == {"plane": 0.0, "pillar1": 0.02}
    assert study_unknowns(flat()).table.form.features == {"plane": 0.1}
    sensor = flat().sensor
    assert "form" in budget_groups(study_unknowns(flat()), "render", sensor)
    assert "form" not in budget_groups(study_unknowns(flat(form={"features": {"plane": 0}})), "render", sensor)


def test_form_moves_other_measurements_of_the_face_but_not_that_of_the_form_itself(flat) -> None:
    study = flat(coat={"thickness_um": [0, 0]})
    maker = measurements_of(study, study_unknowns(study, ("form",)))
    view = min(study.views, key=lambda one: abs(one.elevation_deg - 45))
    world = maker.unknowns.draw(Trial(0))
    bent, plane = (
        maker._finish(maker._captured(view, replace(world, form=seed)), Job(view, Trial(0))) for seed in (world.form, 0)
    )
    assert world.form and abs(bent.errors["plane_pillar1_angle"] - plane.errors["plane_pillar1_angle"]) > 1e-3
    assert bent.errors["flat"] == plane.errors["flat"]
    assert np.array_equal(bent.deviations["flat"], plane.deviations["flat"], equal_nan=True)


def test_a_form_is_measured_once_and_the_rest_with_it(flat) -> None:
    """Half of the time of a trial of a large plane went to a flatness that was then replaced."""
    task, asked = flat().task, []

    def evaluate(part, with_form):
        asked.append((with_form, list(part.measurements)))
        return dict.fromkeys(part.measurements, with_form)

    found = measured_with_form(task, evaluate, deviates=True)
    assert list(found) == list(task.measurements)
    assert [name for name, with_form in found.items() if not with_form] == ["flat"]
    assert sorted(name for _, names in asked for name in names) == sorted(task.measurements)


def test_a_set_of_one_view_is_measured_like_the_view(flat) -> None:
    """Before, its flatness had the form of the drawing as well."""
    study = flat(coat={"thickness_um": [0, 0]})
    maker = measurements_of(study, study_unknowns(study))
    view = min(study.views, key=lambda one: abs(one.elevation_deg - 45))
    ((_, alone),) = maker.run([Job(view, Trial(3))])
    ((day, joined),) = JoinedMeasurements(maker, [view], SetTable()).run([3])
    assert day == 3 and np.isfinite(alone.errors["flat"])
    assert joined.errors == alone.errors
    np.testing.assert_equal(joined.deviations, alone.deviations)


def grids(kind):
    """Return places on a shape, their areas, and the movements of its feature by their own formulas, (n, k)."""
    nodes, weights = np.polynomial.legendre.leggauss(30)
    angles = np.arange(120) / 120 * 2 * np.pi
    if kind == "plane":
        x, y = (values.ravel() for values in np.meshgrid(30 * nodes, 40 * nodes, indexing="ij"))
        return np.c_[x, y, 0 * x], np.outer(weights, weights).ravel(), np.c_[x**0, x / 30, y / 40]
    u, angle = (values.ravel() for values in np.meshgrid(nodes, angles, indexing="ij"))
    area, c, s = np.repeat(weights, 120), np.cos(angle), np.sin(angle)
    if kind == "cylinder":
        return np.c_[20 * c, 20 * s, 30 + 30 * u], area, np.c_[u**0, c, s, u * c, u * s]
    if kind == "sphere":
        out = np.c_[np.sqrt(1 - u**2) * c, np.sqrt(1 - u**2) * s, u]
        return 12 * out + [5, 6, 7], area, np.c_[u**0, out]
    radius = 20 + 10 * u
    return np.c_[radius * c, radius * s, 20 + 20 * u], area * radius, np.c_[u**0, u, c, s, u * c, u * s]


@pytest.fixture(scope="module")
def shapes(tmp_path_factory):
    """One shape of each kind with its feature: the axes along z, the plane upward."""
    file = tmp_path_factory.mktemp("cone") / "cone.ply"
    rim = np.exp(2j * np.pi * np.arange(256) / 256)
    corners = np.concatenate([np.c_[r * rim.real, r * rim.imag, z + 0 * rim.real] for r, z in ((10, 0), (30, 40))])
    k, after = np.arange(256), np.roll(np.arange(256), -1)
    faces = np.concatenate([np.c_[k, after, 256 + k], np.c_[after, 256 + after, 256 + k]])
    trimesh.Trimesh(corners, faces, process=False).export(file)
    backend.activate()
    wide = backend.mi.ScalarTransform4f().scale([30, 40, 1])
    scene = scene_from_dict(
        {
            "plane": {"type": "rectangle", "to_world": wide},
            "cylinder": {"type": "cylinder", "p1": [0, 0, 60], "radius": 20.0},
            "sphere": {"type": "sphere", "center": [5, 6, 7], "radius": 12.0},
            "cone": {"type": "ply", "filename": str(file)},
        },
        850.0,
    )
    up = {"direction": (0, 0, 1)}
    features = {
        "plane": {"kind": "plane", "point_mm": (0, 0, 0), **up},
        "cylinder": {"kind": "cylinder", "point_mm": (0, 0, 0), "radius_mm": 20, **up},
        "sphere": {"kind": "sphere", "point_mm": (5, 6, 7), "radius_mm": 12},
        "cone": {"kind": "cone", "point_mm": (0, 0, 20), "radius_mm": 20, "half_angle_deg": np.degrees(np.arctan(0.5))}
        | up,
    }
    asked = {"radius": {"kind": "radius", "features": ["sphere"], "nominal": 12, "unit": "mm"}}
    return scene, Task.model_validate({"features": features, "measurements": asked})


@pytest.mark.parametrize("kind", ["plane", "cylinder", "sphere", "cone"])
def test_a_form_leaves_the_feature_of_its_face_in_place_and_fills_its_zone(shapes, kind) -> None:
    """Before, it moved a plane by 0.7 and tilted it by 1.0 of its standard deviations, which were counted as errors."""
    (form,) = forms_of_faces(*shapes, {kind: 0.025})
    places, areas, movements = grids(kind)
    root = np.sqrt(areas)
    for seed in range(1, 6):
        heights = form.heights(places, seed)
        moved = np.linalg.lstsq(root[:, None] * movements, root * heights, rcond=None)[0]
        assert np.abs(moved).max() < 1e-4
        assert np.ptp(heights) == pytest.approx(0.1, rel=0.03)


def test_a_bent_sheet_rises_on_one_side_where_it_falls_on_the_other(shapes) -> None:
    """Before, it came toward the sensor from both sides."""
    wide = backend.mi.ScalarTransform4f().scale([30, 40, 1])
    white = {"type": "twosided", "bsdf": {"type": "diffuse"}}
    sheet = scene_from_dict({"plane": {"type": "rectangle", "to_world": wide, "bsdf": white}}, 850.0)
    forms, grid = forms_of_faces(sheet, shapes[1], {"plane": 0.1}), ViewGrid(1000.0, 1000.0, 60.0, 60.0, 121, 121)
    heights = []
    for z in (1000, -1000):
        pose = look_at([0, 0, z], [0, 0, 0], [0, 1, 0])
        surfaces = cast(sheet, PixelRays.of_grid(grid), pose, np.zeros((0, 3)))
        flat = points_of(surfaces, grid).astype(np.float32)
        bent = pose.points(form_deviation(flat, SeenFaces(sheet, surfaces, pose, grid), forms, 5).astype(float))
        seen = np.isfinite(bent).all(axis=-1)
        place = np.rint(bent[seen][:, :2]).astype(int)
        heights.append(dict(zip(map(tuple, place.tolist()), bent[seen][:, 2].tolist(), strict=True)))
    above, below = (np.array([one[place] for place in heights[0].keys() & heights[1].keys()]) for one in heights)
    assert len(above) > 3000
    np.testing.assert_allclose(above, below, atol=2e-3)
    assert np.ptp(above) == pytest.approx(0.4, rel=0.1)
