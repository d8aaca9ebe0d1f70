"""The digests of trials and captures change with everything that these depend on, and with nothing else."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from characterisation.maps.performance_map import PerformanceMap
from mitsim.running.executor import Pool
from mitsim.sensor.preset import load_sensor
from mitsim.study import StudyFile, open_study
from mitsim.study.many_captures import origin_of
from mitsim.study.session import Session
from mitsim.study.virtual.plan import trial_digest
from mitsim.study.virtual.study_unknowns import study_unknowns
from tests.proofs.case_trials import trials_by_kind
from tests.proofs.part_cases import read_part_cases

STUDY = {
    "scene": "balls.xml",
    "task": "task.toml",
    "sensor": "ensenso-n10",
    "views": {"subdivisions": 0, "rolls_deg": [0], "standoff_mm": 450, "lowest_elevation_deg": 60},
}
TASK = """
[features.left]
kind = "sphere"
point_mm = [-40, 0, 12]
radius_mm = 12
[measurements.radius]
kind = "radius"
features = ["left"]
nominal = 12
unit = "mm"
"""
SCENE = """
<scene version="3.0.0">
    <default name="mesh" value="left"/>
    <path value="meshes"/>
    <bsdf type="matt_white" id="white"/>
    <shape type="rectangle" id="plate">
        <transform name="to_world"><scale value="80"/></transform><ref id="white"/>
    </shape>
    <shape type="ply" id="left"><string name="filename" value="$mesh.ply"/><ref id="white"/></shape>
    <include filename="right.xml"/>
</scene>
"""
RIGHT = """
<scene version="3.0.0">
    <shape type="ply" id="right"><string name="filename" value="right.ply"/><ref id="white"/></shape>
