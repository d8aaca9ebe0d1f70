"""Emulated stages in separate processes: what goes wrong, what is said, that the axes stand, and how it goes on."""

import re
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from mitsim.capture.devices.device_error import DeviceError
from mitsim.capture.devices.stage import open_stage
from tests.capture.devices.emulator_process import connection, start_emulator

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="pseudo-terminals are POSIX only")

PLAN = [[12.0, -8.0, 5.0], [-12.0, 8.0, -4.0]]
STOPPED, DEAF, BEYOND = "The stage was stopped", "did not confirm the stop", "could not be sent"

FAULTS = {
    # fault -> what is said of a PTU, what of GRBL, and whether it says that it was stopped
    "silence": ("P: found no reply within 1 s", "no reply within 1 s", DEAF),
    "garbage": ("Check that this is a PTU", "Check that this is GRBL", STOPPED),
    "half": ("a partial line within 1 s, '*", "a partial line within 1 s, '<Jog", STOPPED),
    "late": (
        "P: found no reply within 1 s",
        "no reply within 1 s",
        (DEAF, STOPPED),
    ),  # GRBL is asked again, and answers in time
    "limit": ("!P: the pan axis has hit its end", "ALARM:1, a limit switch was hit", STOPPED),
    "reset": ("It has restarted and lost its position", "a board that has restarted", STOPPED),
    "stall": ("axis pan: move: found an axis that stands at", "an axis that stands at", STOPPED),
    "gone": ("the port disconnected", "the port disconnected", BEYOND),
}
#: (kind, over a socket, fault); what a line does to a fault is seen by the two that are the line's own
CASES = [(kind, tcp, fault) for kind, tcp in (("ptu", False), ("grbl", True)) for fault in FAULTS]
CASES += [(kind, tcp, fault) for kind, tcp in (("ptu", True), ("grbl", False)) for fault in ("silence", "gone")]


def run(table, done):
    """What a campaign does: home, then the angles that are not kept yet; ``done`` holds what was read back."""
    with open_stage(table) as stage:
        stage.home()
        for index, angles in enumerate(PLAN):
            if index not in done:
                done[index] = stage.move(angles[: len(stage.axes)])


def check_plan(done, tolerance=0.1):
    for index, angles in enumerate(PLAN):
        assert np.abs(done[index] - angles[: len(done[index])]).max() <= tolerance


@dataclass
class Outcome:
    """Of a campaign that met a fault in its second move, and was run again."""

    port: str
    message: str
    kept: list[int]
    struck: list[str]
    stood: bool
    first: NDArray[np.float64]
    done: dict[int, NDArray[np.float64]]


def meet(folder, kind, tcp, fault):
    """Run a campaign into a fault, mend it, and run it again."""
    emulator = start_emulator(folder, kind, f"{fault}@2", tcp=tcp)
    port, message, done = emulator.port, "no error", {}
    try:
        try:
            run(connection(kind, port), done)
        except DeviceError as error:
            message = str(error)
        kept, first = list(done), done[0].copy()
        if fault == "gone":
            time.sleep(1.0)  # nobody could tell it to stop: it ends the move that it was sent on
        struck = [entry["kind"] for entry in emulator.journal("fault")]
        stood = emulator.stands() or (fault == "gone" and not tcp)  # gone with its emulator
        if fault == "gone" and not tcp:
            emulator.end()
            emulator = start_emulator(folder, kind)
        emulator.mend()
        run(connection(kind, port), done)
    finally:
        emulator.end()
    return Outcome(port, message, kept, struck, stood, first, done)


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory):
    """(kind, tcp, fault) -> outcome; the campaigns mostly wait, so they run side by side."""
    folder = tmp_path_factory.mktemp("faults")
    with ThreadPoolExecutor(32) as pool:
        begun = {
            (kind, tcp, fault): pool.submit(meet, folder / f"{kind}{tcp}{fault}", kind, tcp, fault)
            for kind, tcp, fault in CASES
        }
        return {case: future.result() for case, future in begun.items()}


@pytest.mark.parametrize(("kind", "tcp", "fault"), CASES)
def test_a_fault_in_mid_move_is_told_and_stops_the_axes(kind, tcp, fault, outcomes):
    outcome = outcomes[kind, tcp, fault]
    by_ptu, by_grbl, stopped = FAULTS[fault]
    assert (by_ptu if kind == "ptu" else by_grbl) in outcome.message
    assert f"stage on {outcome.port}" in outcome.message
    assert (stopped if isinstance(stopped, str) else stopped[kind == "grbl"]) in outcome.message
    assert outcome.struck == [fault]
    assert outcome.stood


