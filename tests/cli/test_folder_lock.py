"""Two commands do not write to one folder; one that was killed keeps nothing, and what it left is swept."""

import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from unittest import mock

import cv2
import numpy as np
import pytest
import trimesh

from characterisation.files.atomic_io import HOST, atomic_write, atomic_write_named, write_folder
from characterisation.files.errors import InputError
from mitsim.cli.folder_lock import LOCK, _holder, lock_folder, release_folders, remove_partial, remove_partial_beside
from mitsim.cli.options import check_folder
from mitsim.study.scoring import score_study
from mitsim.study.virtual.trials import Outcome, TrialFolder
from mitsim.study.virtual.world import Trial
from tests.shell import ROOT, mitsim_here
from tests.small_study import SCENES, small_study
from tests.smaller_sensors import coarse_sensor

pytestmark = pytest.mark.skipif(os.name != "posix", reason="locks of POSIX")

HOLD = "import sys, time, pathlib; from mitsim.cli.folder_lock import lock_folder; f = pathlib.Path(sys.argv[1]); "
HOLD += "release = lock_folder(f); (f / f'.scores.csv.{__import__(\"os\").getpid()}.partial').write_text('half'); "
HOLD += "print('held', flush=True); time.sleep(600)"


@pytest.fixture
def holder(tmp_path):
    with subprocess.Popen([sys.executable, "-c", HOLD, str(tmp_path)], stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout.readline() == "held\n"
        yield other
        other.kill()


def test_a_folder_that_is_held_is_refused_and_a_dead_holder_keeps_nothing(tmp_path, holder):
    left = tmp_path / f".scores.csv.{holder.pid}.partial"
    with pytest.raises(InputError, match=rf"process {holder.pid} on .*since \d{{4}}-"):
        lock_folder(tmp_path)
    assert remove_partial(tmp_path) == [] and left.exists()
    os.kill(holder.pid, signal.SIGKILL)
    holder.wait()
    release = lock_folder(tmp_path)
    assert not left.exists() and (tmp_path / LOCK).exists()
    with pytest.raises(InputError, match=f"process {os.getpid()}"):
        lock_folder(tmp_path)
    release()
    assert list(tmp_path.iterdir()) == []
    lock_folder(tmp_path)()


def test_a_lock_of_no_process_is_another_mitsim(tmp_path):
    """Before, an OverflowError."""
    (tmp_path / "lock").write_text('{"command": "run", "pid": 1e999, "host": "a", "since": "b"}')
    with (tmp_path / "lock").open() as stream:
        assert _holder(stream.fileno()) == "another mitsim"


def test_no_process_is_asked_on_windows(tmp_path, monkeypatch):
    """os.kill(pid, 0) sends Ctrl-C there: signal.CTRL_C_EVENT is 0."""
    asked = []
    monkeypatch.setattr("mitsim.cli.folder_lock.os.kill", lambda *signal: asked.append(signal))
    monkeypatch.setattr("mitsim.cli.folder_lock.sys", mock.Mock(platform="win32"))
    names = [f".a.ply.{999999990 + k}-{HOST}.partial" for k in (1, 2)]
    for name in names:
        (tmp_path / name).write_text("half")
    two_days_ago = time.time() - 2 * 86400
    os.utime(tmp_path / names[1], (two_days_ago, two_days_ago))
    assert remove_partial_beside(tmp_path / "a.ply") == [tmp_path / names[1]]
    assert asked == []


def test_only_left_overs_of_the_dead_are_swept(tmp_path):
    (tmp_path / "captures" / f".view_0001.partial-999999999-{HOST}1b").mkdir(parents=True)
    kept = [
        ".poses.partial-x",
        "a.partial",
        ".hidden",
        f".map.nc.{os.getpid()}.partial",
        f".k.partial-{os.getppid()}-{HOST}0f",
        ".k.partial-999999999-0000000f",  # of another machine, and fresh
    ]
    for name in kept:
        (tmp_path / name).write_text("", encoding="utf-8")
    assert [path.name for path in remove_partial(tmp_path)] == [f".view_0001.partial-999999999-{HOST}1b"]
    assert {path.name for path in tmp_path.iterdir()} == {*kept, "captures"}
    day_old = time.time() - 25 * 3600
    os.utime(tmp_path / ".k.partial-999999999-0000000f", (day_old, day_old))
    assert [path.name for path in remove_partial(tmp_path)] == [".k.partial-999999999-0000000f"]


def test_light_of_a_killed_command_is_swept_in_every_run_of_its_folder(tmp_path):
    left = [
        tmp_path / run / f".light.npz.partial-999999999-{HOST}{number}"
        for number, run in enumerate(("", "zivid-2-m70", "remedies/spray", "zivid-2-m70/remedies/spray"))
    ]
    for path in left:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"light")
    assert sorted(remove_partial(tmp_path)) == sorted(left)


