"""Faults of the machine rather than of what the user wrote: the command line ends with exit code 3 on them."""

from __future__ import annotations

from typing import Any

from characterisation.errors import InputError, MissingEnvironmentError, nearest

__all__ = ["DeviceError", "InputError", "MissingEnvironmentError", "nearest"]


class DeviceError(MissingEnvironmentError):
    """A device that is there and does not do what it should, or has gone while it was used.

    Parameters
    ----------
    where
        The device and its port, and the axis if one is meant.
    what
        What was asked of it.
    found
        What it did or said instead.
    expected
        What it should have done.
    hint
        What to do about it.
    """

    def __init__(self, where: str, what: str, found: str, expected: str, hint: str = "") -> None:
        self.where, self.what, self.found, self.expected, self.hint = where, what, found, expected, hint
        super().__init__(f"{where}: {what}: found {found}; expected: {expected}" + (f". {hint}" if hint else ""))

    def __reduce__(self) -> tuple[Any, ...]:
        """Travel between processes whole."""
        return type(self), (self.where, self.what, self.found, self.expected, self.hint)
