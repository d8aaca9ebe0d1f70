"""A small study from the shell: what a run leaves, and the commands that go on from there."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest

from characterisation.cloud_files import read_cloud
from characterisation.maps.performance_map import PerformanceMap
from tests.plain_pages import without_pictures
from tests.shell import ROOT, mitsim_here
from tests.small_study import MEASUREMENTS, few_measurements
from tests.smaller_sensors import coarse_sensor


@pytest.fixture(scope="module")
def study_folder(tmp_path_factory):
    """A study small enough for a test: 6 normals, 2 samples, a dozen views, 3 of the task's measurements."""
    folder = tmp_path_factory.mktemp("study")
    scenes = (ROOT / "scenes").as_posix()
    (folder / "campaign.toml").write_text(f"""
        distances_mm = [400, 600]
        samples_per_pixel = 4
        orientations = [{{ up_to_deg = 72, subdivisions = 0 }}]
        [[samples]]
        scene = "{scenes}/coupon/matt_white.xml"
        [[samples]]
        scene = "{scenes}/coupon/coupon.xml"
        parameters = {{ Ra = 1.6 }}
    """)
    (folder / "study.toml").write_text(f"""
        scene = "{scenes}/two_pillars/two_pillars.xml"
        parameters = {{ plane_Ra = 1.6, pillar_Ra = 1.6 }}
        task = "task.toml"
        sensor = "{coarse_sensor("ensenso-n10", 2, folder).name}"
        [characterisation]
        campaign = "campaign.toml"
        [views]
        subdivisions = 0
        standoff_mm = 500
        rolls_deg = [0, 90]
        lowest_elevation_deg = 20
        [score]
        light_path_depth = 1
        [measure]
        samples_per_pixel = 4
        light_path_depth = 1
        [race]
        shortlist = 1
        trials = 4
        [statement]
        trials = 2
        [check]
        views = 2
    """)
    (folder / "task.toml").write_text(few_measurements())
    with without_pictures():  # `mitsim report` writes the page with its pictures below
        return folder, mitsim_here("run", folder / "study.toml", "-o", folder / "out")


def test_run_leaves_everything(study_folder):
    folder, done = study_folder
    out = folder / "out"
    for name in (
        "run.json",
        "map.nc",
        "samples.nc",
        "scores.csv",
        "scores.nc",
        "checks.nc",
        "statement.json",
        "report.html",
    ):
        assert (out / name).stat().st_size > 0, name
    shown = json.loads((out / "run.json").read_text())["checked_views"]
    assert 1 <= len(shown) <= 2
    assert sorted(path.name for path in (out / "captures").iterdir()) == sorted(f"view_{v:04d}" for v in shown)
    assert len(list((out / "clouds").glob("rendered_*.ply"))) == len(shown)
    assert not list(out.rglob("*.partial"))
    assert len(list((out / "clouds").glob("predicted_*.ply"))) >= 2
    assert {"poses.csv", "poses.json"} <= {path.name for path in (out / "poses").iterdir()}
    for step in ("characterise", "score views", "race", "state view", "predict clouds", "render pictures"):
        assert step in done.stderr
    run = json.loads((out / "run.json").read_text())
    assert run["source"] == "simulated"
    assert "matt white" in run["exposure_rule"]
    assert PerformanceMap.load(out / "map.nc").data.attrs["exposure_rule"] == run["exposure_rule"]
    assert set(run["render_residual"]) == {"noise", "quadrature", "outliers"}
    assert run["render_residual"]["noise"] == 0 < run["render_residual"]["quadrature"]  # direct light, few samples
    assert "matt_white: render noise 0.000" in done.stderr  # 4 samples per pixel are too few


