"""What every camera on a line has in common: once closed or failed, it must be opened again."""

from __future__ import annotations

from mitsim.errors import DeviceError


def check_open(where: str, what: str, closed: bool, fault: str) -> None:
    """Refuse to go on with a camera that was closed, or has failed at ``fault`` ("" for not).

    Raises
    ------
    DeviceError
        Naming what was to be done.
    """
    if closed or fault:
        found = "a camera that was closed" if not fault else f"a camera that has failed, at {fault}"
        raise DeviceError(where, what, found, "an open camera", "Open it again")
