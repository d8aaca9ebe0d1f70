"""Faults of the machine rather than of what the user wrote: the command line ends with exit code 3 on them."""

from __future__ import annotations

from characterisation.errors import InputError, nearest

__all__ = ["InputError", "MissingEnvironmentError", "nearest"]


class MissingEnvironmentError(RuntimeError):
    """Something that must be installed, plugged in or switched on is not; the message says what to do."""
