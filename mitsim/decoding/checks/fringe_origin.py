"""Compare the origin and direction of fringes with the Gray code along the same axis.

Signal chain: lines of pixels -> edges between neighbouring Gray stripes, whose projector coordinates e are multiples
of the stripe -> the phase there, which is 2 pi e / P if fringes and Gray code count from one origin -> the circular
mean of the difference, for each period -> the wave, origin and direction of the shifts that explain it.

The comparison needs no fringe order, so it also holds where a wrong origin changes the order by one. With a stripe as
wide as a fringe, phase and Gray code never contradict each other: a quarter of a period between their origins places a
quarter of the pixels one period off, and all are valid.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from characterisation.files.arrays import Floats
from mitsim.decoding.checks.code_lines import CodeLines
from mitsim.decoding.checks.fringe_edges import ENOUGH, StripeEdges
from mitsim.sensor.image_role import Axis, Origin, Role, Wave, offset_in_pixels, origin_shift
from mitsim.sensor.image_sequence import ImageSequence
from mitsim.sensor.light_code import GrayCode, LightCode

#: largest deviation of a phase at the edges [cycles]: half of the quarter turn between sine and cosine
_EIGHTH = 0.125

#: least length of the mean of unit vectors of the deviations, below which the period itself is doubtful; chosen
_CONCENTRATED = 0.6

#: an origin is half a pixel off if it is so within this margin [px]; chosen
_HALF_PIXEL_MARGIN = 0.2

#: largest standard error of such an origin [px]: it separates half a pixel from none by five standard deviations
_HALF_PIXEL_ERROR = 0.1

#: deviation from every usual origin that is reported [px], in addition to five standard errors and the effect of gamma:
#: half a pixel, which the description of the fringes may be off, and half of that
_UNUSUAL = 0.75

#: deviation of a period from the one that the Gray code measures, relative to it, that is reported, in addition to five
#: standard errors; chosen
_OTHER_PERIOD = 0.02

#: ratio of the two periods above which the phases do not follow the Gray code at all; chosen
_FOLLOWED = 5.0

#: excess of edges beyond the projector that excludes an offset, as a share of all; chosen
_BEYOND = 0.02

#: largest gamma of a projector, that of the recording kamino_phaseshift rounded up
_GAMMA = 2.6

_OTHER_WAVE: dict[Wave, Wave] = {"cosine": "sine", "sine": "cosine"}
_OTHER_ORIGIN: dict[Origin, Origin] = {"edge": "pixel", "pixel": "edge"}


@dataclass(frozen=True)
class DescribedFringes:
    """Fringes of one period as the sensor file describes them: ``period`` [px] and ``shifts`` (N,) delta [rad]."""

    period: float
    shifts: Floats
    wave: Wave
    at: Origin


@dataclass(frozen=True)
class FringeChange:
    """A change of the description of fringes: other ``wave``, ``at``, sign or order of the shifts, or 180 deg more."""

    wave: bool = False
    at: bool = False
    negated: bool = False
    reverse: bool = False
    half_turn: bool = False

    @property
    def mistakes(self) -> float:
        """Return a weighted number of mistakes that the change corrects, to choose the simplest of those that fit."""
        return self.wave + self.reverse + 1.1 * self.negated + 2.0 * self.half_turn

    def shifts(self, fringes: DescribedFringes) -> Floats:
        """Return the shifts delta (N,) [rad] after the change."""
        wave = _OTHER_WAVE[fringes.wave] if self.wave else fringes.wave
        at = _OTHER_ORIGIN[fringes.at] if self.at else fringes.at
        listed = fringes.shifts - origin_shift(fringes.wave, fringes.at, fringes.period)
        listed = (-listed if self.negated else listed)[:: -1 if self.reverse else 1]
        return np.asarray(listed + origin_shift(wave, at, fringes.period) + np.pi * self.half_turn)

    def in_words(self, fringes: DescribedFringes) -> str:
        """Return the keys to write in the sensor file, in words."""
        parts = [
            (self.reverse, "the shifts in the reverse order"),
            (
                self.negated,
                "the shifts with the opposite sign (the numbers of shifts_deg as phases_deg, or vice versa)",
            ),
            (self.wave, f'wave = "{_OTHER_WAVE[fringes.wave]}"'),
            (self.at, f'at = "{_OTHER_ORIGIN[fringes.at]}"'),
            (self.half_turn, "180 deg more in each shift"),
        ]
        return " and ".join(words for changed, words in parts if changed)


#: all changes of a description, the simplest first
CHANGES = sorted(
    (
        FringeChange(wave=wave, negated=negated, reverse=reverse, half_turn=half_turn)
        for wave, negated, reverse, half_turn in product((False, True), repeat=4)
    ),
    key=lambda change: change.mistakes,
)


def origin_in_words(edges: StripeEdges, images: CodeLines, axis: Axis) -> str:
    """Warn if fringes and Gray code of an axis do not count from one origin, or not in one direction; "" if unknown."""
    code, image_roles = images.code, images.image_roles
    every = described(code, image_roles, axis)
    if not edges.bits_fit or edges.cycles.shape[1] < ENOUGH:
        return ""
    for fringes, rate, error in zip(every, np.abs(edges.rates[0]), edges.rates[1], strict=True):
        if rate * fringes.period < 1 / _FOLLOWED:
            return (
                f"the phases of the fringes of the {axis} at {fringes.period:g} px do not follow the Gray code: check "
                "that none of their images is missing or repeated"
            )
        off = abs(rate * fringes.period - 1) - 5 * error * fringes.period
        if off > _OTHER_PERIOD:
            return (
                f"the fringes of the {axis} at {fringes.period:g} px change by one period over {1 / rate:.3g} px of "
                "the Gray code: they fit if period_px or stripe_px of [pattern] is corrected"
            )
    forward = edges.rising > 0.5
    measured = [
        PhaseDeviation.of(edges.position, fringes.period, cycles if forward else -cycles)
        for fringes, cycles in zip(every, edges.cycles, strict=True)
    ]
    if min(deviation.length for deviation in measured) < _CONCENTRATED:
        return ""
    needed = [
        (fringes.shifts if forward else -fringes.shifts) - 2 * np.pi * deviation.cycles
        for fringes, deviation in zip(every, measured, strict=True)
    ]
    change = next(
        (
            candidate
            for candidate in CHANGES
            if all(_off(candidate.shifts(f), n) < _EIGHTH for f, n in zip(every, needed, strict=True))
        ),
        None,
    )
    start = f"the fringes and the Gray code of the {axis} do not count from one origin"
    unusual = change is None or any(
        deviation.unusual(edges, f, n) for deviation, f, n in zip(measured, every, needed, strict=True)
    )
    offset, certain = "", False
    if unusual or change != FringeChange():
        offset, certain = _fitting_offset(edges, every, image_roles, axis, images.extent(axis))
    kind = "" if isinstance(code, ImageSequence) else ', in a [pattern] of kind = "image_sequence"'
    if offset and certain:
        return f"{start}: they fit if {offset}{kind}"
    either = f"; or if {offset}{kind}. The images do not tell which: decode with each, and keep the right depths"
    either = either if offset else ""
    if change is None or unusual:
        fitting = " and ".join(
            f"shifts_deg = {_degrees(shifts - origin_shift(fringes.wave, fringes.at, fringes.period))} at "
            f"{fringes.period:g} px"
            for fringes, shifts in zip(every, needed, strict=True)
        )
        return f"{start}: they fit if the fringes of the {axis} have about {fitting}{either}"
    change = replace(change, at=_half_a_pixel_off(edges, every, measured, needed))
    if change == FringeChange():
        return ""
    if change.reverse or change.negated:
        start = f"in the {axis}, the fringes move in the other direction than the Gray code"
    elif not change.wave and not change.half_turn:
        start += ", by half a pixel"
    where = f"the fringes of the {axis} have {change.in_words(every[0])}"
    if change.reverse or change.negated or change.half_turn:
        where += kind
    return f"{start}: they fit if {where}{either}"


def described(code: LightCode, image_roles: list[Role], axis: Axis) -> list[DescribedFringes]:
    """Return the fringes of an axis as the sensor file describes them, from the longest period on."""
    groups = code.fringes(axis) if isinstance(code, ImageSequence) else []
    out: list[DescribedFringes] = []
    for index in sorted({role.index for role in image_roles if role.kind == "phase" and role.axis == axis}):
        phase_roles = [role for role in image_roles if (role.kind, role.axis, role.index) == ("phase", axis, index)]
        wave: Wave = "cosine"
        at: Origin = "edge"
        if groups:
            wave, at = groups[index].wave, groups[index].at
        elif not isinstance(code, ImageSequence | GrayCode):
            wave, at = code.wave, code.at
        out.append(DescribedFringes(phase_roles[0].period, np.array([role.shift for role in phase_roles]), wave, at))
    return out


@dataclass(frozen=True)
class PhaseDeviation:
    """Phase at the edges less that of their coordinate: mean ``cycles``, ``length`` of the mean unit vector [1]."""

    cycles: float
    length: float

    @classmethod
    def of(cls, position: Floats, period: float, cycles: Floats) -> PhaseDeviation:
        """Measure the deviation of ``cycles`` (n,) at edges ``position`` (n,) [px] of fringes of ``period`` [px]."""
        mean = np.mean(np.exp(2j * np.pi * (cycles - position / period)))
        return cls(float(np.angle(mean) / (2 * np.pi)), float(np.abs(mean)))

    @property
    def quarters_removed(self) -> float:
        """Return the deviation from the nearest quarter turn [cycles]."""
        return self.cycles - round(4 * self.cycles) / 4

    def error(self, edges: StripeEdges) -> float:
        """Return the standard error of the mean [cycles]; of n angles it is sqrt(-2 ln length / n)."""
        return float(np.sqrt(-2 * np.log(self.length) / edges.position.size)) / (2 * np.pi)

    def unusual(self, edges: StripeEdges, fringes: DescribedFringes, shifts: Floats) -> bool:
        """Return whether neither another wave nor half a pixel nor the projector's gamma explains the deviation."""
        allowed = _UNUSUAL / fringes.period + 5 * self.error(edges) + gamma_error(edges, fringes.period, shifts)
        return abs(self.quarters_removed) > allowed


