"""Check whether the images of a structured-light capture match its pattern.

Signal chain: some rows and columns of the images -> white compared with black, and both with the code's images ->
projector coordinates along these rows and columns -> smoothness of their changes -> if it is low, the same with the
images in another order.

Along a surface a coordinate changes monotonically between neighbouring pixels: the absolute sum of a dozen successive
changes is nearly the sum of their absolute values. If bits are exchanged, the coordinate jumps back and forth.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from characterisation.files.arrays import Singles
from characterisation.files.errors import InputError
from characterisation.point_cloud import Status
from mitsim.decoding.checks.code_lines import CodeLines, Levels, line_slices, lines_of
from mitsim.decoding.checks.fringe_edges import stripe_edges
from mitsim.decoding.checks.fringe_origin import origin_in_words
from mitsim.decoding.checks.fringe_steps import copies_in_words, steps_in_words
from mitsim.decoding.checks.fringe_wave import wave_in_words
from mitsim.decoding.checks.gray_origin import beyond_in_words
from mitsim.decoding.coded_images import CodedImages
from mitsim.decoding.structured_light.projector_coordinate import ProjectorCoordinate
from mitsim.sensor.decoder_settings import DecoderSettings
from mitsim.sensor.image_role import Axis, Kind, Role

#: number of successive changes of a coordinate in one sum
_CHANGES = 12

#: Evenness (ratio of sums, median) below which coordinates are not smooth; less its share of contradictions, that of
#: another order of the images must exceed it. It is 0.99 and more for the recordings kamino_procam, kamino_phaseshift
#: and binocular_gray, and 0.16 to 0.52 with their images in a wrong order.
SMOOTH = 0.5

#: Evenness below which other orders are tried. Bits exchanged with their complements leave a coordinate that rises and
#: falls over long stretches, with an evenness of 0.2 to 0.6.
_ASKED = 0.85

#: improvement of the evenness that another order must bring to be reported; chosen
_BETTER = 0.25

#: share of the lit pixels with contradictory bits or phases above which the order is doubtful
CONTRADICTED = 0.5

#: least excess of an image over white, or below black, relative to the step from black to white; chosen
_BEYOND = 0.2

#: share of the lit pixels with this excess above which it is reported; chosen
_MANY = 0.1

#: share of the lit pixels with white darker than black above which the two are exchanged
_EXCHANGED = 0.85

#: allowed relative variation between bits of the sum of a bit and its complement, which is white plus black
_STEADY = 0.25

#: file names often sort off before on
_BEFORE = 'write inverse = "before" instead of "each"'

#: gammas of projector and camera together that are tried; 2.2 is that of sRGB and of most projectors
_GAMMAS = (0.5, 0.7, 1.4, 1.8, 2.2, 2.6)

#: full scale of the levels without a gamma [DN]: fine enough for dark ones
_FINE = 65535

#: changes smaller than this [projector px] are ignored
_STILL = 1e-3


@dataclass(frozen=True)
class Smoothness:
    """Smoothness of a coordinate: ``evenness`` [1], NaN if too little is lit; ``contradicted`` share [1]."""

    evenness: float
    contradicted: float

    @property
    def doubtful(self) -> bool:
        """Return whether it is implausible as the coordinate of a surface."""
        return self.evenness < SMOOTH or self.contradicted > CONTRADICTED


def image_warnings(images: CodedImages, camera: str, decoded: Mapping[Axis, ProjectorCoordinate]) -> list[str]:
    """Return warnings about the images of one camera; ``decoded``: their coordinates (H, W)."""
    stack = images.stacks[camera]
    lines = CodeLines(lines_of(stack), images.code, images.size, images.settings, images.full_scale)
    rows, image_roles, settings = lines.lines[0], lines.image_roles, images.settings
    out = _plain_images(rows, image_roles, settings, images.full_scale, camera)
    if out:
        return out
    shape = stack.shape[1:]
    by_axis = _smoothness(
        [{axis: coordinate.part(way) for axis, coordinate in decoded.items()} for way in line_slices(shape)]
    )
    for axis, smoothness in by_axis.items():
        warning = copies_in_words(lines, axis) or _unresolved(rows, image_roles, axis, settings, camera)
        order = ""
        edges = None if warning else stripe_edges(lines, axis)
        if edges is not None:
            warning = origin_in_words(edges, lines, axis)
        elif not warning:
            warning = wave_in_words(lines, axis) or beyond_in_words(lines, axis)
        warning = warning or steps_in_words(lines, axis)
        if warning and camera not in warning:
            warning = f"{camera}: {warning}"
        if not warning and (smoothness.doubtful or smoothness.evenness < _ASKED):
            least = SMOOTH if smoothness.doubtful else smoothness.evenness - smoothness.contradicted + _BETTER
            orders: Iterable[tuple[str, list[int]]] = _other_orders(image_roles, axis)
            if edges is not None and edges.bits_fit:
                orders = _with_bits_in_place(orders, image_roles, axis)
            order = _fitting_order(lines, axis, orders, least)
        if order:
            warning = f"{_doubt(smoothness, axis, camera)}: they fit if {order}"
        warning = warning or _changed_exposure(rows, image_roles, axis, camera)
        if not warning and smoothness.doubtful:
            advice = "check that the images are in the order of [pattern]"
            if any(role.kind == "phase" and role.axis == axis for role in image_roles):
                advice = _fitting_gamma(lines, axis) or f"{advice}, and that projector and camera have gamma 1"
            warning = f"{_doubt(smoothness, axis, camera)}: {advice}"
        out += [warning] if warning else []
    return out


def _doubt(smoothness: Smoothness, axis: Axis, camera: str) -> str:
    """Describe the doubt about a coordinate."""
    if smoothness.evenness < SMOOTH or smoothness.contradicted <= CONTRADICTED:
        return f"the {axis} that {camera} decodes do not vary smoothly"
    return f"bits or phases of the {axis} contradict one another on {100 * smoothness.contradicted:.0f} % of {camera}"


def _fitting_order(lines: CodeLines, axis: Axis, orders: Iterable[tuple[str, list[int]]], least: float) -> str:
    """Return the description of an order of the images with more smoothness than ``least``; "" if none."""
    best, description = least, ""
    for name, order in orders:
        rows, columns = (array[order] for array in lines.lines)
        try:
            decoded = replace(lines, lines=(rows, columns)).decoded(axis)
        except InputError:
            continue
        # an order may be smooth although most pixels are contradictory, or its pairs are not complements
        if _changed_exposure(rows, lines.image_roles, axis, ""):
            continue
        smoothness = _smoothness([{axis: coordinate} for coordinate in decoded])[axis]
        if not smoothness.doubtful and smoothness.evenness - smoothness.contradicted > best:
            best, description = smoothness.evenness - smoothness.contradicted, name
    return description


def _fitting_gamma(lines: CodeLines, axis: Axis) -> str:
    """Return what to do about a gamma without which the coordinates are smooth; "" if none is found."""
    best, found = 0.0, 1.0
    for gamma in _GAMMAS:
        rows, columns = (
            np.rint(_FINE * (part / lines.full_scale) ** (1 / gamma)).astype(np.uint16) for part in lines.lines
        )
        decoded = replace(lines, lines=(rows, columns), full_scale=_FINE).decoded(axis)
        smoothness = _smoothness([{axis: coordinate} for coordinate in decoded])[axis]
        if not smoothness.doubtful and smoothness.evenness - smoothness.contradicted > best:
            best, found = smoothness.evenness - smoothness.contradicted, gamma
    if not best:
        return ""
    side = "over" if found > 1 else "under"
    return (
        f"they fit in this order if projector and camera have a gamma {side} 1. Set both to 1, or use five steps or "
        "more, or white and black images, with correct_gamma = true in [decoder]"
    )


def _smoothness(lines: Sequence[Mapping[Axis, ProjectorCoordinate]]) -> dict[Axis, Smoothness]:
    """Return the smoothness of coordinates along decoded rows (n, W), and along decoded columns (H, m)."""
    evenness: dict[Axis, list[float]] = {}
    statuses: dict[Axis, list[NDArray[np.uint8]]] = {}
    lit_pixels: dict[Axis, list[NDArray[np.bool_]]] = {}
    for way, coordinates in enumerate(lines):
        for axis, coordinate in coordinates.items():
            values = coordinate.value if way == 0 else coordinate.value.T
            evenness.setdefault(axis, []).append(_evenness(values))
            statuses.setdefault(axis, []).append(coordinate.status.ravel())
            lit_pixels.setdefault(axis, []).append(coordinate.lit.ravel())
    out: dict[Axis, Smoothness] = {}
    for axis, measured in evenness.items():
        status, lit = np.concatenate(statuses[axis]), np.concatenate(lit_pixels[axis])
        share = float(np.mean(status[lit] == Status.PHASE_INCONSISTENT)) if lit.mean() > 0.02 else 0.0
        finite = [value for value in measured if np.isfinite(value)]
        out[axis] = Smoothness(max(finite, default=float("nan")), share)
    return out


def _evenness(values: NDArray[np.float64]) -> float:
    """Return the median, over dozens of changes along the rows (n, W), of |sum| over the sum of absolute values."""
    shares = []
    for row in values:
        change = np.diff(row[np.isfinite(row)])  # gaps are skipped: a surface continues behind them
        changes = change[np.abs(change) > _STILL]
        groups = changes[: len(changes) // _CHANGES * _CHANGES].reshape(-1, _CHANGES)
        shares.append(np.abs(groups.sum(axis=1)) / np.abs(groups).sum(axis=1))
    all_shares = np.concatenate(shares) if shares else np.empty(0)
    return float(np.median(all_shares)) if len(all_shares) >= 10 else float("nan")


def _plain_images(
    stack: Levels, image_roles: list[Role], settings: DecoderSettings, full_scale: float, camera: str
) -> list[str]:
    """Return warnings about white and black images that are exchanged or wrong."""
    kinds = [role.kind for role in image_roles]
    coded = stack[[role.axis is not None for role in image_roles]].astype(np.float32)
    most, least = coded.max(axis=0), coded.min(axis=0)
    lit = most - least > 4 * settings.minimum_modulation_dn * full_scale / 255
    if lit.mean() < 0.02:
        return []
    room = _BEYOND * (most - least)
    out = []
    if {"white", "black"} <= set(kinds):
        white, black = (stack[kinds.index(kind)].astype(np.float32) for kind in ("white", "black"))
        differ = lit & (np.abs(white - black) > room)
        if differ.sum() > 0.5 * lit.sum() and (white < black)[differ].mean() > _EXCHANGED:
            share = 100 * float((white < black)[differ].mean())
            return [
                f"the white image of {camera} is darker than the black one on {share:.0f} % of the lit pixels: "
                "check whether the two are exchanged in [pattern]"
            ]
    for kind, beyond, limit in (
        ("white", "darker than the brightest", most),
        ("black", "brighter than the darkest", least),
    ):
        if kind not in kinds:
            continue
        image = stack[kinds.index(kind)].astype(np.float32)
        off = limit - image if kind == "white" else image - limit
        share = float((off > room)[lit].mean())
        if share > _MANY:
            out.append(
                f"the {kind} image of {camera} is {beyond} image of the code on {100 * share:.0f} % of the lit "
                f"pixels: it is not {kind}. Check that the images are in the order of [pattern]"
            )
    return out


def _pairs(stack: Levels, image_roles: list[Role], axis: Axis) -> list[tuple[int, Singles, Singles]]:
    """Return number, image and complement of every bit of an axis that has a complement, most significant first."""
    where = {
        (role.kind, role.index): image for role, image in zip(image_roles, stack, strict=True) if role.axis == axis
    }
    bits = sorted(index for kind, index in where if kind == "gray_inverse")
    return [(bit, where["gray", bit].astype(np.float32), where["gray_inverse", bit].astype(np.float32)) for bit in bits]


def _changed_exposure(stack: Levels, image_roles: list[Role], axis: Axis, camera: str) -> str:
    """Return a warning about bits with different exposures, or ""."""
    sums = [float(np.median(image + other)) for _, image, other in _pairs(stack, image_roles, axis)]
    if len(sums) < 2 or max(sums) - min(sums) <= _STEADY * float(np.median(sums)):
        return ""
    return (
        f"the {axis} images of {camera} are not equally bright: a bit and its complement together have "
        f"{min(sums):.0f} to {max(sums):.0f} DN. Check whether the exposure was automatic"
    )


def _unresolved(stack: Levels, image_roles: list[Role], axis: Axis, settings: DecoderSettings, camera: str) -> str:
    """Return a warning about fine bits whose stripes the camera does not resolve, or ""."""
    pairs = _pairs(stack, image_roles, axis)
    if len(pairs) < 2:
        return ""
    contrast = np.max([np.abs(image - other) for _, image, other in pairs], axis=0)
    lit = contrast > np.percentile(contrast, 90) / 3
    lost = [float(np.mean((np.abs(image - other) < settings.bit_share * contrast)[lit])) for _, image, other in pairs]
    count = next((n for n, share in enumerate(lost[::-1]) if share < CONTRADICTED), len(lost))
    if count == 0:
        return ""
    period = {role.index: role.period for role in image_roles if role.axis == axis and role.kind == "gray"}
    which = "the finest bit" if count == 1 else f"the {count} finest bits"
    return (
        f"{camera} does not resolve {which} of the {axis}, stripes up to {period[pairs[-count][0]]:g} px: leave "
        "them out by bits in [pattern], and list those images as unused"
    )


def _with_bits_in_place(
    orders: Iterable[tuple[str, list[int]]], image_roles: list[Role], axis: Axis
) -> list[tuple[str, list[int]]]:
    """Return the orders with the Gray bits of an axis in place: others only make fringes agree with wrong stripes."""
    bits = [i for i, role in enumerate(image_roles) if role.axis == axis and role.kind in ("gray", "gray_inverse")]
    return [(name, order) for name, order in orders if all(order[i] == i for i in bits)]


def _other_orders(image_roles: list[Role], axis: Axis) -> Iterator[tuple[str, list[int]]]:
    """Yield common alternative orders of the images with their descriptions; an order lists the image at each place."""
    plain = list(range(len(image_roles)))
    indices = {(role.kind, role.index): index for index, role in enumerate(image_roles) if role.axis == axis}
    bits = [index for kind, index in indices if kind == "gray"]
    inverse = ("gray_inverse", 0) in indices

    def moved(places: Iterable[int], sources: Iterable[int]) -> list[int]:
        order = list(plain)
        for at, source in zip(places, sources, strict=True):
            order[at] = source
        return order

    def exchanged(reverse: bool, complement: bool) -> list[int]:
        sources = {}
        for (kind, index), at in indices.items():
            if kind != "phase":
                other: Kind = ("gray_inverse" if kind == "gray" else "gray") if complement else kind
                sources[at] = indices[other, len(bits) - 1 - index if reverse else index]
        return moved(sources, sources.values())

    if bits:
        yield (
            "the bits are in the reverse order: change the key first of [pattern]",
            exchanged(True, False),
        )
    if inverse:
        yield f"every bit is exchanged with its complement: {_BEFORE}", exchanged(False, True)
        yield (
            f"the bits are in the reverse order, and every bit is exchanged with its complement: {_BEFORE}",
            exchanged(True, True),
        )
        grays = sorted(at for (kind, _), at in indices.items() if kind != "phase")
        half = len(grays) // 2
        interleaved = [at for pair in zip(grays[:half], grays[half:], strict=True) for at in pair]
        for sources in (interleaved, grays[::2] + grays[1::2]):
            yield 'the complements are in another order: change inverse between "each" and "all"', moved(grays, sources)
    phases: dict[int, list[int]] = {}
    for at, role in enumerate(image_roles):
        if role.kind == "phase" and role.axis == axis:
            phases.setdefault(role.index, []).append(at)
    if phases:
        places = [at for same in phases.values() for at in same]
        turned = moved(places, [at for same in phases.values() for at in same[::-1]])
        yield "the fringes move in the other direction: reverse the shifts", turned
    yield "the first image is not listed in [pattern]", [*plain[1:], plain[0]]
    yield "the first image of [pattern] is missing", [plain[-1], *plain[:-1]]