</scene>
"""


def ball(file, radius, x):
    mesh = trimesh.creation.icosphere(2, radius)
    mesh.apply_translation((x, 0, 12))
    file.parent.mkdir(exist_ok=True)
    mesh.export(file, vertex_normal=True)


@pytest.fixture
def folder(tmp_path):
    for name, text in (("balls.xml", SCENE), ("right.xml", RIGHT), ("task.toml", TASK)):
        (tmp_path / name).write_text(text)
    ball(tmp_path / "meshes" / "left.ply", 12, -40)
    ball(tmp_path / "right.ply", 12, 40)
    return tmp_path


def digest(folder, source="render", **more):
    study = open_study(folder / "study.toml", StudyFile.model_validate(STUDY | more))
    return trial_digest(study, study_unknowns(study), source)


@pytest.mark.parametrize("mesh", ["meshes/left.ply", "right.ply"])
def test_a_mesh_belongs_to_it_by_way_of_parameters_paths_and_includes(folder, mesh, monkeypatch):
    before = digest(folder)
    (folder / "other").mkdir()
    monkeypatch.chdir(folder / "other")
    assert digest(folder) == before  # wherever the program runs
    ball(folder / mesh, 9, -40 if "left" in mesh else 40)
    assert digest(folder) != before


def test_a_mesh_of_another_parameter_belongs_to_it(folder):
    shutil.copy(folder / "meshes" / "left.ply", folder / "small.ply")
    before, other = digest(folder), digest(folder, parameters={"mesh": "small"})
    ball(folder / "small.ply", 9, -40)
    assert digest(folder) == before and digest(folder, parameters={"mesh": "small"}) != other


@pytest.mark.parametrize("mesh", ["small.ply", "right.ply"])
def test_a_mesh_belongs_to_a_capture_that_is_rendered_of_it(folder, mesh):
    shutil.copy(folder / "meshes" / "left.ply", folder / "small.ply")
    sensor, of_small = load_sensor("ensenso-n10"), {"mesh": "small"}
    before = origin_of(folder / "balls.xml", sensor, of_small)
    ball(folder / mesh, 9, 40)
    assert origin_of(folder / "balls.xml", sensor, of_small) != before


def test_the_values_of_the_map_belong_to_it_if_clouds_are_drawn_from_them(folder):
    study = open_study(folder / "study.toml", StudyFile.model_validate(STUDY))
    unknowns = study_unknowns(study)
    data = study.performance_map.data.copy(deep=True)
    data["ray_noise_std"].values *= 2
    noisy = replace(study, performance_map=PerformanceMap(data))
    digests = {source: [trial_digest(one, unknowns, source) for one in (study, noisy)] for source in ("map", "render")}
    assert digests["map"][0] != digests["map"][1] and digests["render"][0] == digests["render"][1]


def test_kept_trials_of_a_case_are_not_those_of_another_mesh(folder):
    part = folder / "part"
    part.mkdir()
    shutil.move(folder / "meshes", part / "meshes")
    for name, new in (("balls.xml", "part.xml"), ("right.xml", "right.xml"), ("right.ply", "right.ply")):
        shutil.move(folder / name, part / new)
    shutil.move(folder / "task.toml", part / "task.toml")
    (folder / "cases.toml").write_text(
        'sealed = []\ncandidates = 2\n[views]\nsubdivisions = 0\n[[cases]]\npart = "part"\nsensor = "ensenso-n10"\n'
        'finish = "white"\n'
    )

    def digests():
        (case,) = read_part_cases(folder / "cases.toml")
        return {kind: one.trials.digest for kind, one in trials_by_kind(case, case.open(), folder / "run").items()}

    before = digests()
    ball(part / "right.ply", 9, 40)
    after = digests()
    assert not set(before.values()) & set(after.values())


def test_what_cannot_change_a_trial_does_not_belong_to_it(folder):
    """Before, a tolerance, a comment in the scene or the ranges of a known decoder made all trials again."""
    known = {"unknowns": {"decoder": {"known": True}}}
    before, before_known = digest(folder), digest(folder, **known)
    assert digest(folder, unknowns={"decoder": {"known": True, "p1": [5, 6]}}) == before_known != before
    assert digest(folder, unknowns={"decoder": {"p1": [5, 6]}}) != before
    (folder / "task.toml").write_text(TASK + "tolerance = 0.1\n")
    (folder / "balls.xml").write_text(SCENE.replace("<path ", "<!-- the balls -->\n\n    <path "))
    assert digest(folder) == before
    (folder / "task.toml").write_text(TASK.replace("= 12\n", "= 13\n"))
    assert digest(folder) != before
    (folder / "task.toml").write_text(TASK)
    (folder / "balls.xml").write_text(SCENE.replace('value="80"', 'value="81"'))
    assert digest(folder) != before


def test_a_tolerance_of_form_belongs_to_it_by_the_form_that_it_gives(folder):
    flat = (
        TASK.replace("sphere", "plane")
        .replace("radius_mm = 12\n", "direction = [0, 0, 1]\n")
        .replace('kind = "radius"', 'kind = "flatness"')
        .replace("nominal = 12", "nominal = 0\ntolerance = 0.1")
    )
    (folder / "task.toml").write_text(flat)
    before = digest(folder)
    (folder / "task.toml").write_text(flat.replace("0.1", "0.2"))
    assert digest(folder) != before


def test_last_digits_of_a_simulated_calibration_do_not_belong_to_it(folder):
    """Before, trials were made again if the number of BLAS threads changed the covariance by some 1e-10."""
    given = open_study(folder / "study.toml", StudyFile.model_validate(STUDY))
    study = replace(given, sensor=replace(given.sensor, name="mine"))  # which has no covariance
    unknowns = study_unknowns(study)
    rng = np.random.default_rng(1)

    def digest_of(relative, stated):
        factor = 1 + relative * rng.standard_normal(unknowns.calibration.covariance.shape)
        matrix = unknowns.calibration.covariance * (factor + factor.T) / 2
        calibration = replace(unknowns.calibration, covariance=matrix, simulated=not stated)
        return trial_digest(study, replace(unknowns, calibration=calibration), "render")

    assert unknowns.calibration.simulated
    assert digest_of(2e-10, False) == digest_of(2e-10, False) == trial_digest(study, unknowns, "render")
    assert digest_of(0.1, False) != trial_digest(study, unknowns, "render")
    assert digest_of(2e-10, True) != digest_of(2e-10, True)
    assert not study_unknowns(given).calibration.simulated


def test_workers_prepare_a_part_anew_if_its_mesh_has_changed(folder):
    def order_digest():
        study = open_study(folder / "study.toml", StudyFile.model_validate(STUDY))
        return Session(study, folder, workers=Pool(2)).runner._order.digest

    before = order_digest()
    assert order_digest() == before
    ball(folder / "right.ply", 9, 40)
    assert order_digest() != before
