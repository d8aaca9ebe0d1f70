r"""Exchange lines of text with a device on a serial port: pyserial, with plain messages for every fault of the port.

Signal chain: port (a name, or a URL such as socket://host:4000) -> bytes -> lines, each awaited until a deadline.

Whatever the device sends, a call ends at its deadline: with a line, or with a
:class:`~mitsim.capture.devices.device_error.DeviceError`. Bytes that are not ASCII are kept as ``\xNN``. A carriage
return or a line feed ends a line, and empty lines are skipped.
"""

from __future__ import annotations

import errno
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib import import_module
from typing import Protocol

from characterisation.files.errors import InputError
from mitsim.capture.devices.device_error import DeviceError, imported_package

#: longest wait of one read of the port [s], which limits the precision of deadlines
TICK_S = 0.02

#: time-out of a write [s]
WRITE_S = 2.0

#: longest line of the supported devices [bytes]
LONGEST_LINE = 512

#: longest time for reading unrequested data [s]
LONGEST_UNREAD_S = 0.1

#: number of characters shown of an invalid reply
SHOWN = 60

SILENT = "Check its power, the cable, the port and the baud rate"


class PortGoneError(DeviceError):
    """The port itself failed during use, so the device cannot be reached any more."""


class Port(Protocol):
    """The part of an open pyserial port that is used."""

    def read(self, size: int = 1, /) -> bytes:
        """Read up to ``size`` bytes, fewer after the port's own time-out."""

    def write(self, data: bytes, /) -> int | None:
        """Send bytes."""

    def close(self) -> None:
        """Close the port."""

    @property
    def in_waiting(self) -> int:
        """Return the number of bytes that can be read without waiting."""


@dataclass(frozen=True)
class Clock:
    """The clock of the deadlines [s], and a function that waits."""

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
        """Send bytes."""
        with self._port_there("send"):
            self._port.write(data)

    def receive(self, deadline: float, operation: str, expected: str) -> str:
        """Return the next line with text, without its line end.

        Raises DeviceError if no line or only a part of one arrives by the deadline, or the port failed. It states the
        request ``operation`` and the ``expected`` reply.
        """
        began = self.clock.now()
        waited = f"within {max(deadline - began, 0):.2g} s"
        while self.clock.now() < deadline:
            if line := self._cut():
                return line
            self._buffer += self._read()
            if len(self._buffer) > LONGEST_LINE and not line_ends(self._buffer):
                found = f"{len(self._buffer)} bytes without the end of a line, {shown(text_of(self._buffer))}"
                self._buffer.clear()
                raise DeviceError(self.where, operation, found, expected, "Check the baud rate")
        if began >= deadline:  # lines arrived all the time, but no reply
            raise DeviceError(self.where, operation, "other lines until the time-out", expected, SILENT)
        if line := self._cut():
            return line
        if fragment := text_of(self._buffer).strip():
            raise DeviceError(self.where, operation, f"a partial line {waited}, {shown(fragment)}", expected, SILENT)
        raise DeviceError(self.where, operation, f"no reply {waited}", expected, SILENT)

    def unread(self) -> str:
        """Return the data that have arrived and were not read yet, without waiting."""
        end = self.clock.now() + LONGEST_UNREAD_S
        with self._port_there("read"):
            while self._port.in_waiting and self.clock.now() < end:
                self._buffer += self._port.read(min(self._port.in_waiting, LONGEST_LINE))
        return self._emptied()

    def drain(self, quiet_s: float, longest_s: float) -> str:
        """Read until nothing arrives for ``quiet_s``, at most ``longest_s``; return the last part of the data."""
        began = self.clock.now()
        quiet = began + quiet_s
        while self.clock.now() < min(began + longest_s, quiet):
            if data := self._read():
                self._buffer += data
                del self._buffer[:-LONGEST_LINE]
                quiet = self.clock.now() + quiet_s
        return self._emptied()

    def close(self) -> None:
        """Close the port, even after a failure."""
        socket = getattr(self._port, "_socket", None)
        with suppress(OSError):
            self._port.close()
        if socket is not None:  # pyserial leaves it open if the other end has closed first
            with suppress(OSError):
                socket.close()

    def _emptied(self) -> str:
        """Return the data in the buffer, and empty it."""
        text = text_of(self._buffer)
        self._buffer.clear()
        return text

    def _read(self) -> bytes:
        with self._port_there("read"):
            return self._port.read(max(1, min(self._port.in_waiting, LONGEST_LINE)))

    def _cut(self) -> str:
        """Remove and return the first line with text from the buffer; empty if there is none."""
        while (end := line_ends(self._buffer)) > 0:
            line = text_of(self._buffer[: end - 1]).strip()
            del self._buffer[:end]
            if line:
                return line
        return ""

    @contextmanager
    def _port_there(self, operation: str) -> Iterator[None]:
        try:
            yield
        except OSError as error:  # includes pyserial's SerialException
            hint = "Check the cable and the device's power, then open it again"
            found = f"the port disconnected ({error})"
            raise PortGoneError(self.where, operation, found, "a connected port", hint) from None


