"""Operate a live stage in degrees: move it to angles, read them back, and stop it on any error.

Signal chain: requested angles [deg] -> check of the limits -> the device's own degrees -> command -> polled until the
axes stand, by a deadline from distance and speed -> settling time -> read back -> actual angles.

The angles read back, not the requested ones, are the pose of a capture. The two may differ by ``tolerance_deg`` at
most. A device with stepper motors and no encoders returns the steps that it has sent. Steps lost by a motor are not
included; only homing corrects them.

**Stopping.** Every error, Ctrl-C and closing stop the axes before the error is raised. The message says whether the
device confirmed it. A device that cannot be reached finishes its current move: moves are sent one at a time, each with
a target within the limits. After an error the stage must be opened again and homed.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from characterisation.files.errors import InputError
from mitsim.capture.devices.device_error import DeviceError, check_open
from mitsim.capture.devices.grbl import Grbl
from mitsim.capture.devices.ptu import PanTiltUnit
from mitsim.capture.devices.serial_line import WALL_CLOCK, Clock, SerialLine, open_line
from mitsim.capture.devices.stage_connection import StageConnection

Angles = NDArray[np.float64]

#: time between two polls of moving axes [s]; GRBL's interface.md recommends no more than 5 per second
POLL_S = 0.2

#: axes of a device that does not report motion stand if nothing has changed for this time [s]; assumed
STANDSTILL_S = 1.0

#: factor on the time of a move from its distance and speed, in addition to one reply's time-out; assumed
PATIENCE = 1.5

_STOPPED = "The stage was stopped"
_DEAF = "The stage did not confirm the stop: check that it stands before you approach it"
_BEYOND_REACH = "The stop could not be sent: the stage finishes its current move and stops there"
_AGAIN = "open the stage again and home it"


class Controller(Protocol):
    """Operations of a device through its own protocol; angles in its own degrees, axes in the connection's order.

    ``identity``: its self-description; ``resolution``: its steps [own deg]; ``travel``: its range (low, high).
    """

    identity: str
    resolution: tuple[float, ...]
    travel: tuple[tuple[float, float], ...]

    def home(self, timeout_s: float) -> None:
        """Let the device find its zero; return when it has."""

    def start(self, targets: Sequence[float]) -> float:
        """Start the axes, and return the expected duration of the move [s]."""

    def report(self) -> tuple[tuple[float, ...], bool | None]:
        """Return the positions of the axes, and whether they move; None if the device does not report motion."""

    def halt(self) -> bool:
        """Stop the axes; return whether the device has confirmed it."""

    def close(self) -> None:
        """Close the port."""


class LiveStage:
    """A connected stage; a context manager that stops the axes and closes the port.

    ``axes``: names; ``limits``: (low, high) of each [deg]; ``resolution``: its step [deg]; ``identity``: the device's
    self-description.
    """

    def __init__(self, connection: StageConnection, controller: Controller, clock: Clock = WALL_CLOCK) -> None:
        self.connection = connection
        self.identity = controller.identity
        self.axes = tuple(axis.name for axis in connection.axes)
        self.limits = tuple(axis.limits_deg for axis in connection.axes)
        steps = zip(connection.axes, controller.resolution, strict=True)
        self.resolution = tuple(step / abs(axis.gear) for axis, step in steps)
        self._controller, self._clock = controller, clock
        self._homed = connection.homing == "none"
        self._fault, self._closed, self._halted = "", False, False
        self._check_travel()

    def position(self) -> Angles:
        """Read the current angles (axes,) [deg] of the stage from the device.

        Raises DeviceError if the device does not answer, or has not been homed.
        """
        self._check_homed("position")
        with self._stopped_on_error("position"):
            return self._angles(self._controller.report()[0])

    def home(self) -> Angles:
        """Let the device find its zero, and return its angles (axes,) [deg] there.

        With ``homing = "none"`` the axes move to the zero that the device assumes. Raises DeviceError if it does not
        find its zero.
        """
        if self.connection.homing == "none":
            return self.move(np.zeros(len(self.axes)))
        with self._stopped_on_error("home"):
            self._controller.home(self.connection.home_timeout_s)
            self._homed = True
            return self._angles(self._controller.report()[0])

    def move(self, angles_deg: ArrayLike) -> Angles:
        """Move to angles (axes,) [deg], and return the angles read back once all axes stand.

        Raises InputError if an angle exceeds the limits; then nothing moves. Raises DeviceError if the stage has not
        been homed, does not arrive, or stands elsewhere; it is stopped first.
        """
        requested = self._within_limits(angles_deg)
        self._check_homed("move")
        with self._stopped_on_error("move"):
            targets = [axis.device_angle(angle) for axis, angle in zip(self.connection.axes, requested, strict=True)]
            started = self._clock.now()
            seconds = PATIENCE * self._controller.start(targets) + self.connection.reply_timeout_s
            self._await_rest(targets, started + seconds)
            self._clock.sleep(self.connection.settle_s)
            position = self._angles(self._controller.report()[0])
            self._check_arrival(requested, position)
            return position

    def stop(self) -> None:
        """Stop the axes at their current position.

        Raises DeviceError if the device does not confirm the stop.
        """
        with self._stopped_on_error("stop"):
            if not self._halt():
                raise self.connection.stage_fault("stop", "no confirmation", "axes that stand")

    def close(self) -> None:
        """Stop the axes if they are not stopped yet, and close the port; further calls do nothing."""
        if self._closed:
            return
        self._closed = True
        try:
            if not (self._fault and self._halted):
                self._controller.halt()
        except DeviceError:
            pass  # the port failed: the device cannot be reached
        finally:
            self._controller.close()

    def __enter__(self) -> LiveStage:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _angles(self, readings: Sequence[float]) -> Angles:
        return np.array([axis.angle(value) + 0.0 for axis, value in zip(self.connection.axes, readings, strict=True)])

    def _within_limits(self, angles_deg: ArrayLike) -> list[float]:
        angles = np.asarray(angles_deg, float)
        if angles.shape != (len(self.axes),):
            raise InputError("stage", "angles", f"{angles.size} of them", f"{len(self.axes)}: {', '.join(self.axes)}")
        for name, angle, (low, high) in zip(self.axes, angles, self.limits, strict=True):
            if not low - 1e-9 <= angle <= high + 1e-9:  # NaN fails too
                raise InputError("stage", name, f"{angle:g} deg", f"{low:g} to {high:g} deg", "nothing was moved")
        return [float(angle) for angle in angles]

    def _check_homed(self, operation: str) -> None:
        if not self._homed and not self._fault and not self._closed:
            hint = "Its zero is unknown after power-up and after every fault"
            raise self.connection.stage_fault(operation, "a stage that has not been homed", "home() first", hint)

    def _halt(self) -> bool:
        self._halted = self._controller.halt()
        return self._halted

    def _check_travel(self) -> None:
        """Reject a connection that exceeds the device's range, before a plan fails half-way."""
        for index, (axis, step) in enumerate(zip(self.connection.axes, self.resolution, strict=True)):
            low, high = sorted(axis.angle(reading) for reading in self._controller.travel[index])
            if axis.limits_deg[0] < low - step or axis.limits_deg[1] > high + step:
                field, found = f"axes.{index}.limits_deg", list(axis.limits_deg)
                allowed = f"between {low:.6g} and {high:.6g} deg"
                hint = f"this is the range of the device's channel {axis.channel}, converted by zero_deg and gear"
                raise InputError("stage.connection", field, found, allowed, hint)
            if (tolerance := self.connection.tolerance_deg) < step / 2:
                allowed, hint = f"at least {step / 2:.4g}", f"the steps of axis {axis.name} are {step:.4g} deg"
                raise InputError("stage.connection", "tolerance_deg", f"{tolerance:g}", allowed, hint)

    def _await_rest(self, targets: Sequence[float], deadline: float) -> None:
        """Return once all axes stand, wherever that is."""
        last: tuple[float, ...] = ()
        since = self._clock.now()
        while True:
            readings, moving = self._controller.report()
            now = self._clock.now()
            if readings != last:
                last, since = readings, now
            places = zip(readings, targets, self._controller.resolution, strict=True)
            there = all(abs(reading - target) <= step for reading, target, step in places)
            if moving is False or (moving is None and (there or now - since >= STANDSTILL_S)):
                return
            if now >= deadline:
                angles = zip(self.axes, self._angles(readings), strict=True)
                found = f"axes that still move, at {', '.join(f'{name} {angle:.3f}' for name, angle in angles)} deg"
                expected = "arrival in the time that follows from distance and speed"
                raise self.connection.stage_fault("move", found, expected, "Check for a blocked axis")
            self._clock.sleep(POLL_S)

    def _check_arrival(self, requested: Sequence[float], position: Angles) -> None:
        for name, target, angle in zip(self.axes, requested, position, strict=True):
            if not abs(angle - target) <= self.connection.tolerance_deg:
                found, hint = f"an axis that stands at {angle:.3f} deg", "Check for a blocked axis, or a manual stop"
                expected = f"{target:.3f} deg within {self.connection.tolerance_deg:g}"
                raise self.connection.stage_fault("move", found, expected, hint, name)

    @contextmanager
    def _stopped_on_error(self, operation: str) -> Iterator[None]:
        """Run a block with a working stage; on any error stop the axes before the error is raised."""
        check_open(self.connection.where, operation, self._closed, self._fault, _AGAIN.capitalize())
        try:
            yield
        except BaseException as error:  # Ctrl-C as well
            self._fault, self._halted = operation, False
            try:
                end = _STOPPED if self._halt() else _DEAF
            except DeviceError:
                end = _BEYOND_REACH
            if not isinstance(error, DeviceError):
                raise
            stop = "" if error.hint[-1:] in ("", "?") else "."
            hint = f"{error.hint}{stop} {end}. To go on, {_AGAIN}".lstrip()
            raise DeviceError(error.where, error.operation, error.found, error.expected, hint) from error


def open_stage(connection: StageConnection) -> LiveStage:
    """Open a stage. Nothing moves; axes left moving by an earlier program are stopped.

    Raises MissingEnvironmentError without pyserial. Raises DeviceError if the port cannot be opened, or the device
    there is not the one of the connection. Raises InputError if the connection exceeds what the device allows.
    """
    line = open_line(connection.port, connection.bits_per_second, connection.where)
    return start_stage(connection, line)


def start_stage(connection: StageConnection, line: SerialLine) -> LiveStage:
    """Open a stage on an open line; the line is closed on failure."""
    try:
        controller: Controller = (PanTiltUnit if connection.kind == "ptu" else Grbl)(connection, line)
        return LiveStage(connection, controller, line.clock)
    except BaseException:
        line.close()
        raise
