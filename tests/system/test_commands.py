"""The commands as a user runs them: from the shell, on real files, with good and with bad input."""

from __future__ import annotations

import csv
import importlib.metadata
import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from characterisation.atomic_io import HOST
from characterisation.cloud_files import read_ply
from characterisation.maps.performance_map import PerformanceMap
from mitsim.capture.folder import read_capture
from mitsim.progress import be_quiet, say, say_progress, track
from mitsim.simulation.truth import read_exr

ROOT = Path(__file__).resolve().parents[2]


def mitsim(*arguments, code=0, cwd=ROOT):
    """Run a command; whatever happens, a traceback is a fault of ours."""
    done = subprocess.run([sys.executable, "-m", "mitsim", *map(str, arguments)], capture_output=True, text=True,
                          cwd=cwd, timeout=500, check=False)  # fmt: skip
    assert "Traceback" not in done.stderr, done.stderr
    assert done.returncode == code, (done.returncode, done.stderr)
    return done


@pytest.mark.parametrize("module", ["import mitsim", "import mitsim.cli"])
def test_importing_is_quick_and_light(module):
    """Heavy imports stand inside the commands: none of them is loaded by the command line itself."""
    heavy = ("mitsuba", "cv2", "scipy", "xarray", "numpy")
    code = f"{module}; import sys; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_help_names_every_command_and_each_has_an_example():
    text = mitsim("--help").stdout
    for command in ("doctor", "run", "render", "import", "decode", "characterise", "predict", "calibrate", "report"):
        assert command in text
        assert f"Example: mitsim {command}" in " ".join(mitsim(command, "--help").stdout.split())


@pytest.mark.parametrize("group", [(), ("validate",), ("export",), ("fit",)])
def test_the_list_of_commands_tells_whole_sentences(group):
    assert "..." not in mitsim(*group, "--help").stdout.partition("Commands:")[2]


def test_version_is_that_of_the_package():
    assert mitsim("--version").stdout == f"mitsim {importlib.metadata.version('mitsim')}\n"


def test_completion_for_a_shell_can_be_had():
    assert "--install-completion" in mitsim("--help").stdout


def test_quiet_leaves_out_progress_and_keeps_results(capsys):
    try:
        be_quiet()
        assert list(track(range(3), "count")) == [0, 1, 2]
        say_progress("half way")
        say("done")
    finally:
        be_quiet(False)
    list(track(range(3), "count"))
    assert capsys.readouterr().err.splitlines()[0] == "done"


def test_doctor_says_what_is_there():
    findings = {f["what"]: f for f in json.loads(mitsim("doctor", "--json").stdout)}
    assert findings["renderer"]["verdict"] == "ok"
    assert "llvm_ad_mono" in findings["renderer"]["detail"] or "cuda_ad_mono" in findings["renderer"]["detail"]
    assert findings["mitsim"]["detail"]
    assert "renderer" in mitsim("doctor").stdout


def test_render_decode_and_back(tmp_path):
    mitsim("render", "scenes/coupon/matt_white.xml", "--position", 60, -80, 550, "-o", tmp_path / "capture",
           "--samples", 4, "--seed", 3, "--truth")  # fmt: skip
    known = read_exr(tmp_path / "capture/truth/right.exr")
    assert 400 < np.nanmedian(known["Z"]) < 600
    capture = read_capture(tmp_path / "capture")
    assert capture.source == "simulated"
    assert capture.images["left"].shape == (1, 480, 752)
    out = mitsim("decode", tmp_path / "capture", "-o", tmp_path / "cloud.ply").stdout
    counts = dict(line.split("\t") for line in out.splitlines())
    cloud = read_ply(tmp_path / "cloud.ply")
    assert int(counts["valid"]) == cloud.valid.sum() > 8000
    assert sum(map(int, counts.values())) == cloud.status.size
    world = capture.world_from_sensor.points(cloud.points[cloud.valid].astype(float))
    assert abs(np.median(world[:, 2])) < 0.5


