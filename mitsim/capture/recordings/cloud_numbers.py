"""Know what the numbers in a cloud's file mean: their unit of length, and the points that stand for missing ones.

Signal chain: numbers of x, y and z, and the words of the file about them -> missing points as NaN -> mm.

Programs mark a missing point by NaN, by (0, 0, 0), or by another point that no surface has, such as (-1, -1, -1): the
same numbers again and again.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from characterisation.files.errors import InputError
from mitsim.sensor.calibration_qualifiers import LENGTHS_MM, UNITS_MM

#: median distance of the points, in the file's numbers, below which the unit is metres. All sensors here measure
#: between 20 mm and 20 m
METRES_UNDER = 20.0

#: median distance above which the unit is neither metres nor millimetres, or the coordinates have an offset
NEITHER_ABOVE = 20_000.0

#: median distance [mm] under which a unit that nothing states may be cm or inches; chosen: few sensors are so near
_NEAR_MM = 100.0

#: coordinates beyond this are not measurements [mm]
FARTHEST_MM = 1e6

#: least number of times that a point repeats if it marks missing ones: noise repeats none; chosen
_LEAST_REPEATS = 10

#: least share of the points that are this one; chosen
_LEAST_SHARE = 0.005

#: most points of which a repeated one is looked for
_SAMPLE = 4000

#: most columns of a point: x, y, z, colour, normal and some values more; a row of depths has more. Chosen
_MOST_COLUMNS = 24

#: how often the most frequent point occurs at least, over the second most; points on a raster all repeat
_MORE_THAN_OTHERS = 4

#: ratio of a repeated depth to the median of the others from which it means no depth; chosen
FAR_BEYOND = 10.0

#: least distance of neighbours, in steps of rounding, from which rounding makes few equal; chosen: at 3 steps 1 in 20
_STEPS_APART = 3.0

_STATED = re.compile(r"\bunits?\b\s*(?:\bof length\b)?[\s:=,;]*[\"'(\[]?([a-zµμ]+)")


def unit_in(lines: Iterable[str]) -> str | None:
    """Return the unit of length that one of some lines states, such as ``units: mm``; None without one."""
    for line in lines:
        for word in _STATED.findall(line.lower()):
            if word in UNITS_MM:
                return unit_named(word)
    return None


def unit_named(word: str) -> str:
    """Return the name of a unit of length in :data:`~mitsim.sensor.calibration_qualifiers.LENGTHS_MM`."""
    size = UNITS_MM[word]
    return next(name for name, length in LENGTHS_MM.items() if length == size)


def leave_out_marks(points: NDArray[np.floating]) -> str:
    """Set the points (n, 3) or (H, W, 3) that stand for missing ones to NaN, in place; return a note, or nothing.

    These are (0, 0, 0), points without three finite numbers, a point that is repeated as no measured one is, and points
    with a z so repeated that is behind the sensor or far beyond all others, as of OpenCV's ``reprojectImageTo3D``.
    """
    missing = _without_place(points)
    points[missing] = np.nan
    flat = points.reshape(-1, 3)
    for columns, what in ((slice(0, 3), "all"), (slice(2, 3), "all at z =")):
        mark = _repeated(flat[:, columns], ~np.isnan(flat[:, 0]))
        if mark is None:
            continue
        marked = (flat[:, columns] == mark).all(axis=1)
        others = flat[~marked & ~np.isnan(flat[:, 0]), 2]
        if len(mark) == 1 and not _is_no_depth(float(mark[0]), others):
            continue
        flat[marked] = np.nan
        points[...] = flat.reshape(points.shape)
        shown = ", ".join(f"{coordinate:g}" for coordinate in mark)
        shown = f"({shown})" if len(mark) == 3 else shown
        return f"{int(marked.sum())} points are {what} {shown}: left out, since measured points do not repeat"
    return ""


def leave_out_copies(points: NDArray[np.floating]) -> str:
    """Set all but the first of equal points (n, 3) or (H, W, 3) to NaN, in place; return a note, or nothing.

    A file that was joined with itself has each point twice, and a copy has no noise of its own. Points may also be
    equal because their numbers are rounded to about their spacing. Such points are measured ones, which tell where more
    of them lie: they stay, but for the share that their least common repetition tells to be copies.
    """
    flat = points.reshape(-1, 3)
    seen = np.flatnonzero(np.isfinite(flat).all(axis=-1))
    values = flat[seen]
    # equal points have equal sums: most clouds have no such, and their rows are not sorted
    sums = np.sort(values[:, 0] + math.e * values[:, 1] + math.pi * values[:, 2])
    if (sums[1:] != sums[:-1]).all():
        return ""
    order = np.lexsort(values.T)  # stable: equal points keep their order
    values = values[order]
    first = np.flatnonzero(np.r_[True, (values[1:] != values[:-1]).any(axis=1)])
    if len(first) >= len(values):
        return ""
    times = np.diff(first, append=len(values))
    kept = times // np.gcd.reduce(times) if _is_rounded(values[first]) else np.ones_like(times)
    copies = order[np.arange(len(values)) - np.repeat(first, times) >= np.repeat(kept, times)]
    if not len(copies):
        return ""
    flat[seen[copies]] = np.nan
    points[...] = flat.reshape(points.shape)
    return f"{len(copies)} points are copies of others: left out, since measured points do not repeat"


def _is_rounded(values: NDArray[np.floating]) -> bool:
    """Return whether different points (n, 3) are rounded to about the distance of their nearest neighbours."""
    gaps = [np.diff(np.unique(column)) for column in values.T]
    step = min((float(gap.min()) for gap in gaps if len(gap)), default=0.0)
    sample = values[:: 1 + len(values) // _SAMPLE]
    apart = cKDTree(values).query(sample, 2)[0][:, 1]
    return float(np.median(apart)) < _STEPS_APART * step


def _repeated(values: NDArray[np.floating], seen: NDArray[np.bool_]) -> NDArray[np.floating] | None:
    """Return the row of values (n, k) that is repeated among those ``seen`` (n,) as no measured one is; else None."""
    indices = np.flatnonzero(seen)
    if len(indices) < _LEAST_REPEATS:
        return None
    chosen = indices[np.linspace(0, len(indices) - 1, min(_SAMPLE, len(indices))).astype(np.intp)]
    rows, counts = np.unique(values[chosen], axis=0, return_counts=True)
    order = np.argsort(counts)
    most, second = counts[order[-1]], counts[order[-2]] if len(counts) > 1 else counts[order[-1]]
    if most < max(_LEAST_SHARE * len(chosen), 3) or most < _MORE_THAN_OTHERS * second:
        return None
    mark = rows[order[-1]]
    return mark if (values[seen] == mark).all(axis=1).sum() >= _LEAST_REPEATS else None


def _is_no_depth(z: float, others: NDArray[np.floating]) -> bool:
    """Return whether a repeated z is none of a surface, beside the z of the ``others``: a face may lie at z = 0."""
    if not len(others):
        return False
    behind = z < 0 < float(np.percentile(others, 1))
    return behind or abs(z) > FAR_BEYOND * float(np.median(np.abs(others)))


def _without_place(points: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Return which points (..., 3) have no three finite numbers, or are (0, 0, 0)."""
    return np.asarray(~np.isfinite(points).all(axis=-1) | (points == 0).all(axis=-1))


