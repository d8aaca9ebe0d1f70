"""An emulated GRBL 1.1 with three axes: gnea/grbl doc/markdown, interface.md, commands.md, jogging.md, settings.md.

Welcome, $I, $$, $H, $X, jogs with soft limits, status reports with and without work offsets, jog cancel, feed hold,
soft reset, alarms. Left out: G-code that is no jog, the planner's queue, spindle, probe, accelerations.
On a socket it restarts when it is opened, as an Arduino does; on a pseudo-terminal it does not.
"""

from __future__ import annotations

import re

from tests.capture.devices.emulation import Axis, Faults, Journal, options, serve

SETTINGS = {
    0: 10,
    1: 25,
    10: 1,
    13: 0,
    20: 1,
    21: 1,
    22: 1,
    23: 0,
    24: 100,
    25: 1000,
    27: 1.0,
    100: 80,
    101: 80,
    102: 80,
    110: 3600,
    111: 3600,
    112: 3600,
    120: 500,
    121: 500,
    122: 500,
    130: 180,
    131: 180,
    132: 360,
}
HOMING_S = 0.3


class Grbl:
    def __init__(self, faults, journal, settings):
        self.faults, self.journal = faults, journal
        self.version = settings.pop("version", "1.1h")
        self.offset = [float(part) for part in settings.pop("offset", "0,0,0").split(",")]
        self.settings = {**SETTINGS, **{int(name): float(value) for name, value in settings.items()}}
        self.output, self.typed = bytearray(), ""
        self.reports = self.moves = 0
        self.homing = None
        self.was_moving = False
        self._power_up()

    def _power_up(self):
        self.axes = [Axis(), Axis(), Axis()]
        self.alarm = self.settings[22] == 1  # locked until homed
        self.critical = self.hold = False

    def opened(self, now):
        """The board restarts: its position is zero where it stands."""
        self._power_up()
        self._welcome(now)

    def mend(self):
        self.faults.mend()

    def busy(self, now):
        return any(axis.moving(now) for axis in self.axes) or self.homing is not None

    def receive(self, data, now):
        for byte in data:
            if byte == 0x18:
                self._soft_reset(now)
            elif byte == ord("?"):
                self._status(now)
            elif byte == 0x85:
                if any(axis.moving(now) for axis in self.axes):
                    self._stop(now)
            elif byte == ord("!"):
                self._stop(now)
                self.hold = self.hold or not any(axis.moving(now) for axis in self.axes)
            elif byte == ord("~"):
                self.hold = False
            elif byte in b"\r\n":
                line, self.typed = self.typed, ""
                self._do(line.replace(" ", "").upper(), now)
            else:
                self.typed += chr(byte)

    def tick(self, now):
        moving = [axis for axis in self.axes if axis.moving(now)]
        if moving:
            for kind in self.faults.due(self.moves, max(axis.progress(now) for axis in moving)):
                self._strike(kind, now)
        if self.homing is not None and now >= self.homing:
            self.homing, self.alarm = None, False
            self.axes = [Axis(-self.settings[27]) for _ in self.axes]  # off the switches
            self.journal.note("homed")
            self._say("ok", now)
        if self.was_moving and not self.busy(now):
            self.journal.note("stands", at=self._positions(now))
        self.was_moving = self.busy(now)

    def _strike(self, kind, now):
        self.journal.note("fault", kind=kind)
        if kind in ("limit", "stall", "reset"):
            self._stop(now)
        if kind == "limit":
            self.alarm = self.critical = True
            self._say("ALARM:1", now)
            self._say("[MSG:Reset to continue]", now)
        if kind == "reset":
            self._power_up()
            self._welcome(now)

    def _positions(self, now):
        return [round(axis.at(now), 3) for axis in self.axes]

    def _say(self, text, now):
        self.output += self.faults.altered(text.encode() + b"\r\n", now)

    def _stop(self, now):
        for axis in self.axes:
            axis.stop(now)
        self.journal.note("halt", at=self._positions(now))

    def _welcome(self, now):
        version = "0.9j" if "wrong" in self.faults.active else self.version
        self._say(f"Grbl {version} ['$' for help]", now)
        if self.alarm:
            self._say("[MSG:'$H'|'$X' to unlock]", now)

    def _soft_reset(self, now):
        moving = self.busy(now)
        self._stop(now)
        if self.homing is not None:
            self.homing = None
            self._say("ALARM:6", now)
        elif moving:
            self._say("ALARM:3", now)
        self.alarm, self.critical, self.hold = self.alarm or moving, False, False
        self.typed = ""
        self._welcome(now)

    def _status(self, now):
        if self.homing is not None or self.critical:
            return
        state = "Alarm" if self.alarm else "Hold:0" if self.hold else "Jog" if self.busy(now) else "Idle"
        work = self.settings[10] == 0
        at = [axis.at(now) - (offset if work else 0) for axis, offset in zip(self.axes, self.offset, strict=True)]
        place = ",".join(f"{value:.3f}" for value in at)
        self.reports += 1
        offset = "|WCO:" + ",".join(f"{value:.3f}" for value in self.offset) if self.reports % 10 == 9 else ""
        self._say(f"<{state}|{'WPos' if work else 'MPos'}:{place}|FS:0,0{offset}>", now)

    def _do(self, line, now):
        version = "0.9j" if "wrong" in self.faults.active else self.version
        if line == "":
            self._say("ok", now)
        elif line == "$I":
            self._say(f"[VER:{version}.20190830:]", now)
            self._say("[OPT:V,15,128]", now)
            self._say("ok", now)
        elif line == "$$":
            for number, value in self.settings.items():
                self._say(f"${number}={value:g}" if number < 100 else f"${number}={value:.3f}", now)
            self._say("ok", now)
        elif line == "$X":
            self.alarm = False
            self._say("[MSG:Caution: Unlocked]", now)
            self._say("ok", now)
        elif line == "$H" and self.settings[22] != 1:
            self._say("error:5", now)
        elif line == "$H":
            self.homing = now + HOMING_S
            self.journal.note("home")
        elif line.startswith("$J="):
            self._jog(line[3:], now)
        else:
            self._say("error:9" if self.alarm else "error:20", now)

    def _jog(self, text, now):
        words = re.findall(r"([A-Z])(-?\d+\.?\d*)", text)
        codes = {float(value) for letter, value in words if letter == "G"}
        targets = {"XYZ".index(letter): float(value) for letter, value in words if letter in "XYZ"}
        feed = [float(value) for letter, value in words if letter == "F"]
        if self.alarm or self.hold:
            return self._say("error:9", now)
        if codes != {90, 21, 53} or not feed or not targets:
            return self._say("error:16", now)
        if self.settings[20] and any(not -self.settings[130 + i] <= t <= 0 for i, t in targets.items()):
            return self._say("error:15", now)
        targets = {i: round(t * self.settings[100 + i]) / self.settings[100 + i] for i, t in targets.items()}
        distances = [targets.get(i, axis.at(now)) - axis.at(now) for i, axis in enumerate(self.axes)]
        length = sum(d * d for d in distances) ** 0.5
        rates = [60 * abs(d) / self.settings[110 + i] for i, d in enumerate(distances)]
        seconds = max([60 * length / feed[0], *rates])
        for axis, distance in zip(self.axes, distances, strict=True):
            axis.go(now, axis.at(now) + distance, seconds)
        self.moves += 1
        self.journal.note("move", to=[axis.target for axis in self.axes], seconds=seconds)
        self._say("ok", now)


if __name__ == "__main__":
    arguments = options(__doc__)
    settings = dict(text.split("=", 1) for text in arguments.set)
    serve(Grbl(Faults(arguments.fault), Journal(arguments.journal), settings), arguments)