def open_line(port: str, baud: int, where: str) -> SerialLine:
    """Open a port exclusively, 8 data bits, no parity, 1 stop bit.

    ``port`` is a device (``/dev/ttyUSB0``, ``COM3``) or a URL of pyserial (``socket://host:4000``,
    ``rfc2217://host:port``), for which ``baud`` may have no effect. Raises DeviceError if the port does not open,
    InputError if its name is invalid, MissingEnvironmentError without pyserial.
    """
    serial = imported_package("serial", "pyserial", "stages", 'pip install "mitsim[hardware]"')
    try:
        opened = serial.serial_for_url(port, baud, timeout=TICK_S, write_timeout=WRITE_S, exclusive=True)
    except ValueError as error:
        allowed = "a serial port (/dev/ttyUSB0, COM3), or socket://host:port"
        raise InputError(where, "port", f"{port!r} ({error})", allowed) from None
    except Exception as error:  # OSError or an error of the platform; termios.error is not an OSError
        raise _not_opened(port, where, error) from None
    return SerialLine(opened, where)


def known_ports() -> list[str]:
    """Return the names of the serial ports of this machine."""
    return sorted(str(port.device) for port in import_module("serial.tools.list_ports").comports())


def _not_opened(port: str, where: str, error: Exception) -> DeviceError:
    """Return the reason why a port could not be opened, with advice."""
    number, message = getattr(error, "errno", None), str(error).lower()
    if number in (errno.EACCES, errno.EPERM) or "permission" in message:
        hint = "Let your user open serial ports: sudo usermod -aG dialout $USER, then log in again"
        return DeviceError(where, "open", "permission denied", "a port that you may open", hint)
    if number in (errno.EAGAIN, errno.EBUSY) or "exclusively lock" in message or "busy" in message:
        hint = "Close the other program (a terminal, another mitsim), or find it: fuser -v " + port
        return DeviceError(where, "open", "the port busy: another program uses it", "a free port", hint)
    if number in (errno.ENOENT, errno.ENODEV, errno.ENXIO) or "filenotfound" in message:
        there = ", ".join(known_ports()) or "none"
        return DeviceError(where, "open", "no such port", "an existing port", f"Ports of this machine: {there}")
    remote = "Check that the device is on and has no other connection"
    hint = remote if "://" in port else "Unplug it and plug it in again"
    return DeviceError(where, "open", f"a port that does not open ({error})", "an open port", hint)


def line_ends(data: bytes | bytearray) -> int:
    """Return the length of the first line with its end; 0 if it is incomplete."""
    ends = [end for end in (data.find(b"\r"), data.find(b"\n")) if end >= 0]
    return min(ends) + 1 if ends else 0


def text_of(data: bytes | bytearray) -> str:
    r"""Return bytes as text; all but printable ASCII as \xNN."""
    return "".join(chr(b) if 32 <= b < 127 or b in b"\r\n\t" else f"\\x{b:02x}" for b in data)


def shown(text: str) -> str:
    """Return a text as quoted in a message."""
    text = " ".join(text.split())
    return repr(text if len(text) <= SHOWN else text[:SHOWN] + "...")
