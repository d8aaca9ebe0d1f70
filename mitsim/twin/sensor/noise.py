"""Estimate the imager's noise from repeats, from dark captures, or from one uniform image, in this order.

Signal chain: one image with the projector off -> first knee of the response curve (:mod:`mitsim.twin.sensor.response`);
groups of repeats -> photon-transfer line -> full well, read noise; dark captures -> black level, DSNU; uniform light ->
PRNU. Without repeats, from one image with the projector off: finest detail by level -> smoothing, full well, read
noise, including the fixed pattern (:mod:`mitsim.twin.sensor.photon_transfer`). From dots alone the imager stays unknown
here, and is fitted with the dots.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.special import ndtri

from characterisation.files.arrays import MEDIAN_TO_STD
from mitsim.sensor.imager import Imager
from mitsim.sensor.point_spread import point_spread
from mitsim.sensor.sensor import Sensor
from mitsim.twin.compare.denoise import denoised
from mitsim.twin.finish.find_specimen import MARGIN_PX, image_mask
from mitsim.twin.finish.fine_detail import FINEST, finest_detail
from mitsim.twin.finish.specimen import Specimen
from mitsim.twin.sensor.estimate import FittedKey, Undetermined
from mitsim.twin.sensor.input_captures import InputCapture
from mitsim.twin.sensor.photon_transfer import (
    Repeats,
    TransferLine,
    dithered,
    fixed_variance,
    independent_share,
    one_image_line,
    repeated_line,
)
from mitsim.twin.sensor.response import SLOPE, first_knee, quiet_pixels

#: largest number of pixels used in a group
_PIXELS = 200_000

#: range of the smoothing estimate [px]; chosen
_SMOOTHINGS = (0.05, 3.0)

#: its least significance, in standard uncertainties; chosen
_SURE = 3.0

#: variance of rounding to whole grey levels [DN^2]
_ROUNDING = 1 / 12

#: strips of rows, and of columns, whose scatter gives the uncertainty of the black level; chosen
_STRIPS = 16

#: share of pixels at level 0 up to which they do not matter; chosen
_MOST_BLACK = 0.01

#: share of the specimen's pixels away from edges of the print, above which the noise is estimated from these alone
_LEAST_QUIET = 0.2


@dataclass(frozen=True)
class ImagerFit:
    """The fitted ``imager``, its estimates, whether its noise is ``known``, and by repeats, without fixed pattern."""

    imager: Imager
    estimates: tuple[FittedKey, ...]
    undetermined: tuple[Undetermined, ...] = ()
    known: bool = True
    repeated: bool = False


def fit_imager(groups: list[list[InputCapture]], sensor: Sensor, specimens: dict[str, Specimen]) -> ImagerFit:
    """Fit the noise of the reference camera's imager."""
    repeated = [group for group in groups if len(group) > 1]
    dark = [group for group in groups if group[0].kind == "dark"]
    imager, estimates = sensor.imager, list[FittedKey]()
    if dark:
        every = [source for group in dark for source in group]
        level, spread = dark_level(_images(every))
        names, method = tuple(source.name for source in every), "mean grey level in the dark"
        estimates.append(FittedKey("imager.black_level_dn", level, spread, "DN", names, method))
        imager = replace(imager, black_level=level)
    imager, curve = _with_curve(imager, groups, sensor)
    estimates += curve
    if repeated:
        masked = [(_images(group), _specimen_mask(group[0], specimens)) for group in repeated]
        line = repeated_line([Repeats.of(images, mask, _PIXELS) for images, mask in masked], imager)
        if line is not None:
            names = tuple(source.name for group in repeated for source in group)
            imager = replace(imager, row_noise=0.0)
            imager, noise_estimates = _with_line(imager, line, names, "photon transfer of repeats")
            imager, fixed, undetermined = _with_fixed(imager, sensor.imager, repeated, specimens)
            return ImagerFit(imager, (*estimates, *noise_estimates, *fixed), tuple(undetermined), repeated=True)
    for group in groups:
        if group[0].kind == "off" and (found := _from_one_image(group[0], imager, specimens)) is not None:
            return ImagerFit(found[0], (*estimates, *found[1]))
    return ImagerFit(imager, tuple(estimates), known=False)


def without_fixed_pattern(imager: Imager) -> Imager:
    """Return the imager without the fixed pattern of pixels, which one image does not separate from other noise."""
    return replace(imager, dsnu=0.0, prnu=0.0)


