"""Simulate the camera's imager in the terms of EMVA 1288.

Signal chain: radiance [W/(mm^2 sr)] -> irradiance on the imager through the lens -> photons in a pixel during the
exposure -> photo-electrons (quantum efficiency) -> response of the pixel (PRNU) -> shot noise of signal and dark
current -> offset of the pixel (DSNU) and column -> read and row noise -> full well -> smoothing by the device ->
response curve, gain, black level -> quantisation -> grey levels [DN].

    mu_e = QE A t (pi L / 4 N^2) lambda / (h c),      N the f-number, A the pixel's area
    sigma^2 = K^2 (sigma_read^2 + sigma_row^2 + mu_e + D t) + 1/12        K = full scale / full well [DN/e-]

Source: EMVA Standard 1288, release 4.0, linear camera model. The imager's black-level clamp removes the mean of the
dark current D t; its shot noise remains. With a gamma the response curve is DN = black level + (full scale - black
level) x^(1/gamma), x = charge / full well, and noise below black is clipped.

With companding the imager converts to more bits than it outputs. A piecewise linear curve through knees
(DN_in, DN_out) maps the converter's levels to grey levels, rounded down (data sheets of MT9V034 and KAC-0311; "hardware
gamma" in the IDS uEye manual). A grey level spans q converter levels. There, with K in DN_in/e-,

    sigma^2 = K^2 (sigma_read^2 + sigma_row^2 + mu_e + D t) + q^2/12 [DN_in^2],    DN_out = DN_in / q + constant

Many devices smooth their images before output. ``smoothing_px`` models this by a Gaussian filter of charge and noise
together, which reduces the noise and correlates neighbours. Quantisation follows.

Not modelled:

- the share of the well that dark current fills,
- cross-talk and flicker,
- the imager's own quantisation ahead of its gamma curve,
- noise that grows with the row as charge waits to be read.

The loss of light toward the corners belongs to the incoming electrons: multiply them by
:func:`mitsim.sensor.vignetting.camera_illumination`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import correlate1d

from mitsim.sensor.imager import Imager
from mitsim.sensor.noise_sources import Noise
from mitsim.sensor.point_spread import point_spread

#: Shot noise is drawn as a skewed normal, which is faster than a Poisson draw, where the excess kurtosis of the charge
#: is at most this: at means from 100 e-, or lower with read noise. The distribution functions then differ by at most
#: 1.4e-4; 10^8 pixels of one mean are needed to tell them apart.
_LARGEST_KURTOSIS = 0.01

#: Read noise from here on [e-] is drawn together with the shot noise. It leaves 2 exp(-2 (pi sigma)^2) = 5e-9 of the
#: steps of whole electrons.
_SMOOTHING_E = 1.0

#: pixels exposed at once: 256 KiB of electrons
_PIXELS_AT_ONCE = 1 << 16

#: rounding tolerance of the knees [DN]: a level that the curve reaches within it counts as reached
_KNEE_TOLERANCE_DN = 1e-3


@dataclass(frozen=True)
class FixedPattern:
    """Fixed pattern of one physical imager.

    ``offset`` [e-] (DSNU) and ``response`` [1] (1 + PRNU), (H, W); ``column`` [e-], (W,).
    """

    offset: NDArray[np.float32]
    response: NDArray[np.float32]
    column: NDArray[np.float32]


def fixed_pattern(imager: Imager, shape: tuple[int, int], rng: np.random.Generator) -> FixedPattern:
    """Draw the fixed pattern of one camera; equal generator states give equal cameras."""
    offset = rng.normal(0.0, 1.0, shape).astype(np.float32) * np.float32(imager.dsnu)
    response = 1 + rng.normal(0.0, 1.0, shape).astype(np.float32) * np.float32(imager.prnu)
    column = rng.normal(0.0, 1.0, shape[1]).astype(np.float32) * np.float32(imager.column_pattern)
    return FixedPattern(offset, response, column)


def converter(imager: Imager, noise: Noise) -> Imager:
    """Return the imager with the ``bits``, ``full_scale`` and ``black_level`` of the images that :func:`expose` makes.

    With quantisation on, this is the imager itself. With quantisation off, its converter is replaced by one of 16 bits
    with the black level at the same share of full scale. The remaining quantisation noise is full well / 227 000 e-
    (1/sqrt(12) of a level). A companding curve remains, without its steps. A capture takes its bits from here. A
    second conversion changes nothing.
    """
    if noise.quantisation:
        return imager
    if not imager.companding:
        return replace(imager, bits=16, black_level=imager.black_level * 65535 / imager.full_scale)
    last_in, last_out = imager.companding[-1]
    knees = tuple((x * 65536 / last_in, y * 65536 / last_out) for x, y in imager.companding)
    return replace(imager, bits=16, black_level=imager.black_level * 65536 / last_out, companding=knees)


def expose(
    electrons: NDArray[np.floating],
    imager: Imager,
    fixed_pattern: FixedPattern | None,
    noise: Noise,
    rng: np.random.Generator | None,
    exposure_s: float = 0.0,
) -> NDArray[np.uint8] | NDArray[np.uint16]:
    """Convert mean photo-electrons to grey levels [DN].

    Returns: of the same shape, uint8 up to 8 bits, else uint16; bits and full scale are those of :func:`converter`.
    Raises ValueError for electrons that are not finite, or temporal noise without ``rng``.

    Parameters
    ----------
    electrons
        (..., H, W) mean photo-electrons of each image, finite.
    imager
        Properties of the imager.
    fixed_pattern
        Of the camera, from :func:`fixed_pattern`; None is an imager without one.
    noise
        Sources that are on; saturation is always on.
    rng
        One for each camera and pose, such as ``default_rng(SeedSequence([seed of the pose, index of the camera]))``.
        Every image draws from a stream spawned from it, so all images are independent and may be exposed in any order:
        ``rng.spawn(n)`` and n calls give the same images as one call. None is allowed if no temporal source is on.
    exposure_s
        Exposure [s], for the dark current.

    See Also
    --------
    mitsim.sensor.modulation.expose_taps : the differences of a time-of-flight camera's taps
    """
    if noise.temporal and rng is None:
        raise ValueError("temporal noise needs a generator: rng")
    chip = converter(imager, noise)
    stack = np.asarray(electrons)
    levels: NDArray[np.uint8] | NDArray[np.uint16]
    levels = np.empty(stack.shape, np.uint8) if chip.bits <= 8 else np.empty(stack.shape, np.uint16)
    dark = imager.dark_current * exposure_s if noise.dark else 0.0
    indices = list(np.ndindex(stack.shape[:-2]))
    streams = rng.spawn(len(indices)) if rng is not None and len(indices) > 1 else [rng] * len(indices)
    # a few rows at a time fit the processor's cache, and avoid a second copy of the stack in floating point
    rows = max(1, _PIXELS_AT_ONCE // max(1, stack.shape[-1]))
    smoothed = np.empty(stack.shape[-2:], np.float32) if imager.smoothing_px > 0 else None
    for index, stream in zip(indices, streams, strict=True):
        for first in range(0, stack.shape[-2], rows):
            part = slice(first, first + rows)
            charge = np.array(stack[index][part], np.float32)
            if not np.isfinite(charge).all():
                raise ValueError("mean electrons must be finite")
            if fixed_pattern is not None and noise.prnu:
                charge *= fixed_pattern.response[part]
            if stream is not None:
                _add_temporal(charge, imager, noise, dark, stream)
            if fixed_pattern is not None and noise.dsnu:
                charge += fixed_pattern.offset[part]
            if fixed_pattern is not None and noise.column:
                charge += fixed_pattern.column
            if smoothed is None:
                levels[index][part] = _convert(charge, chip)
            else:
                smoothed[part] = np.minimum(charge, np.float32(imager.full_well))
        if smoothed is not None:
            for axis in (0, 1):
                smoothed[:] = correlate1d(smoothed, point_spread(imager.smoothing_px), axis, mode="reflect")
            levels[index] = _convert(smoothed, chip)
    return levels


def _add_temporal(
    charge: NDArray[np.float32], imager: Imager, noise: Noise, dark: float, rng: np.random.Generator
) -> None:
    read = imager.read_noise if noise.read else 0.0
    joined = noise.shot and read >= _SMOOTHING_E
    if noise.shot:
        np.maximum(charge, 0, out=charge)
        if dark:
            charge += np.float32(dark)
        _add_shot_noise(charge, read if joined else 0.0, rng)
        if dark:
            charge -= np.float32(dark)
    elif dark:
        charge += rng.poisson(dark, charge.shape) - np.float32(dark)
    if read > 0 and not joined:
        draw = rng.standard_normal(charge.shape, np.float32)
        draw *= np.float32(read)
        charge += draw
    if noise.row and imager.row_noise > 0:
        charge += rng.standard_normal((charge.shape[0], 1), np.float32) * np.float32(imager.row_noise)


def _add_shot_noise(means: NDArray[np.float32], read: float, rng: np.random.Generator) -> None:
    """Replace means mu (H, W) [e-] by counts plus read noise [e-]; without read noise they are whole numbers.

    The sum has the variance s^2 = mu + read^2 and the third central moment mu. Where it is close enough to normal, it
    is drawn as mu + s z + mu/s^2 (z^2 - 1)/6 with z normal, the Cornish-Fisher expansion to its skewness (Abramowitz &
    Stegun 26.2.49). At 1000 e- the error of its distribution function is 1.2e-5; that of a normal is 2e-3.
    """
    z = rng.standard_normal(means.shape, np.float32)
    exact = counted_below(read)
    # nothing is counted where there is no light, such as beside a part
    faint = (means < np.float32(exact)) & (means > 0) if exact > 0 else None
    any_faint = faint is not None and bool(faint.any())
    if any_faint:
        counts = rng.poisson(means[faint]) + np.float32(read) * z[faint]
    variance = np.maximum(means, np.float32(1e-3)) if read == 0 else means + np.float32(read**2)
    skewed = np.divide(means, variance)
    np.sqrt(variance, out=variance)
    variance *= z
    means += variance
    z *= z
    z -= 1
    z *= np.float32(1 / 6)
    skewed *= z
    means += skewed
    if read == 0:
        np.rint(means, out=means)
    if any_faint:
        means[faint] = counts


def counted_below(read: float) -> float:
    """Return the mean [e-] below which shot noise with this read noise [e-] is a Poisson draw.

    From there on the excess kurtosis mu / (mu + read^2)^2 of the sum is at most ``_LARGEST_KURTOSIS``. Returns 0 if
    that holds at every mean.
    """
    half = 0.5 / _LARGEST_KURTOSIS
    if read**2 >= 0.5 * half:
        return 0.0
    return float(half - read**2 + np.sqrt(half**2 - 2 * half * read**2))


def _convert(charge: NDArray[np.float32], chip: Imager) -> NDArray[np.float32]:
    """Convert charges [e-], in place, to grey levels that are still floating point."""
    np.minimum(charge, np.float32(chip.full_well), out=charge)
    if chip.companding:
        return _compand(charge, chip)
    if chip.gamma == 1.0:
        charge *= np.float32(chip.gain)
    else:
        np.maximum(charge, 0, out=charge)
        charge *= np.float32(1.0 / chip.full_well)
        np.power(charge, np.float32(1.0 / chip.gamma), out=charge)
        charge *= np.float32(chip.full_scale - chip.black_level)
    charge += np.float32(chip.black_level)
    np.rint(charge, out=charge)
    return np.clip(charge, 0, chip.full_scale, out=charge)


def _compand(charge: NDArray[np.float32], chip: Imager) -> NDArray[np.float32]:
    """Convert charges [e-] up to a full well to floating-point grey levels through the converter's levels."""
    levels_in, levels_out = chip.knees
    table = np.floor(np.interp(np.arange(levels_in[-1]), levels_in, levels_out) + _KNEE_TOLERANCE_DN)
    charge *= np.float32(chip.gain)
    charge += np.float32(chip.converter_black)
    np.rint(charge, out=charge)
    np.clip(charge, 0, len(table) - 1, out=charge)
    return np.asarray(table.astype(np.float32)[charge.astype(np.int32)])
