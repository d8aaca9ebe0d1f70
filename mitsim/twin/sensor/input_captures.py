"""Sort the captures of a fit: projector on or off, dark, and repeats of one pose.

Two captures are repeats if only the imager's noise differs between them. The mean over 5 x 5 px reduces noise to a
fifth, as measured by its finest detail; the difference of a moved dot or shadow remains.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from characterisation.files.errors import InputError
from mitsim.capture.capture import Capture
from mitsim.capture.folder import read_capture
from mitsim.sensor.fitted_to import note_images
from mitsim.sensor.sensor import Sensor
from mitsim.twin.finish.fine_detail import finest_detail

Kind = Literal["on", "off", "dark"]

#: side of the window of the mean [px]; chosen
_MEAN_PX = 5

#: factor over the noise that remains in the mean, up to which a difference is noise; chosen
_FACTOR = 3.0

#: allowance for rounding [DN]; chosen
_ROUNDING_DN = 0.1


@dataclass(frozen=True)
class InputCapture:
    """One capture: its ``folder``, and its kind: projector ``on`` or ``off``, or all light off (``dark``)."""

    folder: Path
    capture: Capture
    kind: Kind

    @property
    def name(self) -> str:
        """Return the folder as text."""
        return str(self.folder)

    @property
    def image(self) -> NDArray[Any]:
        """Return the first image (H, W) [DN] of the reference camera."""
        return np.asarray(next(iter(self.capture.images.values()))[0])


def read_input_captures(
    folders: Sequence[Path], off: Sequence[Path], dark: Sequence[Path], sensor: Sensor
) -> list[InputCapture]:
    """Read the captures of a fit; InputError if none, one twice or copied, of another technology, or no images."""
    requested: list[tuple[Path, Kind | None]] = [(folder, None) for folder in folders]
    requested += [(folder, "off") for folder in off] + [(folder, "dark") for folder in dark]
    if not requested:
        raise InputError("CAPTURES", "", "none", "one capture folder or more")
    if len({folder.resolve() for folder, _ in requested}) < len(requested):
        raise InputError("CAPTURES", "", "a folder twice", "each capture once", "the same noise twice is not a repeat")
    input_captures, digests = [], dict[str, str]()
    for folder, given_kind in requested:
        capture = read_capture(folder)
        if capture.technology != sensor.technology:
            allowed = f"{sensor.technology}, as --sensor {sensor.name}"
            raise InputError(folder, "technology", capture.technology, allowed)
        if not capture.images:
            raise InputError(folder, "images", "none", "a capture with images")
        note_images(digests, capture.images, folder)
        stated_kind: Kind = "off" if capture.settings.get("projector_on") is False else "on"
        stated_kind = "dark" if capture.settings.get("dark") is True else stated_kind
        input_captures.append(InputCapture(folder, capture, given_kind or stated_kind))
    return input_captures


def repeats(input_captures: Sequence[InputCapture]) -> list[list[InputCapture]]:
    """Group captures that repeat one another, in the given order; a group of one has no repeat."""
    groups: list[list[InputCapture]] = []
    for source in input_captures:
        group = next((group for group in groups if _repeats(group[0], source)), None)
        if group is None:
            groups.append([source])
        else:
            group.append(source)
    return groups


def _repeats(first: InputCapture, other: InputCapture) -> bool:
    """Return whether two captures differ by the noise of their first images alone."""
    told = [(one.kind, one.image.shape, one.capture.bits, one.capture.decoding.exposure_s) for one in (first, other)]
    if told[0] != told[1]:
        return False
    off = first.image.astype(float) - other.image.astype(float)
    noise = float(np.abs(finest_detail(off)).mean()) * np.sqrt(np.pi / 2)
    smooth = float(np.sqrt(np.mean(uniform_filter(off, _MEAN_PX) ** 2)))
    return bool(smooth < _FACTOR * noise / _MEAN_PX + _ROUNDING_DN)
