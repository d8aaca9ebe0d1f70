"""The commands as a user runs them: from the shell, on real files, with good and with bad input."""

from __future__ import annotations

import importlib.metadata
import json
import subprocess
import sys

import numpy as np
import pytest

from characterisation.cloud_files import read_cloud
from characterisation.files.atomic_io import HOST
from characterisation.words.progress import be_quiet, say, say_progress, track
from mitsim.capture.folder import read_capture
from mitsim.capture.truth import read_truth
from mitsim.cli import doctor
from tests.shell import ROOT, mitsim, mitsim_here
from tests.smaller_sensors import coarse_sensor


@pytest.mark.parametrize("module", ["import mitsim", "import mitsim.cli"])
def test_importing_is_quick_and_light(module):
    """Heavy imports stand inside the commands: none of them is loaded by the command line itself."""
    heavy = ("mitsuba", "cv2", "scipy", "xarray", "numpy")
    code = f"{module}; import sys; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_help_names_every_command_and_each_has_an_example():
    text = mitsim_here("--help").stdout
    for command in (
        "doctor",
        "run",
        "render",
        "import",
        "decode",
        "calibrate",
        "report",
        "map make",
        "study score",
        "measure",
    ):
        assert command.split()[0] in text
        helped = mitsim_here(*command.split(), "--help").stdout
        assert f"Example: mitsim {command}" in " ".join(helped.split())


@pytest.mark.parametrize("group", [(), ("study",), ("map",), ("export",), ("fit",)])
def test_the_list_of_commands_tells_whole_sentences(group):
    assert "..." not in mitsim_here(*group, "--help").stdout.partition("Commands:")[2]


def test_version_is_that_of_the_package():
    assert mitsim("--version").stdout == f"mitsim {importlib.metadata.version('mitsim')}\n"


def test_completion_for_a_shell_can_be_had():
    assert "--install-completion" in mitsim_here("--help").stdout


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
    findings = {f["what"]: f for f in json.loads(mitsim_here("doctor", "--json").stdout)}
    assert findings["renderer"]["verdict"] == "ok"
    assert "llvm_ad_mono" in findings["renderer"]["detail"] or "cuda_ad_mono" in findings["renderer"]["detail"]
    assert findings["mitsim"]["detail"]
    assert "renderer" in mitsim_here("doctor").stdout


def test_doctor_gives_up_a_kernel_that_never_ends(monkeypatch):
    monkeypatch.setattr(doctor, "_TRIAL", "import time; time.sleep(310)")
    monkeypatch.setattr(doctor, "_PATIENCE_S", 0.3, raising=False)
    findings = {f["what"]: f for f in json.loads(mitsim_here("doctor", "--json", code=3).stdout)}
    assert findings["renderer"]["verdict"] == "missing"
    assert findings["renderer"]["detail"].endswith("failed: a trial kernel did not end within 0.3 s")


def test_render_decode_and_back(tmp_path):
    mitsim_here(
        "render",
        "scenes/coupon/matt_white.xml",
        "--position",
        60,
        -80,
        550,
        "-o",
        tmp_path / "capture",
        "--samples",
        4,
        "--seed",
        3,
        "--truth",
    )
    known = read_truth(tmp_path / "capture")["right"]
    assert 400 < np.nanmedian(known.depth) < 600
    capture = read_capture(tmp_path / "capture")
    assert capture.source == "simulated"
    assert capture.images["left"].shape == (1, 480, 752)
    out = mitsim_here("decode", tmp_path / "capture", "--range", 450, 650, "-o", tmp_path / "cloud.ply").stdout
    counts = dict(line.split("\t") for line in out.splitlines())
    cloud = read_cloud(tmp_path / "cloud.ply")
    assert int(counts["valid"]) == cloud.valid.sum() > 8000
    assert sum(map(int, counts.values())) == cloud.status.size
    world = capture.world_from_sensor.points(cloud.points[cloud.valid].astype(float))
    assert abs(np.median(world[:, 2])) < 0.5