def test_the_same_render_again_is_finished_and_another_is_refused_before_it_is_rendered(tmp_path):
    coupon = ("render", "scenes/coupon/matt_white.xml", "--position", 0, 0, 500, "--samples", 1, "--depth", 1)
    mitsim(*coupon, "-o", tmp_path / "c")
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "c").rglob("*")}
    (tmp_path / f".c.partial-999999999-{HOST}0123456789ab").mkdir()
    assert "finished before" in mitsim(*coupon, "-o", tmp_path / "c").stderr
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "c").rglob("*")} == before
    assert [path.name for path in tmp_path.iterdir()] == ["c"]
    for other in (("--seed", 2), ("--truth",), ("--noise", "none"), ("--sensor", "oak-d-pro")):
        assert "another capture that is there already" in mitsim(*coupon, *other, "-o", tmp_path / "c", code=2).stderr
    (tmp_path / "c/pose.json").write_text("{}")
    assert "pose.json" in mitsim(*coupon, "-o", tmp_path / "c", code=2).stderr


def test_a_deviation_is_told_and_kept_with_the_capture(tmp_path):
    coupon = ("render", "scenes/coupon/coupon.xml", "--position", 0, 0, 500, "--samples", 1)
    done = mitsim(*coupon, "--deviation", "alpha=1,wide_angle=-1", "-o", tmp_path / "moved")
    assert "aluminium/ground Ra 0.4 um: prior of ground metal" in done.stderr
    assert "alpha +1 and wide angle -1 sigma" in done.stderr
    kept = read_capture(tmp_path / "moved").settings["deviation"]
    assert kept == {"alpha": 1.0, "wide_angle": -1.0, "reflectance": 0.0}
    done = mitsim(*coupon, "--deviation", "alfa=1", "-o", tmp_path / "not", code=2)
    assert "did you mean 'alpha'" in done.stderr


def test_characterise_says_what_is_not_known_of_a_finish(tmp_path):
    coupon = (ROOT / "scenes/coupon/coupon.xml").as_posix()
    (tmp_path / "campaign.toml").write_text(f"""
        distances_mm = [500]
        samples_per_pixel = 4
        orientations = [{{ up_to_deg = 20, subdivisions = 0 }}]
        [[samples]]
        scene = "{coupon}"
        spread = true
    """)
    done = mitsim("characterise", tmp_path / "campaign.toml", "-o", tmp_path / "out")
    assert "aluminium/ground, Ra 0.4 µm: what is not known of the finish moves F by up to 0." in done.stderr


@pytest.fixture(scope="module")
def study_folder(tmp_path_factory):
    """A study small enough for a test: 46 normals in all, 2 samples, a dozen views."""
    folder = tmp_path_factory.mktemp("study")
    scenes = (ROOT / "scenes").as_posix()
    (folder / "campaign.toml").write_text(f"""
        distances_mm = [400, 600]
        samples_per_pixel = 4
        orientations = [{{ up_to_deg = 72, subdivisions = 1 }}]
        [[samples]]
        scene = "{scenes}/coupon/matt_white.xml"
        [[samples]]
        scene = "{scenes}/coupon/coupon.xml"
        parameters = {{ Ra = 0.4 }}
    """)
    (folder / "study.toml").write_text(f"""
        scene = "{scenes}/two_pillars/two_pillars.xml"
        parameters = {{ plane_Ra = 0.4, pillar_Ra = 0.4 }}
        task = "{scenes}/two_pillars/task.toml"
        sensor = "ensenso-n10"
        [characterisation]
        campaign = "campaign.toml"
        [views]
        subdivisions = 1
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
        trials = 4
        pairs = 1
        [check]
        views = 2
    """)
    started = time.monotonic()
    done = mitsim("run", folder / "study.toml", "-o", folder / "out")
    print(f"small study: {time.monotonic() - started:.0f} s")
    return folder, done


def test_run_leaves_everything(study_folder):
    folder, done = study_folder
    out = folder / "out"
    for name in ("run.json", "map.nc", "samples.nc", "scores.csv", "scores.nc", "checks.nc", "statement.json",
                 "report.html"):  # fmt: skip
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
    assert len(rows) == 7 * run["views"]
    for name in run["measurements"]:
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
    done = mitsim("run", folder / "study.toml", "-o", folder / "out", "--overwrite")
    assert "characterise: 0 done" in done.stderr and "state view" in done.stderr
    assert (folder / "out/scores.csv").read_bytes() == before
    assert (folder / "out/statement.json").read_bytes() == statement


