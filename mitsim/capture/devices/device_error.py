"""The error of a connected device; the command line ends with exit code 3 on it."""

from __future__ import annotations

from typing import Any

from characterisation.files.errors import MissingEnvironmentError


class DeviceError(MissingEnvironmentError):
    """A connected device that fails, or that disappears while it is used.

    Parameters
    ----------
    where
        The device, its port and, if it applies, the axis.
    what
        The request to the device.
    found
        The reaction of the device.
    expected
        The correct reaction.
    hint
        What to do about it.
    """

    def __init__(self, where: str, what: str, found: str, expected: str, hint: str = "") -> None:
        self.where, self.what, self.found, self.expected, self.hint = where, what, found, expected, hint
        super().__init__(f"{where}: {what}: found {found}; expected: {expected}" + (f". {hint}" if hint else ""))

    def __reduce__(self) -> tuple[Any, ...]:
        """Support pickling between processes."""
        return type(self), (self.where, self.what, self.found, self.expected, self.hint)
