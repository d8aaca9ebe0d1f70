"""Warn of numbers of a calibration that can be right but seldom are: another unit, lens model or size of images."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from characterisation.files.errors import InputError
from mitsim.sensor.calibration_qualifiers import LENGTHS_MM
from mitsim.sensor.camera import Camera

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

#: tangential coefficients of most lenses are smaller; chosen
_USUAL_TANGENTIAL = 0.005

#: k1 of a lens with a barrel distortion that k1 of cv2.fisheye seldom has; chosen: 0.03 describe a k1 of -0.3
_STRONG_BARREL = 0.15

#: widest horizontal field of view of a perspective lens that raises no doubt [deg]; chosen
_WIDEST_DEG = 100.0

#: least distance at the image's corner between two lens models that matters [px]; chosen
_LEAST_APART_PX = 0.5

#: words that name a fisheye lens in the names of files and values
_FISHEYE_WORD = re.compile(r"fish_?eye|equidist\w*|kannala", re.IGNORECASE)

#: principal points farther from the middle, in both axes, raise doubt [share of the sides]
_FAR_FROM_MIDDLE = 0.2

#: largest ratio of fx and fy that raises no doubt; pixels are square, or nearly so
_MOST_ASPECT = 1.25

#: largest angle between the axes of two eyes that raises no doubt [deg]; chosen
_MOST_TURNED_DEG = 60.0


def check_unit(where: str | Path, name: str, baseline: float, unit_mm: float | None) -> None:
    """Check that a distance between two eyes is plausible in a unit that the file itself does not state.

    Raises InputError if the distance is too long, or, in mm, too short.

    Parameters
    ----------
    where, name
        The file and the second eye, for messages.
    baseline
        As the file has it.
    unit_mm
        The unit that the format implies [mm]; None if nothing tells it: then mm is assumed.
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


def unnamed_lens(name: str, camera: Camera, words: str, where: str | Path) -> tuple[str, str]:
    """Return the model of a lens whose model no file states, and a warning; empty without doubt.

    Four coefficients are k1, k2, p1, p2 of a perspective lens, or k1 to k4 of a fisheye lens (``cv2.fisheye``). What
    tells, in this order: ``words``, the names of the file and of its values; a tangential distortion or a field of view
    that few perspective lenses have, which is refused; a strong barrel distortion, which few fisheye lenses have in k1.

    Parameters
    ----------
    name, camera
        The camera; a size that is not known may be twice its principal point.
    words
        Names that may state the model.
    where
        The file, for messages.

    Raises
    ------
    InputError
        If the numbers contradict a perspective lens.

    See Also
    --------
    mitsim.sensor.lens_models.lens_model : the model that a file states
    """
    distortion = camera.distortion
    p1, p2 = distortion[2:4] if len(distortion) > 3 else (0.0, 0.0)
    tangential = max(abs(p1), abs(p2))
    if len(distortion) != 4:
        if tangential <= _LARGEST_TANGENTIAL:
            return "perspective", ""
        return "perspective", (
            f"{name} has p1 and p2 of {p1:g} and {p2:g}, larger than those of lenses: OpenCV's order is k1, k2, p1, "
            "p2, k3; is that of the file another, such as k1, k2, k3, p1, p2?"
        )
    corner = np.array([camera.width - 1.0, camera.height - 1.0])
    ray = np.array([*((corner - camera.matrix[:2, 2]) / np.diag(camera.matrix)[:2]), 1.0])
    seen = [replace(camera, model=model).project(ray) for model in ("perspective", "fisheye")]
    apart = float(np.linalg.norm(seen[0] - seen[1]))
    if not distortion.any() or apart < _LEAST_APART_PX:
        return "perspective", ""
    if (word := _FISHEYE_WORD.search(words)) is not None:
        return "fisheye", f"{name} is taken as a fisheye lens of k1 to k4, since {word[0]!r} is in the file's names"
    field_deg = 2 * math.degrees(math.atan(camera.width / 2 / camera.matrix[0, 0]))
    four = f"{name} has four coefficients without a lens model"
    key = 'write distortion_model: "equidistant" (k1 to k4, fisheye) or "plumb_bob" (k1, k2, p1, p2) beside them, or'
    key += ' model = "fisheye" or "perspective" in [calibration] of a sensor file'
    if tangential > _LARGEST_TANGENTIAL or field_deg > _WIDEST_DEG:
        found = f"{four}: {distortion.tolist()}, and a field of view of {field_deg:.0f} deg"
        allowed = f"p1 and p2 up to {_LARGEST_TANGENTIAL:g} and up to {_WIDEST_DEG:g} deg, or a stated model"
        raise InputError(where, f"distortion of {name}", found, allowed, key)
    if distortion[0] < -_STRONG_BARREL and tangential <= _USUAL_TANGENTIAL:
        return "perspective", ""
    by = f"moves by {apart:.0f} px" if math.isfinite(apart) else "is beyond one of the lenses"
    return "perspective", f"{four}, taken as k1, k2, p1, p2; as k1 to k4 the image's corner {by}: {key}"


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
