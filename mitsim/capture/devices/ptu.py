"""Drive pan-tilt units of Directed Perception and FLIR by their ASCII protocol.

Signal chain: own degrees -> counts, 3600 / resolution ["] per degree -> ``PP<n>``, ``TP<n>`` -> ``PP``, ``TP`` polled
-> counts -> own degrees.

From the manufacturer's *PTU-D46 User's Manual* 2.14, section 4, whose command set the D47, D48, D300 and E series keep:

- A command ends with a blank; the reply is ``*``, ``* <result>`` or ``! <error>`` and the end of a line (4.2).
- ``!P`` or ``!T`` come unrequested when an axis has hit its end and lost its position (4.2, 4.3.5).
- ``PR`` is the seconds of arc per count (4.3.3); ``PN PX TN TX`` are the bounds found at reset (4.3.4).
- Speeds and accelerations are in counts/s and counts/s^2 (4.4).
- ``ED`` disables the echo of commands, ``FT`` makes replies terse (4.5.3, 4.5.4).

Published drivers are the source of two facts: a reset answers ``!T!T!P!P*``, and ``CI`` selects position control.
*Recalled, not confirmed:* ``H`` is obeyed during a reset; a restarted unit echoes again and sends verbose replies;
``VM`` returns the model in the E series.

After ``FT`` and ``ED`` a reply with a command's echo or whole words can only come from a restarted unit. Messages are
not numbered: one command is sent at a time, and an unexpected line is an error. ``A``, answered at the end of a motion,
is not used, because no other query is possible before its answer, not even of the positions.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

from mitsim.capture.devices.device_error import DeviceError
from mitsim.capture.devices.serial_line import PortGoneError, SerialLine, shown
from mitsim.capture.devices.stage_connection import StageConnection

#: silence after which all replies to an earlier session have arrived [s]; assumed
QUIET_S = 0.3

#: silence after a command that may have several reply lines [s]; assumed
PAUSE_S = 0.1

_NAMES = {"P": "pan", "T": "tilt"}
_LIMIT = re.compile(r"!([PT])(?=\s*(?:$|[!*\r\n]))")
_HALTED = re.compile(r"(?:.*\bH\s*)?\*")  # with the echo of a restarted unit
_INTEGER = re.compile(r"[-+]?\d{1,9}")
_NUMBER = re.compile(r"[-+]?\d{1,9}(\.\d{0,9})?")


class PanTiltUnit:
    """A PTU on a serial line; a :class:`~mitsim.capture.devices.stage.Controller`."""

    def __init__(self, connection: StageConnection, line: SerialLine) -> None:
        self._line, self._connection, self._fault = line, connection, connection.stage_fault
        self._channels = tuple(axis.channel for axis in connection.axes)
        line.send(b" H ")  # stop a motion left by an earlier program
        self._make_terse()
        self.identity = self._identity()
        connection.check_model(self.identity)
        arc = [self._number(f"{channel}R") for channel in self._channels]
        if bad := [value for value in arc if not 0 < value < 3600]:
            raise self._fault("resolution", f"{bad[0]:g} seconds of arc", "more than 0, less than 3600")
        self.resolution: tuple[float, ...] = tuple(value / 3600 for value in arc)
        for index, step in enumerate(self.resolution):
            connection.check_steps(index, 1 / step)
        self.travel = tuple(self._travel(channel, step) for channel, step in self._by_channel())
        self._paces = [self._pace(index) for index in range(len(arc))]

    def home(self, timeout_s: float) -> None:
        """Reset: both axes move to their ends and then to the centre."""
        self._line.unread()
        self._line.send(b" R ")
        deadline = self._line.clock.now() + timeout_s
        while True:
            line = self._line.receive(deadline, "reset (R)", "!T!T!P!P*, when both axes have found their ends")
            answer = _LIMIT.sub("", line).strip()
            if answer.endswith("*"):
                break
            if answer.startswith("!"):
                raise self._fault("reset (R)", shown(answer), "*", "Check for a heavy load or a blocked axis")
        self._make_terse()
        for channel, step in self._by_channel():
            if abs(position := self._count(f"{channel}P") * step) > step:
                raise self._fault(f"reset (R), channel {channel}", f"{position:.3f} deg", "0 deg after a reset")

    def start(self, targets: Sequence[float]) -> float:
        """Start both axes, immediately and independently (``I``)."""
        seconds = []
        for index, target in enumerate(targets):
            channel, step = self._channels[index], self.resolution[index]
            position = self._count(f"{channel}P") * step
            low, high = self.travel[index]
            self._order(f"{channel}P{round(min(max(target, low), high) / step)}")
            speed, acceleration = self._paces[index]
            seconds.append(abs(target - position) / speed + speed / acceleration)
        return max(seconds)

    def report(self) -> tuple[tuple[float, ...], bool | None]:
        """Return the positions of the axes; a PTU does not report whether it moves."""
        return tuple(self._count(f"{channel}P") * step for channel, step in self._by_channel()), None

    def halt(self) -> bool:
        """Halt both axes with ``H``; the preceding blank ends a partly sent command."""
        self._line.unread()
        self._line.send(b" H ")
        deadline = self._line.clock.now() + self._connection.reply_timeout_s
        try:
            while not _HALTED.fullmatch(_LIMIT.sub("", self._line.receive(deadline, "halt (H)", "*")).strip()):
                pass
        except PortGoneError:
            raise
        except DeviceError:
            return False
        return True

    def close(self) -> None:
        """Close the port."""
        self._line.close()

    def _by_channel(self) -> list[tuple[str, float]]:
        return list(zip(self._channels, self.resolution, strict=True))

    def _make_terse(self) -> None:
        """Disable the echo and make replies terse, whatever the unit's state."""
        self._line.drain(QUIET_S, self._connection.opening_timeout_s)
        for command in ("ED", "FT", "CI", "I"):
            self._line.send(command.encode() + b" ")
            deadline = self._line.clock.now() + self._connection.opening_timeout_s
            while not self._line.receive(deadline, f"begin ({command})", "*").endswith("*"):
                pass
        self._line.drain(PAUSE_S, self._connection.opening_timeout_s)

    def _identity(self) -> str:
        answer = [self._result("V")]
        self._line.drain(PAUSE_S, self._connection.opening_timeout_s)  # the version may have several lines
        if (model := self._reply("VM")).startswith("*"):  # the E series; others answer with an error
            answer.append(model[1:].strip())
        self._line.drain(PAUSE_S, self._connection.opening_timeout_s)
        return ", ".join(answer)

    def _travel(self, channel: str, step: float) -> tuple[float, float]:
        low, high = self._count(f"{channel}N"), self._count(f"{channel}X")
        if low >= high:
            expected, hint = "the lower before the upper", "Reset the unit after power-up"
            raise self._fault(f"bounds, channel {channel}", f"{low} to {high}", expected, hint)
        return low * step, high * step

    def _pace(self, index: int) -> tuple[float, float]:
        """Return speed [own deg/s] and acceleration [own deg/s^2] of an axis, after setting the connection's speed."""
        channel, step, axis = self._channels[index], self.resolution[index], self._connection.axes[index]
        if self._connection.speed_deg_s is not None:
            steps = round(self._connection.speed_deg_s * abs(axis.gear) / step)
            low, high = self._count(f"{channel}L"), self._count(f"{channel}U")
            if not low <= steps <= high:
                slowest, fastest = (steps * step / abs(axis.gear) for steps in (low, high))
                allowed = f"{slowest:.3g} to {fastest:.3g} for axis {axis.name}"
                raise self._connection.speed_fault(allowed, "the unit's own limits")
            self._order(f"{channel}S{steps}")
        speed, acceleration = self._count(f"{channel}S"), self._count(f"{channel}A")
        if speed <= 0 or acceleration <= 0:
            raise self._fault(f"pace, channel {channel}", f"{speed} counts/s, {acceleration} counts/s^2", "more than 0")
        return speed * step, acceleration * step

    def _count(self, query: str) -> int:
        result = self._result(query)
        if not _INTEGER.fullmatch(result):
            raise self._not_terse(query, result, "a whole number")
        return int(result)

    def _number(self, query: str) -> float:
        result = self._result(query)
        if not _NUMBER.fullmatch(result) or not math.isfinite(float(result)):
            raise self._not_terse(query, result, "a number")
        return float(result)

    def _order(self, command: str) -> None:
        if result := self._result(command):
            raise self._not_terse(command, result, "*")

    def _result(self, command: str) -> str:
        """Send a command and return the text after the star of its reply."""
        if (reply := self._reply(command)).startswith("!"):
            raise self._fault(command, shown(reply), "*")
        return reply[1:].strip()

    def _reply(self, command: str) -> str:
        """Send a command and return its reply, which begins with a star or an exclamation mark."""
        if stray := self._checked(self._line.unread(), command).strip():
            hint = "Check for another program on this line, or a late reply"
            raise self._fault(command, f"an unexpected line, {shown(stray)}", "silence before a command", hint)
        self._line.send(command.encode() + b" ")
        deadline = self._line.clock.now() + self._connection.reply_timeout_s
        while True:
            reply = self._checked(self._line.receive(deadline, command, "a reply that begins with *"), command).strip()
            if reply.startswith(("*", "!")):
                return reply
            if reply:
                raise self._not_terse(command, reply, "a reply that begins with *")

    def _checked(self, answer: str, command: str) -> str:
        """Return a text if it has no sign that an axis has hit its end; raise an error otherwise."""
        if hit := _LIMIT.search(answer):
            found = f"!{hit[1]}: the {_NAMES[hit[1]]} axis has hit its end"
            expected, hint = "an axis within its travel", "Its position is lost. Remove the obstacle"
            raise self._fault(f"{command}, channel {hit[1]}", found, expected, hint)
        return answer

    def _not_terse(self, command: str, answer: str, expected: str) -> DeviceError:
        if re.match(r"[A-Za-z]{1,2}[-+\d]* ?[*!]|[A-Za-z]+[- ][A-Za-z]+", answer):
            hint = "It has restarted and lost its position. Check its power"
            return self._fault(command, f"verbose replies again, {shown(answer)}", expected, hint)
        return self._fault(command, shown(answer), expected, "Check that this is a PTU, and the baud rate")
