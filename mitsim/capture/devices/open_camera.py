"""Check that a camera is open and has not failed."""

from __future__ import annotations

from mitsim.capture.devices.device_error import DeviceError


def check_open(where: str, what: str, closed: bool, fault: str) -> None:
    """Reject a camera that was closed, or that failed at ``fault`` ("" for no failure).

    Raises
    ------
    DeviceError
        Naming the rejected operation.
    """
    if closed or fault:
        found = "a camera that was closed" if not fault else f"a camera that has failed, at {fault}"
        raise DeviceError(where, what, found, "an open camera", "Open it again")
