"""Translate NxLib's errors to plain messages with advice.

NxLib returns an error code, and for a failed command also a symbol and a text. The package raises them as
``NxLibException``, and has a few exceptions of its own for missing cameras. The meaning of the symbols is inferred from
their names; none was observed on a device.
"""

from __future__ import annotations

from contextlib import suppress
from typing import Any

from mitsim.capture.devices.device_error import DeviceError

#: what was found, what is expected, and what to do
_Words = tuple[str, str, str]

_WAIT = "Check cable and power, wait until NxView lists the camera, and open it again"
_GONE = ("the camera disconnected", "a connected camera", _WAIT)
_TRIGGER = "Check that the trigger mode is Software and the network is not overloaded, or raise capture_timeout_s"
_LATE = ("no images within its time", "images", _TRIGGER)
_NETWORK = "Check the cable and the network: its own adapter, jumbo frames, full bandwidth"
_BROKEN = ("incompletely transferred images", "complete images", _NETWORK)
_LICENCE = "NxLib does this for genuine cameras and signed images only: ask the manufacturer for a licence"
_UNKNOWN = ("no such camera", "a camera that NxLib lists", "")
_FREE = "Close NxView and other programs that use it; NxView also shows what it needs (firmware, address)"
_BUSY = ("the camera in use, or not ready", "a free camera", _FREE)

_SYMBOLS: dict[str, _Words] = {
    **dict.fromkeys(("CaptureTimeout", "DeviceTimeout"), _LATE),
    **dict.fromkeys(("ImageTransferFailed", "MissedImages", "DiscardedImage", "DeviceCaptureFailed"), _BROKEN),
    "CameraNotFound": _GONE,
    "NoLicense": ("no licence for this", "a licence", _LICENCE),
    "DeviceNotReady": _BUSY,
}

#: error codes of nxlib.constants: an item that does not exist, a time-out, and a camera that is not connected
_CODES: dict[int, _Words] = {3: _GONE, 8: _LATE, 9: _GONE}

#: error code of a failed command, which has a symbol
_EXECUTION_FAILED = 17


def no_library(where: str, error: Exception) -> DeviceError:
    """Return the error for an NxLib that is missing or invalid."""
    found, expected = f"no NxLib that can be loaded ({error})", "the library of the manufacturer's SDK"
    hint = (
        "Install the Ensenso SDK (ensenso.com, Support); if its library is elsewhere, set NXLIB_LIBRARY_PATH to its "
        "folder"
    )
    return DeviceError(where, "open", found, expected, hint)


def fault_of(error: BaseException, nxlib: Any, where: str, operation: str, serials: list[str]) -> BaseException:
    """Return the error to raise instead of an error: a DeviceError for errors of NxLib, else the error itself.

    ``serials`` are those of the cameras that NxLib lists.
    """
    if isinstance(error, nxlib.NxLibException):
        code = error.get_error_code()
        words, detail = _command_words(error, operation) if code == _EXECUTION_FAILED else (None, "")
        words = words or _CODES.get(code)
        detail = detail or f"{error.get_error_text()} at {error.get_item_path()}"
        if words is None:
            hint = "Check whether NxView can take such a capture"
            return DeviceError(where, operation, f"an error of NxLib: {detail}", "none", hint)
        return DeviceError(where, operation, f"{words[0]} ({detail})", *words[1:])
    match type(error).__name__:  # nxlib.context's own, which the package does not export
        case "CameraNotFoundError":
            listed = f"NxLib lists {', '.join(serials) or 'none'}"
            return DeviceError(where, operation, *_UNKNOWN[:2], f"{listed}. Check its power and cable")
        case "CameraOpenError":
            return DeviceError(where, operation, *_BUSY)
        case "CameraTypeError":
            found, expected = f"another kind of camera ({error})", "a stereo camera: N, X and similar series"
            return DeviceError(where, operation, found, expected, "Check the serial number")
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