def unseparated(imager: Imager) -> list[Undetermined]:
    """Return the fixed pattern of pixels, which noise from single images contains, unlike that of rows and columns."""
    needed = "repeats of one pose; until then read_noise_e and full_well_e include it"
    values = {"dsnu_e": imager.dsnu, "prnu": imager.prnu}
    return [Undetermined(f"imager.{key}", value, needed, True) for key, value in values.items()]


def smoothing_of(image: NDArray[np.unsignedinteger], mask: NDArray[np.bool_]) -> tuple[float, float]:
    """Return the standard deviation [px] of the Gaussian that smoothed an image's noise, and its uncertainty.

    The correlation of neighbours in the finest detail is -0.8 for white noise and rises with smoothing. The white
    noise of whole grey levels is subtracted first.
    """
    fine = finest_detail(image.astype(float))
    size = MEDIAN_TO_STD * float(np.median(np.abs(fine[mask])))
    usable = mask & (np.abs(fine) < 4 * max(size, 0.5))
    energy, products = float((fine[usable] ** 2).mean()), []
    for first, second in ((np.s_[:, 1:], np.s_[:, :-1]), (np.s_[1:], np.s_[:-1])):
        both = usable[first] & usable[second]
        products.append(float((fine[first] * fine[second])[both].mean()))
    white_energy, white_product = _fine_moments(0.0)
    left = energy - _ROUNDING * white_energy
    if left <= 0.1 * energy:
        return 0.0, float("inf")
    correlation = (float(np.mean(products)) - _ROUNDING * white_product) / left
    spread = np.sqrt(2 / (float(usable.sum()) * independent_share())) * energy / left
    low, high = (_correlation(s) for s in _SMOOTHINGS)

    def at(value: float) -> float:
        if low < value < high:
            return float(brentq(lambda s: _correlation(s) - value, *_SMOOTHINGS))
        return 0.0 if value <= low else _SMOOTHINGS[1]

    smoothing = at(correlation)
    return smoothing, max(at(correlation + spread) - smoothing, smoothing - at(correlation - spread), 1e-3)


def fine_gain(smoothing: float) -> float:
    """Return the variance of the finest detail of smoothed white noise over that of white noise [1]."""
    return float(_fine_moments(smoothing)[0] / _fine_moments(0.0)[0])


def _fine_moments(smoothing: float) -> tuple[float, float]:
    """Return the variance of the finest detail of smoothed white noise, and the mean product of neighbours."""
    weights = np.convolve(FINEST, point_spread(smoothing)) if smoothing > 0 else FINEST
    energy, product = float(weights @ weights), float(weights[1:] @ weights[:-1])
    return energy**2, product * energy


def _correlation(smoothing: float) -> float:
    energy, product = _fine_moments(smoothing)
    return product / energy


def _specimen_mask(source: InputCapture, specimens: dict[str, Specimen]) -> NDArray[np.bool_]:
    camera = source.capture.rig.reference
    if source.kind == "dark":
        return np.ones((camera.height, camera.width), bool)
    return image_mask(specimens[source.name], camera, MARGIN_PX)


def _with_curve(imager: Imager, groups: list[list[InputCapture]], sensor: Sensor) -> tuple[Imager, list[FittedKey]]:
    """Return the imager with the knee of its curve, if one image shows it; only stereo sensor files may have one."""
    if sensor.technology != "active_stereo" or imager.companding or imager.gamma != 1:
        return imager, []
    for source in (group[0] for group in groups if group[0].kind == "off"):
        image = source.image
        levels, mask = image.astype(float), (image > 0) & (image < imager.full_scale)
        knee = first_knee(levels, mask, imager)
        if knee is not None:
            method = f"noise by level of one image: the first knee, {SLOPE:g} times as steep beyond it"
            estimate = FittedKey("imager.companding_dn", knee.level, knee.uncertainty, "DN", (source.name,), method)
            return replace(imager, companding=knee.companding(imager.bits)), [estimate]
    return imager, []


def _images(group: list[InputCapture]) -> NDArray[np.unsignedinteger]:
    return np.stack([source.image for source in group])


def dark_level(images: NDArray[np.unsignedinteger]) -> tuple[float, float]:
    """Return the black level [DN] of images (n, H, W) without light, and its standard uncertainty.

    It is the mean level. If the converter ends at 0 within the noise, it is the middle of the normal distribution with
    the shares of pixels at 0 and up to a second level. The scatter of strips contains noise of rows and columns; less
    noise than half a grey level leaves an error of rounding.
    """
    second = max(int(np.quantile(images, 0.9)), 1)
    cut = (images == 0).mean() > _MOST_BLACK and (images > second).any()

    def level(part: NDArray[np.unsignedinteger]) -> float:
        if not cut:
            return float(part.mean())
        ends = ndtri([((part <= end).sum() + 0.5) / (part.size + 1) for end in (0, second)])
        return float(0.5 - ends[0] * second / (ends[1] - ends[0]))

    variance = _ROUNDING * np.exp(-4 * np.pi**2 * max(float(images.var()) - _ROUNDING, 0.0))
    for axis in (1, 2):
        strips = np.array_split(images, min(_STRIPS, images.shape[axis]), axis)
        variance += np.var([level(strip) for strip in strips], ddof=1) / len(strips)
    return max(level(images), 0.0), float(np.sqrt(variance))


