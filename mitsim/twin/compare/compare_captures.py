"""Compare a real capture with a simulated one of the same specimen: quantity by quantity, each with its uncertainty.

Signal chain: both captures, decoded alike -> patches of the specimen (:mod:`mitsim.twin.compare.specimen_patches`) ->
value of each quantity over all patches, for both captures -> block bootstrap: the same patches drawn with replacement
from both -> difference and its standard uncertainty -> verdict.

A patch is many correlation lengths wide. Patches are therefore independent, unlike pixels (block bootstrap; Kunsch,
Ann. Stat. 17 (1989) 1217, *recalled*). Patches are drawn in pairs, so variations over the specimen that both captures
share, such as its distance, add no uncertainty. A patch whose noise is unknown in one capture is excluded from both
medians. With k = 2,

    agrees: |simulated - real| <= max(2 u, margin)

A quantity that agrees only because 2 u is over half of it is not comparable. The quantities and their
margins are those of :mod:`mitsim.twin.compare.compared_quantities`.

The distance between the histograms is Wasserstein's of first order. Two samples of one population also have a distance.
Its 2 u is therefore the 95th percentile over random exchanges of patches between real and simulated (a permutation
test).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import numpy as np
from scipy.stats import wasserstein_distance

from characterisation.files.arrays import Floats
from characterisation.files.atomic_io import json_values
from characterisation.files.errors import InputError
from characterisation.words.numbers import two_digits
from mitsim.capture.capture import Capture
from mitsim.decoding.cloud import Geometry, Settings, capture_geometry
from mitsim.decoding.matching.stereo_geometry import StereoGeometry
from mitsim.twin.compare.compared_quantities import QUANTITIES, Quantity
from mitsim.twin.compare.plain_image import median_level, plain_image
from mitsim.twin.compare.specimen_patches import PATCH_PX, SpecimenPatches, contrast_window, specimen_patches
from mitsim.twin.finish.specimen import LARGER, Specimen

Verdict = Literal["agrees", "differs", "not comparable", "does not apply"]

#: draws of the bootstrap: a standard deviation follows to 4 %; chosen
DRAWS = 400

#: least number of patches of a comparison; chosen
LEAST_PATCHES = 6

#: coverage factor of the verdicts
COVERAGE = 2.0

#: largest ratio of 2 u to a quantity for an agreement
_TOO_UNCERTAIN = 0.5

#: largest relative difference in distance between the simulated and the real plane
_SAME_PLANE = 0.02

#: ratio to the difference below which an uncertainty is rounding, since all draws gave the same value
_ROUNDING = 1e-9

#: what to do about a capture that cannot be compared
_SIMULATE = "leave SIMULATED out: mitsim then simulates it"


@dataclass(frozen=True)
class ComparedRow:
    """A quantity of both captures, unknown numbers NaN; ``uncertainty`` (k = 1), ``margin``, ``why`` of the verdict."""

    quantity: str
    unit: str
    real: float
    simulated: float
    difference: float
    uncertainty: float
    margin: float
    verdict: Verdict
    why: str


@dataclass(frozen=True)
class Comparison:
    """All rows; numbers of the ``image_patches`` and ``cloud_patches``; ``window_px`` of the contrast."""

    rows: tuple[ComparedRow, ...]
    image_patches: int
    cloud_patches: int
    window_px: int
    real: SpecimenPatches
    simulated: SpecimenPatches

    @property
    def agrees(self) -> bool:
        """Return whether no quantity differs."""
        return all(row.verdict != "differs" for row in self.rows)

    def numbers(self) -> dict[str, Any]:
        """Return all rows for JSON; unknown numbers are null."""
        return {
            "image_patches": self.image_patches,
            "cloud_patches": self.cloud_patches,
            "window_px": self.window_px,
            "draws": DRAWS,
            "rows": [json_values(asdict(row)) for row in self.rows],
        }


HISTOGRAMS = "grey levels, distance"


def compare_captures(
    real: Capture,
    simulated: Capture,
    specimen: Specimen,
    settings: Settings,
    where: str,
    *,
    projector_on: bool = True,
    seed: int = 1,
) -> Comparison:
    """Compare a simulated capture with a real one, on the pixels of the specimen as the real one shows it.

    ``where`` names the simulated capture, ``seed`` selects the draws of the bootstrap, ``projector_on`` is the state in
    the real capture. Raises InputError if the simulated capture has another camera, its specimen is at another
    distance, or the specimen is too small.
    """
    _check(real, simulated, where)
    window = contrast_window(real, specimen)
    geometry = capture_geometry(real, settings)
    seen = [
        specimen_patches(real, settings, geometry, specimen, window),
        specimen_patches(simulated, settings, capture_geometry(simulated, settings), specimen, window),
    ]
    patches, simulated_counts = ({"image": len(side.contrast), "cloud": len(side.sigma)} for side in seen)
    if patches != simulated_counts:
        text = "{image} patches of images and {cloud} of clouds on the specimen"
        found, allowed = text.format(**simulated_counts), f"that of REAL: {text.format(**patches)}"
        raise InputError(where, "calibration", found, allowed, _SIMULATE)
    real_patches, simulated_patches = _known_in_both(*seen)
    if min(patches.values()) < LEAST_PATCHES:
        found = f"{min(patches.values())} patches of {PATCH_PX} px on it"
        raise InputError("REAL", "specimen", found, f"{LEAST_PATCHES} or more", LARGER)
    _check_distance(real_patches, simulated_patches, where)
    reasons, inapplicable = _reasons_not_comparable(simulated, projector_on), _inapplicable(real, geometry)
    rows = [_histogram_row(real_patches, simulated_patches, reasons, seed)]
    for number, quantity in enumerate(QUANTITIES):
        if quantity.name in inapplicable:
            none, why = float("nan"), inapplicable[quantity.name]
            rows.append(ComparedRow(quantity.name, quantity.unit, none, none, none, none, none, "does not apply", why))
            continue
        rng = np.random.default_rng([seed, number])
        rows += _row(quantity, real_patches, simulated_patches, patches[quantity.of], reasons, rng)
    return Comparison(tuple(rows), patches["image"], patches["cloud"], window, real_patches, simulated_patches)


def _known_in_both(
    real_patches: SpecimenPatches, simulated_patches: SpecimenPatches
) -> tuple[SpecimenPatches, SpecimenPatches]:
    """Return both without values of patches that only one capture has, so that medians are over the same patches."""
    for name in ("sigma", "sigma_px", "distance", "row_error"):
        values = getattr(real_patches, name), getattr(simulated_patches, name)
        unknown = np.where(np.isfinite(values).all(axis=0), 0.0, np.nan)
        real_patches = replace(real_patches, **{name: values[0] + unknown})
        simulated_patches = replace(simulated_patches, **{name: values[1] + unknown})
    return real_patches, simulated_patches


def _check(real: Capture, simulated: Capture, where: str) -> None:
    if simulated.source != "simulated":
        raise InputError(where, "source", simulated.source, "simulated", "give the real capture first")
    camera, real_camera = simulated.rig.reference, real.rig.reference
    if (camera.width, camera.height) != (real_camera.width, real_camera.height) or simulated.bits != real.bits:
        found = f"{camera.width} x {camera.height} pixels of {simulated.bits} bits"
        allowed = f"{real_camera.width} x {real_camera.height} of {real.bits} bits, as REAL"
        raise InputError(where, "camera", found, allowed, _SIMULATE)
    if simulated.technology != real.technology:
        raise InputError(where, "technology", simulated.technology, f"{real.technology}, as REAL")


def _check_distance(real_patches: SpecimenPatches, simulated_patches: SpecimenPatches, where: str) -> None:
    off = np.abs(simulated_patches.distance / real_patches.distance - 1)
    off = off[np.isfinite(off)]
    if len(off) and np.median(off) > _SAME_PLANE:
        found = f"a specimen {100 * float(np.median(off)):.1f} % nearer or farther than that of REAL"
        raise InputError(where, "pose", found, f"up to {100 * _SAME_PLANE:g} %", _SIMULATE)


def _reasons_not_comparable(simulated: Capture, projector_on: bool) -> dict[str, str]:
    """Return the reasons why quantities cannot be compared, by name."""
    taken: dict[str, str] = simulated.settings.get("rebuilt", {}).get("taken", {})
    if projector_on == (simulated.settings.get("projector_on") is not False):
        return taken
    names = [HISTOGRAMS, *(quantity.name for quantity in QUANTITIES if quantity.needs_pattern)]
    return dict.fromkeys(names, f"the projector was off in {'SIMULATED' if projector_on else 'REAL'}") | taken


def _inapplicable(capture: Capture, geometry: Geometry) -> dict[str, str]:
    """Return the reasons why quantities are meaningless for this kind of capture, by name."""
    inapplicable: dict[str, str] = {}
    if not isinstance(geometry, StereoGeometry):
        inapplicable = dict.fromkeys(("sigma in disparity", "vertical error"), "it needs points from a pair of cameras")
    elif capture.technology == "structured_light":
        inapplicable["vertical error"] = "stripes along the rows do not identify a row"
    plain = plain_image(capture)
    without_dots = () if plain.has_dots else ("contrast", "run length")
    return inapplicable | dict.fromkeys(without_dots, f"there are no dots in {plain.name}")


def _row(
    quantity: Quantity,
    real_patches: SpecimenPatches,
    simulated_patches: SpecimenPatches,
    patches: int,
    reasons: Mapping[str, str],
    rng: np.random.Generator,
) -> list[ComparedRow]:
    """Return the row of a quantity; none for the share of a status that occurs in neither capture."""
    every = np.arange(patches)[None]
    real, simulated = (float(quantity.figure(seen, every)[0]) for seen in (real_patches, simulated_patches))
    if quantity.name.startswith("share") and not (real > 0 or simulated > 0):
        return []
    draws = rng.integers(0, patches, (DRAWS, patches))
    drawn = quantity.figure(simulated_patches, draws) - quantity.figure(real_patches, draws)
    drawn = drawn[np.isfinite(drawn)]
    uncertainty = float(drawn.std(ddof=1)) if len(drawn) > DRAWS // 2 else float("nan")
    if uncertainty <= _ROUNDING * abs(simulated - real):
        uncertainty = 0.0
    margin = quantity.margin if np.isfinite(real) else float("nan")
    if quantity.factor > 1 and np.isfinite(real):  # symmetric: either capture may have the larger value
        margin = abs(real) * (quantity.factor - 1 if simulated >= real else 1 - 1 / quantity.factor)
    verdict, why = _verdict(simulated - real, uncertainty, margin, reasons.get(quantity.name, ""))
    if verdict == "differs" and quantity.factor > 1 and min(real, simulated) > 0:
        why = f"real is {two_digits(real / simulated)} times simulated, {why}"
    if verdict == "agrees" and quantity.factor > 1 and COVERAGE * uncertainty > _TOO_UNCERTAIN * abs(real):
        verdict, why = "not comparable", f"2 u is over {100 * _TOO_UNCERTAIN:.0f} % of it"
    return [
        ComparedRow(quantity.name, quantity.unit, real, simulated, simulated - real, uncertainty, margin, verdict, why)
    ]


def _verdict(difference: float, uncertainty: float, margin: float, reason: str) -> tuple[Verdict, str]:
    if reason:
        return "not comparable", reason
    if not np.isfinite(difference) or not np.isfinite(uncertainty):
        return "not comparable", "too few points in one of the captures"
    if abs(difference) <= COVERAGE * uncertainty:
        return "agrees", "within 2 u"
    if abs(difference) <= margin:
        return "agrees", "within the margin"
    over = abs(difference) / uncertainty if uncertainty > 0 else np.inf
    return "differs", f"by {two_digits(over)} u" if np.isfinite(over) else "by more than the margin"


def _histogram_row(
    real_patches: SpecimenPatches, simulated_patches: SpecimenPatches, reasons: Mapping[str, str], seed: int
) -> ComparedRow:
    """Return the row of Wasserstein's distance [DN] between the histograms of all pixels on the specimen."""
    counts = real_patches.levels, simulated_patches.levels
    totals = [np.asarray(levels.sum(axis=0)) for levels in counts]
    distance = _distance(*totals)
    rng = np.random.default_rng([seed, len(QUANTITIES) - 1])
    exchanged = []
    for _ in range(DRAWS):
        from_real = rng.integers(0, 2, counts[0].shape[0])
        mixed = np.asarray(from_real @ counts[0] + (1 - from_real) @ counts[1])
        exchanged.append(_distance(mixed, totals[0] + totals[1] - mixed))
    uncertainty = float(np.percentile(exchanged, 95)) / COVERAGE
    margin = 0.05 * median_level(totals[0])
    verdict, why = _verdict(distance, uncertainty, margin, reasons.get(HISTOGRAMS, ""))
    return ComparedRow(HISTOGRAMS, "DN", float("nan"), float("nan"), distance, uncertainty, margin, verdict, why)


def _distance(histogram: Floats, other_histogram: Floats) -> float:
    levels = np.arange(len(histogram))
    return float(wasserstein_distance(levels, levels, histogram, other_histogram))
