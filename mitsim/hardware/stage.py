"""A live stage, in degrees: turned to angles, read back, and stopped when anything goes wrong.

Signal chain: angles asked for [deg] -> within the limits -> the device's own degrees -> sent -> polled until the axes
stand, by a deadline that follows from distance and speed -> settled -> read back -> angles where the stage stands.

What is read back, not what was asked for, is the pose of a capture. The two may differ by ``tolerance_deg``, no more.
A device with stepper motors and no encoders reads back the steps that it has sent: steps that a motor has lost are not
in it, and only homing puts them right.

**Stopping.** Every error, and Ctrl-C, sends the axes to a stop before it goes up, and so does closing. The message
says whether the device confirmed it. A device that could not be told anything ends the one move that it was sent on:
moves are sent one at a time, each to an end within the limits. After an error the stage does nothing more; open it
again, and let it find its zero.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import TracebackType
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsim.errors import DeviceError, InputError
from mitsim.hardware.grbl import Grbl
from mitsim.hardware.ptu import PanTiltUnit
from mitsim.hardware.serial_line import WALL_CLOCK, Clock, SerialLine, open_line
from mitsim.hardware.stage_connection import StageConnection

Angles = NDArray[np.float64]

#: between two looks at moving axes [s]; GRBL's interface.md asks for no more than 5 a second
POLL_S = 0.2

#: axes of a device that does not say whether it moves stand, if nothing has changed for so long [s]; assumed
STANDSTILL_S = 1.0

#: a move may take so much longer than its distance and speed make it, and one reply's time-out; assumed
PATIENCE = 1.5

_STOPPED = "The stage was stopped"
_DEAF = "The stage was told to stop and did not confirm it: look at it before you go near"
_BEYOND_REACH = "The stage could not be told to stop: it ends the move it was sent on, and stands there"
_AGAIN = "open the stage again and home it"


class Controller(Protocol):
    """What a device is asked through its own protocol; angles in its own degrees, axes as in the connection.

    ``identity``: what it says it is; ``resolution``: its steps [own deg]; ``travel``: what it allows (low, high).
    """

    identity: str
    resolution: tuple[float, ...]
    travel: tuple[tuple[float, float], ...]

    def home(self, timeout_s: float) -> None:
        """Let the device find its zero; return when it has."""
        ...

    def start(self, targets: Sequence[float]) -> float:
        """Send the axes on their way, and return how long they should take [s]."""
        ...

    def report(self) -> tuple[tuple[float, ...], bool | None]:
        """Where the axes are, and whether they move; None from a device that does not say."""
        ...

    def halt(self) -> bool:
        """Stop the axes; return whether the device has confirmed it."""
        ...

    def close(self) -> None:
        """Give the port back."""
        ...


class LiveStage:
    """A stage that is connected; a context manager that stops the axes and closes the port.

    ``axes``: names; ``limits``: (low, high) of each [deg]; ``resolution``: its step [deg]; ``identity``: what the
    device says it is.
    """

    def __init__(self, connection: StageConnection, controller: Controller, clock: Clock = WALL_CLOCK) -> None:
        self.connection = connection
        self.identity = controller.identity
        self.axes = tuple(axis.name for axis in connection.axes)
        self.limits = tuple(axis.limits_deg for axis in connection.axes)
        self.resolution = tuple(
            step / abs(axis.gear) for axis, step in zip(connection.axes, controller.resolution, strict=True)
        )
        self._controller, self._clock = controller, clock
        self._homed = connection.homing == "none"
        self._fault, self._closed, self._halted = "", False, False
        self._check_travel()

    def position(self) -> Angles:
        """Angles (axes,) [deg] at which the stage is now, read from the device.

        Raises
        ------
        DeviceError
            If the device does not say, or has not been homed.
        """
        self._check_homed("position")
        with self._stopped_on_error("position"):
            return self._angles(self._controller.report()[0])

    def home(self) -> Angles:
        """Let the device find its zero, and return the angles (axes,) [deg] at which it stands then.

        With ``homing = "none"`` the axes turn to zero, as far as the device knows it.

        Raises
        ------
        DeviceError
            If it does not find it.
        """
        if self.connection.homing == "none":
            return self.move(np.zeros(len(self.axes)))
        with self._stopped_on_error("home"):
            self._controller.home(self.connection.home_timeout_s)
            self._homed = True
            return self._angles(self._controller.report()[0])

    def move(self, angles_deg: ArrayLike) -> Angles:
        """Turn to angles (axes,) [deg], and return those that are read back once all axes stand.

        Raises
        ------
        InputError
            If an angle is beyond the limits; nothing moves then.
        DeviceError
            If the stage has not been homed, does not arrive, or stands elsewhere; it is stopped first.
        """
        asked = self._within_limits(angles_deg)
        self._check_homed("move")
        with self._stopped_on_error("move"):
            targets = [axis.own(angle) for axis, angle in zip(self.connection.axes, asked, strict=True)]
            started = self._clock.now()
            seconds = PATIENCE * self._controller.start(targets) + self.connection.reply_timeout_s
            self._await_rest(targets, started + seconds)
            self._clock.sleep(self.connection.settle_s)
            stands = self._angles(self._controller.report()[0])
            self._check_arrival(asked, stands)
            return stands

    def stop(self) -> None:
        """Stop the axes where they are.

        Raises
        ------
        DeviceError
            If the device does not confirm that it has.
        """
        with self._stopped_on_error("stop"):
            if not self._halt():
                raise DeviceError(self.connection.where, "stop", "no confirmation", "axes that stand")

    def close(self) -> None:
        """Stop the axes, if they are not stopped yet, and give the port back; a second time does nothing."""
        if self._closed:
            return
        self._closed = True
        try:
            if not (self._fault and self._halted):
                self._controller.halt()
        except DeviceError:
            pass  # the port has gone: there is nobody to tell
        finally:
            self._controller.close()

    def __enter__(self) -> LiveStage:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _angles(self, own: Sequence[float]) -> Angles:
        return np.array([axis.angle(value) + 0.0 for axis, value in zip(self.connection.axes, own, strict=True)])

    def _within_limits(self, angles_deg: ArrayLike) -> list[float]:
        angles = np.asarray(angles_deg, float)
        if angles.shape != (len(self.axes),):
            raise InputError("stage", "angles", f"{angles.size} of them", f"{len(self.axes)}: {', '.join(self.axes)}")
        for name, angle, (low, high) in zip(self.axes, angles, self.limits, strict=True):
            if not low - 1e-9 <= angle <= high + 1e-9:  # NaN is not, either
                raise InputError("stage", name, f"{angle:g} deg", f"{low:g} to {high:g} deg", "nothing was moved")
        return [float(angle) for angle in angles]

    def _check_homed(self, what: str) -> None:
        if not self._homed and not self._fault and not self._closed:
            raise DeviceError(
                self.connection.where,
                what,
                "a stage that has not been homed",
                "home() first",
                "After power-up and after every fault its zero is not known",
            )

    def _halt(self) -> bool:
        self._halted = self._controller.halt()
        return self._halted

    def _check_travel(self) -> None:
        """Refuse a connection that the device cannot keep: a plan would fail half-way."""
        for index, (axis, step) in enumerate(zip(self.connection.axes, self.resolution, strict=True)):
            low, high = sorted(axis.angle(own) for own in self._controller.travel[index])
            if axis.limits_deg[0] < low - step or axis.limits_deg[1] > high + step:
                raise InputError(
                    "stage.connection",
                    f"axes.{index}.limits_deg",
                    list(axis.limits_deg),
                    f"between {low:.6g} and {high:.6g} deg",
                    f"the device allows channel {axis.channel} no more; zero_deg and gear decide what that is",
                )
            if self.connection.tolerance_deg < step / 2:
                raise InputError(
                    "stage.connection",
                    "tolerance_deg",
                    f"{self.connection.tolerance_deg:g}",
                    f"at least {step / 2:.4g}",
                    f"the steps of axis {axis.name} are {step:.4g} deg",
                )

    def _await_rest(self, targets: Sequence[float], deadline: float) -> None:
        """Return once all axes stand, wherever that is."""
        last: tuple[float, ...] = ()
        since = self._clock.now()
        while True:
            own, moving = self._controller.report()
            now = self._clock.now()
            if own != last:
                last, since = own, now
            there = all(
                abs(a - b) <= step for a, b, step in zip(own, targets, self._controller.resolution, strict=True)
            )
            if moving is False or (moving is None and (there or now - since >= STANDSTILL_S)):
                return
            if now >= deadline:
                at = ", ".join(f"{name} {angle:.3f}" for name, angle in zip(self.axes, self._angles(own), strict=True))
                expected = "arrival in the time that distance and speed need"
                raise DeviceError(
                    self.connection.where, "move", f"axes that still move, at {at} deg", expected, "Is an axis blocked?"
                )
            self._clock.sleep(POLL_S)

    def _check_arrival(self, asked: Sequence[float], stands: Angles) -> None:
        for name, wanted, found in zip(self.axes, asked, stands, strict=True):
            if not abs(found - wanted) <= self.connection.tolerance_deg:
                raise DeviceError(
                    f"{self.connection.where}, axis {name}",
                    "move",
                    f"an axis that stands at {found:.3f} deg",
                    f"{wanted:.3f} deg within {self.connection.tolerance_deg:g}",
                    "Is it blocked, or was it stopped by hand?",
                )

    @contextmanager
    def _stopped_on_error(self, what: str) -> Iterator[None]:
        """Run with a stage that is in order; whatever goes wrong, the axes are stopped before it goes up."""
        if self._closed or self._fault:
            found = "a stage that was closed" if self._closed else f"a stage that has failed before, at {self._fault}"
            raise DeviceError(self.connection.where, what, found, "an open stage", _AGAIN.capitalize())
        try:
            yield
        except BaseException as error:  # Ctrl-C as well
            self._fault, self._halted = what, False
            try:
                end = _STOPPED if self._halt() else _DEAF
            except DeviceError:
                end = _BEYOND_REACH
            if not isinstance(error, DeviceError):
                raise
            hint = error.hint + ("" if error.hint[-1:] in ("", "?") else ".")
            raise DeviceError(
                error.where, error.what, error.found, error.expected, f"{hint} {end}. To go on, {_AGAIN}".lstrip()
            ) from error


def open_stage(connection: StageConnection, clock: Clock = WALL_CLOCK) -> LiveStage:
    """Open a stage: nothing moves, but for axes that an earlier program left moving, which are stopped.

    Raises
    ------
    MissingEnvironmentError
        Without pyserial.
    DeviceError
        If the port cannot be opened, or what answers there is not the device that the connection describes.
    InputError
        If the connection asks for more than the device allows.
    """
    line = open_line(connection.port, connection.bits_per_second, connection.where, clock)
    return start_stage(connection, line)


def start_stage(connection: StageConnection, line: SerialLine) -> LiveStage:
    """Open a stage on a line that is open already; it is closed if that fails."""
    try:
        controller: Controller = (PanTiltUnit if connection.kind == "ptu" else Grbl)(connection, line)
        return LiveStage(connection, controller, line.clock)
    except BaseException:
        line.close()
        raise
