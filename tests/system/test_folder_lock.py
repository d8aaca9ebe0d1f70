"""Two commands do not write to one folder; one that was killed keeps nothing, and what it left is swept."""

import os
import signal
import subprocess
import sys
import time

import pytest

from characterisation.whole_files import write_folder, written_whole
from mitsim.commands.folder_lock import LOCK, hold, sweep
from mitsim.errors import InputError

pytestmark = pytest.mark.skipif(os.name != "posix", reason="locks of POSIX")

HOLD = "import sys, time, pathlib; from mitsim.commands.folder_lock import hold; f = pathlib.Path(sys.argv[1]); "
HOLD += "let = hold(f); (f / f'.scores.csv.{__import__(\"os\").getpid()}.partial').write_text('half'); "
HOLD += "print('held', flush=True); time.sleep(60)"


@pytest.fixture
def holder(tmp_path):
    with subprocess.Popen([sys.executable, "-c", HOLD, str(tmp_path)], stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout.readline() == "held\n"
        yield other
        other.kill()


def test_a_folder_that_is_held_is_refused_and_a_dead_holder_keeps_nothing(tmp_path, holder):
    left = tmp_path / f".scores.csv.{holder.pid}.partial"
    with pytest.raises(InputError, match=rf"process {holder.pid} on .*since \d{{4}}-"):
        hold(tmp_path)
    assert sweep(tmp_path) == [] and left.exists()
    os.kill(holder.pid, signal.SIGKILL)
    holder.wait()
    let_go = hold(tmp_path)
    assert not left.exists() and (tmp_path / LOCK).exists()
    with pytest.raises(InputError, match=f"process {os.getpid()}"):
        hold(tmp_path)
    let_go()
    assert list(tmp_path.iterdir()) == []
    hold(tmp_path)()


def test_only_left_overs_of_the_dead_are_swept(tmp_path):
    (tmp_path / "captures" / ".view_0001.partial-999999999-0a1b").mkdir(parents=True)
    kept = [
        ".poses.partial-x",
        "a.partial",
        ".hidden",
        f".map.nc.{os.getpid()}.partial",
        f".k.partial-{os.getppid()}-0f",
    ]
    for name in kept:
        (tmp_path / name).write_text("", encoding="utf-8")
    assert [path.name for path in sweep(tmp_path)] == [".view_0001.partial-999999999-0a1b"]
    assert {path.name for path in tmp_path.iterdir()} == {*kept, "captures"}


def test_what_is_being_written_names_its_process(tmp_path, monkeypatch):
    names = []
    with written_whole(tmp_path / "a.csv") as partial:
        names.append(partial.name)
        partial.write_text("", encoding="utf-8")
    monkeypatch.setattr("characterisation.whole_files._sync_directory", lambda d: names.append(d.name))
    write_folder(tmp_path / "poses", {"a": b""})
    assert all(str(os.getpid()) in name for name in names[:2])


@pytest.mark.timeout(120)
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGINT])
def test_signals_end_a_command_as_ctrl_c_does(tmp_path, number):
    wait = "import mitsim.commands.machine as m, time; import mitsim.cli as c; "
    wait += "c.app.command(name='wait')(lambda: (print('on', flush=True), time.sleep(60))[1]); c.main()"
    with subprocess.Popen(
        [sys.executable, "-c", wait, "wait"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as command:
        assert command.stdout.readline() == "on\n"
        started = time.monotonic()
        command.send_signal(number)
        told = command.communicate(timeout=30)[1]
    assert command.returncode == 130 and "stopped; what was finished is kept" in told
    assert "Traceback" not in told and time.monotonic() - started < 20
