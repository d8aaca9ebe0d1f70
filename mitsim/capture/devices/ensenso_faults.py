"""Translate NxLib's errors to plain messages with advice.

NxLib returns an error code, and for a failed command also a symbol and a text. The package raises them as
``NxLibException``, and has a few exceptions of its own for missing cameras. The meaning of the symbols is inferred from
their names; none was observed on a device.
"""

from __future__ import annotations

from contextlib import suppress
from enum import IntEnum
from typing import Any, NamedTuple

from mitsim.capture.devices.device_error import DeviceError


class _Code(IntEnum):
    """Error codes of nxlib.constants."""

    INEXISTENT = 3
    TIMEOUT = 8
    NOT_CONNECTED = 9
    EXECUTION_FAILED = 17


class _Words(NamedTuple):
    found: str
    expected: str
    hint: str


_GONE = _Words(
    "the camera disconnected",
    "a connected camera",
    "Check cable and power, wait until NxView lists the camera, and open it again",
)
_LATE = _Words(
    "no images within its time",
    "images",
    "Check that the trigger mode is Software and the network is not overloaded, or raise capture_timeout_s",
)
_BROKEN = _Words(
    "incompletely transferred images",
    "complete images",
    "Check the cable and the network: its own adapter, jumbo frames, full bandwidth",
)
_UNLICENSED = _Words(
    "no licence for this",
    "a licence",
    "NxLib does this for genuine cameras and signed images only: ask the manufacturer for a licence",
)
_UNKNOWN = _Words("no such camera", "a camera that NxLib lists", "")
_BUSY = _Words(
    "the camera in use, or not ready",
    "a free camera",
    "Close NxView and other programs that use it; NxView also shows what it needs (firmware, address)",
)

_SYMBOLS = {
    "CaptureTimeout": _LATE,
    "DeviceTimeout": _LATE,
    "CameraNotFound": _GONE,
    "NoLicense": _UNLICENSED,
    "DeviceNotReady": _BUSY,
    "ImageTransferFailed": _BROKEN,
    "MissedImages": _BROKEN,
    "DiscardedImage": _BROKEN,
    "DeviceCaptureFailed": _BROKEN,
}

_CODES = {_Code.INEXISTENT: _GONE, _Code.TIMEOUT: _LATE, _Code.NOT_CONNECTED: _GONE}


def no_library(where: str, error: Exception) -> DeviceError:
    """Return the error for an NxLib that is missing or invalid."""
    return DeviceError(
        where,
        "open",
        f"no NxLib that can be loaded ({error})",
        "the library of the manufacturer's SDK",
        "Install the Ensenso SDK (ensenso.com, Support); if its library is elsewhere, set NXLIB_LIBRARY_PATH to its "
        "folder",
    )


def fault_of(error: BaseException, nxlib: Any, where: str, operation: str, serials: list[str]) -> BaseException:
    """Return the error to raise instead of an error: a DeviceError for errors of NxLib, else the error itself.

    Parameters
    ----------
    error, nxlib, serials
        Caught error, the package ``ensenso_nxlib``, and serial numbers of the cameras that NxLib lists.
    where, operation
        Name of the camera in messages, and operation that failed.
    """
    if isinstance(error, nxlib.NxLibException):
        words, detail = (
            _command_words(error, operation) if error.get_error_code() == _Code.EXECUTION_FAILED else (None, "")
        )
        words = words or _CODES.get(error.get_error_code())
        detail = detail or f"{error.get_error_text()} at {error.get_item_path()}"
        if words is None:
            return DeviceError(
                where, operation, f"an error of NxLib: {detail}", "none", "Check whether NxView can take such a capture"
            )
        return DeviceError(where, operation, f"{words.found} ({detail})", words.expected, words.hint)
    match type(error).__name__:  # nxlib.context's own, which the package does not export
        case "CameraNotFoundError":
            listed = f"NxLib lists {', '.join(serials) or 'none'}"
            return DeviceError(
                where, operation, _UNKNOWN.found, _UNKNOWN.expected, f"{listed}. Check its power and cable"
            )
        case "CameraOpenError":
            return DeviceError(where, operation, _BUSY.found, _BUSY.expected, _BUSY.hint)
        case "CameraTypeError":
            expected = "a stereo camera: N, X and similar series"
            return DeviceError(
                where, operation, f"another kind of camera ({error})", expected, "Check the serial number"
            )
    if isinstance(error, nxlib.NxLibError):
        return DeviceError(where, operation, f"an error of NxLib: {error}", "none")
    if isinstance(error, AttributeError) and "nxLib" in str(error):  # a function missing in the library
        return no_library(where, error)
    return error


def _command_words(error: Any, operation: str) -> tuple[_Words | None, str]:
    """Return the words for the symbol of a failed command, and NxLib's own text."""
    with suppress(Exception):  # the library may fail as well
        symbol = str(error.get_command_error_symbol())
        words = _UNKNOWN if symbol == "CameraNotFound" and operation == "open" else _SYMBOLS.get(symbol)
        return words, f"{symbol}: {error.get_command_error_text()}"
    return None, ""
