"""The error of a connected device, on which the command line ends with exit code 3; and the check that it is open."""

from __future__ import annotations

from typing import Any

from characterisation.files.errors import MissingEnvironmentError


class DeviceError(MissingEnvironmentError):
    """A connected device that fails, or that disappears while it is used.

    Parameters
    ----------
    where
        The device, its port and, if it applies, the axis.
    operation
        The request to the device.
    found
        The reaction of the device.
    expected
        The correct reaction.
    hint
        What to do about it.
    """

    def __init__(self, where: str, operation: str, found: str, expected: str, hint: str = "") -> None:
        self.where, self.operation, self.found, self.expected, self.hint = where, operation, found, expected, hint
        super().__init__(f"{where}: {operation}: found {found}; expected: {expected}" + (f". {hint}" if hint else ""))

    def __reduce__(self) -> tuple[Any, ...]:
        """Support pickling between processes."""
        return type(self), (self.where, self.operation, self.found, self.expected, self.hint)


def check_open(where: str, operation: str, closed: bool, fault: str) -> None:
    """Reject a camera that was closed, or that failed.

    Parameters
    ----------
    where
        Name of the camera in messages.
    operation
        Operation that is requested.
    closed
        Whether the camera was closed.
    fault
        Operation at which the camera failed, "" for no failure.

    Raises
    ------
    DeviceError
        Naming the rejected operation.
    """
    if closed or fault:
        found = "a camera that was closed" if not fault else f"a camera that has failed, at {fault}"
        raise DeviceError(where, operation, found, "an open camera", "Open it again")
