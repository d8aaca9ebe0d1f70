"""Evaluate the codes that a projector's light carries: patterns, or a modulation in time.

The code of patterns is a function of the projector coordinate (u, v): :class:`ProjectedPatterns`. The code of a
time-of-flight sensor is a function of L, the optical length from the projector over the scene to the camera:
:class:`ModulatedLight`. The same loop evaluates both on the same paths.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator
from functools import reduce
from operator import add
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import qr

from characterisation.files.errors import InputError
from mitsim.scene.backend import dr, mi
from mitsim.scene.device import opaque
from mitsim.sensor.modulation import LIGHT_MM_S
from mitsim.sensor.projector import Projector

#: largest error of a pattern that is a sum of others, relative to white: a few roundings in single precision
_LOOKUP_ERROR = 5e-7

#: weights of such sums below this are rounding errors
_NO_WEIGHT = 1e-10

#: number of values of patterns that are converted to double precision at once
_VALUES_AT_ONCE = 1 << 22


class ProjectedLight(Protocol):
    """A projector and the codes of all images of a capture.

    ``count`` images are weighted sums of ``codes`` codes, which are as many or fewer.
    """

    projector: Projector
    count: int
    codes: int

    def values(self, uv: Any, length: Any, active: Any) -> list[Any]:
        """Return the relative light of each code at texture coordinate ``uv`` and optical length ``length`` [mm]."""

    def images(self, codes: list[Any]) -> list[Any]:
        """Return a quantity of each image from that of each code, numbers or arrays."""


class ProjectedPatterns:
    """Patterns (P, H, W) of values 0..1, relative to white, on the device.

    The light is interpolated between the centres of projector pixels. With a pixel gap each pixel is a square with dark
    lines around it, brighter by the factor that keeps the flux. Patterns that are sums of others are not stored: only
    three steps of a sinusoid are independent. Patterns with equal rows are stored as one row.

    Raises
    ------
    InputError
        If the patterns do not have the size of the projector.
    """

    def __init__(self, patterns: NDArray[np.floating], projector: Projector) -> None:
        optics = projector.optics
        if patterns.ndim != 3 or patterns.shape[1:] != (optics.height, optics.width):
            raise InputError("patterns", "shape", patterns.shape, f"(P, {optics.height}, {optics.width})")
        self.count = patterns.shape[0]
        self.projector = projector
        self.along_row = bool((patterns == patterns[:, :1]).all())
        emitted = projector.emit(patterns[:, :1] if self.along_row else patterns)
        chosen, self.weights = independent(emitted)
        self.codes = len(chosen)
        gap = float(projector.pixel_gap)
        self.has_gap = gap > 0
        self.size = [opaque(n) for n in (optics.width, optics.height)]
        self.half_lit, self.lit_factor = (opaque(n) for n in (0.5 - 0.5 * gap, 1.0 / (1.0 - gap) ** 2))
        self.texture = self._stored(emitted[chosen])

    def _stored(self, codes: NDArray[np.float32]) -> Any:
        """Return codes (C, H, W) as a texture on the device."""
        stack = np.ascontiguousarray(np.moveaxis(codes, 0, -1))
        kind, stack = (mi.Texture1f, stack[0]) if self.along_row else (mi.Texture2f, stack)
        filter_mode = dr.FilterMode.Nearest if self.has_gap else dr.FilterMode.Linear
        return kind(mi.TensorXf(stack), wrap_mode=dr.WrapMode.Clamp, filter_mode=filter_mode)

    def showing(self, patterns: NDArray[np.floating]) -> ProjectedPatterns:
        """Return the same projector with other patterns of the same kind, such as the mask of another device.

        Textures have the same shape, so that the kernels of these patterns serve the others. Raises InputError if the
        patterns do not have the size of the projector.
        """
        plain = self.codes == self.count and not self.along_row
        if not plain or patterns.shape != (self.count, self.projector.optics.height, self.projector.optics.width):
            return ProjectedPatterns(patterns, self.projector)
        other = copy.copy(self)
        other.texture = self._stored(self.projector.emit(patterns))
        return other

    def values(self, uv: Any, length: Any, active: Any) -> list[Any]:
        """Return the relative light of each independent pattern at texture coordinate ``uv``."""
        values = list(self.texture.eval(mi.Array1f(uv.x) if self.along_row else uv, active))
        if self.has_gap:
            across, down = uv.x * self.size[0], uv.y * self.size[1]
            lit = (dr.abs(across - dr.floor(across) - 0.5) < self.half_lit) & (
                dr.abs(down - dr.floor(down) - 0.5) < self.half_lit
            )
            factor = dr.select(lit, self.lit_factor, 0.0)
            values = [value * factor for value in values]
        return values

    def images(self, codes: list[Any]) -> list[Any]:
        """Return the quantity of each pattern from that of the independent ones."""
        terms = [[code * w for code, w in zip(codes, row, strict=True) if w != 0.0] for row in self.weights.tolist()]
        return [reduce(add, row) if row else 0.0 * codes[0] for row in terms]


def independent(patterns: NDArray[np.float32]) -> tuple[list[int], NDArray[np.float64]]:
    """Return the indices of patterns of which all others are sums, and the weights (P, chosen) of the sums.

    The error is at most ``_LOOKUP_ERROR`` of white. QR decomposition of the Gram matrix with column pivoting sorts the
    patterns by their contribution (Golub and Van Loan, Matrix Computations, 4th ed., section 5.4.2).
    """
    count, parts = len(patterns), np.array_split(patterns, -(-patterns.size // _VALUES_AT_ONCE), axis=1)

    def double_parts() -> Iterator[NDArray[np.float64]]:
        return (part.reshape(count, -1).astype(np.float64) for part in parts)

    gram = np.zeros((count, count))
    for part in double_parts():
        gram += part @ part.T
    order = qr(gram, mode="r", pivoting=True)[1]
    for size in range(1, count):
        chosen = sorted(int(index) for index in order[:size])
        weights = np.asarray(np.linalg.lstsq(gram[np.ix_(chosen, chosen)], gram[chosen], rcond=None)[0].T, np.float64)
        # the residual sum of squares follows from the Gram matrix alone
        if (gram.diagonal() - (weights * gram[:, chosen]).sum(axis=1)).max() > _LOOKUP_ERROR**2 * patterns[0].size:
            continue
        weights[chosen] = np.eye(size)
        weights[np.abs(weights) < _NO_WEIGHT] = 0.0
        if all(np.abs(part - weights @ part[chosen]).max(initial=0.0) <= _LOOKUP_ERROR for part in double_parts()):
            return chosen, weights
    return list(range(count)), np.eye(count)


class ModulatedLight:
    """Light whose power is modulated in time, and the correlations that a time-of-flight imager measures.

    Image k is the mean of the received light times the demodulation of the imager, per unit of light:

        c_k = 1 + m_k cos(2 pi f_k L / c - delta_k)

    for continuous-wave modulation of frequency f and reference phase delta (Lange and Seitz, IEEE J. Quantum Electron.
    37, 2001). The contrast m is that of light and pixel together.

    Parameters
    ----------
    projector
        The light source.
    frequencies_hz, phases
        f [Hz] and delta [rad], one for each image.
    contrast
        m [1], one number or one for each image.

    Raises
    ------
    InputError
        If a frequency is not positive, or there is not one phase for each frequency.
    """

    def __init__(self, projector: Projector, frequencies_hz: ArrayLike, phases: ArrayLike, contrast: ArrayLike) -> None:
        frequencies, deltas = np.atleast_1d(np.asarray(frequencies_hz, float)), np.atleast_1d(np.asarray(phases, float))
        if frequencies.shape != deltas.shape or frequencies.ndim != 1 or not np.all(frequencies > 0):
            raise InputError(
                "time of flight",
                "frequencies_hz, phases",
                (frequencies.shape, deltas.shape),
                "one frequency over 0 and one phase for each image",
            )
        self.projector = projector
        self.count = self.codes = len(frequencies)
        contrasts = np.broadcast_to(np.asarray(contrast, float), frequencies.shape)
        self.contrasts = [opaque(m) for m in contrasts]
        self.turns_per_mm = [opaque(f / LIGHT_MM_S) for f in frequencies]
        self.deltas = [opaque(d) for d in deltas]

    def values(self, uv: Any, length: Any, active: Any) -> list[Any]:
        """Return the relative correlation of each image for light of optical length ``length`` [mm]."""
        out = []
        for turns, delta, contrast in zip(self.turns_per_mm, self.deltas, self.contrasts, strict=True):
            phase = length * turns
            phase -= dr.floor(phase)  # without whole turns, for single precision
            out.append(1.0 + contrast * dr.cos(2.0 * dr.pi * phase - delta))
        return out

    def images(self, codes: list[Any]) -> list[Any]:
        """Return the codes: each image has its own."""
        return codes
