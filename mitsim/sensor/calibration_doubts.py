"""Warn of numbers of a calibration that can be right but seldom are: another unit, lens model or size of images."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from characterisation.files.errors import InputError
from mitsim.sensor.calibration_qualifiers import LENGTHS_MM

#: longest baseline [mm] that is plausible in a unit that the file does not state. Chosen: the 1.8 cm of a RealSense
#: D405, read in metres, are longer
_LONGEST_MM = 1500.0

#: shortest baseline [mm] that is plausible in mm if nothing tells the unit. Chosen: rigs whose eyes stand over 40 cm
#: apart seldom state them in cm; those of a RealSense D435 stand 50 mm apart
_SHORTEST_MM = 40.0

#: shortest baseline [mm] of a unit that the message proposes. Chosen: that of a RealSense D405 has 18 mm
_SHORTEST_PROPOSED_MM = 10.0

#: tangential coefficients of a lens are smaller
_LARGEST_TANGENTIAL = 0.02

#: principal points farther from the middle, in both axes, raise doubt [share of the sides]
_FAR_FROM_MIDDLE = 0.2

#: largest ratio of fx and fy that raises no doubt; pixels are square, or nearly so
_MOST_ASPECT = 1.25

#: largest angle between the axes of two eyes that raises no doubt [deg]; chosen
_MOST_TURNED_DEG = 60.0


def check_unit(where: str | Path, name: str, baseline: float, unit_mm: float | None) -> None:
    """Check that a distance between two eyes is plausible in a unit that the file itself does not state.

    Parameters
    ----------
    where, name
        The file and the second eye, for messages.
    baseline
        As the file has it.
    unit_mm
        The unit that the format implies [mm]; None if nothing tells it: then mm is assumed.

    Raises
    ------
    InputError
        If the distance is too long, or, in mm, too short.
    """
    low = _SHORTEST_MM if unit_mm is None else 0.0
    if baseline == 0 or low <= baseline * (unit_mm or 1.0) <= _LONGEST_MM:
        return
    limits = f"{low:g} to {_LONGEST_MM:g} mm" if low else f"up to {_LONGEST_MM / (unit_mm or 1.0):g}, as in its format"
    found = f"a baseline of {baseline:.4g} in a unit that the file does not state"
    sizes = {
        unit: size for unit, size in LENGTHS_MM.items() if _SHORTEST_PROPOSED_MM <= baseline * size <= _LONGEST_MM
    } or LENGTHS_MM
    units = ", ".join(f'unit: "{unit}" ({baseline * size:.4g} mm)' for unit, size in sizes.items())
    factors = ", ".join(f"{size:g}" for size in sizes.values())
    hint = f"state it beside the translation: {units}; or in [calibration] of a sensor file as to_mm: {factors}"
    raise InputError(where, f"translation of {name}", found, f"{limits}, or a stated unit", hint)


def board_unit_note(name: str, baseline_mm: float) -> str:
    """Return a warning about a distance in the unit of a board that the user gave, which the file does not state."""
    return (
        f"{name} stands {baseline_mm:.4g} mm from the first camera, if the square of MC-Calib's board was given in mm, "
        "which the file does not state; else say its unit in a sensor file: [calibration] with to_mm"
    )


def lens_note(name: str, distortion: NDArray[np.float64]) -> str:
    """Return a warning about coefficients without a model that suggest another lens or order; empty without doubt."""
    if len(distortion) < 4 or np.abs(distortion[2:4]).max() <= _LARGEST_TANGENTIAL:
        return ""
    p1, p2 = distortion[2:4]
    if len(distortion) > 4:
        return (
            f"{name} has p1 and p2 of {p1:g} and {p2:g}, larger than those of lenses: OpenCV's order is k1, k2, p1, "
            "p2, k3; is that of the file another, such as k1, k2, k3, p1, p2?"
        )
    return (
        f"{name} has four coefficients, of which p1 and p2 would be {p1:g} and {p2:g}: if they are k1 to k4 of a "
        'fisheye lens, say so in a sensor file: [calibration] with model = "fisheye"'
    )


def matrix_notes(name: str, matrix: NDArray[np.float64], size: tuple[int, int] | None) -> list[str]:
    """Return warnings about a camera matrix that suggests another order of numbers, or images of another size [px]."""
    notes = []
    centre, (fx, fy) = matrix[:2, 2], np.diag(matrix)[:2]
    if max(fx / fy, fy / fx) > _MOST_ASPECT:
        notes.append(
            f"{name}: focal lengths of {fx:g} and {fy:g} px differ by more than pixels do: are these fx and fy, and cx "
            f"and cy {centre[0]:g} and {centre[1]:g}?"
        )
    if size is not None and (np.abs(centre - (np.array(size) - 1) / 2) / size).min() > _FAR_FROM_MIDDLE:
        width, height = size
        notes.append(
            f"{name}: the principal point {centre[0]:g}, {centre[1]:g} is far from the middle of images of {width} x "
            f"{height} px: is the calibration that of images of another size, or does the point count from the middle?"
        )
    return notes


def facing_note(name: str, R: NDArray[np.float64]) -> str:
    """Return a warning about two eyes that look in very different directions; empty without doubt."""
    angle = math.degrees(math.acos(min(max(float(R[2, 2]), -1.0), 1.0)))
    if angle <= _MOST_TURNED_DEG:
        return ""
    return f"{name} looks {angle:.0f} deg away from the first camera: is its rotation in degrees, or another eye's?"
