"""Fit camera and projector to one capture of a stripe code on a sheet, printed or not.

Signal chain: images of the code -> white and black -> line of black over white through all pixels of the print: black
level of the imager, share of light without a pattern -> finest detail of both by level: full well, read noise ->
difference of stripes on and off, by width: blur; if it changes with depth, the projector's focus and aperture
(:mod:`mitsim.twin.sensor.defocus`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, minimum_filter

from characterisation.files.arrays import Floats
from mitsim.decoding.cloud import capture_pattern
from mitsim.sensor.image_role import Role
from mitsim.sensor.imager import Imager
from mitsim.sensor.light_code import LightCode, roles
from mitsim.sensor.sensor import Sensor
from mitsim.twin.finish.electrons import linearised
from mitsim.twin.finish.find_specimen import MARGIN_PX, image_mask
from mitsim.twin.finish.specimen import Specimen
from mitsim.twin.sensor.defocus import Defocus, fit_defocus, fitted_blur
from mitsim.twin.sensor.estimate import FittedKey
from mitsim.twin.sensor.input_captures import InputCapture
from mitsim.twin.sensor.noise import without_fixed_pattern
from mitsim.twin.sensor.photon_transfer import one_image_line

#: side of the window around a pixel that must be uniform [px]; chosen
_EVEN_PX = 7

#: its largest variation as a share of white; chosen
_EVEN_SHARE = 0.3

#: least white minus black of a pixel's modulation [DN]; chosen
_LEAST_DN = 8.0

#: side of the blocks whose scatter gives the uncertainty [px]; chosen
_BLOCK_PX = 40

#: share of full scale below which a pixel is unsaturated; chosen
_UNSATURATED = 0.97

#: least significance of an aperture, in standard uncertainties; chosen
_SURE = 2.0


@dataclass(frozen=True)
class StripeImages:
    """White, black and on-off ``pairs`` (n, 2, H, W) [DN] of ``widths`` [projector px]; ``across``: along columns."""

    white: Floats
    black: Floats
    pairs: Floats
    widths: Floats
    across: NDArray[np.bool_]


def stripes_of(source: InputCapture) -> StripeImages | None:
    """Return a capture's stripes, the extremes for a missing white or black; None without inverses."""
    code, projector = capture_pattern(source.capture), source.capture.rig.projector
    if not isinstance(code, LightCode) or projector is None:
        return None
    images = next(iter(source.capture.images.values()))
    kinds: list[Role] = list(roles(code, projector.width, projector.height))
    names = [role.kind for role in kinds]
    inverses = {(role.axis, role.index): n for n, role in enumerate(kinds) if role.kind == "gray_inverse"}
    bits = [(n, role) for n, role in enumerate(kinds) if role.kind == "gray" and (role.axis, role.index) in inverses]
    if not bits:
        return None
    pairs = np.array([(images[n], images[inverses[role.axis, role.index]]) for n, role in bits], float)
    white = images[names.index("white")].astype(float) if "white" in names else pairs.max(axis=(0, 1))
    black = images[names.index("black")].astype(float) if "black" in names else pairs.min(axis=(0, 1))
    widths = np.array([2 * role.period for _, role in bits])  # a bit of a Gray code changes every second time
    return StripeImages(white, black, pairs, widths, np.array([role.axis == "columns" for _, role in bits]))


def fit_stripes(source: InputCapture, sensor: Sensor, specimen: Specimen) -> list[FittedKey]:
    """Fit one capture of stripes; the sensor must have the capture's own cameras and exposure."""
    seen = stripes_of(source)
    if seen is None:
        return []
    camera = source.capture.rig.reference
    mask = image_mask(specimen, camera, MARGIN_PX)
    full = 2**source.capture.bits - 1
    clear = mask & (maximum_filter(seen.white, 3) < _UNSATURATED * full)
    spread = maximum_filter(seen.white, _EVEN_PX) - minimum_filter(seen.white, _EVEN_PX)
    even = clear & (spread < np.maximum(_EVEN_SHARE * seen.white, 4.0))
    imager, levels = _levels(source, sensor.imager, seen, even)
    imager, noise = _noise(source, imager, seen, even)
    return levels + noise + _blur(source, imager, specimen, seen, even)


def _levels(
    source: InputCapture, imager: Imager, seen: StripeImages, even: NDArray[np.bool_]
) -> tuple[Imager, list[FittedKey]]:
    """Estimate the imager's black level and the light without a pattern from the line of black over white."""
    white, black = seen.white[even], seen.black[even]
    if len(white) < 500 or np.percentile(white, 95) < 2 * np.percentile(white, 5):
        return imager, []
    block, lines = _block_of(even), []
    slope, intercept = np.polyfit(white, black, 1).tolist()
    for part in np.array_split(np.random.default_rng(0).permutation(np.unique(block)), 20):  # a jackknife over blocks
        kept = ~np.isin(block, part)
        lines.append(np.polyfit(white[kept], black[kept], 1))
    spread = np.sqrt(19 / 20 * ((np.array(lines) - np.mean(lines, axis=0)) ** 2).sum(axis=0))
    # black = level + slope (white - level)
    level, share = max(intercept / (1 - slope), 0.0), float(np.clip(slope, 0.0, 0.95))
    method, names = "line of the black image over the white one through the print", (source.name,)
    room = method + "; includes the room"
    return replace(imager, black_level=level), [
        FittedKey("imager.black_level_dn", level, float(spread[1]) / (1 - slope), "DN", names, method),
        FittedKey("projector.black_level", share, float(spread[0]), "1", names, room),
    ]


