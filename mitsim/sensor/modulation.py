"""Simulate time of flight: amplitude-modulated light, and the imager that correlates it.

Signal chain: radiance of every correlation 1 + m cos(2 pi f L / c - delta)
(:class:`mitsim.scene.light_transport.projected_codes.ModulatedLight`) -> delays of the pixels -> charge of the two taps
A and B of a pixel -> noise of each (:mod:`mitsim.sensor.image_formation`) -> their difference -> quantisation -> grey
levels [DN].

While a pixel demodulates, the reference signal directs its light to tap A or tap B; none is lost. With w the mean over
the delays (all light, including ambient) and s_k a correlation, in electrons,

    A = s_k / 2,    B = w - s_k / 2,    x_k = black level + K (A - B) [DN],    var(A - B) = w + 2 sigma_read^2

so the mean of x_k over the delays is the black level, and ambient light adds only noise (Lange & Seitz, IEEE J. Quantum
Electron. 37, 2001; two taps with the difference read out: Bamji et al., IEEE J. Solid-State Circuits 50, 2015). w needs
no image of its own: the N >= 3 evenly spaced delays of a frequency sum to N w on every light path.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator, model_validator

from characterisation.files.documents import Document
from mitsim.sensor.decoder_settings import DepthSettings
from mitsim.sensor.image_formation import FixedPattern, converter, expose
from mitsim.sensor.imager import Imager
from mitsim.sensor.noise_sources import Noise

#: speed of light [mm/s]
LIGHT_MM_S = 299792458e3

Frequency = Annotated[float, Field(ge=1, le=1000)]
Contrast = Annotated[float, Field(gt=0, le=1)]


class AmplitudeModulation(Document):
    """Continuous-wave amplitude modulation, demodulated by a pixel with two taps.

    - ``frequencies_mhz``: rising, each demodulated at ``steps`` delays of 2 pi k / steps.
    - ``contrast``: m of light and pixel together, one number or one for each frequency.
    - ``delay_pattern_mm``: fixed pattern of the pixels' delays, as a standard deviation of the optical path [mm].
    """

    kind: Literal["amplitude_modulation"]
    frequencies_mhz: list[Frequency] = Field(min_length=1, max_length=6)
    steps: int = Field(default=4, ge=3, le=16)
    contrast: Contrast | list[Contrast] = 1.0
    delay_pattern_mm: Annotated[float, Field(ge=0, le=1000)] = 0.0

    @field_validator("frequencies_mhz")
    @classmethod
    def _rising(cls, frequencies: list[float]) -> list[float]:
        if any(a >= b for a, b in pairwise(frequencies)):
            raise ValueError("frequencies that rise")
        return frequencies

    @model_validator(mode="after")
    def _consistent(self) -> AmplitudeModulation:
        if isinstance(self.contrast, list) and len(self.contrast) != len(self.frequencies_mhz):
            raise ValueError(f"contrast: one number, or as many as there are frequencies ({len(self.frequencies_mhz)})")
        return self

    @property
    def frequencies_hz(self) -> NDArray[np.float64]:
        """Return the modulation frequencies, (F,) [Hz]."""
        return np.array(self.frequencies_mhz) * 1e6

    @property
    def contrasts(self) -> NDArray[np.float64]:
        """Return the contrast m of each frequency, (F,) [1]."""
        return np.broadcast_to(np.asarray(self.contrast, float), len(self.frequencies_mhz)).copy()

    @property
    def delays(self) -> NDArray[np.float64]:
        """Return delta_k of the images of one frequency, (N,) [rad]."""
        return 2 * np.pi * np.arange(self.steps) / self.steps

    @property
    def count(self) -> int:
        """Return the number of images of a capture; all delays of the first frequency come first."""
        return self.steps * len(self.frequencies_mhz)

    def images(self) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return frequency [Hz], delay [rad] and contrast [1] of every image, (P,) each."""
        delays = np.tile(self.delays, len(self.frequencies_mhz))
        return np.repeat(self.frequencies_hz, self.steps), delays, np.repeat(self.contrasts, self.steps)


class TimeOfFlightSettings(DepthSettings):
    """Limits of a time-of-flight decoder. Nothing is filtered or filled: lost points stay lost.

    - ``near_mm``, ``far_mm``: range of accepted depths along the camera's axis.
    - ``minimum_amplitude_dn``: least accepted amplitude, at every frequency [DN of 8 bit, that is 1/255 of full scale].
    - ``consistency_sigma``: number of standard deviations by which the phases may disagree with their common path.
    - ``systematic_rad``: standard deviation added to the noise of every phase for systematic errors.
    """

    level_key = "minimum_amplitude_dn"

    minimum_amplitude_dn: float = Field(default=0.1, ge=0)
    consistency_sigma: float = Field(default=5.0, gt=0)
    systematic_rad: float = Field(default=0.05, ge=0, le=1)


def delay_pattern(code: AmplitudeModulation, shape: tuple[int, int], rng: np.random.Generator) -> NDArray[np.float32]:
    """Draw each pixel's addition to the optical path [mm], (H, W); equal generator states give equal cameras."""
    return np.asarray(rng.standard_normal(shape, np.float32) * np.float32(code.delay_pattern_mm))


