"""What NxLib says when something goes wrong, in plain words with what to do about it.

NxLib answers with an error code, and of a command that failed with a symbol and a text of its own. The package raises
them as ``NxLibException``, and a few exceptions of its own for cameras that are not there. Which symbol a device gives
for which fault is taken from their names and was never seen.
"""

from __future__ import annotations

from contextlib import suppress
from typing import Any, NamedTuple

from mitsim.errors import DeviceError

#: of nxlib.constants
_INEXISTENT, _TIMEOUT, _NOT_CONNECTED, _EXECUTION_FAILED = 3, 8, 9, 17


class _Words(NamedTuple):
    found: str
    expected: str
    hint: str


_GONE = _Words(
    "the camera gone",
    "a camera that stays",
    "Was a cable pulled, or its power cut? Plug it in, wait until NxView lists it, and open it again",
)
_LATE = _Words(
    "no images within its time",
    "images",
    "Is its trigger mode Software, is the network overloaded? Else raise capture_timeout_s",
)
_BROKEN = _Words(
    "images that were not transferred whole",
    "whole images",
    "Look at the cable and the network: its own adapter, jumbo frames, full bandwidth",
)
_UNLICENSED = _Words(
    "no licence for this",
    "a licence",
    "NxLib does this for genuine cameras and signed images only: ask the maker for a licence",
)
_UNKNOWN = _Words("no such camera", "a camera that NxLib lists", "")
_BUSY = _Words(
    "the camera in use, or not ready",
    "a free camera",
    "Close NxView and other programs that use it; NxView also tells what it needs (firmware, address)",
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

_CODES = {_INEXISTENT: _GONE, _TIMEOUT: _LATE, _NOT_CONNECTED: _GONE}


def no_library(where: str, error: Exception) -> DeviceError:
    """NxLib itself is not there, or is something else."""
    return DeviceError(
        where,
        "open",
        f"no NxLib that can be loaded ({error})",
        "the library of the maker's SDK",
        "Install the Ensenso SDK (ensenso.com, Support); if its library is elsewhere, set NXLIB_LIBRARY_PATH to its "
        "folder",
    )


def fault_of(error: BaseException, nxlib: Any, where: str, what: str, known: list[str]) -> BaseException:
    """The error to be raised instead of ``error``: a DeviceError where it comes from NxLib, else itself.

    ``known``: serial numbers of the cameras that NxLib lists.
    """
    if isinstance(error, nxlib.NxLibException):
        words, said = _command_words(error, what) if error.get_error_code() == _EXECUTION_FAILED else (None, "")
        words = words or _CODES.get(error.get_error_code())
        said = said or f"{error.get_error_text()} at {error.get_item_path()}"
        if words is None:
            return DeviceError(where, what, f"an error of NxLib: {said}", "none", "Does NxView take such a capture?")
        return DeviceError(where, what, f"{words.found} ({said})", words.expected, words.hint)
    match type(error).__name__:  # nxlib.context's own, which the package does not export
        case "CameraNotFoundError":
            listed = f"NxLib lists {', '.join(known) or 'none'}"
            return DeviceError(where, what, _UNKNOWN.found, _UNKNOWN.expected, f"{listed}. Is it on, is its cable in?")
        case "CameraOpenError":
            return DeviceError(where, what, _BUSY.found, _BUSY.expected, _BUSY.hint)
        case "CameraTypeError":
            expected = "a stereo camera: N, X and similar series"
            return DeviceError(where, what, f"another kind of camera ({error})", expected, "Is this the serial number?")
    if isinstance(error, nxlib.NxLibError):
        return DeviceError(where, what, f"an error of NxLib: {error}", "none")
    if isinstance(error, AttributeError) and "nxLib" in str(error):  # a function that the library does not have
        return no_library(where, error)
    return error


def _command_words(error: Any, what: str) -> tuple[_Words | None, str]:
    """Words for the symbol of a command that failed, and what NxLib itself said."""
    with suppress(Exception):  # the library may have gone as well
        symbol = str(error.get_command_error_symbol())
        words = _UNKNOWN if symbol == "CameraNotFound" and what == "open" else _SYMBOLS.get(symbol)
        return words, f"{symbol}: {error.get_command_error_text()}"
    return None, ""