def test_the_same_render_again_is_finished_and_another_is_refused_before_it_is_rendered(tmp_path):
    coupon = ("render", "scenes/coupon/matt_white.xml", "--position", 0, 0, 500, "--samples", 1, "--depth", 1)
    mitsim_here(*coupon, "-o", tmp_path / "c")
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "c").rglob("*")}
    (tmp_path / f".c.partial-999999999-{HOST}0123456789ab").mkdir()
    assert "finished before" in mitsim_here(*coupon, "-o", tmp_path / "c").stderr
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "c").rglob("*")} == before
    assert [path.name for path in tmp_path.iterdir()] == ["c"]
    for other in (("--seed", 2), ("--truth",), ("--noise", "none"), ("--sensor", "oak-d-pro")):
        said = mitsim_here(*coupon, *other, "-o", tmp_path / "c", code=2).stderr
        assert "an existing capture" in said
    (tmp_path / "c/pose.json").write_text("{}")
    assert "pose.json" in mitsim_here(*coupon, "-o", tmp_path / "c", code=2).stderr


def test_a_deviation_is_told_and_kept_with_the_capture(tmp_path):
    coupon = ("render", "scenes/coupon/coupon.xml", "--position", 0, 0, 500, "--samples", 1, "--depth", 1)
    done = mitsim_here(*coupon, "--deviation", "alpha=1,wide_angle=-1", "-o", tmp_path / "moved")
    assert "aluminium/ground Ra 0.4 um: prior of ground metal" in done.stderr
    assert "alpha +1 and wide angle -1 sigma" in done.stderr
    kept = read_capture(tmp_path / "moved").settings["deviation"]
    assert {name: value for name, value in kept.items() if value} == {"alpha": 1.0, "wide_angle": -1.0}
    done = mitsim_here(*coupon, "--deviation", "alfa=1", "-o", tmp_path / "not", code=2)
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
    sensor = coarse_sensor("ensenso-n10", 2, tmp_path)
    done = mitsim_here("map", "make", tmp_path / "campaign.toml", "--sensor", sensor, "-o", tmp_path / "out")
    assert "aluminium/ground, Ra 0.4 µm: unknown properties of the finish change F by up to 0." in done.stderr


STUDY = ROOT / "scenes/two_pillars/study.toml"
TABLE = "# [characterisation] "


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('scene = "two_pillars.xml"', 'scene = "two_pilars.xml"', "did you mean 'two_pillars.xml'"),
        ("# standoff_mm = 500", "standof_mm = 500", "did you mean 'standoff_mm'"),
        ("# standoff_mm = 500", "standoff_mm = 0.5", "greater than or equal to 50"),
        ("# standoff_mm = 500", "standoff_mm = 1500", "400 to 800 mm"),
        (TABLE, '[characterisation]\ncampaign = "near.toml" #', "400 to 450 mm, the characterised distances"),
        ('sensor = "ensenso-n10"', 'sensor = "ensenso"', "ensenso-n10"),
        ("seed = 1", "seed = [1", "not TOML"),
        (TABLE, '[characterisation]\ncampaign = "a.toml"\nmap = "b.nc" #', "not both"),
        ('task = "task.toml"', 'task = "other.toml"', "pillar3"),
        ("seed = 1", "seed = 1\nparameters = { pilar_Ra = 0.3 }", "did you mean 'pillar_Ra'"),
    ],
)
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
    done = mitsim_here("run", tmp_path / "study.toml", "-o", tmp_path / "out", code=2)
    assert says in done.stderr
    assert done.stderr.startswith("mitsim: ")
    assert len(done.stderr.strip().splitlines()) == 1
    assert not list((tmp_path / "out").rglob("*")) if (tmp_path / "out").exists() else True