def test_a_repaired_file_of_trials_leaves_nothing_that_is_not_swept(tmp_path, monkeypatch):
    """Killed before the rename, the repair leaves a file; before, no command recognised its name and its folder."""
    trials = TrialFolder(tmp_path / "david-sls-3" / "trials", "digest", ["radius"])
    trials.add(3, Trial(0), Outcome({"radius": 0.5}))
    file = trials.folder / "view_0003.jsonl"
    file.write_bytes(file.read_bytes() + b'{"day": 1, "cap')
    left = []

    def killed(partial, _target):
        dead = partial.with_name(partial.name.replace(str(os.getpid()), "999999999"))
        left.append(Path(shutil.copy(partial, dead)))
        raise KeyboardInterrupt

    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr(Path, "replace", killed)
        TrialFolder(trials.folder, "digest", ["radius"]).known(3)
    assert remove_partial(tmp_path) == left and len(left) == 1
    assert list(trials.folder.iterdir()) == [file]
    assert TrialFolder(trials.folder, "digest", ["radius"]).known(3) == trials.known(3)


def test_beside_a_file_only_its_own_left_overs_are_swept(tmp_path):
    kept = [f".other.ply.999999999-{HOST}.partial", f".a.ply.{os.getppid()}-{HOST}.partial", "a.ply"]
    gone = [f".a.ply.999999999-{HOST}.partial", f".a.ply.partial-999999999-{HOST}ab"]
    for name in {*kept, *gone}:
        (tmp_path / name).write_text("", encoding="utf-8")
    with (
        pytest.raises(FileNotFoundError),
        atomic_write_named(tmp_path / "a.ply") as partial,
    ):  # its folder has letters behind the name
        mine = partial.parent.name
        (tmp_path / mine.replace(str(os.getpid()), "999999999")).mkdir()
        assert {path.name for path in remove_partial_beside(tmp_path / "a.ply")} == {
            *gone,
            mine.replace(str(os.getpid()), "999999999"),
        }
        assert {path.name for path in tmp_path.iterdir()} == {*kept, mine}


def test_what_is_being_written_names_its_process(tmp_path, monkeypatch):
    names = []
    with atomic_write(tmp_path / "a.csv") as partial:
        names.append(partial.name)
        partial.write_text("", encoding="utf-8")
    monkeypatch.setattr("characterisation.files.atomic_io._sync_directory", lambda d: names.append(d.name))
    write_folder(tmp_path / "poses", {"a": b""})
    assert all(str(os.getpid()) in name for name in names[:2])


@pytest.mark.timeout(120)
def test_a_command_without_an_input_stream_ends_with_its_message(tmp_path):
    """Before, with a closed stdin, as services have it, commands that may ask ended in a traceback."""
    call = [sys.executable, "-m", "mitsim", "study", "score", "no.toml", "-o", "out"]
    closed = f"exec <&-; exec {shlex.join(call)}"
    done = subprocess.run(
        ["sh", "-c", closed],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        check=False,
    )
    assert (done.returncode, done.stderr) == (2, "mitsim: no.toml: found no such file; allowed: a TOML file\n")