def test_scores_are_a_row_per_measurement_and_view_best_first(study_folder):
    folder, _ = study_folder
    with (folder / "out/scores.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0])[:4] == ["measurement", "view", "rank", "view_score"]
    run = json.loads((folder / "out/run.json").read_text())
    assert len(rows) == len(MEASUREMENTS) * run["views"]
    assert set(run["measurements"]) == set(MEASUREMENTS)
    for name in MEASUREMENTS:
        mine = [row for row in rows if row["measurement"] == name]
        every = list(range(1, run["views"] + 1))
        assert [int(row["final_rank"]) for row in mine] == every
        measured = [int(row["trials"]) > 0 for row in mine]
        assert measured == sorted(measured, reverse=True) and measured[0]  # the race comes first
        risks = [float(row["measured_risk"]) for row in mine if int(row["trials"])]
        assert risks == sorted(risks)
        screened = sorted(mine, key=lambda row: int(row["uncertainty_rank"]))
        uncertainty = [float(row["predicted_uncertainty"]) for row in screened if float(row["chance"]) >= 0.5]
        assert uncertainty == sorted(uncertainty) and uncertainty[0] > 0
        by_score = sorted(mine, key=lambda row: int(row["rank"]))
        assert [int(row["rank"]) for row in by_score] == every
        scores = [float(row["view_score"]) for row in by_score]
        assert scores == sorted(scores, reverse=True)
    best = rows[0]
    position = np.array([float(best[f"position_{axis}_mm"]) for axis in "xyz"])
    assert np.isclose(np.linalg.norm(position - [0, 0, 30]), 500, atol=0.1)
    assert np.isclose(sum(float(best[f"quaternion_{axis}"]) ** 2 for axis in "xyzw"), 1)


def test_run_again_uses_the_map_and_gives_the_same(study_folder):
    folder, _ = study_folder
    before = (folder / "out/scores.csv").read_bytes()
    statement = (folder / "out/statement.json").read_bytes()
    with without_pictures():
        done = mitsim_here("run", folder / "study.toml", "-o", folder / "out", "--overwrite")
    assert "characterise: 0 done" in done.stderr and "state view" not in done.stderr  # all are there
    assert (folder / "out/scores.csv").read_bytes() == before
    assert (folder / "out/statement.json").read_bytes() == statement


def test_a_run_is_exported_for_other_tools(study_folder, tmp_path):
    for module in ("rerun", "pygltflib", "pxr", "rosbags", "pye57"):
        pytest.importorskip(module)
    folder, _ = study_folder
    shown = len(json.loads((folder / "out/run.json").read_text())["checked_views"])
    clouds = len(list((folder / "out/clouds").iterdir()))
    for suffix in ("rrd", "glb", "usdc", "mcap", "e57"):
        said = mitsim_here("export", "run", folder / "out", "-o", tmp_path / f"run.{suffix}").stderr
        assert clouds > shown
        assert (f"{clouds} clouds" in said) == (suffix in ("rrd", "mcap", "e57"))  # glTF and USD hold none
    said = mitsim_here("export", "results", folder / "out", "-o", tmp_path / "run.qif").stderr
    assert f"{len(MEASUREMENTS)} measurements" in said and "mitsim.verdict" in (tmp_path / "run.qif").read_text()
    mitsim_here("export", "targets", folder / "out", "--robot", "abb", "--views", "all", "-o", tmp_path / "views.mod")
    views = json.loads((folder / "out/run.json").read_text())["views"]
    assert (tmp_path / "views.mod").read_text().count("robtarget view_") == views
    cloud = next((folder / "out/clouds").glob("predicted_*.ply"))
    said = mitsim_here("export", "cloud", cloud, "-o", tmp_path / "cloud.pcd").stderr
    points = len(read_cloud(cloud).points[read_cloud(cloud).valid])
    assert f"{points} points, {points} of them with a covariance" in said


def test_score_prints_the_best_views_as_the_run_ranked_them(study_folder, tmp_path):
    folder, _ = study_folder
    done = mitsim_here(
        "study",
        "score",
        folder / "study.toml",
        "--map",
        folder / "out/map.nc",
        "--top",
        3,
        "--measurement",
        "pillar1_radius",
        "-o",
        tmp_path / "scores",
    )
    lines = done.stdout.splitlines()
    assert lines[0].startswith("pillar1_radius [mm]:")
    assert len(lines) == 2 + 3 + 1

    def rows(path):
        with path.open(newline="") as file:
            mine = [row for row in csv.DictReader(file) if row["measurement"] == "pillar1_radius"]
        return sorted(mine, key=lambda row: int(row["uncertainty_rank"]))

    ran, scored = rows(folder / "out/scores.csv"), rows(tmp_path / "scores/scores.csv")
    assert [line.split()[1] for line in lines[2:5]] == [row["view"] for row in ran[:3]]
    assert [{key: row[key] for key in scored[0]} for row in ran] == scored
    assert (tmp_path / "scores/poses/poses.json").exists()
    said = mitsim_here(
        "study",
        "score",
        folder / "study.toml",
        "--map",
        folder / "out/map.nc",
        "--measurement",
        "pillar9",
        "-o",
        tmp_path / "no",
        code=2,
    ).stderr
    assert "pillar9" in said


def test_a_set_of_views_is_chosen_and_told(study_folder, tmp_path):
    folder, _ = study_folder
    text = (folder / "study.toml").read_text().replace('campaign = "campaign.toml"', 'map = "out/map.nc"')
    table = "[set]\nlimits = {{ pillar1_radius = {0}, pillar2_radius = {0} }}\n"
    (folder / "set.toml").write_text(text + table.format(100.0))
    done = mitsim_here("study", "score", folder / "set.toml", "--measurement", "pillar1_radius", "-o", tmp_path / "one")
    assert "views that measure together: " in done.stderr and "(the fewest)" in done.stderr
    (folder / "wrong.toml").write_text(text + "[set]\nlimits = { pilar1_radius = 1.0 }\n")
    done = mitsim_here("study", "score", folder / "wrong.toml", "-o", tmp_path / "no", code=2)
    assert "set.limits.pilar1_radius" in done.stderr
    (folder / "small.toml").write_text(text + table.format(1e-5))
    done = mitsim_here("study", "score", folder / "small.toml", "-o", tmp_path / "small")
    assert "is unreachable" in done.stderr


def test_report_and_predict_from_what_run_left(study_folder, tmp_path):
    folder, _ = study_folder
    (folder / "out/report.html").unlink()
    mitsim_here("report", folder / "out")
    page = (folder / "out/report.html").read_text()
    for name in ("point1_point2_distance", "pillar2_radius", "simulated", "ensenso-n10"):
        assert name in page
    mitsim_here(
        "map",
        "predict",
        "scenes/two_pillars/two_pillars.xml",
        "--map",
        folder / "out/map.nc",
        "--position",
        0,
        -400,
        300,
        "-D",
        "plane_Ra=1.6",
        "-D",
        "pillar_Ra=1.6",
        "-o",
        tmp_path / "cloud.ply",
    )
    cloud = read_cloud(tmp_path / "cloud.ply")
    assert cloud.source == "predicted"
    assert set(cloud.feature_names) >= {"plane", "pillar1", "pillar2"}
    assert cloud.valid.sum() > 1000


def test_a_map_of_another_sensor_is_refused(study_folder):
    folder, _ = study_folder
    other = PerformanceMap.load(folder / "out/map.nc")
    other.data.attrs["sensor"] = "ensenso-n35"
    other.save(folder / "other.nc")
    text = (folder / "study.toml").read_text().replace('campaign = "campaign.toml"', 'map = "other.nc"')
    (folder / "other.toml").write_text(text)
    done = mitsim_here("run", folder / "other.toml", "-o", folder / "other", code=2)
    assert "ensenso-n35" in done.stderr
