"""Simulate speckle: interference of partially coherent light scattered by a rough surface.

Signal chain: surface heights and light source -> contrast C -> two effects on a pixel. Its brightness is multiplied by
a draw of mean 1 and standard deviation C. The point that it sees is displaced by a draw of standard deviation

    dx = C lambda / (2 pi sin u_obs)

(Dorsch, Haeusler & Herrmann, Appl. Opt. 33, 1306, 1994). Both are constant while surface and sensor do not move: one
draw serves all images of a pose. The first cancels in phase shifting, the second does not.

The contrast is a product of five terms (Goodman, "Speckle Phenomena in Optics"). The product is an approximation that
holds for independent averaging:

    roughness        sqrt(1 + 2 r) / (1 + r),  r = A / (1 - A)       A coherent share of the reflected light
    bandwidth        (1 + 16 Rq^2 s_k^2)^(-1/4),  s_k = 2 pi s_lambda / lambda^2,  s_lambda = FWHM / 2.355
    illumination     1 / sqrt(1 + (u_ill / u_obs)^2)                 u half-angles of the two apertures
    pixel            1 / sqrt(M)                                     M speckles in a pixel, see below
    polarisation     1 / sqrt(2)                                     of a surface that depolarises

The bandwidth term assumes Gaussian heights, a Gaussian spectrum and normal incidence. Light reflected at height h has
the phase 2 k h, so two wave numbers decorrelate by |mu|^2 = exp(-4 Rq^2 (k - k')^2), and C^2 is its mean over two draws
from the spectrum.

A round pupil correlates the intensities of two places at distance r on the imager by |mu|^2 = (2 J1(x) / x)^2, with
x = pi r / (lambda N) and N the f-number. A speckle has its area A = 4 (lambda N)^2 / pi. A square pixel of width a
averages over

    1 / M = (4 / a^2) * integral from 0 to a of (1 - x / a) (1 - y / a) |mu|^2 dx dy

The sum of the correlations of a pixel with all pixels is then M A / a^2: pixels larger than a speckle correlate, since
speckles lie on their edges. That sum is what the noise of a block of pixels follows from.

Not modelled: oblique incidence, movement during the exposure, speckle of a laser line's own optics.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.special import gammaincinv, j1, ndtr

from characterisation.files.errors import InputError

#: full width at half maximum of a Gaussian over its standard deviation
_FWHM_PER_SIGMA = float(np.sqrt(8 * np.log(2)))
#: square root of the area of a speckle of a round pupil, over lambda N
_SIZE_OF_ROUND_PUPIL = 2 / float(np.sqrt(np.pi))
#: nodes of the quadrature over a pixel, for pixels smaller than a speckle; each lambda N needs some more
_NODES = 24
#: widest pixel [lambda N] of which the quadrature is made
_WIDEST = 100.0
#: sizes below this [px] leave neighbouring pixels independent (correlation under 0.2 %)
_INDEPENDENT_PX = 0.7
#: the normal variable of the gamma tables spans +-_REACH: beyond it lie 2e-9 of all pixels
_REACH = 6.0
#: steps of a table over that span
_STEPS = 1024
#: tables for contrasts from 0 to 1
_CONTRASTS = 65


@dataclass(frozen=True)
class SpeckleField:
    """One realisation of speckle on an image, the same for all images of a pose.

    ``gain`` (H, W) [1] multiplies the light. ``shift`` (2, H, W), along columns and rows, has unit standard deviation:
    multiply it by :func:`lateral_shift_std`.
    """

    gain: NDArray[np.float32]
    shift: NDArray[np.float32]


def bandwidth_contrast(height_um: float, wavelength_nm: float, linewidth_nm: float) -> float:
    """Return the contrast that a linewidth (FWHM) leaves on a surface of rms height ``height_um`` [1]."""
    spread_per_um = 2 * np.pi * (linewidth_nm / _FWHM_PER_SIGMA) / wavelength_nm**2 * 1e3
    return float((1 + 16 * (height_um * spread_per_um) ** 2) ** -0.25)


def speckle_size_um(wavelength_nm: float, f_number: float) -> float:
    """Return the square root of the area 4 (lambda N)^2 / pi of a speckle on the imager, for a round pupil [um]."""
    return wavelength_nm * 1e-3 * f_number * _SIZE_OF_ROUND_PUPIL


def speckles_in_pixel(pixel_um: float, wavelength_nm: float, f_number: float) -> float:
    """Return M, the number of independent speckles that a square pixel averages over [1], at least 1."""
    return _speckles_in_square(pixel_um / (wavelength_nm * 1e-3 * f_number))


@lru_cache(maxsize=256)
def _speckles_in_square(width: float) -> float:
    """Return M of a square whose width is given in lambda N; beyond :data:`_WIDEST` by its area alone, to 2 %."""
    if width > _WIDEST:
        return _speckles_in_square(_WIDEST) * (width / _WIDEST) ** 2
    nodes, weights = np.polynomial.legendre.leggauss(_NODES + 4 * int(width))
    distances = (nodes + 1) / 2
    shares = weights / 2 * (1 - distances)  # of pairs of points of the pixel, by their distance along an axis
    argument = np.maximum(np.pi * width * np.hypot(distances, distances[:, None]), 1e-9)
    return float(1 / (4 * shares @ (2 * j1(argument) / argument) ** 2 @ shares))


def correlation_size_px(pixel_um: float, wavelength_nm: float, f_number: float) -> float:
    """Return the size [px] for :func:`speckle_field`, with which the correlations of a pixel add up to M A / a^2."""
    share = speckle_size_um(wavelength_nm, f_number) / pixel_um
    along = np.sqrt(speckles_in_pixel(pixel_um, wavelength_nm, f_number)) * share
    return _size_of_sum(float(along))


@lru_cache(maxsize=256)
def _size_of_sum(along: float) -> float:
    """Return the size whose correlations exp(-pi d^2 / size^2) add up to this number along a row of pixels."""
    steps = np.arange(1, 2 + int(3 * along))

    def excess(size: float) -> float:
        return float(1 + 2 * np.exp(-np.pi * (steps / size) ** 2).sum() - along)

    smallest = 0.1
    return smallest if excess(smallest) >= 0 else float(brentq(excess, smallest, along + 1, xtol=1e-9))


@dataclass(frozen=True)
class SpeckleSurface:
    """Properties of a surface that decide on its speckle.

    - ``height_um``: Rq of a metal; for a paint, the spread of path lengths inside it [*assumed* by the caller].
    - ``coherent_share``: A, share of the light reflected as by a mirror [1]; 1 leaves no speckle.
    - ``depolarising``: whether the surface scrambles polarisation, as white paint does and metal does not.
    """

    height_um: float
    coherent_share: float
    depolarising: bool


@dataclass(frozen=True)
class SpeckleOptics:
    """Properties of light and lenses that decide on speckle.

    - ``wavelength_nm``, ``linewidth_nm`` of the light: the full width at half maximum, 0 for an ideal laser.
    - ``u_illumination``, ``u_observation``: half-angles of the projector's and the camera's aperture, seen from the
      surface [rad].
    - ``pixel_um``: pitch of the imager; ``f_number``: working f-number of its lens [1].
    """

    wavelength_nm: float
    linewidth_nm: float
    u_illumination: float
    u_observation: float
    pixel_um: float
    f_number: float


def contrast(surface: SpeckleSurface, optics: SpeckleOptics) -> float:
    """Return the speckle contrast C of a pixel: standard deviation over mean of its brightness [1], 0 to 1."""
    # sqrt(1 + 2 r) / (1 + r) with r = A / (1 - A), written so that A = 1 gives 0
    roughness = np.sqrt(1 - surface.coherent_share**2)
    bandwidth = bandwidth_contrast(surface.height_um, optics.wavelength_nm, optics.linewidth_nm)
    illumination = 1 / np.sqrt(1 + (optics.u_illumination / optics.u_observation) ** 2)
    pixel = speckles_in_pixel(optics.pixel_um, optics.wavelength_nm, optics.f_number) ** -0.5
    polarisation = np.sqrt(0.5) if surface.depolarising else 1.0
    return float(roughness * bandwidth * illumination * pixel * polarisation)


def lateral_shift_std(contrast: float, wavelength_nm: float, sin_u_observation: float) -> float:
    """Return the standard deviation [mm] of the displacement, on the surface, of the point seen, along either axis.

    Dorsch, Haeusler & Herrmann (1994), C lambda / (2 pi sin u). For C = 1 it is the centroid's error of a uniformly lit
    round spot, large against a speckle, seen through a round aperture. A Gaussian spot has 1/sqrt(2) of it.
    """
    return contrast * wavelength_nm * 1e-6 / (2 * np.pi * sin_u_observation)


def speckle_field(
    shape: tuple[int, int], contrast: float | NDArray[np.floating], size_px: float, rng: np.random.Generator
) -> SpeckleField:
    """Draw one realisation of speckle.

    Parameters
    ----------
    shape
        (H, W) of the image.
    contrast
        C [1], 0 to 1, of the image or of each of its pixels (H, W). The gain is gamma-distributed with mean 1 and this
        standard deviation: exactly 1 for C = 0, exponential for C = 1.
    size_px
        Size [px] over which pixels correlate, from :func:`correlation_size_px`. Two pixels at distance d have the
        correlation exp(-pi d^2 / size^2), whose area is size^2; below 0.7 px all pixels are independent.
    rng
        Generator of the draws.

    Raises
    ------
    InputError
        For speckle larger than a quarter of the image.

    See Also
    --------
    contrast : the contrast of it
    """
    if size_px > max(0.25 * min(shape), 1):
        raise InputError("speckle", "size_px", size_px, "up to a quarter of the image", "a smaller f-number")
    values = np.asarray(contrast, np.float32)
    normal = _correlated_normal(shape, size_px, rng)
    gain = _gamma_of_normal(normal, values)
    shift = np.stack([_correlated_normal(shape, size_px, rng) for _ in range(2)])
    return SpeckleField(gain, shift)


def _correlated_normal(shape: tuple[int, int], size_px: float, rng: np.random.Generator) -> NDArray[np.float32]:
    """Draw unit normal variables (H, W) with the correlation exp(-pi d^2 / size^2)."""
    if size_px < _INDEPENDENT_PX:
        return rng.standard_normal(shape, np.float32)
    kernel = _kernel(size_px)
    reach = len(kernel) // 2
    noise = rng.standard_normal((shape[0] + 2 * reach, shape[1] + 2 * reach), np.float32)
    filtered = cv2.sepFilter2D(noise, cv2.CV_32F, kernel, kernel)
    return np.ascontiguousarray(filtered[reach : reach + shape[0], reach : reach + shape[1]])


@lru_cache(maxsize=32)
def _kernel(size_px: float) -> NDArray[np.float32]:
    """Return a filter whose autocorrelation is the required one: the square root of the spectrum, transformed back."""
    reach = int(np.ceil(2.5 * size_px)) + 2
    period = 4 * reach + 1
    distance = np.minimum(np.arange(period), period - np.arange(period))
    spectrum = np.fft.rfft(np.exp(-np.pi * (distance / size_px) ** 2)).real
    response = np.fft.irfft(np.sqrt(np.maximum(spectrum, 0)), period)
    kernel = np.concatenate([response[-reach:], response[: reach + 1]])
    return np.asarray(kernel / np.sqrt((kernel**2).sum()), np.float32)


def _gamma_of_normal(normal: NDArray[np.float32], contrast: NDArray[np.float32]) -> NDArray[np.float32]:
    """Map normal variables to gamma variables of mean 1 and standard deviation ``contrast`` at equal quantiles."""
    position = np.clip(normal, -_REACH, _REACH)
    position += np.float32(_REACH)
    position *= np.float32(_STEPS / (2 * _REACH))
    step = np.minimum(position.astype(np.int32), _STEPS - 1)
    position -= step
    if contrast.ndim == 0:
        table = _quantiles(float(contrast))
        return np.asarray(table[step] * (1 - position) + table[step + 1] * position)
    tables = _all_quantiles()
    row_position = contrast * np.float32(_CONTRASTS - 1)
    row = np.minimum(row_position.astype(np.int32), _CONTRASTS - 2)
    row_position -= row
    step += row * (_STEPS + 1)
    low = tables[step] * (1 - position) + tables[step + 1] * position
    step += _STEPS + 1
    high = tables[step] * (1 - position) + tables[step + 1] * position
    return np.asarray(low + row_position * (high - low))


@lru_cache(maxsize=64)
def _quantiles(contrast: float) -> NDArray[np.float32]:
    """Return the gamma quantiles at the table's normal quantiles, (steps + 1,)."""
    normal = np.linspace(-_REACH, _REACH, _STEPS + 1)
    if contrast < 1e-3:  # the shape parameter exceeds 10^6: gamma and normal agree to 1e-6 of the mean
        return np.asarray(1 + contrast * normal, np.float32)
    shape = contrast**-2.0
    return np.asarray(gammaincinv(shape, ndtr(normal)) / shape, np.float32)


@lru_cache(maxsize=1)
def _all_quantiles() -> NDArray[np.float32]:
    """Return tables for contrasts 0 to 1 in equal steps, concatenated, for interpolation between them."""
    return np.concatenate([_quantiles(float(c)) for c in np.linspace(0, 1, _CONTRASTS)])