def _off(shifts: Floats, needed: Floats) -> float:
    """Return the largest distance of shifts (N,) [rad] from those needed, apart from whole turns [cycles]."""
    cycles = (shifts - needed) / (2 * np.pi)
    return float(np.max(np.abs(cycles - np.rint(cycles))))


def _degrees(shifts: Floats) -> list[int]:
    """Return shifts (N,) [rad] as whole degrees from 0 to 359."""
    return [int(angle) % 360 for angle in np.rint(np.degrees(shifts))]


def _fitting_offset(
    edges: StripeEdges, every: list[DescribedFringes], image_roles: list[Role], axis: Axis, extent: int
) -> tuple[str, bool]:
    """Return another usual offset of the Gray code that fits the described fringes, and whether it alone is possible.

    In words, "" if there is none. Other fringes explain the same edges if the offset is a whole number of quarters of
    their periods. Then edges beyond the projector, with either offset, exclude it.
    """
    gray = [role for role in image_roles if role.kind == "gray" and role.axis == axis]
    stripe, stated = min(role.period for role in gray), gray[0].offset
    centred = offset_in_pixels("centred", len(gray), stripe, extent)
    for value, offset in (('"centred"', centred), ("0", 0.0)):
        if offset == stated or edges.rising <= 0.5:
            continue
        position = edges.position + stated - offset
        deviations = [
            PhaseDeviation.of(position, fringes.period, cycles).cycles
            for fringes, cycles in zip(every, edges.cycles, strict=True)
        ]
        if max(map(abs, deviations)) >= _EIGHTH / 4:
            continue
        quarters = [4 * (offset - stated) / fringes.period for fringes in every]
        certain = any(abs(n - round(n)) > 0.1 for n in quarters)
        beyond, beyond_with_it = (float(np.mean((x < 0) | (x > extent))) for x in (edges.position, position))
        if certain or beyond_with_it - beyond < _BEYOND:
            words = f"the Gray code of the {axis} has offset_px = {value} in [pattern]"
            return words, certain or beyond - beyond_with_it > _BEYOND
    return "", False


