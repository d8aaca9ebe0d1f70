"""Find the distortion of a lens in the maps of a calibration: a list, single numbers, or two lists.

Signal chain: maps -> coefficients under usual names -> OpenCV's order.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from characterisation.files.errors import InputError
from mitsim.sensor.calibration_names import USUAL_NAMES
from mitsim.sensor.calibration_numbers import Composed, dotted, number_of, vector
from mitsim.sensor.lens_models import check_fourth

#: names of distortions in a map, in small letters
_LENSES = frozenset(name.lower() for name in (*USUAL_NAMES["distortion"][0], "coeffs"))

#: single numbers of the distortion in OpenCV's order, and those of a fisheye lens
_BENT = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "taux", "tauy")
_FISHEYE = ("k1", "k2", "k3", "k4")

#: names of lists of these names, which state the order of a list of coefficients
_NAMES_OF_BENT = re.compile(r"(?i:(?:dist|coef).*(?:names|order|labels))")

#: names of lists of radial and of tangential coefficients; MATLAB's are written together
_RADIAL_TANGENTIAL = (
    ("radial_distortion", "radial_coefficients", "radial"),
    ("tangential_distortion", "tangential_coefficients", "tangential"),
)


def lens_in(maps: Sequence[tuple[str, dict[str, Any]]], fisheye: bool) -> Composed | None:
    """Return the distortion in the first of several maps that states one: a list, single numbers, or two lists.

    The two lists are those of radial and of tangential coefficients. ``maps`` have their dotted names.
    """
    for name, table in maps:
        low = {key.lower(): key for key in table}
        for spelling in sorted(_LENSES & set(low)):
            bent = vector(table[low[spelling]])
            if bent is not None:
                return Composed(bent, (dotted(name, low[spelling]),), table)
        plain = {key.replace("_", ""): written for key, written in low.items()}  # tau_x
        known = _FISHEYE if fisheye else _BENT
        names = [each for each in known if vector(table.get(plain.get(each, "")), 1) is not None]
        if names:
            numbers = _ordered({coefficient: number_of(table[plain[coefficient]]) for coefficient in names}, fisheye)
            return Composed(numbers, tuple(dotted(name, plain[coefficient]) for coefficient in names), table)
        radial, tangential = (next((key for key in keys if key in table), "") for keys in _RADIAL_TANGENTIAL)
        k, p = vector(table.get(radial)), vector(table.get(tangential, [0.0, 0.0]), 2)
        if k is not None and p is not None and 1 <= len(k) <= 3:
            k1, k2, k3 = [*k, 0.0, 0.0][:3]
            sources = tuple(dotted(name, source) for source in (radial, tangential) if source)
            return Composed(np.array([k1, k2, *p, k3]), sources, table)
    return None


def in_opencvs_order(value: Any, table: Mapping[str, Any], fisheye: bool, where: Path) -> Any:
    """Return coefficients in OpenCV's order if their map states another; anything else as it is.

    ``value``: the coefficients, as the file has them. ``table``: their map, which may have a list of names, such as
    ``distortion_names``. ``fisheye``: whether they are those of a fisheye lens. ``where``: the file, for messages.
    Raises InputError if a name is unknown, or there are not as many names as coefficients.
    """
    numbers = vector(value)
    if numbers is None or not numbers.size:
        return value
    for key in filter(_NAMES_OF_BENT.search, table):
        stated = table[key]
        words = stated.replace(",", " ").split() if isinstance(stated, str) else np.ravel(np.asarray(stated, object))
        if not all(isinstance(word, str) for word in words):
            continue
        names = [word.strip().lower().replace("_", "") for word in words]
        known = _FISHEYE if fisheye else _BENT
        if sorted(set(names) & set(known)) != sorted(names) or len(names) != numbers.size:
            allowed = f"the name of each of the {numbers.size} coefficients, of {', '.join(known)}"
            raise InputError(where, key, ", ".join(words), allowed)
        check_fourth(names, numbers.tolist(), fisheye, where)
        return _ordered(dict(zip(names, numbers.tolist(), strict=True)), fisheye)
    return value


def _ordered(named: Mapping[str, float], fisheye: bool) -> NDArray[np.float64]:
    """Return coefficients by name in OpenCV's order, 0 for those that are missing: four for a fisheye lens alone."""
    order, lengths = (_FISHEYE, (4,)) if fisheye else (_BENT, (5, 8, 12, 14))
    last = max(order.index(name) for name in named)
    count = next(length for length in lengths if length > last)
    return np.array([named.get(name, 0.0) for name in order[:count]])
