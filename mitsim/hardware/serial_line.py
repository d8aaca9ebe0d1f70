r"""A serial line to a device that talks in lines of text: pyserial, with every fault of the port said in plain words.

Signal chain: port (a name, or a URL such as socket://host:4000) -> bytes -> lines, each waited for until a deadline.

Whatever the device sends, a call ends: with a line, or with a :class:`~mitsim.errors.DeviceError` at its deadline.
Bytes that are no ASCII are kept as ``\xNN``. A carriage return ends a line as well as a line feed does, and lines
without text are skipped.
"""

from __future__ import annotations

import errno
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Protocol

from mitsim.errors import DeviceError, InputError, MissingEnvironmentError

#: one read of the port waits at most this long [s]: deadlines are kept to it
TICK_S = 0.02

#: a write that the port does not take within this is a fault [s]
WRITE_S = 2.0

#: no device here sends longer lines [bytes]
LONGEST_LINE = 512

#: reading what came unasked ends after this, should it not end by itself [s]
LONGEST_UNREAD_S = 0.1

#: of a reply that makes no sense, so many characters are shown
SHOWN = 60

SILENT = "Is it switched on, is the cable in, is this its port, is the baud rate right?"


class PortGoneError(DeviceError):
    """The port itself has gone while it was used: nothing can be said to the device any more."""


class Port(Protocol):
    """What is used of an open pyserial port."""

    def read(self, size: int = 1, /) -> bytes:
        """Up to ``size`` bytes, fewer when the port's own time-out has passed."""
        ...

    def write(self, data: bytes, /) -> int | None:
        """Send bytes."""
        ...

    def close(self) -> None:
        """Give the port back."""
        ...

    @property
    def in_waiting(self) -> int:
        """Bytes that can be read without waiting."""
        ...


@dataclass(frozen=True)
class Clock:
    """The time that deadlines are kept by [s], and a way to let it pass."""

    now: Callable[[], float] = time.monotonic
    sleep: Callable[[float], None] = time.sleep


WALL_CLOCK = Clock()


class SerialLine:
    """An open port, read line by line; ``where`` names it in messages."""

    def __init__(self, port: Port, where: str, clock: Clock = WALL_CLOCK) -> None:
        self.where, self.clock = where, clock
        self._port = port
        self._buffer = bytearray()

    def send(self, data: bytes) -> None:
        """Send bytes.

        Raises
        ------
        DeviceError
            If the port has gone, or takes nothing.
        """
        with self._port_there("send"):
            self._port.write(data)

    def receive(self, deadline: float, what: str, expected: str) -> str:
        """Return the next line that holds text, without its end.

        Raises
        ------
        DeviceError
            If none has come by the deadline, only a part of one has, or the port has gone; it says ``what`` was asked
            and what reply was ``expected``.
        """
        asked = self.clock.now()
        waited = f"within {max(deadline - asked, 0):.2g} s"
        while self.clock.now() < deadline:
            if line := self._cut():
                return line
            self._buffer += self._read()
            if len(self._buffer) > LONGEST_LINE and not line_ends(self._buffer):
                found = f"{len(self._buffer)} bytes without the end of a line, {shown(text_of(self._buffer))}"
                self._buffer.clear()
                raise DeviceError(self.where, what, found, expected, "Is the baud rate right?")
        if asked >= deadline:  # lines have come all the time, and none was the reply
            raise DeviceError(self.where, what, "other talk until its time was over", expected, SILENT)
        if line := self._cut():
            return line
        if rest := text_of(self._buffer).strip():
            raise DeviceError(self.where, what, f"half a line {waited}, {shown(rest)}", expected, SILENT)
        raise DeviceError(self.where, what, f"no reply {waited}", expected, SILENT)

    def unread(self) -> str:
        """Take what has come and was not read yet, without waiting for more."""
        end = self.clock.now() + LONGEST_UNREAD_S
        with self._port_there("read"):
            while self._port.in_waiting and self.clock.now() < end:
                self._buffer += self._port.read(min(self._port.in_waiting, LONGEST_LINE))
        text = text_of(self._buffer)
        self._buffer.clear()
        return text

    def drain(self, quiet_s: float, longest_s: float) -> str:
        """Read until nothing has come for ``quiet_s``, at most ``longest_s``; return the end of what came."""
        end = quiet = self.clock.now()
        end, quiet = end + longest_s, quiet + quiet_s
        while self.clock.now() < min(end, quiet):
            if data := self._read():
                self._buffer += data
                del self._buffer[:-LONGEST_LINE]
                quiet = self.clock.now() + quiet_s
        text = text_of(self._buffer)
        self._buffer.clear()
        return text

    def close(self) -> None:
        """Give the port back; one that has gone is given back as well."""
        socket = getattr(self._port, "_socket", None)
        with suppress(OSError):
            self._port.close()
        if socket is not None:  # pyserial leaves it open where the other end has closed first
            with suppress(OSError):
                socket.close()

    def _read(self) -> bytes:
        with self._port_there("read"):
            return self._port.read(max(1, min(self._port.in_waiting, LONGEST_LINE)))

    def _cut(self) -> str:
        """Take the first line that holds text off the buffer; empty if there is none."""
        while (end := line_ends(self._buffer)) > 0:
            line = text_of(self._buffer[: end - 1]).strip()
            del self._buffer[:end]
            if line:
                return line
        return ""

    @contextmanager
    def _port_there(self, what: str) -> Iterator[None]:
        try:
            yield
        except OSError as error:  # also pyserial's own SerialException
            raise PortGoneError(
                self.where,
                what,
                f"the port gone ({error})",
                "a port that stays",
                "Was a cable pulled, or the device switched off? Plug it in and open it again",
            ) from None


