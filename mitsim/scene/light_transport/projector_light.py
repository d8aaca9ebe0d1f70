"""Compute the light of the projector on a surface, and the code that it carries.

Signal chain: surface point -> position in the projector's aperture, if nothing blocks it -> ideal image point in the
plane of focus -> distortion (:mod:`mitsim.scene.ray_casting.distortion`) -> projector coordinate (u, v) and irradiance
-> value of the code of each image.

The code of patterns is a function of (u, v): :class:`ProjectedPatterns`. The code of a time-of-flight sensor is a
function of L, the optical length from the projector over the scene to the camera: :class:`ModulatedLight`. The same
loop evaluates both on the same paths. The radiometry is that of :mod:`mitsim.sensor.projector`.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator, Sequence
from functools import reduce
from operator import add
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import qr

from characterisation.files.errors import InputError
from mitsim.scene.backend import dr, mi
from mitsim.scene.device import opaque
from mitsim.scene.ray_casting.distortion import Distortion
from mitsim.scene.ray_casting.eye import Eye, of_lane, shadow_ray
from mitsim.sensor.modulation import LIGHT_MM_S
from mitsim.sensor.projector import Projector
from mitsim.sensor.transforms import Transform

#: largest error of a pattern that is a sum of others, relative to white: a few roundings in single precision
_LOOKUP_ERROR = 5e-7

#: weights of such sums below this are rounding errors
_NO_WEIGHT = 1e-10

#: number of values of patterns that are converted to double precision at once
_VALUES_AT_ONCE = 1 << 22

#: margin on each side of the rectangle that photons pass through, as a share of the size of the projector's image
_MARGIN = 2e-3


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

        Textures have the same shape, so that the kernels of these patterns serve the others.

        Raises
        ------
        InputError
            If the patterns do not have the size of the projector.
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


class ProjectorLight(Eye):
    """A projector at a pose, seen from a surface, or at several: then ``lane`` is the number of each lane's pose.

    ``bounds`` (2, 3) [mm] of the scene, world frame; photons are emitted only toward them.
    """

    def __init__(
        self,
        world_from_sensor: Transform | Sequence[Transform],
        projector: Projector,
        bounds: NDArray[np.floating] | None = None,
        lane: Any = None,
    ) -> None:
        optics = projector.optics
        poses = [world_from_sensor] if isinstance(world_from_sensor, Transform) else world_from_sensor
        frames = [pose @ optics.sensor_from_camera for pose in poses]
        super().__init__(frames, lane)
        # numbers of a projector are no literals of the kernel: a fit that varies one would compile a kernel for each
        # value, and a comparison of sensors one for each sensor
        self.per_size = [opaque(1.0 / n) for n in (optics.width, optics.height)]
        self.distortion = Distortion(optics)
        self.has_stretch = projector.is_stretched
        self.irradiance = opaque(projector.plane_irradiance)
        self.has_aperture = projector.aperture_mm > 0
        self.radius = opaque(0.5 * projector.aperture_mm)
        self.radius_over_focus = opaque(0.5 * projector.aperture_mm / projector.focus_mm)
        rectangles = np.array([_photon_rectangle(self.distortion, projector, frame, bounds) for frame in frames])
        low, high = rectangles[:, 0], rectangles[:, 1]
        self.extents = [(of_lane(a, lane), of_lane(b - a, lane)) for a, b in zip(low.T, high.T, strict=True)]
        self.area = of_lane(np.prod(high - low, axis=1), lane)
        self.has_corner_loss = projector.corner_illumination < 1
        self.corner_loss = opaque(float(projector.corner_illumination) ** -0.5 - 1.0)
        cx, cy = optics.matrix[0, 2], optics.matrix[1, 2]
        self.principal = [opaque(c) for c in (cx, cy)]
        farthest = np.hypot(max(cx, optics.width - 1 - cx), max(cy, optics.height - 1 - cy))
        self.per_farthest_squared = opaque(farthest**-2)

    def light(
        self, scene: Any, surface: Any, ray_direction: Any, lens: Any, shift: Any, active: Any
    ) -> tuple[Any, Any, Any, Any]:
        """Return the light that arrives at a surface from one position in the aperture.

        Parameters
        ----------
        scene
            Mitsuba scene whose shapes can block the light; None if nothing can.
        surface, ray_direction
            Surface interaction, and unit direction of the ray that met it, world frame.
        lens
            Position in the unit disc of the aperture.
        shift
            Displacement [mm], world frame, of the point at which the code is evaluated; None for none. Speckle causes
            it.
        active
            Mask of the lanes.

        Returns
        -------
        toward
            Unit direction to the projector, world frame.
        arriving
            Radiant intensity / distance^2 [W/mm^2], 0 in shadow.
        uv
            Texture coordinate.
        distance
            Distance to the position in the aperture [mm].

        See Also
        --------
        emit_photon : a photon of the same light
        """
        position = self.position
        if self.has_aperture:
            position = position + self.axes[0] * (lens.x * self.radius) + self.axes[1] * (lens.y * self.radius)
        to_projector = position - surface.p
        distance = dr.norm(to_projector)
        toward = to_projector / distance
        local = self.to_local(-to_projector)
        in_front = active & (local.z > 0)
        z = dr.select(in_front, local.z, 1.0)
        code_point = local if shift is None else local + self.to_local(shift)
        x, y = code_point.x / z, code_point.y / z
        if self.has_aperture:  # the point where the ray crosses the plane of focus, as seen from the centre of the lens
            x += lens.x * self.radius_over_focus
            y += lens.y * self.radius_over_focus
        u, v, inside = self.distortion.image(x, y, in_front)
        facing = inside & (dr.dot(surface.n, toward) * dr.dot(surface.n, -ray_direction) > 0)
        if scene is not None:
            facing &= ~scene.ray_test(shadow_ray(surface, toward, distance), facing)
        cosine = z / distance
        arriving = self.irradiance / (dr.square(cosine) * cosine * dr.square(distance))
        if self.has_stretch:
            arriving *= self.distortion.stretch(x, y)
        if self.has_corner_loss:
            arriving *= self._corner_loss(u, v)
        return toward, dr.select(facing, arriving, 0.0), self._texture(u, v), distance

    def emit_photon(self, position: Any, lens: Any) -> tuple[Any, Any, Any, Any]:
        """Return the ray of a photon from one position in the image and one in the aperture.

        Parameters
        ----------
        position
            Position in the unit square, which is mapped to the rectangle in the ideal image plane that photons pass
            through.
        lens
            Position in the unit disc of the aperture.

        Returns
        -------
        origin, direction
            Ray in the world frame [mm, unit].
        flux
            Radiant intensity over the density of directions [W]; 0 outside the image.
        uv
            Texture coordinate.
        """
        x, y = (low + p * extent for p, (low, extent) in zip((position.x, position.y), self.extents, strict=True))
        u, v, inside = self.distortion.image(x, y, True)
        flux = self.irradiance * self.area
        if self.has_stretch:
            flux *= self.distortion.stretch(x, y)
        if self.has_corner_loss:
            flux *= self._corner_loss(u, v)
        local, origin = mi.Vector3f(x, y, 1.0), self.position
        if self.has_aperture:
            origin = origin + self.axes[0] * (lens.x * self.radius) + self.axes[1] * (lens.y * self.radius)
            local -= mi.Vector3f(lens.x, lens.y, 0.0) * self.radius_over_focus
        return origin, self.to_world(dr.normalize(local)), dr.select(inside, flux, 0.0), self._texture(u, v)

    def density(self, toward: Any, distance: Any) -> Any:
        """Return the density of the photons of :meth:`emit_photon` on a surface across their direction [1/mm^2].

        One photon represents the area A cos^3(theta) d^2, where A is the area of the rectangle in the plane z = 1.
        """
        cosine = dr.maximum(-dr.dot(self.axes[2], toward), 1e-6)
        return 1.0 / (self.area * dr.square(cosine) * cosine * dr.square(distance))

    def _corner_loss(self, u: Any, v: Any) -> Any:
        off = (dr.square(u - self.principal[0]) + dr.square(v - self.principal[1])) * self.per_farthest_squared
        return 1.0 / dr.square(1.0 + self.corner_loss * off)

    def _texture(self, u: Any, v: Any) -> Any:
        return mi.Point2f((u + 0.5) * self.per_size[0], (v + 0.5) * self.per_size[1])


def _photon_rectangle(
    distortion: Distortion, projector: Projector, world_from_projector: Transform, bounds: NDArray[np.floating] | None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the rectangle (low, high) in the ideal image plane that photons pass through.

    It contains the image, or the scene if that is smaller.
    """
    low, high = distortion.border.min(axis=0), distortion.border.max(axis=0)
    margin = _MARGIN * (high - low)  # the border is computed at 65 points per side and is curved between them
    low, high = low - margin, high + margin
    if bounds is None:
        return low, high
    corners = np.stack(np.meshgrid(*bounds.T, indexing="ij"), axis=-1).reshape(8, 3)
    local = world_from_projector.inverse().points(corners)
    if local[:, 2].min() <= 0:
        return low, high
    # out of focus, a point has another image from each position in the aperture
    blur = 0.5 * projector.aperture_mm * np.abs(1.0 / projector.focus_mm - 1.0 / local[:, 2:])
    projected = local[:, :2] / local[:, 2:]
    near, far = np.min(projected - blur, axis=0) - margin, np.max(projected + blur, axis=0) + margin
    # a scene outside the image receives no light, but the rectangle must not be empty
    inner_low, inner_high = np.clip(near, low, high), np.clip(far, low, high)
    return inner_low, np.maximum(inner_high, inner_low + margin)