def delayed(
    light: NDArray[np.float32], code: AmplitudeModulation, path_mm: NDArray[np.floating]
) -> NDArray[np.float32]:
    """Return correlations (P, H, W), in any unit, for a path longer by ``path_mm`` (H, W) in every pixel.

    The images of a frequency are w + c cos(delta) + d sin(delta) for any mix of light paths. A delay rotates (c, d).
    """
    out = np.empty_like(light)
    by_frequency = light.reshape(-1, code.steps, *light.shape[1:])
    turned = out.reshape(by_frequency.shape)
    for images, result, frequency in zip(by_frequency, turned, code.frequencies_hz, strict=True):
        mean = images.mean(axis=0)
        across = np.tensordot(2 / code.steps * np.sin(code.delays), images, axes=1)
        along = np.tensordot(2 / code.steps * np.cos(code.delays), images, axes=1)
        angle = 2 * np.pi * frequency / LIGHT_MM_S * path_mm
        cosine, sine = np.cos(angle), np.sin(angle)
        for delta, image in zip(code.delays, result, strict=True):
            image[:] = (
                mean
                + (along * cosine - across * sine) * np.cos(delta)
                + (along * sine + across * cosine) * np.sin(delta)
            )
    return out


def fullest_tap(light: NDArray[np.float32], code: AmplitudeModulation) -> NDArray[np.float32]:
    """Return the light (H, W) of the fullest tap of each pixel in any image, from correlations (P, H, W)."""
    by_frequency = light.reshape(-1, code.steps, *light.shape[1:])
    other_tap = by_frequency.mean(axis=1) - 0.5 * by_frequency.min(axis=1)
    return np.asarray(np.maximum(0.5 * light.max(axis=0), other_tap.max(axis=0)), np.float32)


def correlated_light(stack: NDArray[np.generic]) -> NDArray[np.float64]:
    """Return the light (H, W) [DN] of correlations (P, H, W): their range over the phase steps, twice the amplitude."""
    return np.asarray(2 * np.sqrt(2) * stack.std(axis=0, dtype=np.float64))


def expose_taps(
    electrons: NDArray[np.floating],
    code: AmplitudeModulation,
    imager: Imager,
    fixed_pattern: FixedPattern | None,
    noise: Noise,
    rng: np.random.Generator | None,
    exposure_s: float = 0.0,
) -> NDArray[np.uint8] | NDArray[np.uint16]:
    """Return the grey levels [DN] of the differences of the taps.

    Returns: (P, H, W), uint8 up to 8 bits, else uint16; bits and black level are those of
    :func:`mitsim.sensor.image_formation.converter`. Only a pixel with a full tap reaches full scale.

    Parameters
    ----------
    electrons
        (P, H, W) correlations: twice the mean photo-electrons of tap A.
    code
        Frequencies of the modulation, and the steps of each.
    imager
        ``full_well``, ``read_noise`` and the other temporal sources are those of one tap. The offset of a pixel or
        column is that of the difference. A difference of a full well is full scale.
    fixed_pattern, noise, rng
        As for :func:`mitsim.sensor.image_formation.expose`.
    exposure_s
        Of each image [s], for the dark current.

    See Also
    --------
    mitsim.sensor.image_formation.expose : grey levels of an ordinary imager
    """
    chip = converter(imager, noise)
    fine = replace(noise, quantisation=False)
    # the taps' converter has a quarter of the step of a 15-bit one, and levels for noise below zero
    tap = replace(imager, bits=16, black_level=4096.0)
    plain = (
        None
        if fixed_pattern is None
        else replace(
            fixed_pattern, offset=np.zeros_like(fixed_pattern.offset), column=np.zeros_like(fixed_pattern.column)
        )
    )
    out: NDArray[np.uint8] | NDArray[np.uint16]
    out = np.empty(electrons.shape, np.uint8) if chip.bits <= 8 else np.empty(electrons.shape, np.uint16)
    everything = electrons.reshape(-1, code.steps, *electrons.shape[1:]).mean(axis=1)
    for index, image in enumerate(electrons):
        half = 0.5 * image
        a = expose(half, tap, fixed_pattern, fine, rng, exposure_s)
        b = expose(everything[index // code.steps] - half, tap, plain, fine, rng, exposure_s)
        level = (a.astype(np.float32) - b) * np.float32(chip.gain / tap.gain) + np.float32(chip.black_level)
        level = np.clip(np.rint(level), 0, chip.full_scale - 1)
        level[(a == tap.full_scale) | (b == tap.full_scale)] = chip.full_scale
        out[index] = level
    return out


def sample_variance(amplitude: NDArray[np.float32], contrast: float, imager: Imager | None) -> NDArray[np.float32]:
    """Return the variance [DN^2] of one image of amplitude B (...) [DN]; without an imager, of quantisation alone.

    sigma^2 = K B / m + 2 K^2 (sigma_read^2 + sigma_row^2) + 1/12. The charge of both taps is B / (K m) without ambient
    light, which a difference does not show.
    """
    if imager is None:
        return np.full(amplitude.shape, 1 / 12, np.float32)
    dark = 2 * imager.gain**2 * (imager.read_noise**2 + imager.row_noise**2) + 1 / 12
    return np.asarray(amplitude * np.float32(imager.gain / contrast) + np.float32(dark))
