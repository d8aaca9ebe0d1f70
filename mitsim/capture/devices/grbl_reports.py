"""Parse GRBL 1.1's status reports and settings, and explain its numbered errors and alarms.

From the project's own documents, gnea/grbl ``doc/markdown/interface.md`` and ``doc/csv`` of version 1.1. The meanings
are reworded for a stage, with advice.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

#: error:N -- GRBL rejected the line and moved nothing because of it
ERRORS = {
    1: "a word without its letter",
    2: "a number that cannot be read",
    3: "an unknown $ command",
    4: "a negative value where none is allowed",
    5: "homing is switched off: $22=1 switches it on, with limit switches",
    6: "a step pulse under 3 us",
    7: "its settings could not be read and are the defaults now: check $$",
    8: "only possible in state Idle",
    9: "locked by an alarm: it must be homed first",
    10: "soft limits need homing, $22=1",
    11: "a line that is too long",
    12: "more steps per second than possible: lower $110 to $112",
    13: "its safety door is open",
    14: "a start-up line that is too long",
    15: "a target beyond its travel, $130 to $132, counted from the limit switch",
    16: "an invalid jog",
    17: "laser mode needs PWM",
    20: "an unsupported G-code",
    21: "two G-codes of one group in a line",
    22: "no feed rate",
    23: "a number that is not an integer",
    24: "two codes that both need axes",
    25: "a word twice",
    26: "no axis named",
    27: "a line number out of range",
    28: "a value missing",
    29: "an unsupported coordinate system",
    30: "G53 without G0 or G1",
    31: "unused axes",
    32: "an arc without axes",
    33: "an invalid target",
    34: "an impossible arc",
    35: "an arc without its centre",
    36: "unused words",
    37: "a tool offset not allowed",
    38: "a tool number too large",
}

#: ALARM:N -- GRBL has stopped and is locked
ALARMS = {
    1: "a limit switch was hit; its position is lost",
    2: "a target beyond its travel; it stopped and kept its position",
    3: "a reset while it moved; its position is lost",
    4: "probe: not in its initial state",
    5: "probe: no contact",
    6: "homing: reset before its end",
    7: "homing: the safety door was opened",
    8: "homing: the switch stays pressed after backing off; raise $27, or check its wire",
    9: "homing: no switch found; check its wire, and that the travel $130 to $132 is long enough",
}

#: states in which nothing moves until a new command
STANDING = ("Idle", "Alarm", "Check", "Sleep")

#: states of a stage in use; in others something external has stopped it
IN_USE = ("Idle", "Jog", "Run")

_SETTING = re.compile(r"\$(\d{1,3})=([-+]?\d{1,9}(?:\.\d{0,9})?)\b")
_VERSION = re.compile(r"\[VER:v?(\d+\.\d+)([^:\]]*):?([^\]]*)\]")
_WELCOME = re.compile(r"Grbl(?:HAL)? (\d+\.\d+)(\S*)", re.IGNORECASE)
_NUMBERED = re.compile(r"(error|ALARM):(\d{1,3})", re.IGNORECASE)


@dataclass(frozen=True)
class StatusReport:
    """A status report: ``state`` and ``detail`` of ``Hold:0``; positions of all axes.

    ``machine`` is the position from the machine's zero, ``work`` from the work offset; a report has one of the two.
    ``offset``, in some reports, is machine - work. Missing values are None.
    """

    state: str
    detail: str
    machine: tuple[float, ...] | None
    work: tuple[float, ...] | None
    offset: tuple[float, ...] | None


def parse_status(line: str) -> StatusReport | None:
    """Parse ``<Idle|MPos:0.000,0.000,0.000|FS:0,0>``; None if it is not a status report."""
    if not (line.startswith("<") and line.endswith(">")):
        return None
    state, *fields = line[1:-1].split("|")
    name, _, detail = state.partition(":")
    if not name.isalpha():
        return None
    coordinates: dict[str, tuple[float, ...] | None] = {"MPos": None, "WPos": None, "WCO": None}
    for field in fields:
        key, _, text = field.partition(":")
        if key in coordinates:
            coordinates[key] = _numbers(text)
            if coordinates[key] is None:
                return None
    if (coordinates["MPos"] is None) == (coordinates["WPos"] is None):
        return None
    return StatusReport(name, detail, coordinates["MPos"], coordinates["WPos"], coordinates["WCO"])


def parse_setting(line: str) -> tuple[int, float] | None:
    """Parse ``$100=250.000``; None if it is not a setting."""
    match = _SETTING.match(line)
    return (int(match[1]), float(match[2])) if match else None


def parse_version(line: str) -> tuple[str, str] | None:
    """Parse ``[VER:1.1h.20190830:text]`` or the welcome ``Grbl 1.1h ['$' for help]``: ("1.1", "GRBL 1.1h...")."""
    match = _VERSION.match(line) or _WELCOME.match(line)
    if match is None:
        return None
    return match[1], f"GRBL {match[1]}{match[2]}" + (f" {match[3]}" if match.re is _VERSION and match[3] else "")


def is_welcome(line: str) -> bool:
    """Return whether a line is GRBL's welcome after a restart."""
    return _WELCOME.match(line) is not None


def parse_refusal(line: str) -> str | None:
    """Parse ``error:9`` or ``ALARM:1``, and add its meaning; None if it is neither."""
    match = _NUMBERED.fullmatch(line)
    if match is None:
        return None
    table = ERRORS if match[1].lower() == "error" else ALARMS
    return f"{line}, {table.get(int(match[2]), 'a number unknown to GRBL 1.1')}"


def _numbers(text: str) -> tuple[float, ...] | None:
    try:
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError:
        return None
    return numbers if 3 <= len(numbers) <= 8 and all(map(math.isfinite, numbers)) else None
