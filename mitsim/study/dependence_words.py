"""Say in words on which drawn number the size of an error depends, and how a user finds that number out.

Signal chain: :class:`characterisation.statements.size_dependence.SizeDependence` of measurements -> one sentence for
each number, with the uncertainty at its low and its high values -> one sentence on what to do.
"""

from __future__ import annotations

from collections.abc import Iterable

from characterisation.statements.size_dependence import SizeDependence
from characterisation.words.numbers import percent, quantity

#: phrases for low and for high values of a number, by group and name
_PHRASES = {
    ("finish", "alpha"): ("a narrow lobe", "a broad lobe"),
    ("finish", "wide_angle"): ("little light at wide angles", "much light at wide angles"),
    ("finish", "reflectance"): ("less reflected light", "more reflected light"),
    ("finish", "tail"): ("a long tail of the lobe", "a short tail of the lobe"),
    ("finish", "lay"): ("strongly directed marks", "weakly directed marks"),
    ("light", "room"): ("a dim room", "a bright room"),
    ("light", "power"): ("a weak projector", "a strong projector"),
    ("decoder", "level"): ("low thresholds", "high thresholds"),
    ("decoder", "smoothing"): ("little smoothing", "much smoothing"),
    ("decoder", "census"): ("costs other than census", "census costs"),
    ("decoder", "correlation"): ("costs other than correlation", "correlation"),
    ("decoder", "support"): ("small windows", "large windows"),
    ("decoder", "p1"): ("small penalties", "large penalties"),
    ("decoder", "p2_over_p1"): ("equal penalties of small and large steps", "unequal penalties of steps"),
    ("decoder", "uniqueness"): ("a weak test of uniqueness", "a strict test of uniqueness"),
    ("decoder", "left_right"): ("a strict left-right check", "a weak left-right check"),
    ("decoder", "contrast"): ("no normalised contrast", "normalised contrast"),
    ("decoder", "cap"): ("a low cap of the prefilter", "a high cap of the prefilter"),
    ("decoder", "one_pass"): ("paths from all sides", "paths of one pass"),
    ("decoder", "three_paths"): ("more than three paths", "three paths"),
    ("decoder", "equiangular"): ("another sub-pixel fit than equiangular", "an equiangular sub-pixel fit"),
    ("decoder", "parabola"): ("another sub-pixel fit than a parabola", "a parabola as sub-pixel fit"),
    ("decoder", "opencv"): ("another sub-pixel fit than OpenCV's", "OpenCV's sub-pixel fit"),
    ("decoder", "median"): ("a small median filter", "a large median filter"),
    ("decoder", "speckle"): ("no speckle filter", "a speckle filter"),
    ("decoder", "step"): ("fine steps of the disparity", "coarse steps of the disparity"),
}

#: what a user does to know the number, by group
REMEDIES = {
    "finish": "A capture of the part narrows the finish: mitsim fit finish",
    "decoder": "If the sensor file has the settings of your decoder, say so: known = true in [unknowns.decoder]",
    "light": "Measure the illuminance: [unknowns.light]",
}


def dependences_in_words(rows: Iterable[tuple[str, str, SizeDependence | None, float | None]]) -> list[str]:
    """Return a sentence for each measurement whose error has a size that depends on a drawn number.

    ``rows`` have the name, the unit and the dependence of each measurement, and the uncertainty with which it fits its
    tolerance, None without one.
    """
    return [
        _sentence(name, unit, dependence, needed) for name, unit, dependence, needed in rows if dependence is not None
    ]


def remedies_in_words(dependences: Iterable[SizeDependence | None]) -> str:
    """Return what a user can do to know the numbers of some dependences; empty without any."""
    groups = dict.fromkeys(dependence.group for dependence in dependences if dependence is not None)
    words = ". ".join(REMEDIES[group] for group in groups if group in REMEDIES)
    return f"{words}." if words else ""


def _sentence(name: str, unit: str, dependence: SizeDependence, needed: float | None) -> str:
    phrases = _PHRASES.get((dependence.group, dependence.name), (f"low {dependence.name}", f"high {dependence.name}"))
    of = f" of {dependence.of}" if dependence.of else ""
    (low, high), (held_low, held_high) = dependence.uncertainty, dependence.inside
    # where the tolerance lies between both ends, the number decides whether the measurement fits
    between = needed is not None and min(low, high) <= needed < max(low, high)
    limit = f", and {quantity(needed, unit)} is needed" if needed is not None and between else ""
    return (
        f"{name}: u is {quantity(low, unit)} with {phrases[0]}{of}, {quantity(high, unit)} with {phrases[1]}{limit}; "
        f"{percent(held_low)} and {percent(held_high)} of these errors are inside the interval"
    )
