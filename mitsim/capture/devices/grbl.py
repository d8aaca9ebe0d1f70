"""Drive rotary and pan-tilt tables whose stepper motors are controlled by GRBL 1.1.

Signal chain: own degrees (mm for GRBL) -> ``$J=G90 G21 G53 X30.000 Y-15.000 F1800`` -> ``?`` polled until
``<Idle|...>`` -> machine position -> own degrees.

From the project's documents, gnea/grbl ``doc/markdown`` of version 1.1 (interface.md):

- GRBL answers a line by ``ok`` or ``error:N`` when it has parsed it, not when it has executed it.
- ``?`` requests a status report at any time except in a homing cycle and after a limit alarm.
- ``ALARM:N`` and ``[MSG:...]`` come unrequested.
- WPos = MPos - WCO; only some reports contain WCO.

Moves are jogs (commands.md, jogging.md). They change no modes, and a target beyond the travel is rejected without an
alarm. The jog cancel 0x85 decelerates, flushes the jog and keeps the position; in any other state it does nothing. 0x18
stops at once and loses the position.

Machine coordinates (``G53``) count from the limit switch: -travel to 0, wherever the switch is. They are 0 to travel if
GRBL was built with its origin at the switch (``Z`` in ``[OPT:``) and the switch is at the low end (``$23``). The latter
is *recalled* from its source, system.c.

Opening the port restarts most Arduino boards. Such a board sends ``Grbl 1.1h ['$' for help]``, sets its position to
zero where it stands and, with homing on (``$22=1``), is locked until it is homed. Boards that do not restart are asked
for their status. Any later welcome is an unexpected restart.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from characterisation.files.errors import InputError
from mitsim.capture.devices.device_error import DeviceError
from mitsim.capture.devices.grbl_reports import (
    IN_USE,
    STANDING,
    StatusReport,
    is_welcome,
    parse_refusal,
    parse_setting,
    parse_status,
    parse_version,
)
from mitsim.capture.devices.serial_line import PortGoneError, SerialLine, shown
from mitsim.capture.devices.stage_connection import StageConnection

#: longest command line that GRBL accepts (else error:11) [characters]
LONGEST_COMMAND = 78

#: GRBL sends a work offset in every 10th or 30th report
REPORTS_FOR_OFFSET = 32

#: time for which a restarting board is silent [s]; assumed
BOOT_S = 0.5

#: real-time command of GRBL that stops all motion and restarts the controller
_RESET = b"\x18"

#: real-time command that cancels a jog; the position stays known
_JOG_CANCEL = b"\x85"

#: real-time command that asks for a status report
_STATUS = b"?"
_REFUSED = "Correct the setting with a terminal; the board stores it"


class Grbl:
    """GRBL on a serial line; a :class:`~mitsim.capture.devices.stage.Controller`."""

    def __init__(self, connection: StageConnection, line: SerialLine) -> None:
        self._line, self._connection, self._fault = line, connection, connection.stage_fault
        self._columns = tuple("XYZ".index(axis.channel) for axis in connection.axes)
        self._offset: tuple[float, ...] | None = None
        self._homing = False
        self._wake()
        about = self._ask("$I")
        versions = [version for version in map(parse_version, about) if version]
        if not versions or versions[0][0] != "1.1":
            version = versions[0][1] if versions else " ".join(about)
            raise self._fault("identify ($I)", shown(version), "GRBL 1.1")
        self.identity = versions[0][1]
        connection.check_model(self.identity)
        settings = dict(setting for setting in map(parse_setting, self._ask("$$")) if setting)
        options = next((line for line in about if line.startswith("[OPT:")), "[OPT:]")[5:-1].partition(",")[0]
        self._read(settings, "Z" in options)

    def home(self, timeout_s: float) -> None:
        """Run the homing cycle, ``$H``."""
        self._homing = True
        self._ask("$H", timeout_s)
        self._homing = False
        if (state := self._status().state) != "Idle":
            raise self._fault("home ($H)", f"state {state}", "Idle")

    def start(self, targets: Sequence[float]) -> float:
        """Jog to machine coordinates, all axes together."""
        status, positions = self._place()
        if status.state != "Idle":
            raise self._fault("move", f"state {status.state}", "Idle")
        distances = [abs(target - position) for target, position in zip(targets, positions, strict=True)]
        pairs = zip(distances, self._rates, strict=True)
        seconds = max(distance / rate for distance, rate in pairs)
        # the feed is that of the combined motion, a vector length
        feed = 60 * math.hypot(*distances) / seconds if seconds > 0 else 60 * min(self._rates)
        words = " ".join(
            f"{axis.channel}{min(max(target, low), high):.3f}"  # GRBL rejects targets beyond by a fraction of a step
            for axis, target, (low, high) in zip(self._connection.axes, targets, self.travel, strict=True)
        )
        command = f"$J=G90 G21 G53 {words} F{max(feed, 1e-3):.3f}"
        if len(command) > LONGEST_COMMAND:
            raise self._fault("move", f"{len(command)} characters", f"{LONGEST_COMMAND} in a line")
        self._ask(command)
        return seconds + max(rate / slope for rate, slope in zip(self._rates, self._accelerations, strict=True))

    def report(self) -> tuple[tuple[float, ...], bool | None]:
        """Return the positions of the axes, and whether they move."""
        status, positions = self._place()
        return positions, status.state != "Idle"

    def halt(self) -> bool:
        """Cancel the jog; if that has no effect, reset."""
        self._line.unread()
        self._line.send(_RESET if self._homing else _JOG_CANCEL)
        reset = self._homing
        while True:
            try:
                if self._stands_by(self._line.clock.now() + self._connection.reply_timeout_s):
                    return True
            except PortGoneError:
                raise
            except DeviceError:  # silence, or lines that are not GRBL's
                self._line.unread()
            if reset:
                return False
            self._line.send(_RESET)
            reset = True

    def close(self) -> None:
        """Close the port."""
        self._line.close()

    def _stands_by(self, deadline: float) -> bool:
        """Request reports until one says that nothing moves; return False at the deadline."""
        while (now := self._line.clock.now()) < deadline:
            self._line.send(_STATUS)
            while True:
                line = self._line.receive(min(deadline, now + self._connection.reply_timeout_s), "halt", "<Idle|...>")
                if is_welcome(line):
                    return True
                if status := parse_status(line):
                    if status.state in STANDING or (status.state in ("Hold", "Door") and status.detail == "0"):
                        return True
                    break
            self._line.clock.sleep(0.05)
        return False

    def _wake(self) -> None:
        """Wait for the first line of a board that restarts on opening; query one that does not."""
        clock = self._line.clock
        deadline = clock.now() + self._connection.opening_timeout_s
        heard, reset = "", False
        while True:
            try:
                line = self._line.receive(min(deadline, clock.now() + BOOT_S), "open", "Grbl 1.1")
            except PortGoneError:
                raise
            except DeviceError as error:
                left = deadline - clock.now()
                if left <= 0:
                    found = f"no line of GRBL, but {shown(heard)}" if heard else error.found
                    raise self._fault("open", found, "a welcome (Grbl 1.1...) or a status report", error.hint) from None
                if not reset and left < self._connection.opening_timeout_s / 2:
                    self._line.send(_RESET)  # after a limit alarm it answers only to a reset
                    reset = True
                else:
                    self._line.send(_STATUS)
                continue
            heard = line
            if is_welcome(line):
                break
            if status := parse_status(line):
                if status.state in ("Idle", "Alarm"):
                    break
                self._line.send(_RESET)  # stop a motion left by an earlier program
                reset = True
        self._line.drain(min(BOOT_S, 0.2), self._connection.opening_timeout_s)

    def _read(self, settings: dict[int, float], origin_at_switch: bool) -> None:
        """Read steps, rates, accelerations and travel from the board's settings ($100 to $132)."""
        if settings.get(13, 0) != 0:
            raise self._setting(13, settings[13], "0: positions in mm, which stand for degrees")
        if self._connection.homing == "device" and settings.get(22, 0) == 0:
            by_hand = 'homing = "none", with the stage set to zero by hand before it is opened'
            raise self._setting(22, 0, f"1, with limit switches; or {by_hand}")
        rates, accelerations, travel, resolution = [], [], [], []
        for index, (column, axis) in enumerate(zip(self._columns, self._connection.axes, strict=True)):
            steps, rate, slope, length = (settings.get(group + column, math.nan) for group in (100, 110, 120, 130))
            for number, value in ((100, steps), (110, rate), (120, slope)):
                if not value > 0:
                    raise self._setting(number + column, value, "more than 0")
            self._connection.check_steps(index, steps)
            resolution.append(1 / steps)
            speed = (self._connection.speed_deg_s or math.inf) * abs(axis.gear)
            if self._connection.speed_deg_s is not None and speed > rate / 60 * (1 + 1e-9):
                allowed = f"at most {rate / 60 / abs(axis.gear):.4g} for axis {axis.name}"
                raise self._connection.speed_fault(allowed, f"the board's ${110 + column}")
            rates.append(min(speed, rate / 60))
            accelerations.append(slope)
            low_end = int(settings.get(23, 0)) >> column & 1
            if settings.get(20, 0) == 0:
                travel.append((-math.inf, math.inf))
            elif not length > 0:
                raise self._setting(130 + column, length, "more than 0")
            else:
                travel.append((0.0, length) if origin_at_switch and low_end else (-length, 0.0))
        self._rates, self._accelerations = tuple(rates), tuple(accelerations)
        self.resolution, self.travel = tuple(resolution), tuple(travel)

    def _place(self) -> tuple[StatusReport, tuple[float, ...]]:
        """Return a status report of a working stage, and the positions of its axes [own deg]."""
        for _ in range(REPORTS_FOR_OFFSET):
            status = self._status()
            if status.state not in IN_USE:
                state = f"state {status.state}" + (f":{status.detail}" if status.detail else "")
                lost = status.state == "Alarm"
                hint = "Its position may be lost" if lost else "Check for a feed hold or an open door"
                raise self._fault("status (?)", state, " or ".join(IN_USE), hint)
            self._offset = status.offset or self._offset
            machine = status.machine
            if machine is None and status.work is not None and self._offset is not None:
                machine = tuple(a + b for a, b in zip(status.work, self._offset, strict=False))
            if machine is not None:
                if len(machine) <= max(self._columns):
                    raise self._fault("status (?)", f"{len(machine)} axes", f"{max(self._columns) + 1} or more")
                return status, tuple(machine[column] for column in self._columns)
        raise self._fault("status (?)", "work positions without their offset (WCO)", "machine positions", "Set $10=1")

    def _status(self) -> StatusReport:
        """Request a status report, and wait for it."""
        self._check_silence("status (?)", "silence before a query")
        self._line.send(_STATUS)
        deadline = self._line.clock.now() + self._connection.reply_timeout_s
        while True:
            line = self._line.receive(deadline, "status (?)", "<Idle|MPos:...>")
            if status := parse_status(line):
                return status
            self._passing(line, "status (?)", "<Idle|MPos:...>")

    def _ask(self, command: str, timeout_s: float | None = None) -> list[str]:
        """Send a line and return the lines before its ``ok``."""
        self._check_silence(command, "silence before a command")
        self._line.send(command.encode() + b"\n")
        deadline = self._line.clock.now() + (timeout_s or self._connection.reply_timeout_s)
        lines: list[str] = []
        while (line := self._line.receive(deadline, command, "ok")) != "ok":
            if parse_setting(line) or (line.startswith("[") and line.endswith("]")):
                lines.append(line)
            elif not parse_status(line):
                self._passing(line, command, "ok")
        return lines

    def _check_silence(self, operation: str, expected: str) -> None:
        for line in filter(str.strip, self._line.unread().splitlines()):
            self._passing(line.strip(), operation, expected)

    def _passing(self, line: str, operation: str, expected: str) -> None:
        """Ignore a message that is not a reply, and raise an error for an unexpected one."""
        if refusal := parse_refusal(line):
            raise self._fault(operation, refusal, expected)
        if is_welcome(line):
            hint = "Its position is lost. Check its power and its reset line"
            raise self._fault(operation, f"a board that has restarted, {shown(line)}", expected, hint)
        if not line.startswith(("[MSG:", ">")) and parse_status(line) is None:
            raise self._fault(operation, shown(line), expected, "Check that this is GRBL, and the baud rate")

    def _setting(self, number: int, value: float, allowed: str) -> InputError:
        return InputError(self._connection.where, f"GRBL setting ${number}", f"{value:g}", allowed, _REFUSED)