def gamma_error(edges: StripeEdges, period: float, shifts: Floats) -> float:
    """Return the largest mean phase error at the edges that the gamma of a projector causes [cycles].

    (1 + cos x)^gamma has harmonics c_n with c_(n+1) / c_n = (gamma - n) / (gamma + n + 1), by the binomial series. Of N
    equal steps, harmonic N - 1 changes the phase x by c_(N-1) / c_1 sin(N x). This averages out over edges at different
    phases. Unequal steps have the error of three.
    """
    steps = len(shifts)
    turns = np.exp(1j * steps * (shifts - shifts[0]))
    if np.max(np.abs(turns - 1)) > 1e-3 or len(np.unique(np.round(np.exp(1j * shifts), 6))) < steps:
        steps, common = 3, 1.0
    else:
        common = abs(float(np.mean(np.sin(steps * (2 * np.pi * edges.position / period - shifts[0])))))
    ratio = float(np.prod([abs(_GAMMA - n) / (_GAMMA + n + 1) for n in range(1, steps - 1)]))
    return common * ratio / (2 * np.pi)


def _half_a_pixel_off(
    edges: StripeEdges, every: list[DescribedFringes], measured: list[PhaseDeviation], needed: list[Floats]
) -> bool:
    """Return whether the edges show that the fringes count from the other of edge and pixel."""
    for fringes, deviation, shifts in zip(every, measured, needed, strict=True):
        error = deviation.error(edges) + gamma_error(edges, fringes.period, shifts)
        side = -0.5 if fringes.at == "edge" else 0.5
        off = fringes.period * deviation.quarters_removed - side
        if fringes.period * error > _HALF_PIXEL_ERROR or abs(off) > _HALF_PIXEL_MARGIN:
            return False
    return True
