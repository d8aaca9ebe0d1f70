"""What GRBL 1.1 says: status reports, settings, and what its numbered errors and alarms mean.

From the project's own documents, gnea/grbl ``doc/markdown/interface.md`` and ``doc/csv`` of version 1.1; the meanings
are in our words, for a stage, with what to do about them.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

#: error:N -- the line was refused, nothing moved because of it
ERRORS = {
    1: "a word without its letter",
    2: "a number that cannot be read",
    3: "a $ command that it does not know",
    4: "a negative value where none can be",
    5: "homing is switched off: $22=1 switches it on, with limit switches",
    6: "a step pulse under 3 us",
    7: "its settings could not be read and are the defaults now: check $$",
    8: "only possible while it stands idle",
    9: "locked by an alarm: it must be homed first",
    10: "soft limits need homing, $22=1",
    11: "a line too long for it",
    12: "more steps a second than it can make: lower $110 to $112",
    13: "its safety door is open",
    14: "a start-up line too long for it",
    15: "a target beyond its travel, $130 to $132, counted from the limit switch",
    16: "a jog that it cannot read",
    17: "laser mode needs PWM",
    20: "a G-code that it does not have",
    21: "two G-codes of one group in a line",
    22: "no feed rate",
    23: "a number that must be whole",
    24: "two codes that both want axes",
    25: "a word twice",
    26: "no axis named",
    27: "a line number out of range",
    28: "a value missing",
    29: "a coordinate system it has not",
    30: "G53 without G0 or G1",
    31: "axes named in vain",
    32: "an arc without axes",
    33: "a target that is none",
    34: "an arc that cannot be",
    35: "an arc without its centre",
    36: "words left over",
    37: "a tool offset not allowed",
    38: "a tool number too large",
}

#: ALARM:N -- it has stopped and is locked
ALARMS = {
    1: "a limit switch was hit; its position is lost",
    2: "a target beyond its travel; it stopped and knows where it is",
    3: "a reset while it moved; its position is lost",
    4: "probe: not in its first state",
    5: "probe: nothing met",
    6: "homing: reset before it had ended",
    7: "homing: the safety door was opened",
    8: "homing: the switch stays pressed after backing off; raise $27, or look at its wire",
    9: "homing: no switch found; is it wired, is the travel $130 to $132 long enough",
}

#: states in which nothing moves, and nothing will without a new command
STANDING = ("Idle", "Alarm", "Check", "Sleep")

#: states that a stage can be in while it is used; in others somebody or something else has stopped it
IN_USE = ("Idle", "Jog", "Run")

_SETTING = re.compile(r"\$(\d{1,3})=([-+]?\d{1,9}(?:\.\d{0,9})?)\b")
_VERSION = re.compile(r"\[VER:v?(\d+\.\d+)([^:\]]*):?([^\]]*)\]")
_WELCOME = re.compile(r"Grbl(?:HAL)? (\d+\.\d+)(\S*)", re.IGNORECASE)
_NUMBERED = re.compile(r"(error|ALARM):(\d{1,3})", re.IGNORECASE)


@dataclass(frozen=True)
class Status:
    """A status report: ``state`` and ``detail`` of ``Hold:0``; positions of all axes.

    ``machine`` from its own zero, ``work`` from the work offset, of which it sends one; ``offset``, sometimes sent, is
    machine - work. None where it sent none.
    """

    state: str
    detail: str
    machine: tuple[float, ...] | None
    work: tuple[float, ...] | None
    offset: tuple[float, ...] | None


def parse_status(line: str) -> Status | None:
    """Read ``<Idle|MPos:0.000,0.000,0.000|FS:0,0>``; None if that is no status report."""
    if not (line.startswith("<") and line.endswith(">")):
        return None
    state, *fields = line[1:-1].split("|")
    name, _, detail = state.partition(":")
    if not name.isalpha():
        return None
    known: dict[str, tuple[float, ...] | None] = {"MPos": None, "WPos": None, "WCO": None}
    for field in fields:
        key, _, text = field.partition(":")
        if key in known:
            known[key] = _numbers(text)
            if known[key] is None:
                return None
    if (known["MPos"] is None) == (known["WPos"] is None):
        return None
    return Status(name, detail, known["MPos"], known["WPos"], known["WCO"])


def parse_setting(line: str) -> tuple[int, float] | None:
    """Read ``$100=250.000``; None if that is no setting."""
    match = _SETTING.match(line)
    return (int(match[1]), float(match[2])) if match else None


def parse_version(line: str) -> tuple[str, str] | None:
    """Read ``[VER:1.1h.20190830:text]`` or the welcome ``Grbl 1.1h ['$' for help]``: ("1.1", "GRBL 1.1h...")."""
    match = _VERSION.match(line) or _WELCOME.match(line)
    if match is None:
        return None
    return match[1], f"GRBL {match[1]}{match[2]}" + (f" {match[3]}" if match.re is _VERSION and match[3] else "")


def is_welcome(line: str) -> bool:
    """Whether this is what GRBL says first after a restart."""
    return _WELCOME.match(line) is not None


def parse_refusal(line: str) -> str | None:
    """Read ``error:9`` or ``ALARM:1`` with what it means; None if that is neither."""
    match = _NUMBERED.fullmatch(line)
    if match is None:
        return None
    table = ERRORS if match[1].lower() == "error" else ALARMS
    return f"{line}, {table.get(int(match[2]), 'a number that GRBL 1.1 does not have')}"


def _numbers(text: str) -> tuple[float, ...] | None:
    try:
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError:
        return None
    return numbers if 3 <= len(numbers) <= 8 and all(map(math.isfinite, numbers)) else None
