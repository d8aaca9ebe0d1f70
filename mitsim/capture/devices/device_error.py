"""The error of a connected device, on which the command line ends with exit code 3; and the check that it is open."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from characterisation.files.errors import MissingEnvironmentError


class DeviceError(MissingEnvironmentError):
    """A connected device that fails, or that disappears while it is used.

    ``where`` names the device, its port and, if it applies, the axis; ``operation`` is the request to it, ``found`` its
    reaction, ``expected`` the correct one, and ``hint`` what to do about it.
    """

    def __init__(self, where: str, operation: str, found: str, expected: str, hint: str = "") -> None:
        self.where, self.operation, self.found, self.expected, self.hint = where, operation, found, expected, hint
        super().__init__(f"{where}: {operation}: found {found}; expected: {expected}" + (f". {hint}" if hint else ""))

    def __reduce__(self) -> tuple[Any, ...]:
        """Support pickling between processes."""
        return type(self), (self.where, self.operation, self.found, self.expected, self.hint)


def imported_package(name: str, package: str, users: str, command: str) -> Any:
    """Import a module of a package, or raise an error with the command that installs it."""
    try:
        return import_module(name)
    except ImportError:
        raise MissingEnvironmentError(f"{users} need {package}, which is not installed: {command}") from None


def check_open(where: str, operation: str, closed: bool, fault: str, again: str = "Open it again") -> None:
    """Reject an operation of a device that was ``closed``, or failed at the operation ``fault``, "" for none."""
    if closed or fault:
        found = f"a device that has failed, at {fault}" if fault else "a device that was closed"
        raise DeviceError(where, operation, found, "an open device", again)