def _with_line(
    imager: Imager, line: TransferLine, names: tuple[str, ...], method: str
) -> tuple[Imager, list[FittedKey]]:
    (well, well_u), (read, read_u) = line.full_well(imager), line.read_noise()
    return replace(imager, full_well=well, read_noise=read), [
        FittedKey("imager.full_well_e", well, well_u, "e-", names, method),
        FittedKey("imager.read_noise_e", read, read_u, "e-", names, method),
    ]


def _with_fixed(
    imager: Imager, before: Imager, repeated: list[list[InputCapture]], specimens: dict[str, Specimen]
) -> tuple[Imager, list[FittedKey], list[Undetermined]]:
    """Estimate DSNU from dark repeats, PRNU from repeats in uniform light."""
    estimates: list[FittedKey] = []
    needed = "the mean of rows in the dark; read_noise_e includes it"
    undetermined = [Undetermined("imager.row_noise_e", before.row_noise, needed, True)]
    for kind, key, determined_by in (
        ("dark", "imager.dsnu_e", "repeats in the dark, with noise over 0.3 DN and a level above it"),
        ("off", "imager.prnu", "repeats with the projector off"),
    ):
        groups = [group for group in repeated if group[0].kind == kind and _shows_pattern(group, specimens)]
        if not groups:
            undetermined.append(Undetermined(key, before.dsnu if kind == "dark" else before.prnu, determined_by))
            continue
        group = groups[0]
        mask, gain = _specimen_mask(group[0], specimens), fine_gain(imager.smoothing_px)
        level, variance, spread = fixed_variance(_images(group), mask, imager, gain)
        if kind == "off":
            variance -= imager.dsnu**2
        root = float(np.sqrt(max(variance, 0.0)))
        spread_root = spread / (2 * root) if root > 0 else float(np.sqrt(spread))
        scale, unit = (1.0, "e-") if kind == "dark" else (level, "1")
        names, method = tuple(source.name for source in group), "finest detail of the mean of repeats"
        estimates.append(FittedKey(key, root / scale, spread_root / scale, unit, names, method))
        imager = replace(imager, dsnu=root) if kind == "dark" else replace(imager, prnu=root / scale)
    return imager, estimates, undetermined


def _shows_pattern(group: list[InputCapture], specimens: dict[str, Specimen]) -> bool:
    """Return whether neither rounding nor black hides the fixed pattern of repeats."""
    levels = _images(group)[:, _specimen_mask(group[0], specimens)]
    return dithered(levels, levels.mean(axis=0)) and float((levels == 0).mean()) < _MOST_BLACK


def _from_one_image(
    source: InputCapture, imager: Imager, specimens: dict[str, Specimen]
) -> tuple[Imager, list[FittedKey]] | None:
    """Return the imager and its estimates; None without several levels: one determines a sum of both kinds of noise."""
    image, mask = source.image, _specimen_mask(source, specimens)
    names, method = (source.name,), "finest detail of one image by level, including its fixed pattern"
    bare, gain, estimates = without_fixed_pattern(imager), 1.0, list[FittedKey]()
    smoothing, spread = smoothing_of(image, mask)
    quiet = quiet_pixels(image.astype(float), denoised(image.astype(float), mask), mask)
    mask = quiet if quiet.mean() > _LEAST_QUIET * mask.mean() else mask
    if smoothing > max(_SURE * spread, 0.2):
        bare, gain = replace(bare, smoothing_px=smoothing), fine_gain(smoothing)
        by_neighbours = "correlation of neighbours in finest detail"
        estimates.append(FittedKey("imager.smoothing_px", smoothing, spread, "px", names, by_neighbours))
    if (line := one_image_line(image, mask, imager)) is None:
        return None
    line = line.over(gain).not_negative()
    well, well_u = line.full_well(imager)
    if not (well_u < 0.3 * well and line.offset >= 0):
        return None
    fitted_imager, from_line = _with_line(bare, line, names, method)
    return fitted_imager, [*estimates, *from_line]