@pytest.mark.parametrize(
    "arguments",
    [
        ("run", "missing.toml", "-o", "{tmp}/out"),
        ("decode", "missing", "-o", "{tmp}/cloud.ply"),
        ("import", "missing.zip", "-o", "{tmp}/out"),
        ("report", "{tmp}"),
        ("map", "make", "missing.toml", "-o", "{tmp}/out"),
        (
            "map",
            "predict",
            "scenes/coupon/coupon.xml",
            "--map",
            "missing.nc",
            "--position",
            "0",
            "0",
            "500",
            "-o",
            "{tmp}/c.ply",
        ),
        ("render", "scenes/coupon/coupon.xml", "--position", "0", "0", "0.5", "-o", "{tmp}/out"),
        (
            "render",
            "scenes/coupon/coupon.xml",
            "--position",
            "0",
            "0",
            "500",
            "--sensor",
            "missing.toml",
            "-o",
            "{tmp}/o",
        ),
        ("render", "scenes/coupon/coupon.xml", "--position", "0", "0", "500", "-D", "Ra", "-o", "{tmp}/out"),
        (
            "render",
            "scenes/coupon/coupon.xml",
            "--position",
            "0",
            "0",
            "500",
            "--variant",
            "scalar_rgb",
            "-o",
            "{tmp}/out",
        ),
        ("frobnicate",),
    ],
)
def test_bad_arguments_are_told_with_code_2(tmp_path, arguments):
    done = mitsim_here(*[a.format(tmp=tmp_path) for a in arguments], code=2)
    assert done.stderr.strip()
    assert not list(tmp_path.rglob("*.ply"))


def test_a_broken_png_is_named(tmp_path):
    plate = "scenes/coupon/matt_white.xml"
    mitsim_here("render", plate, "--position", 0, 0, 500, "-o", tmp_path / "capture", "--samples", 1, "--depth", 1)
    image = tmp_path / "capture/images/left_000.png"
    image.write_bytes(image.read_bytes()[:5000])
    done = mitsim_here("decode", tmp_path / "capture", "-o", tmp_path / "cloud.ply", code=2)
    assert "left_000.png" in done.stderr
    assert not (tmp_path / "cloud.ply").exists()


def test_a_rendering_that_shows_nothing_of_the_part_says_so(tmp_path):
    """The camera looks away; the capture repeats it when it is decoded, and no number is missing or "nan"."""
    sensor = coarse_sensor("ensenso-n10", 8, tmp_path)
    scene = ROOT / "scenes/two_pillars/two_pillars.xml"
    view = ["--sensor", sensor, "--samples", 1, "--depth", 1]
    done = mitsim(
        "render", scene, "--position", 0, -400, 300, "--target", 0, -4000, 300, *view, "-o", tmp_path / "away"
    )
    assert "warning: no pixel of the camera left, camera right, projector shows the part" in done.stderr
    assert "no pixel is lit" in done.stderr
    assert "nan" not in done.stderr
    pixels = read_capture(tmp_path / "away").images["left"][0].size
    decoded = mitsim_here("decode", tmp_path / "away", "-o", tmp_path / "away.ply", code=1)
    assert decoded.stderr.splitlines()[-1].startswith("no pixel has a point")
    assert decoded.stdout.splitlines()[0] == f"valid\t0 of {pixels}"
    assert "shows the part" in decoded.stderr
    seen = mitsim("render", scene, "--position", 0, -400, 300, *view, "-o", tmp_path / "seen")
    assert "warning: no pixel" not in seen.stderr


def test_a_bug_shows_its_traceback_and_differs_from_a_failed_check(monkeypatch):
    def broken(*_, **__):
        raise RuntimeError("a bug of ours")

    monkeypatch.setattr("mitsim.study.open_study", broken)
    done = mitsim_here("study", "score", "study.toml", "-o", "out", code=None)
    assert done.returncode == 70
    assert "Traceback" in done.stderr and "RuntimeError: a bug of ours" in done.stderr
