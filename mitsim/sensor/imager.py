"""The camera's imager, in the terms of EMVA 1288.

Signal chain: radiance [W/(mm^2 sr)] -> irradiance on the imager through the lens -> photons in a pixel during the
exposure -> photo-electrons (quantum efficiency) -> response of the pixel (PRNU) -> shot noise of signal and dark
current -> offset of the pixel (DSNU) and column -> read and row noise -> full well -> smoothing by the device ->
response curve, gain, black level -> quantisation -> grey levels [DN].

    mu_e = QE A t (pi L / 4 N^2) lambda / (h c),      N the f-number, A the pixel's area
    sigma^2 = K^2 (sigma_read^2 + sigma_row^2 + mu_e + D t) + 1/12        K = full scale / full well [DN/e-]

(EMVA Standard 1288, release 4.0, linear camera model; the mean of the dark current D t is taken off by the black-level
clamp that every such chip has, its shot noise stays.) With a gamma the converter's curve is
DN = black level + (full scale - black level) x^(1/gamma), x = charge / full well, and noise below black is cut off.

With companding the chip converts to more bits than it puts out, and a piecewise linear curve of knees (DN_in, DN_out)
takes its converter's levels to grey levels, cut to whole ones (data sheets of MT9V034 and KAC-0311; "hardware gamma"
in the IDS uEye manual). A grey level is q converter levels wide, so that there, with K in DN_in/e-,

    sigma^2 = K^2 (sigma_read^2 + sigma_row^2 + mu_e + D t) + q^2/12 [DN_in^2],    DN_out = DN_in / q + constant

Many devices smooth their images before they put them out. ``smoothing_px`` stands for that: a Gaussian over charge and
noise together, which makes noise smaller and neighbours alike; whole grey levels are cut afterwards.

Left out: the share of the well that dark current fills, cross-talk, flicker, the chip's own grey levels ahead of its
gamma curve, noise that grows with the row as charge waits to be read. Loss toward the corners belongs to the electrons
that come in: multiply them by :func:`mitsim.sensor.vignetting.camera_illumination`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import correlate1d

from mitsim.errors import InputError, nearest
from mitsim.sensor.point_spread import point_spread

_PLANCK_J_S = 6.62607015e-34
_LIGHT_M_S = 299792458.0

#: shot noise is drawn as a skewed normal, which is faster than a Poisson draw, where the excess kurtosis of the charge
#: is at most this: from a mean of 100 e- on, of fewer where read noise joins it. The distribution functions differ by
#: at most 1.4e-4, so that it takes 10^8 pixels of one mean to tell them apart
_LARGEST_KURTOSIS = 0.01

#: read noise from here on [e-] is drawn together with the shot noise: of the steps of whole electrons it leaves
#: 2 exp(-2 (pi sigma)^2) = 5e-9
_SMOOTHING_E = 1.0

#: pixels that are exposed at once: 256 KiB of electrons
_PIXELS_AT_ONCE = 1 << 16

#: knees may be written to so many DN: a level that the curve only just reaches counts as reached
_KNEE_TOLERANCE_DN = 1e-3


@dataclass(frozen=True)
class Imager:
    """Parameters of an imager; electrons are e-, grey levels DN.

    ``pixel_um`` pitch; ``quantum_efficiency`` at the sensor's wavelength [1]; ``full_well`` [e-]; ``read_noise``
    [e-] temporal, dark; ``dsnu`` [e-] and ``prnu`` [1] fixed pattern, standard deviations; ``bits``; ``black_level``
    [DN]; ``f_number`` of the lens; ``blur_px`` standard deviation of the lens's point spread [px]; ``gamma`` of the
    response curve [1], over 1 lifts the shadows; ``row_noise`` [e-] temporal, one draw for each row and image;
    ``column_pattern`` [e-] fixed, one draw for each column; ``dark_current`` [e-/s]; ``corner_illumination`` of the
    image's farthest corner relative to the middle [1], None for the cos^4 law of each camera; ``companding`` knees
    (DN_in, DN_out) of the curve from the converter's levels to grey levels, rising from (0, 0) to the last, (2^bits of
    the converter, 2^``bits``); none is a straight converter. It takes the place of ``gamma``. ``smoothing_px`` standard
    deviation of the Gaussian that the device smooths its images with before it puts them out [px]. ``corner_blur_px``
    standard deviation of the point spread in the image's farthest corner [px], None for ``blur_px`` all over.
    """

    pixel_um: float
    quantum_efficiency: float
    full_well: float
    read_noise: float
    dsnu: float
    prnu: float
    bits: int
    black_level: float
    f_number: float
    blur_px: float = 0.0
    gamma: float = 1.0
    row_noise: float = 0.0
    column_pattern: float = 0.0
    dark_current: float = 0.0
    corner_illumination: float | None = None
    companding: tuple[tuple[float, float], ...] = ()
    smoothing_px: float = field(default=0.0, repr=False)
    corner_blur_px: float | None = field(default=None, repr=False)

    @property
    def full_scale(self) -> int:
        """Largest grey level [DN]; a pixel that shows it is saturated."""
        return int(2**self.bits - 1)

    @property
    def gain(self) -> float:
        """System gain K [DN/e-] of the converter, ahead of gamma and companding: a full well just fills it."""
        last = self.companding[-1][0] - 1 if self.companding else self.full_scale
        return (last - self.converter_black) / self.full_well

    @property
    def converter_black(self) -> float:
        """Level of the converter [DN_in] that shows as ``black_level``."""
        levels_in, levels_out = _knees(self)
        return float(np.interp(self.black_level, levels_out, levels_in)) if self.companding else self.black_level


@dataclass(frozen=True)
class Noise:
    """Which sources of noise are switched on.

    ``shot`` of the signal, ``read``, ``row``, ``dark`` (shot noise of the dark current) and ``quantisation`` differ
    from image to image; ``dsnu``, ``prnu`` and ``column`` belong to the device; ``speckle`` belongs to the surface and
    the pose, and is applied to the light (:mod:`mitsim.sensor.speckle`), not by the imager. Quantisation off means an
    ideal converter of 16 bits: see :func:`converter`.
    """

    shot: bool = True
    read: bool = True
    row: bool = True
    dark: bool = True
    dsnu: bool = True
    prnu: bool = True
    column: bool = True
    speckle: bool = True
    quantisation: bool = True

    @classmethod
    def none(cls) -> Noise:
        """No source at all."""
        return cls.only()

    @classmethod
    def only(cls, *names: str) -> Noise:
        """These sources, and no other."""
        known = _sources(names, "noise")
        return cls(**{field.name: field.name in known for field in fields(cls)})

    @classmethod
    def without(cls, *names: str) -> Noise:
        """All sources but these."""
        return cls(**dict.fromkeys(_sources(names, "noise"), False))

    @classmethod
    def parse(cls, text: str, where: str = "--noise") -> Noise:
        """Noise as it is written on a command line.

        ``all``; ``none``; ``shot,read`` for these two and no other; ``no-shot,no-read`` for all but these two.

        Raises
        ------
        InputError
            For a name that is no source (it suggests the nearest), or for both ways of writing in one text.
        """
        words = [word.strip() for word in text.split(",") if word.strip()]
        if words in (["all"], ["none"]):
            return cls() if words == ["all"] else cls.none()
        removed = [word.removeprefix("no-") for word in words if word.startswith("no-")]
        if not words or (removed and len(removed) < len(words)):
            allowed = "all, none, sources to keep (shot,read) or sources to leave out (no-shot,no-read)"
            raise InputError(where, "", repr(text), allowed)
        names = _sources(removed or words, where)
        return cls.without(*names) if removed else cls.only(*names)

    @property
    def temporal(self) -> bool:
        """Whether two images of the same light differ."""
        return self.shot or self.read or self.row or self.dark


@dataclass(frozen=True)
class FixedPattern:
    """What one physical imager always adds.

    ``offset`` [e-] (DSNU) and ``response`` [1] (1 + PRNU), (H, W); ``column`` [e-], (W,).
    """

    offset: NDArray[np.float32]
    response: NDArray[np.float32]
    column: NDArray[np.float32]


def fixed_pattern(imager: Imager, shape: tuple[int, int], rng: np.random.Generator) -> FixedPattern:
    """Draw the fixed pattern of one camera; the same generator state gives the same camera."""
    offset = rng.normal(0.0, 1.0, shape).astype(np.float32) * np.float32(imager.dsnu)
    response = 1 + rng.normal(0.0, 1.0, shape).astype(np.float32) * np.float32(imager.prnu)
    column = rng.normal(0.0, 1.0, shape[1]).astype(np.float32) * np.float32(imager.column_pattern)
    return FixedPattern(offset, response, column)


def electrons_per_radiance(imager: Imager, wavelength_nm: float, exposure_s: float) -> float:
    """Mean photo-electrons in a pixel per unit of radiance [e- / (W mm^-2 sr^-1)]."""
    area_mm2 = (imager.pixel_um * 1e-3) ** 2
    photons_per_joule = wavelength_nm * 1e-9 / (_PLANCK_J_S * _LIGHT_M_S)
    solid_angle = np.pi / (4.0 * imager.f_number**2)
    return float(solid_angle * area_mm2 * exposure_s * photons_per_joule * imager.quantum_efficiency)


def converter(imager: Imager, noise: Noise) -> Imager:
    """The imager whose ``bits``, ``full_scale`` and ``black_level`` the images of :func:`expose` have.

    With quantisation on it is the imager itself. Without, its converter is replaced by one of 16 bits, the black level
    in the same share of full scale; what is left of quantisation is full well / 227 000 e- (1/sqrt(12) of a level). A
    companding curve stays, its steps do not. A capture takes its bits from here. Converting twice changes nothing.
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
    """Grey levels [DN] of mean photo-electrons.

    Parameters
    ----------
    electrons
        (..., H, W) mean photo-electrons of each image, finite.
    fixed_pattern
        Of the camera, from :func:`fixed_pattern`; None is an imager without any.
    noise
        Sources that are on; saturation always is.
    rng
        Its own for each camera and pose, ``default_rng(SeedSequence([seed of the pose, index of the camera]))`` say.
        Every image draws from a stream that is spawned from it, so that all are independent and may be exposed in any
        order: ``rng.spawn(n)`` and n calls give the same images as one call. None will do if no temporal source is
        on.
    exposure_s
        Exposure [s], for the dark current.

    Returns
    -------
    numpy.ndarray
        Of the same shape, uint8 up to 8 bits, else uint16; bits and full scale are those of :func:`converter`.

    Raises
    ------
    ValueError
        For electrons that are not finite, or temporal noise without ``rng``.
    """
    if noise.temporal and rng is None:
        raise ValueError("temporal noise needs a generator: rng")
    chip = converter(imager, noise)
    stack = np.asarray(electrons)
    levels: NDArray[np.uint8] | NDArray[np.uint16]
    levels = np.empty(stack.shape, np.uint8) if chip.bits <= 8 else np.empty(stack.shape, np.uint16)
    dark = imager.dark_current * exposure_s if noise.dark else 0.0
    places = list(np.ndindex(stack.shape[:-2]))
    streams = rng.spawn(len(places)) if rng is not None and len(places) > 1 else [rng] * len(places)
    # a few rows at a time: they stay in the processor's cache, and a stack must not exist twice in floating point
    rows = max(1, _PIXELS_AT_ONCE // max(1, stack.shape[-1]))
    smoothed = np.empty(stack.shape[-2:], np.float32) if imager.smoothing_px > 0 else None
    for place, stream in zip(places, streams, strict=True):
        for first in range(0, stack.shape[-2], rows):
            part = slice(first, first + rows)
            charge = np.array(stack[place][part], np.float32)
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
                levels[place][part] = _convert(charge, chip)
            else:
                smoothed[part] = np.minimum(charge, np.float32(imager.full_well))
        if smoothed is not None:
            for axis in (0, 1):
                smoothed[:] = correlate1d(smoothed, point_spread(imager.smoothing_px), axis, mode="reflect")
            levels[place] = _convert(smoothed, chip)
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
    """Replace means mu (H, W) [e-] by counts, and add read noise [e-]; without read noise they are whole numbers.

    The sum has the variance s^2 = mu + read^2 and the third central moment mu. Where it is near enough to a normal it
    is drawn as mu + s z + mu/s^2 (z^2 - 1)/6, z normal: the Cornish-Fisher expansion to its skewness (Abramowitz &
    Stegun 26.2.49). At 1000 e- a normal alone is 2e-3 off, this 1.2e-5.
    """
    z = rng.standard_normal(means.shape, np.float32)
    exact = counted_below(read)
    faint = means < np.float32(exact) if exact > 0 else None
    some = faint is not None and bool(faint.any())
    if some:
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
    if some:
        means[faint] = counts


def counted_below(read: float) -> float:
    """Mean [e-] below which shot noise beside so much read noise [e-] is a Poisson draw.

    The excess kurtosis mu / (mu + read^2)^2 of the sum is at most ``_LARGEST_KURTOSIS`` from here on; 0 if it is so at
    every mean.
    """
    half = 0.5 / _LARGEST_KURTOSIS
    if read**2 >= 0.5 * half:
        return 0.0
    return float(half - read**2 + np.sqrt(half**2 - 2 * half * read**2))


def _convert(charge: NDArray[np.float32], chip: Imager) -> NDArray[np.float32]:
    """Grey levels, still in floating point, of charges [e-]; overwrites them."""
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
    """Grey levels, still in floating point, of charges [e-] up to a full well, by way of the converter's levels."""
    levels_in, levels_out = _knees(chip)
    table = np.floor(np.interp(np.arange(levels_in[-1]), levels_in, levels_out) + _KNEE_TOLERANCE_DN)
    charge *= np.float32(chip.gain)
    charge += np.float32(chip.converter_black)
    np.rint(charge, out=charge)
    np.clip(charge, 0, len(table) - 1, out=charge)
    return np.asarray(table.astype(np.float32)[charge.astype(np.int32)])


def _knees(imager: Imager) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Levels in and out of the companding curve, from (0, 0)."""
    levels = np.array([(0.0, 0.0), *imager.companding])
    return levels[:, 0], levels[:, 1]


def _sources(names: list[str] | tuple[str, ...], where: str) -> list[str]:
    known = [field.name for field in fields(Noise)]
    for name in names:
        if name not in known:
            raise InputError(where, "", repr(name), ", ".join(known), nearest(name, known))
    return list(names)
