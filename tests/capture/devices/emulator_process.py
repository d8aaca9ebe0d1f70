"""Emulated stages as processes, and connections to them."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from characterisation.files.documents import validate
from mitsim.capture.devices.stage_connection import StageConnection

ROOT = Path(__file__).parents[3]

PTU = {
    "kind": "ptu",
    "axes": [
        {"name": "pan", "channel": "P", "limits_deg": [-60, 60]},
        {"name": "tilt", "channel": "T", "limits_deg": [-40, 30]},
    ],
}
GRBL = {
    "kind": "grbl",
    "axes": [
        {"name": "turn", "channel": "Z", "limits_deg": [-25, 25], "zero_deg": -30},
        {"name": "pan", "channel": "X", "limits_deg": [-25, 25], "zero_deg": -30},
        {"name": "tilt", "channel": "Y", "limits_deg": [-20, 20], "zero_deg": -60, "gear": -2},
    ],
}
#: shorter than for devices: an emulator answers at once, unless the machine is busy
QUICK = {"settle_s": 0.05, "reply_timeout_s": 1.0, "opening_timeout_s": 3.0, "home_timeout_s": 5.0}


def connection(kind, port, **changes):
    table = {"ptu": PTU, "grbl": GRBL}[kind]
    return validate("test", {**table, **QUICK, "port": str(port), **changes}, StageConnection)


@dataclass
class Emulator:
    process: subprocess.Popen
    port: str
    journal_file: Path

    def journal(self, event=None):
        lines = self.journal_file.read_text().splitlines() if self.journal_file.exists() else []
        entries = [json.loads(line) for line in lines]
        return [entry for entry in entries if event in (None, entry["event"])]

    def stands(self):
        """Whether the last that its axes did was to come to a stand."""
        moves = [entry["event"] for entry in self.journal() if entry["event"] in ("move", "home", "stands", "halt")]
        return not moves or moves[-1] in ("stands", "halt")

    def mend(self):
        self.process.send_signal(signal.SIGUSR1)
        time.sleep(0.05)

    def end(self):
        if self.process.poll() is None:
            self.process.terminate()
        self.process.wait(5)
        self.process.stdout.close()


def start_emulator(folder, kind, *faults, tcp=False, **settings):
    """Start an emulator in a process of its own; its pseudo-terminal is ``folder``/stage."""
    folder.mkdir(exist_ok=True)
    command = [
        sys.executable,
        "-S",
        "-m",
        f"tests.capture.devices.{kind}_emulator",
        "--journal",
        str(folder / "journal.jsonl"),
    ]
    command += ["--tcp", "0"] if tcp else ["--pty", str(folder / "stage")]
    command += [f"--fault={fault}" for fault in faults]
    command += [f"--set={name.lstrip('_')}={value}" for name, value in settings.items()]
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)
    return Emulator(process, process.stdout.readline().strip(), folder / "journal.jsonl")