def scale_to_mm(points: NDArray[np.floating], path: Path, unit: str | None = None, hint: str = "") -> tuple[str, float]:
    """Scale points (..., 3) of a file to mm, in place; return their unit, and their median distance in it.

    Missing ones are NaN or (0, 0, 0), and become NaN. Raises InputError if there is no point, one is beyond
    :data:`FARTHEST_MM`, or the unit is neither given nor plausible.

    Parameters
    ----------
    points, path, hint
        As in the file; for messages the file, and what to do if the points are too far away.
    unit
        One of :data:`~mitsim.sensor.calibration_qualifiers.LENGTHS_MM`; by default metres if the median distance is
        under :data:`METRES_UNDER`, else millimetres.
    """
    points[_without_place(points)] = np.nan
    seen = points[np.isfinite(points[..., 0])]
    if not len(seen):
        raise InputError(path, "", "no points", "a cloud with x, y and z")
    distance = float(np.median(np.linalg.norm(seen.astype(float), axis=-1)))
    if unit is None and distance > NEITHER_ABOVE:
        found = f"points at a median distance of {distance:.4g}, in a unit that the file does not state"
        allowed = f"up to {METRES_UNDER:g} in m, or {NEITHER_ABOVE:g} in mm, from the sensor at the origin"
        of_unit = "name the unit: --unit um; or subtract an offset of the coordinates"
        raise InputError(path, "x, y, z", found, allowed, of_unit)
    unit = unit or ("m" if distance < METRES_UNDER else "mm")
    farthest = float(np.abs(seen).max()) * LENGTHS_MM[unit]
    if farthest > FARTHEST_MM:
        raise InputError(path, "x, y, z", f"{farthest:.3g} mm", f"up to {FARTHEST_MM:g} mm", hint)
    points *= LENGTHS_MM[unit]
    return unit, distance