def test_a_run_is_exported_for_other_tools(study_folder, tmp_path):
    for module in ("rerun", "pygltflib", "pxr", "mcap_ros2", "pye57"):
        pytest.importorskip(module)
    folder, _ = study_folder
    shown = len(json.loads((folder / "out/run.json").read_text())["checked_views"])
    clouds = len(list((folder / "out/clouds").iterdir()))
    for suffix in ("rrd", "glb", "usdc", "mcap", "e57"):
        said = mitsim("export", "run", folder / "out", "-o", tmp_path / f"run.{suffix}").stderr
        assert f"{clouds} clouds" in said and clouds > shown
    said = mitsim("export", "results", folder / "out", "-o", tmp_path / "run.qif").stderr
    assert "7 measurements" in said and "mitsim.verdict" in (tmp_path / "run.qif").read_text()
    mitsim("export", "targets", folder / "out", "--robot", "abb", "--views", "all", "-o", tmp_path / "views.mod")
    views = json.loads((folder / "out/run.json").read_text())["views"]
    assert (tmp_path / "views.mod").read_text().count("robtarget view_") == views
    cloud = next((folder / "out/clouds").glob("predicted_*.ply"))
    said = mitsim("export", "cloud", cloud, "-o", tmp_path / "cloud.pcd").stderr
    points = len(read_ply(cloud).points[read_ply(cloud).valid])
    assert f"{points} points, {points} of them with a covariance" in said


def test_score_prints_the_best_views_as_the_run_ranked_them(study_folder, tmp_path):
    folder, _ = study_folder
    done = mitsim("score", folder / "study.toml", "--map", folder / "out/map.nc", "--top", 3,
                  "--measurement", "pillar1_radius", "-o", tmp_path / "scores")  # fmt: skip
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
    assert "pillar9" in mitsim("score", folder / "study.toml", "--map", folder / "out/map.nc", "--measurement",
                               "pillar9", "-o", tmp_path / "no", code=2).stderr  # fmt: skip


def test_a_set_of_views_is_chosen_and_told(study_folder, tmp_path):
    folder, _ = study_folder
    text = (folder / "study.toml").read_text().replace('campaign = "campaign.toml"', 'map = "out/map.nc"')
    table = "[set]\nlimits = {{ pillar1_radius = {0}, pillar2_radius = {0} }}\n"
    (folder / "set.toml").write_text(text + table.format(100.0))
    done = mitsim("score", folder / "set.toml", "--measurement", "pillar1_radius", "-o", tmp_path / "one")
    assert "views that measure together: " in done.stderr and "(the fewest)" in done.stderr
    (folder / "wrong.toml").write_text(text + "[set]\nlimits = { pilar1_radius = 1.0 }\n")
    done = mitsim("score", folder / "wrong.toml", "-o", tmp_path / "no", code=2)
    assert "set.limits.pilar1_radius" in done.stderr
    (folder / "small.toml").write_text(text + table.format(1e-5))
    done = mitsim("score", folder / "small.toml", "-o", tmp_path / "small")
    assert "out of reach" in done.stderr


def test_report_and_predict_from_what_run_left(study_folder, tmp_path):
    folder, _ = study_folder
    page = (folder / "out/report.html").read_text()
    for name in ("point1_point2_distance", "pillar2_radius", "simulated", "ensenso-n10"):
        assert name in page
    (folder / "out/report.html").unlink()
    mitsim("report", folder / "out")
    assert (folder / "out/report.html").exists()
    mitsim("predict", "scenes/two_pillars/two_pillars.xml", "--map", folder / "out/map.nc", "--position", 0, -400, 300,
           "-D", "plane_Ra=0.4", "-D", "pillar_Ra=0.4", "-o", tmp_path / "cloud.ply")  # fmt: skip
    cloud = read_ply(tmp_path / "cloud.ply")
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
    done = mitsim("run", folder / "other.toml", "-o", folder / "other", code=2)
    assert "ensenso-n35" in done.stderr


STUDY = ROOT / "scenes/two_pillars/study.toml"
TABLE = "# [characterisation] "


