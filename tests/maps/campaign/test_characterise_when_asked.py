"""A finish that a map does not know: `run`, `study state` and `study choose` ask alike, and characterise it.

Clouds of a known F and sigma stand in for the campaign's light, and virtual measurements are drawn from the map
that it ends in.
"""

from __future__ import annotations

import json
import os
import pty
import re
import select
import subprocess
import sys
import time
from unittest import mock

import pytest
import typer

from mitsim.cli import program as cli
from mitsim.study.exposures import exposure_plan
from tests.plain_pages import without_pictures
from tests.shell import mitsim_here
from tests.small_study import small_study
from tests.smaller_sensors import coarse_sensor

#: milled steel of Ra 3.2 on the plane: the map of the N10 knows ground aluminium from 0.09 to 0.74, and matt white
STUDY = small_study("{ plane_Ra = 3.2 }", "ensenso-n10.toml")
DRAWN = STUDY.replace("[measure]\n", '[measure]\nby = "map"\n')
COMMANDS = {"run": [], "study state": ["--view", "1"], "study choose": ["--sensors", "ensenso-n10.toml"]}
#: what each command does with the map, once it has it; and an exit code that says that it came so far
WORK = {
    "run": "mitsim.study.run.run_within",
    "study state": "mitsim.study.session.Session",
    "study choose": "mitsim.study.choose.choose_sensor",
}
REACHED = 7
QUESTION = r"ensenso-n10: its map lacks .*Ra 3\.2.*; characterise now \(about \d+ (s|min)\)\?"


@pytest.fixture
def study(tmp_path, monkeypatch):
    """The study of an N10 with a quarter of the pixels, in the working directory."""
    coarse_sensor("ensenso-n10", 2, tmp_path)
    (tmp_path / "study.toml").write_text(STUDY)
    monkeypatch.chdir(tmp_path)
    return tmp_path / "study.toml"


# a tolerance that does not fit ends with 1
def options_of(command, study):
    return [str(study.parent / option) if option.endswith(".toml") else option for option in COMMANDS[command]]


def invoked(*arguments):
    with without_pictures():
        return mitsim_here(*arguments, code=(0, 1))


@pytest.mark.parametrize("command", COMMANDS)
def test_with_yes_the_finish_is_characterised_and_the_command_goes_on(command, study, quick, tmp_path):
    out = tmp_path / "out"
    study.write_text(DRAWN)
    done = invoked(*command.split(), study, *options_of(command, study), "--yes", "-o", out)
    assert len(quick) >= 1
    assert re.search(r"ensenso-n10: characterising .*Ra 3\.2.* in about \d+ (s|min); kept in ", done.stderr)
    where = out / "ensenso-n10" if command == "study choose" else out
    stated = json.loads((where / "statement.json").read_text())
    assert set(stated["measurements"]) and stated["sensor"] == "ensenso-n10"
    count = len(quick)
    with mock.patch(WORK[command], side_effect=typer.Exit(REACHED)):  # it is kept: the work begins, and nobody is asked
        mitsim_here(*command.split(), study, *options_of(command, study), "-o", tmp_path / "again", code=REACHED)
    assert len(quick) == count


@pytest.mark.parametrize("command", COMMANDS)
def test_at_a_terminal_the_user_is_asked_and_may_refuse(command, study, tmp_path, monkeypatch):
    """`run` in a process of its own, as a user starts it; the others in this one, with the streams of a terminal."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("COLUMNS", "500")
    study.write_text(DRAWN)
    started = at_a_terminal if command == "run" else here_at_a_terminal
    told, code = started(
        [*command.split(), str(study), *options_of(command, study), "-o", str(tmp_path / "out")], "n\n"
    )
    assert re.search(QUESTION, " ".join(told.split())), told
    assert "[y/N]" in told
    assert code == 2
    assert "--yes" in told and "Traceback" not in told


def test_a_rendered_study_goes_on_with_the_nearest_sample(study, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    done = mitsim_here("study", "score", study, "-o", tmp_path / "out")
    assert "optically nearest sample, aluminium/ground Ra 0.74 um" in done.stderr and "--yes" in done.stderr
    assert (tmp_path / "out/scores.csv").exists() and not (tmp_path / "cache").exists()


def test_exposures_of_a_view_need_no_map(study, tmp_path, monkeypatch):
    """The view is rendered, so a finish that the map does not know is no question and no error."""
    monkeypatch.setattr(exposure_plan, "DRAWS", dict.fromkeys(exposure_plan.DRAWS, 1))
    monkeypatch.setattr(exposure_plan, "STEP", 100.0)
    study.write_text(STUDY.replace("[measure]\n", "[measure]\nsamples_per_pixel = 1\n"))
    done = mitsim_here("study", "exposures", study, "--view", "1", "--most", "1", "-o", tmp_path / "out", code=(0, 1))
    assert "characterise" not in done.stderr
    assert json.loads((tmp_path / "out/exposures.json").read_text())["view"] == 1


def here_at_a_terminal(arguments: list[str], typed: str) -> tuple[str, int]:
    """As :func:`at_a_terminal`, in this process: the answer is typed before the question."""
    ours, theirs = pty.openpty()
    os.write(ours, typed.encode())
    with os.fdopen(theirs, "r", closefd=False) as read, os.fdopen(theirs, "w", buffering=1, closefd=False) as write:
        streams = {"stdin": read, "stdout": write, "stderr": write}
        with (
            mock.patch.object(cli, "_stop_as_by_hand"),
            mock.patch.multiple(sys, argv=["mitsim", *arguments], **streams),
            pytest.raises(SystemExit) as ended,
        ):
            cli.main()
    os.close(theirs)
    shown = _shown_until(ours, None)
    os.close(ours)
    return shown, int(ended.value.code or 0)


def at_a_terminal(arguments: list[str], typed: str) -> tuple[str, int]:
    """Run a command at a terminal, type an answer to its question, and return what it showed and its exit code."""
    ours, theirs = pty.openpty()
    streams = dict.fromkeys(("stdin", "stdout", "stderr"), theirs)
    process = subprocess.Popen([sys.executable, "-m", "mitsim", *arguments], close_fds=True, **streams)
    os.close(theirs)
    try:
        shown = _shown_until(ours, b"[y/N]")
        os.write(ours, typed.encode())
        return shown + _shown_until(ours, None), process.wait(timeout=60)
    finally:
        process.kill()
        os.close(ours)


def _shown_until(terminal: int, mark: bytes | None) -> str:
    """What a terminal shows until it has shown a mark, or until its other side is closed."""
    shown, end = b"", time.monotonic() + 300
    while (mark is None or mark not in shown) and time.monotonic() < end:
        if select.select([terminal], [], [], 0.5)[0]:
            try:
                shown += os.read(terminal, 65536)
            except OSError:  # the other side is closed
                break
    return shown.decode(errors="replace")