def near_note(distance: float, option: str) -> str:
    """Return a warning about a median distance, taken as mm, that may be cm, and its ``option``; else nothing."""
    if not METRES_UNDER <= distance < _NEAR_MM:
        return ""
    return f"a median distance of {distance:.4g} is taken as mm, as no unit is stated: if these are cm, say {option}"


#: Microsoft's C library writes 1.#QNAN, -1.#IND and 1.#INF, since 2015 -nan(ind) and nan(snan); glibc and BSD add the
#: payload, as in nan(0x123)
_NAN = re.compile(rb"(?i)[-+]?(?:nan\([a-z0-9_]*\)|1\.#(?:qnan|snan|ind|nan)[0-9]*)")

_INFINITE = re.compile(rb"(?i)([-+]?)1\.#inf[0-9]*")


def number_words(text: bytes) -> list[str]:
    """Return the words of a text of numbers, which ``float`` reads; raise a ValueError if it is not ASCII."""
    if b"#" in text or b"(" in text:
        text = _INFINITE.sub(rb"\1inf", _NAN.sub(b"nan", text))
    return text.decode("ascii").split()


def check_points_first(table: NDArray[Any], path: str | Path, hint: str) -> None:
    """Check that a table (n, columns) without names has x, y and z first, not counts or colours; ``hint`` if not.

    Numbers of a row, or of a row and a column, are whole, and three of a colour up to 255; three columns after them
    that are not, or that do not vary, are x, y and z. A table of very many columns is a map of depths.
    """
    if table.shape[1] > _MOST_COLUMNS:
        found = f"{table.shape[1]} columns without names, as of a map of depths"
        of_maps = "save depths by np.save as rows x columns, and mitsim import them with their camera: --calibration"
        raise InputError(path, "", found, f"x, y and z first, and up to {_MOST_COLUMNS} columns, or names", of_maps)
    sample = table[np.linspace(0, len(table) - 1, min(1000, len(table))).astype(np.intp)]
    sample = sample[np.isfinite(sample).all(axis=1)]
    whole = (sample % 1 == 0).all(axis=0) if len(sample) else np.ones(table.shape[1], bool)
    varies = (sample != sample[:1]).any(axis=0) if len(sample) else ~whole
    for count in (1, 2, 3):
        if table.shape[1] < count + 3:
            continue
        of_colour = ((sample[:, :3] >= 0) & (sample[:, :3] <= 255)).all()
        if count == 3 and not (of_colour and np.abs(sample[:, 3:6]).max() > 1):
            continue  # whole coordinates, or normals after them
        lengths = (~whole)[count : count + 3].sum() >= 2 and not (whole & varies)[count : count + 3].any()
        if whole[:count].all() and varies[:count].any() and lengths:
            counting = ("the first seems to count", "the first two seem to count", "the first three seem to be colours")
            found = f"{table.shape[1]} columns without names, of which {counting[count - 1]}"
            raise InputError(path, "", found, "x, y and z first, or names", hint)
