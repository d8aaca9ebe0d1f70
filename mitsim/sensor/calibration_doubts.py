"""Warn of numbers of a calibration that can be right but seldom are: another unit, lens model or size of images."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

#: shortest baseline [mm] that raises no doubt about the unit
_SHORTEST_MM = 5.0

#: tangential coefficients of a lens are smaller
_LARGEST_TANGENTIAL = 0.02

#: principal points farther from the middle, in both axes, raise doubt [share of the sides]
_FAR_FROM_MIDDLE = 0.2


def baseline_note(name: str, baseline_mm: float) -> str:
    """Return a warning about a distance between two eyes [mm] that suggests another unit; empty without doubt."""
    if baseline_mm >= _SHORTEST_MM or baseline_mm == 0:
        return ""
    return (
        f"{name} stands {baseline_mm:.3g} mm from the first camera: if the translation is in metres, say so in a "
        "sensor file: [calibration] with to_mm = 1000"
    )


def board_unit_note(name: str, baseline_mm: float) -> str:
    """Return a warning about a distance in the unit of a board that the user gave, which the file does not state."""
    return (
        f"{name} stands {baseline_mm:.4g} mm from the first camera, if the square of MC-Calib's board was given in mm, "
        "which the file does not state; else say its unit in a sensor file: [calibration] with to_mm"
    )


def lens_note(name: str, distortion: NDArray[np.float64]) -> str:
    """Return a warning about coefficients without a model that suggest a fisheye lens; empty without doubt."""
    if len(distortion) != 4 or np.abs(distortion[2:]).max() <= _LARGEST_TANGENTIAL:
        return ""
    p1, p2 = distortion[2:]
    return (
        f"{name} has four coefficients, of which p1 and p2 would be {p1:g} and {p2:g}: if they are k1 to k4 of a "
        'fisheye lens, say so in a sensor file: [calibration] with model = "fisheye"'
    )


def principal_note(name: str, matrix: NDArray[np.float64], size: tuple[int, int]) -> str:
    """Return a warning about a principal point far from the middle of images of a size [px]; empty without doubt."""
    centre, (width, height) = matrix[:2, 2], size
    off = np.abs(centre - (np.array(size) - 1) / 2) / size
    if off.min() <= _FAR_FROM_MIDDLE:
        return ""
    return (
        f"{name}: the principal point {centre[0]:g}, {centre[1]:g} is far from the middle of images of {width} x "
        f"{height} px: is the calibration that of images of another size, or does the point count from the middle?"
    )


def facing_note(name: str, R: NDArray[np.float64]) -> str:
    """Return a warning about two eyes that look in opposite directions; empty without doubt."""
    angle = math.degrees(math.acos(min(max(float(R[2, 2]), -1.0), 1.0)))
    if angle <= 90:
        return ""
    return f"{name} looks {angle:.0f} deg away from the first camera: is its rotation in degrees, or another eye's?"
