"""Try other waves and directions for fringes that no Gray code accompanies.

Signal chain: lines of images -> coordinate decoded with each wave, sine or cosine of either sign, and each direction
of the shifts -> share of contradictory phases, and of lines with a jump by nearly the whole projector -> the wave that
fits.

A quarter turn of all phases changes the coordinate from the longest period by a quarter of that period, and the phase
of the next one by a quarter of its own. Usually they contradict each other. If they do not, as with a ratio of five,
the longest period ends inside the projector, not at its edge: there the coordinate jumps from one end to the other.

Fringes of the opposite direction give a mirrored coordinate, which contradicts nothing. Of the descriptions that fit,
one is preferred with which the coordinate rises along the image, as camera and projector side by side see a surface.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from characterisation.files.arrays import Floats
from characterisation.files.errors import InputError
from characterisation.point_cloud import Status
from mitsim.decoding.checks.code_lines import CodeLines
from mitsim.decoding.checks.fringe_origin import CHANGES, FringeChange, described
from mitsim.sensor.image_role import Axis
from mitsim.sensor.image_sequence import FringeImages, ImageSequence
from mitsim.sensor.light_code import GrayCode, LightCode, roles

#: pixels on either side of a jump that have to be smooth
_SIDE = 3

#: least jump of a coordinate that counts, as a share of the projector's extent; chosen
_WHOLE = 0.7

#: share of the lines with a jump above which the wave is doubtful; chosen
_MANY = 0.2

#: largest share of contradictions with a wave that fits; chosen
_CONTRADICTED = 0.1

#: least improvement of this share by another wave; chosen
_BETTER = 0.3

#: division of the allowed contradiction of phases, to choose between waves that fit
_STRICTER = 3.0


def wave_in_words(lines: CodeLines, axis: Axis) -> str:
    """Return a warning if the fringes of an axis fit with another wave only, or ""."""
    code, size = lines.code, lines.size
    if isinstance(code, GrayCode) or any(role.kind == "gray" and role.axis == axis for role in lines.image_roles):
        return ""

    def tried(variant: CodeLines) -> _Trial:
        rows, columns = variant.decoded(axis)
        parts = [(rows.value, rows.status), (columns.value.T, columns.status.T)]
        return _Trial.of(parts, variant.extent(axis), along=0 if axis == "columns" else 1)

    try:
        stated = tried(lines)
        if stated.faults < _BETTER:
            return ""
        variants = {change: replace(lines, code=_with_change(code, size, axis, change)) for change in CHANGES}
        trials = {change: tried(variant) for change, variant in variants.items()}
    except InputError:
        return ""
    limit = min(_CONTRADICTED, stated.faults - _BETTER)
    fitting = [change for change, trial in trials.items() if trial.faults <= limit]
    if not fitting:
        return ""
    strict = lines.settings.model_copy(update={"consistency_sigma": lines.settings.consistency_sigma / _STRICTER})
    stricter = {change: tried(replace(variants[change], settings=strict)).faults for change in fitting}
    change = min(
        fitting, key=lambda candidate: (not trials[candidate].rises, round(stricter[candidate], 1), candidate.mistakes)
    )
    words = f"the fringes of the {axis} fit if they have {change.in_words(described(code, lines.image_roles, axis)[0])}"
    kind = (
        ""
        if isinstance(code, ImageSequence) or change == FringeChange(wave=True)
        else ', in a [pattern] of kind = "image_sequence"'
    )
    return f"{words}{kind}: their phases contradict one another, or jump from end to end of the projector"


@dataclass(frozen=True)
class _Trial:
    """Share of contradictory pixels plus that of lines with a jump, ``faults``; whether the coordinate ``rises``."""

    faults: float
    rises: bool

    @classmethod
    def of(cls, parts: list[tuple[Floats, NDArray[np.uint8]]], extent: int, along: int) -> _Trial:
        """Judge values [px] and statuses (n, W) along rows, and along columns; the code runs along ``along``."""
        lit = [np.isin(status, [Status.VALID, Status.PHASE_INCONSISTENT]) for _, status in parts]
        rejected = sum(
            int((lit_lines & (status != Status.VALID)).sum()) for lit_lines, (_, status) in zip(lit, parts, strict=True)
        )
        jumped = max(
            float(np.mean(has_jump(value, lit_lines, extent))) for lit_lines, (value, _) in zip(lit, parts, strict=True)
        )
        change = np.diff(parts[along][0], axis=1)
        share = rejected / max(sum(int(lit_lines.sum()) for lit_lines in lit), 1)
        return cls(
            share + (jumped if jumped > _MANY else 0.0),
            float(np.nanmedian(change)) > 0 if np.isfinite(change).any() else False,
        )


def has_jump(values: Floats, lit: NDArray[np.bool_], extent: int) -> NDArray[np.bool_]:
    """Return whether rows (n, W) of a coordinate [px] jump by nearly ``extent`` between smooth parts, (n,).

    Rejected pixels that are ``lit`` (n, W) are skipped; unlit pixels, as in shadows, are not.
    """
    width = values.shape[1]
    if width < 2 * (_SIDE + 1):
        return np.zeros(len(values), bool)
    source = np.where(np.isfinite(values) | ~lit, np.arange(width), 0)
    filled = np.take_along_axis(values, np.maximum.accumulate(source, axis=1), axis=1)
    before, after = filled[:, _SIDE : -_SIDE - 1], filled[:, _SIDE + 1 : -_SIDE]
    with np.errstate(invalid="ignore"):
        jump = np.abs(after - before) > _WHOLE * extent
        jump &= np.abs(before - filled[:, : -2 * _SIDE - 1]) < extent / 8
        jump &= np.abs(after - filled[:, 2 * _SIDE + 1 :]) < extent / 8
    return np.asarray(jump.any(axis=1))


def _with_change(code: LightCode, size: tuple[int, int], axis: Axis, change: FringeChange) -> ImageSequence:
    """Return the code as a sequence in which the fringes of an axis have another description."""
    every = described(code, roles(code, *size), axis)
    changed = [
        FringeImages(
            show="fringes", axis=axis, period_px=fringes.period, shifts_deg=np.degrees(change.shifts(fringes)).tolist()
        )
        for fringes in every
    ]
    if isinstance(code, ImageSequence):
        changed_groups = dict(zip(map(id, code.fringes(axis)), changed, strict=True))
        return code.model_copy(update={"images": [changed_groups.get(id(group), group) for group in code.images]})
    assert not isinstance(code, GrayCode)
    return ImageSequence(kind="image_sequence", images=list(changed), mean=code.mean, contrast=code.contrast)