def open_line(port: str, baud: int, where: str, clock: Clock = WALL_CLOCK) -> SerialLine:
    """Open a port for this process alone, 8 data bits, no parity, 1 stop bit.

    ``port`` is a device (``/dev/ttyUSB0``, ``COM3``) or a URL of pyserial (``socket://host:4000``,
    ``rfc2217://host:port``), for which ``baud`` may have no meaning.

    Raises
    ------
    MissingEnvironmentError
        Without pyserial.
    DeviceError
        If there is no such port, or another program holds it, or it must not be opened by this user.
    InputError
        If that is no way to write a port.
    """
    serial = pyserial()
    try:
        opened = serial.serial_for_url(port, baud, timeout=TICK_S, write_timeout=WRITE_S, exclusive=True)
    except ValueError as error:
        allowed = "a serial port (/dev/ttyUSB0, COM3), or socket://host:port"
        raise InputError(where, "port", f"{port!r} ({error})", allowed) from None
    except Exception as error:  # OSError, or the platform's own: termios.error is none
        raise _not_opened(port, where, error) from None
    return SerialLine(opened, where, clock)


def pyserial() -> Any:
    """Import pyserial, or say how to get it."""
    try:
        return import_module("serial")
    except ImportError:
        raise MissingEnvironmentError(
            'stages need pyserial, which is not installed: pip install "mitsim[hardware]"'
        ) from None


def known_ports() -> list[str]:
    """Names of the serial ports that this machine has now."""
    return sorted(str(port.device) for port in import_module("serial.tools.list_ports").comports())


def _not_opened(port: str, where: str, error: Exception) -> DeviceError:
    """Why a port could not be opened, and what to do."""
    number, said = getattr(error, "errno", None), str(error).lower()
    if number in (errno.EACCES, errno.EPERM) or "permission" in said:
        hint = "Let your user open serial ports: sudo usermod -aG dialout $USER, then log in again"
        return DeviceError(where, "open", "permission denied", "a port that you may open", hint)
    if number in (errno.EAGAIN, errno.EBUSY) or "exclusively lock" in said or "busy" in said:
        hint = "Close the other program (a terminal, another mitsim), or look who has it: fuser -v " + port
        return DeviceError(where, "open", "the port busy: another program holds it", "a free port", hint)
    if number in (errno.ENOENT, errno.ENODEV, errno.ENXIO) or "filenotfound" in said:
        there = ", ".join(known_ports()) or "none"
        return DeviceError(where, "open", "no such port", "a port that is there", f"Ports of this machine: {there}")
    hint = "Is the device on, and nobody else connected to it?" if "://" in port else "Unplug it and plug it in again"
    return DeviceError(where, "open", f"a port that does not open ({error})", "an open port", hint)


def line_ends(data: bytes | bytearray) -> int:
    """Length of the first line with its end; 0 if it has none yet."""
    ends = [end for end in (data.find(b"\r"), data.find(b"\n")) if end >= 0]
    return min(ends) + 1 if ends else 0


def text_of(data: bytes | bytearray) -> str:
    r"""Bytes as text, those that are no printable ASCII as \xNN."""
    return "".join(chr(b) if 32 <= b < 127 or b in b"\r\n\t" else f"\\x{b:02x}" for b in data)


def shown(text: str) -> str:
    """Text as it stands in a message."""
    text = " ".join(text.split())
    return repr(text if len(text) <= SHOWN else text[:SHOWN] + "...")
