"""Ctrl-C while worker processes are busy: a word at once, an end within seconds, exit code 130, finished work kept."""

import os
import runpy
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest

pytestmark = [
    pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals"),
    pytest.mark.timeout(300),
]

#: largest time between Ctrl-C and the end [s]: orders last a minute, and processes end within one second
SOON_S = 20


def heed_ctrl_c():
    """What tests start ignores SIGINT where a shell runs them in its background."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


@pytest.fixture
def started():
    """Start a command in its own group of processes, as a terminal does, when the files ``until`` exist."""
    groups = []

    def start(folder, way, *, until):
        script = Path(__file__).with_name("ordered_work.py")
        process = subprocess.Popen(
            [sys.executable, str(script), str(folder), way],
            stderr=subprocess.PIPE,
            env={**os.environ, "PYTHONPATH": str(script.parents[2])},
            preexec_fn=heed_ctrl_c,
            start_new_session=True,
            text=True,
        )
        groups.append(process.pid)
        end = time.monotonic() + 120
        while not all((folder / name).exists() for name in until):
            assert process.poll() is None and time.monotonic() < end
            time.sleep(0.02)
        return process

    yield start
    for group in groups:
        with suppress(ProcessLookupError):
            os.killpg(group, signal.SIGKILL)


BUSY = ("finished_0", "began_1", "began_2")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_command_with_busy_processes_ends_at_once(tmp_path, number, started):
    """Before, it ended only after the orders in work: two minutes here."""
    process = started(tmp_path, "at once", until=BUSY)
    os.killpg(process.pid, number)
    _, said = process.communicate(timeout=SOON_S)
    assert process.returncode == 130
    assert said.splitlines()[-1] == "mitsim: interrupted; finished work is kept" and "Traceback" not in said
    assert (tmp_path / "finished_0").exists()
    end = time.monotonic() + SOON_S
    while any_left(process.pid):
        assert time.monotonic() < end
        time.sleep(0.05)


def test_a_command_that_ends_in_order_gives_up_orders_in_work(tmp_path, started):
    process = started(tmp_path, "in order", until=BUSY)
    os.killpg(process.pid, signal.SIGINT)
    _, said = process.communicate(timeout=SOON_S)
    assert process.returncode == 130 and (tmp_path / "written").exists()
    assert said.splitlines()[0].startswith("stopping, and writing what there is") and "Traceback" not in said


def test_processes_that_start_do_not_hear_ctrl_c(tmp_path, started):
    """Ctrl-C of a terminal goes to all processes: one that still imports modules would print its traceback."""
    process = started(tmp_path, "in order", until=())
    end = time.monotonic() + 120
    while len(children := children_of(process.pid)) < 2 and time.monotonic() < end:
        time.sleep(0.005)
    for child in children:
        os.kill(child, signal.SIGINT)
    while not (tmp_path / "finished_0").exists():
        assert process.poll() is None and time.monotonic() < end
        time.sleep(0.02)
    os.killpg(process.pid, signal.SIGINT)
    _, said = process.communicate(timeout=SOON_S)
    assert "Traceback" not in said and "died" not in said and process.returncode == 130


def any_left(group):
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


def children_of(parent):
    """Numbers of the processes that one has started, from /proc; the tracker of resources is none of them."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rsplit(")", 1)[1].split()
            command = (stat.parent / "cmdline").read_text()
        except (OSError, IndexError):
            continue
        if int(fields[1]) == parent and "spawn_main" in command:
            found.append(int(stat.parent.name))
    return found


def test_ctrl_c_during_the_imports_is_no_traceback(monkeypatch, capsys):
    class Interrupted:
        def find_spec(self, name, path=None, target=None):
            if name == "mitsim.cli.program":
                raise KeyboardInterrupt

    monkeypatch.delitem(sys.modules, "mitsim.cli.program", raising=False)
    monkeypatch.setattr(sys, "meta_path", [Interrupted(), *sys.meta_path])
    with pytest.raises(SystemExit) as ended:
        runpy.run_module("mitsim", run_name="__main__")
    assert ended.value.code == 130 and capsys.readouterr().err == "mitsim: interrupted\n"