def _noise(
    source: InputCapture, imager: Imager, seen: StripeImages, even: NDArray[np.bool_]
) -> tuple[Imager, list[FittedKey]]:
    line = one_image_line(seen.white.astype(np.uint16), even, imager)
    if line is None:
        return imager, []
    (well, well_u), (read, read_u) = line.full_well(imager), line.read_noise()
    method, names = "finest detail of the white image by level, including its fixed pattern", (source.name,)
    return replace(without_fixed_pattern(imager), full_well=well, read_noise=read), [
        FittedKey("imager.full_well_e", well, well_u / well**2, "e-", names, method, "inverse"),
        FittedKey("imager.read_noise_e", read, read_u, "e-", names, method),
    ]


def _blur(
    source: InputCapture, chip: Imager, specimen: Specimen, seen: StripeImages, even: NDArray[np.bool_]
) -> list[FittedKey]:
    """Estimate the blur of camera and projector together from the modulation of stripes of every width, by blocks."""
    white, black = linearised(seen.white, chip), linearised(seen.black, chip)
    usable = even & (seen.white - seen.black > _LEAST_DN)
    if usable.sum() < 500:
        return []
    scales = _pixels_per_stripe(source, specimen)
    pairs = np.stack([linearised(seen.pairs[:, side], chip) for side in (0, 1)], axis=1)
    off = np.abs(pairs[:, 0] - pairs[:, 1])
    focus = fit_defocus(source, chip, white, black, pairs, seen.widths)
    if focus is not None and focus.aperture_mm > _SURE * np.sqrt(focus.covariance[1, 1]):
        return _focus(source, focus, float(np.mean(scales)))
    values, block = [], _block_of(usable)
    width = seen.widths * np.where(seen.across, scales[0], scales[1])
    fine = width < 40 * max(scales)
    off, depth = off[:, usable], (white - black)[usable]
    for pixels in (block == label for label in np.unique(block)):
        if pixels.sum() >= 200:
            ratio = off[:, pixels].mean(axis=1) / depth[pixels].mean()
            values.append(fitted_blur(width[fine], ratio[fine]))
    if len(values) < 4:
        return []
    blur, names = min(float(np.median(values)), 5.0), (source.name,)
    spread = 1.2533 * float(np.std(values, ddof=1)) / np.sqrt(len(values))
    method = "modulation of stripes by width, including the projector's blur"
    return [
        FittedKey("imager.blur_px", blur, spread, "px", names, method),
        FittedKey("projector.aperture_mm", 0.0, 0.0, "mm", names, "imager.blur_px includes its blur"),
    ]


def _block_of(used: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return a number of the block of each used pixel."""
    rows, columns = np.nonzero(used)
    return np.asarray((rows // _BLOCK_PX) * 10_000 + columns // _BLOCK_PX)


def _focus(source: InputCapture, focus: Defocus, scale: float) -> list[FittedKey]:
    """Return the estimates of a focus; one projector pixel is ``scale`` camera pixels."""
    spread, names = np.sqrt(np.diag(focus.covariance)), (source.name,)
    method = "modulation of stripes by width and depth"
    blur = min(focus.still_px * scale, 5.0)
    return [
        FittedKey("imager.blur_px", blur, float(spread[0]) * scale, "px", names, method + ", independent of depth"),
        FittedKey("projector.aperture_mm", focus.aperture_mm, float(spread[1]), "mm", names, method),
        FittedKey("projector.focus_mm", focus.focus_mm, float(spread[2]), "mm", names, method),
    ]


def focused(estimates: list[FittedKey]) -> list[FittedKey]:
    """Return the estimates; if some captures tell the focus, without the blur of others, which has the projector's."""
    telling = {estimate.captures for estimate in estimates if estimate.key == "projector.focus_mm"}
    mixed = "imager.blur_px", "projector.aperture_mm"
    return [one for one in estimates if not telling or one.captures in telling or one.key not in mixed]


def _pixels_per_stripe(source: InputCapture, specimen: Specimen) -> tuple[float, float]:
    """Return the camera pixels per projector pixel, along columns and rows, at the centre of the specimen."""
    camera, projector = source.capture.rig.reference, source.capture.rig.projector
    assert projector is not None
    steps = np.array([[0, 0, 0], [1.0, 0, 0], [0, 1.0, 0]]) + np.array([*(specimen.low + specimen.extent / 2), 0.0])
    points = specimen.world_from_sensor.inverse().points(steps)
    seen, sent = camera.project(points), projector.project(points)
    to_camera, to_projector = ((pixels[1:] - pixels[0]).T for pixels in (seen, sent))
    # a stripe's edge moves along the gradient of its coordinate in the camera: 1 / |gradient| px for one of its pixels
    gradient = to_projector @ np.linalg.inv(to_camera)
    return float(1 / np.linalg.norm(gradient[0])), float(1 / np.linalg.norm(gradient[1]))
