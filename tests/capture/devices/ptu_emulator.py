"""An emulated pan-tilt unit: the ASCII protocol of the PTU-D46 User's Manual 2.14, section 4.

Position and speed commands and queries, offsets, bounds, halts, await, reset, echo, terse and verbose replies. Left
out: slaved mode, velocity control, limits that are switched off, power, networks of units.
"""

from __future__ import annotations

from tests.capture.devices.emulation import Axis, Faults, Journal, options, serve

RESOLUTION = 185.1428  # seconds of arc in a count
BOUNDS = {"P": (-3090, 3090), "T": (-907, 604)}
NAMES = {"P": "Pan", "T": "Tilt"}
VERSION = "Pan-Tilt Controller v2.12.1d1(C14/E), (C)2003 Directed Perception, Inc., All Rights Reserved"
RESET_S = 0.3


class PanTiltUnit:
    def __init__(self, faults, journal, settings):
        self.faults, self.journal = faults, journal
        self.version = settings.get("version", VERSION)
        self.axes = {"P": Axis(), "T": Axis()}
        self.speed, self.acceleration = {"P": 1000, "T": 1000}, {"P": 2000, "T": 2000}
        self.upper, self.lower = 2902, 31
        self.output, self.typed = bytearray(), ""
        self.resetting = self.awaiting = None
        self.moves, self.was_moving = 0, False
        self._start_up()

    def _start_up(self):
        self.echo, self.verbose = True, True

    def opened(self, now):
        """A PTU does not notice that its port is opened."""

    def mend(self):
        self.faults.mend()

    def busy(self, now):
        return any(axis.moving(now) for axis in self.axes.values()) or self.resetting is not None

    def receive(self, data, now):
        for byte in data:
            character = chr(byte)
            if self.echo and "silence" not in self.faults.active:
                self.output.append(byte)
            if character in " \r\n":
                command, self.typed = self.typed, ""
                if command:
                    self._do(command.upper(), now)
            else:
                self.typed += character

    def tick(self, now):
        if self.resetting is not None and now >= self.resetting:
            self.resetting = None
            self._say("!T!T!P!P*", now)
            self.journal.note("homed")
        moving = [axis for axis in self.axes.values() if axis.moving(now)]
        if moving:
            for kind in self.faults.due(self.moves, max(axis.progress(now) for axis in moving)):
                self._strike(kind, now)
        elif self.awaiting is not None:
            self.awaiting = None
            self._say("*", now)
        if self.was_moving and not self.busy(now):
            self.journal.note("stands", at=self._positions(now))
        self.was_moving = self.busy(now)

    def _strike(self, kind, now):
        self.journal.note("fault", kind=kind)
        if kind in ("limit", "stall", "reset"):
            for axis in self.axes.values():
                axis.stop(now)
        if kind == "limit":
            self.output += b"!P"  # the manual gives no end of line
        if kind == "reset":
            self.axes = {"P": Axis(), "T": Axis()}
            self._start_up()

    def _positions(self, now):
        return [round(axis.at(now)) for axis in self.axes.values()]

    def _say(self, text, now):
        self.output += self.faults.altered(text.encode() + b"\r\n", now)

    def _answer(self, words, value, now):
        self._say(f"* {words} {value}" if self.verbose else f"* {value}", now)

    def _do(self, command, now):
        version = "Rotary Table Controller v1.0" if "wrong" in self.faults.active else self.version
        if self.resetting is not None:
            return
        axis, code, argument = command[:1], command[:2], command[2:]
        if command in ("H", "HP", "HT"):
            for name in "PT" if command == "H" else command[1]:
                self.axes[name].stop(now)
            self.journal.note("halt", at=self._positions(now))
            self._say("*", now)
        elif command == "R":
            self.resetting = now + RESET_S
            self.axes = {"P": Axis(), "T": Axis()}
            self.journal.note("home")
        elif command == "A":
            self.awaiting = now
        elif command in ("ED", "EE"):
            self.echo = command == "EE"
            self._say("*", now)
        elif command in ("FT", "FV"):
            self.verbose = command == "FV"
            self._say("*", now)
        elif command in ("CI", "I", "LE"):
            self._say("*", now)
        elif command == "V":
            self._say(f"* {version}", now)
        elif axis in NAMES and code[1:] in ("P", "O") and argument:
            self._go(axis, argument, code[1] == "O", now)
        elif axis in NAMES and code[1:] in ("S", "U", "L", "A") and argument:
            self._set(axis, code[1], argument, now)
        elif axis in NAMES and len(command) == 2 and code[1] in "PORNXSULA":
            self._query(axis, code[1], now)
        else:
            self._say("! Illegal command entered", now)  # the words are assumed

    def _query(self, name, what, now):
        axis, (low, high) = self.axes[name], BOUNDS[name]
        words, value = {
            "P": (f"Current {NAMES[name]} position is", round(axis.at(now))),
            "O": (f"Target {NAMES[name]} position is", round(axis.target)),
            "R": (f"seconds arc per {NAMES[name]} position", RESOLUTION),
            "N": (f"Minimum {NAMES[name]} position is", low),
            "X": (f"Maximum {NAMES[name]} position is", high),
            "S": (f"Target {NAMES[name]} speed is", self.speed[name]),
            "U": (f"Maximum {NAMES[name]} speed is", self.upper),
            "L": (f"Minimum {NAMES[name]} speed is", self.lower),
            "A": (f"{NAMES[name]} acceleration is", self.acceleration[name]),
        }[what]
        self._answer(words, value, now)

    def _set(self, name, what, argument, now):
        value = int(argument)
        if what == "S" and value > self.upper:
            return self._say(f"! {NAMES[name]} speed cannot exceed {self.upper} positions/sec", now)
        if what == "S":
            self.speed[name] = value
        self._say("*", now)

    def _go(self, name, argument, relative, now):
        axis, (low, high) = self.axes[name], BOUNDS[name]
        target = int(argument) + (round(axis.at(now)) if relative else 0)
        if target > high:
            return self._say(f"! Maximum allowable {NAMES[name]} position is {high}", now)
        if target < low:
            return self._say(f"! Minimum allowable {NAMES[name]} position is {low}", now)
        if name == "P":
            self.moves += 1
        axis.go(now, target, abs(target - axis.at(now)) / self.speed[name])
        self.journal.note("move", axis=name, to=target)
        self._say("*", now)


if __name__ == "__main__":
    arguments = options(__doc__)
    settings = dict(text.split("=", 1) for text in arguments.set)
    serve(PanTiltUnit(Faults(arguments.fault), Journal(arguments.journal), settings), arguments)