@pytest.mark.parametrize(("kind", "tcp", "fault"), CASES)
def test_a_campaign_that_met_a_fault_goes_on_where_it_was(kind, tcp, fault, outcomes):
    outcome = outcomes[kind, tcp, fault]
    assert outcome.kept == [0]
    assert (outcome.done[0] == outcome.first).all()
    check_plan(outcome.done)


@pytest.mark.parametrize("kind", ["ptu", "grbl"])
def test_a_device_that_is_silent_from_the_beginning_is_told_within_its_time_out(kind, emulate):
    table = connection(kind, emulate(kind, "silence").port, opening_timeout_s=0.8)
    began = time.monotonic()
    with pytest.raises(DeviceError, match=r"no reply within .* Check its power"):
        open_stage(table)
    assert time.monotonic() - began < 2.5


def test_another_model_is_refused(emulate):
    emulator = emulate("ptu", "wrong")
    with pytest.raises(DeviceError, match=r"identify: found 'Rotary Table.*a device whose name contains 'pan-tilt'"):
        open_stage(connection("ptu", emulator.port, model="pan-tilt"))
    emulator.mend()
    open_stage(connection("ptu", emulator.port, model="pan-tilt")).close()


def test_the_other_protocol_is_refused(emulate):
    unit, board = emulate("ptu").port, emulate("grbl").port
    with pytest.raises(DeviceError, match=r"open: found .* expected: a welcome"):
        open_stage(connection("grbl", unit, opening_timeout_s=1.0))
    with pytest.raises(DeviceError, match=r"begin \(ED\): found no reply"):
        open_stage(connection("ptu", board, opening_timeout_s=0.8))


def test_a_port_that_is_in_use_is_busy_and_free_again_after_closing(emulate):
    table = connection("ptu", emulate("ptu").port)
    with open_stage(table), pytest.raises(DeviceError, match="the port busy: another program uses it"):
        open_stage(table)
    open_stage(table).close()


def test_ctrl_c_stops_the_axes(emulate):
    emulator = emulate("ptu")
    code = f"""
import signal  # a shell that starts tests in the background has them ignore Ctrl-C
signal.signal(signal.SIGINT, signal.default_int_handler)
from tests.capture.devices.emulator_process import connection
from mitsim.capture.devices.stage import open_stage
with open_stage(connection("ptu", {emulator.port!r}, speed_deg_s=10)) as stage:
    stage.home()
    print("moving", flush=True)
    stage.move([60, 0])
"""
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "moving\n"
    time.sleep(0.5)
    process.send_signal(2)
    _, complaint = process.communicate(timeout=10)
    assert complaint.rstrip().endswith("KeyboardInterrupt")
    (halt,) = [entry for entry in emulator.journal("halt") if entry["at"][0] != 0]
    assert 20 < halt["at"][0] < 400  # counts, of 1167 that it was sent: 0.5 s at 10 deg/s are 97
    assert emulator.stands()


def test_axes_that_a_killed_program_left_moving_are_stopped_when_the_stage_is_opened(emulate):
    emulators = {kind: emulate(kind) for kind in ("ptu", "grbl")}
    killed = []
    for kind, emulator in emulators.items():
        code = f"""
import os
from tests.capture.devices.emulator_process import connection
from mitsim.capture.devices.stage import open_stage
stage = open_stage(connection({kind!r}, {emulator.port!r}, speed_deg_s=2))
stage.home()
stage._controller.start([20.0, 20.0] if {kind!r} == "ptu" else [-20.0] * 3)
os._exit(9)  # as kill -9 does
"""
        killed.append(subprocess.Popen([sys.executable, "-c", code]))
    assert [process.wait(20) for process in killed] == [9, 9]
    for kind, emulator in emulators.items():
        assert not emulator.stands()
        with open_stage(connection(kind, emulator.port)) as stage:
            assert emulator.stands()
            stage.home()
            stage.move([0, 0, 0][: len(stage.axes)])


def test_the_pages_first_move_runs_as_it_stands(emulate, tmp_path, monkeypatch, capsys):
    page = (Path(__file__).resolve().parents[3] / "docs/how-to/stage.md").read_text(encoding="utf-8")
    file, code = re.search(r"```toml\n(.*?)```", page, re.DOTALL), re.search(r"```python\n(.*?)```", page, re.DOTALL)
    (tmp_path / "stage.toml").write_text(file[1].replace("/dev/ttyUSB0", emulate("ptu").port), encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    exec(code[1], {})
    assert capsys.readouterr().out.splitlines()[-1] == "[ 9.97713978 -4.98856989]"