@pytest.mark.parametrize(("old", "new", "says"), [
    ('scene = "two_pillars.xml"', 'scene = "two_pilars.xml"', "did you mean 'two_pillars.xml'"),
    ("# standoff_mm = 500", "standof_mm = 500", "did you mean 'standoff_mm'"),
    ("# standoff_mm = 500", "standoff_mm = 0.5", "greater than or equal to 50"),
    ("# standoff_mm = 500", "standoff_mm = 1500", "400 to 800 mm"),
    (TABLE, '[characterisation]\ncampaign = "near.toml" #', "400 to 450 mm, the distances that are characterised"),
    ('sensor = "ensenso-n10"', 'sensor = "ensenso"', "ensenso-n10"),
    ("seed = 1", "seed = [1", "not TOML"),
    (TABLE, '[characterisation]\ncampaign = "a.toml"\nmap = "b.nc" #', "not both"),
    ('task = "task.toml"', 'task = "other.toml"', "pillar3"),
    ("seed = 1", 'seed = 1\nparameters = { pillar_Ra = 3.0 }', "0.09 to 0.74 um"),
    ("seed = 1", 'seed = 1\nparameters = { pilar_Ra = 0.3 }', "did you mean 'pillar_Ra'"),
])  # fmt: skip
def test_a_bad_study_is_one_message_and_code_2(tmp_path, old, new, says):
    text = STUDY.read_text()
    assert old in text
    for name in ("two_pillars.xml", "task.toml"):
        (tmp_path / name).write_text((STUDY.parent / name).read_text())
    (tmp_path / "other.toml").write_text((STUDY.parent / "task.toml").read_text().replace("pillar2", "pillar3"))
    coupons = (ROOT / "scenes/coupon").as_posix()
    near = (ROOT / "scenes/coupon/campaign.toml").read_text().replace('scene = "', f'scene = "{coupons}/')
    (tmp_path / "near.toml").write_text("distances_mm = [400, 450]\n" + near)
    (tmp_path / "study.toml").write_text(text.replace(old, new, 1))
    done = mitsim("run", tmp_path / "study.toml", "-o", tmp_path / "out", code=2)
    assert says in done.stderr
    assert done.stderr.startswith("mitsim: ")
    assert len(done.stderr.strip().splitlines()) == 1
    assert not list((tmp_path / "out").rglob("*")) if (tmp_path / "out").exists() else True


@pytest.mark.parametrize("arguments", [
    ("run", "missing.toml", "-o", "{tmp}/out"),
    ("decode", "missing", "-o", "{tmp}/cloud.ply"),
    ("import", "missing.zip", "-o", "{tmp}/out"),
    ("report", "{tmp}"),
    ("characterise", "missing.toml", "-o", "{tmp}/out"),
    ("predict", "scenes/coupon/coupon.xml", "--map", "missing.nc", "--position", "0", "0", "500", "-o", "{tmp}/c.ply"),
    ("render", "scenes/coupon/coupon.xml", "--position", "0", "0", "0.5", "-o", "{tmp}/out"),
    ("render", "scenes/coupon/coupon.xml", "--position", "0", "0", "500", "--sensor", "missing.toml", "-o", "{tmp}/o"),
    ("render", "scenes/coupon/coupon.xml", "--position", "0", "0", "500", "-D", "Ra", "-o", "{tmp}/out"),
    ("render", "scenes/coupon/coupon.xml", "--position", "0", "0", "500", "--variant", "scalar_rgb", "-o", "{tmp}/out"),
    ("frobnicate",),
])  # fmt: skip
def test_bad_arguments_are_told_with_code_2(tmp_path, arguments):
    done = mitsim(*[a.format(tmp=tmp_path) for a in arguments], code=2)
    assert done.stderr.strip()
    assert not list(tmp_path.rglob("*.ply"))


def test_a_broken_png_is_named(tmp_path):
    plate = "scenes/coupon/matt_white.xml"
    mitsim("render", plate, "--position", 0, 0, 500, "-o", tmp_path / "capture", "--samples", 1)
    image = tmp_path / "capture/images/left_000.png"
    image.write_bytes(image.read_bytes()[:5000])
    done = mitsim("decode", tmp_path / "capture", "-o", tmp_path / "cloud.ply", code=2)
    assert "left_000.png" in done.stderr
    assert not (tmp_path / "cloud.ply").exists()