@pytest.mark.timeout(120)
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGINT])
def test_signals_end_a_command_as_ctrl_c_does(tmp_path, number):
    # tests that a shell runs in its background, or under nohup, ignore SIGINT or SIGHUP, and so does what they start
    wait = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); "
    wait += "signal.signal(signal.SIGHUP, signal.SIG_DFL); "
    wait += "import mitsim.cli.doctor as m, time; import mitsim.cli.program as c; "
    wait += "c.app.command(name='wait')(lambda: (print('on', flush=True), time.sleep(60))[1]); c.main()"
    with subprocess.Popen(
        [sys.executable, "-c", wait, "wait"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as command:
        assert command.stdout.readline() == "on\n"
        started = time.monotonic()
        command.send_signal(number)
        told = command.communicate(timeout=30)[1]
    assert command.returncode == 130 and "interrupted; finished work is kept" in told
    assert "Traceback" not in told and time.monotonic() - started < 20


@pytest.mark.timeout(120)
def test_commands_hold_their_folders_and_let_them_go(tmp_path, tmp_path_factory, holder):
    study, into = str(tmp_path_factory.mktemp("study") / "study.toml"), ("-o", str(tmp_path))
    sensor = coarse_sensor("ensenso-n10", 2, Path(study).parent)
    Path(study).write_text(small_study("{ plane_Ra = 0.37, pillar_Ra = 0.37 }", sensor), encoding="utf-8")
    into_view = ("--view", "1", *into)
    for call in (("study", "score", study, *into), ("run", study, *into), ("study", "state", study, *into_view)):
        assert f"process {holder.pid}" in mitsim_here(*call, code=2).stderr
    assert {path.name for path in tmp_path.iterdir()} == {LOCK, f".scores.csv.{holder.pid}.partial"}
    os.kill(holder.pid, signal.SIGKILL)
    holder.wait()
    seen = []

    def scored(*given):
        seen.append(json.loads((tmp_path / LOCK).read_text())["pid"])
        return score_study(*given)

    with mock.patch("mitsim.study.scoring.score_study", scored):
        mitsim_here("study", "score", study, *into)
    assert seen == [os.getpid()]
    assert (tmp_path / "scores.csv").exists() and not (tmp_path / LOCK).exists()


def test_an_export_does_not_replace_a_folder_that_another_command_holds(tmp_path, holder):
    """Before, the export of a map replaced the folder, with what the other command had written there."""
    for name in ("map.npz", "README.md", "sensor_map.py"):
        (tmp_path / name).write_text("of before")
    call = ("export", "map", "ensenso-n10", "-o", str(tmp_path))
    assert f"process {holder.pid}" in mitsim_here(*call, code=2).stderr
    assert (tmp_path / "map.npz").read_text() == "of before" and (tmp_path / LOCK).exists()


@pytest.mark.timeout(200)
def test_two_commands_do_not_make_one_folder(tmp_path):
    """Before, both worked to their end, and the later one then found the folder there."""
    folder, scene = tmp_path / "new", str(SCENES / "two_pillars.xml")
    trimesh.creation.box((40, 30, 20)).export(tmp_path / "box.stl")
    cv2.imwrite(str(tmp_path / "depth.png"), np.full((48, 64), 600, np.uint16))
    calls = (
        ("export", "map", "ensenso-n10"),
        ("export", "bop", tmp_path),
        ("part", tmp_path / "box.stl"),
        ("import", tmp_path / "depth.png", "--sensor", "realsense-d435"),
        ("render", scene, "--position", 0, -400, 300),
        ("map", "compare", "ensenso-n10"),
    )
    release = lock_folder(folder, whole=True)
    with mock.patch("mitsim.report.export.bop.find_sources", lambda _: []):
        for call in calls:
            assert f"process {os.getpid()}" in mitsim_here(*call, "-o", folder, code=2).stderr, call
    assert not folder.exists()
    release()
    mitsim_here(*calls[0], "-o", folder)
    assert {path.name for path in folder.iterdir()} == {"map.npz", "README.md", "sensor_map.py"}
    assert not list(tmp_path.glob(".*"))


@pytest.mark.parametrize("call", [("export", "map", "ensenso-n10"), ("part", "box.stl")])
def test_a_file_in_place_of_a_new_folder_is_told(tmp_path, call):
    (tmp_path / "file").write_text("mine")
    told = mitsim_here(*call, "-o", "file", cwd=tmp_path, code=2).stderr
    assert told.startswith(f"mitsim: --output: found {tmp_path / 'file'}, which is no folder")


def test_a_command_that_refuses_its_input_leaves_no_folder(tmp_path):
    """Before, it left the empty folder, and those above it."""
    mitsim_here("study", "score", tmp_path / "no.toml", "-o", tmp_path / "runs" / "first", code=2)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_a_link_points_to_is_made_and_swept_beside_itself(tmp_path):
    (tmp_path / "run").symlink_to("disk/run")
    check_folder(tmp_path / "run")
    (tmp_path / "run" / "scores.csv").write_text("")
    release_folders()
    assert (tmp_path / "run").is_symlink() and (tmp_path / "disk" / "run").is_dir()
    left = tmp_path / "disk" / f".run.partial-999999999-{HOST}0b"
    left.mkdir()
    assert remove_partial_beside(tmp_path / "run") == [left] and not left.exists()
