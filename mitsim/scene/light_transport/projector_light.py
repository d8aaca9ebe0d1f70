"""The projector as light: what of it reaches a surface, and what code that light carries.

Signal chain: surface point -> a place in the projector's aperture, if nothing is in between -> ideal image point in
the plane of focus -> distortion (:mod:`mitsim.scene.ray_casting.distortion`) -> projector coordinate (u, v) and
irradiance -> value of every image's code.

A code is a function of (u, v), for patterns (:class:`LitPatterns`), or of the optical length L from the projector by
way of the scene to the camera, for a time-of-flight sensor (:class:`ModulatedLight`). Both are evaluated on the same
paths by the same loop.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import reduce
from operator import add
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import qr

from mitsim.errors import InputError
from mitsim.scene.backend import dr, mi
from mitsim.scene.ray_casting.distortion import Distortion
from mitsim.scene.ray_casting.eye import Eye, shadow_ray
from mitsim.sensor.modulation import LIGHT_MM_S
from mitsim.sensor.projector import Projector
from mitsim.sensor.transforms import Transform

#: largest error of a pattern that is summed of others, relative to white: a few roundings in single precision
_LOOKUP_ERROR = 5e-7

#: weights of such sums under this are roundings
_NO_WEIGHT = 1e-10

#: values of patterns that are taken to double precision at once
_VALUES_AT_ONCE = 1 << 22

#: share of its size by which the rectangle that photons are sent through exceeds the projector's image on every side
_MARGIN = 2e-3


class Light(Protocol):
    """A projector and the codes of all images of a capture.

    ``count`` images are weighted sums of ``codes`` codes, which are as many or fewer.
    """

    projector: Projector
    count: int
    codes: int

    def values(self, uv: Any, length: Any, active: Any) -> list[Any]:
        """Relative light of each code at texture place ``uv`` and optical length ``length`` [mm]."""

    def images(self, codes: list[Any]) -> list[Any]:
        """What each image has of something of which ``codes`` says what each code has; numbers or arrays."""


class LitPatterns:
    """Patterns laid on the device: (P, H, W) values 0..1 relative to white.

    Between the middles of projector pixels the light is interpolated; with a pixel gap every pixel is a square with
    dark lines around it, as bright as keeps the flux.

    Only patterns that are no sums of others are looked up: of the steps of a sinusoid there are three. Patterns that
    are the same in every row are looked up along the row.
    """

    def __init__(self, patterns: NDArray[np.floating], projector: Projector) -> None:
        optics = projector.optics
        if patterns.ndim != 3 or patterns.shape[1:] != (optics.height, optics.width):
            raise InputError("patterns", "shape", patterns.shape, f"(P, {optics.height}, {optics.width})")
        self.count = patterns.shape[0]
        self.projector = projector
        self.along_row = bool((patterns == patterns[:, :1]).all())
        sent = projector.emit(patterns[:, :1] if self.along_row else patterns)
        chosen, self.weights = independent(sent)
        self.codes = len(chosen)
        stack = np.ascontiguousarray(np.moveaxis(sent[chosen], 0, -1))
        kind, stack = (mi.Texture1f, stack[0]) if self.along_row else (mi.Texture2f, stack)
        pixels = dr.FilterMode.Nearest if projector.pixel_gap > 0 else dr.FilterMode.Linear
        self.texture = kind(mi.TensorXf(stack), wrap_mode=dr.WrapMode.Clamp, filter_mode=pixels)

    def values(self, uv: Any, length: Any, active: Any) -> list[Any]:
        """Relative light of each independent pattern at texture place ``uv``."""
        gap = float(self.projector.pixel_gap)
        values = list(self.texture.eval(mi.Array1f(uv.x) if self.along_row else uv, active))
        if gap > 0:
            optics = self.projector.optics
            across, down = uv.x * optics.width, uv.y * optics.height
            edge = 0.5 * gap
            lit = (dr.abs(across - dr.floor(across) - 0.5) < 0.5 - edge) & (
                dr.abs(down - dr.floor(down) - 0.5) < 0.5 - edge
            )
            factor = dr.select(lit, 1.0 / (1.0 - gap) ** 2, 0.0)
            values = [value * factor for value in values]
        return values

    def images(self, codes: list[Any]) -> list[Any]:
        """Every pattern's share of something, from that of the independent ones."""
        terms = [[code * w for code, w in zip(codes, row, strict=True) if w != 0.0] for row in self.weights.tolist()]
        return [reduce(add, row) if row else 0.0 * codes[0] for row in terms]


def independent(patterns: NDArray[np.float32]) -> tuple[list[int], NDArray[np.float64]]:
    """Patterns of which all others are sums, and the weights (P, chosen) of the sums.

    The error is at most ``_LOOKUP_ERROR`` of white. QR decomposition with column pivoting of the Gram matrix (Golub &
    Van Loan, Matrix Computations, 4th ed., section 5.4.2) says in which order patterns add the most.
    """
    count, parts = len(patterns), np.array_split(patterns, -(-patterns.size // _VALUES_AT_ONCE), axis=1)

    def precise() -> Iterator[NDArray[np.float64]]:
        return (part.reshape(count, -1).astype(np.float64) for part in parts)

    gram = np.zeros((count, count))
    for part in precise():
        gram += part @ part.T
    order = qr(gram, mode="r", pivoting=True)[1]
    for size in range(1, count):
        chosen = sorted(int(index) for index in order[:size])
        weights = np.asarray(np.linalg.lstsq(gram[np.ix_(chosen, chosen)], gram[chosen], rcond=None)[0].T, np.float64)
        # the mean square of what is left, without a look at the patterns
        if (gram.diagonal() - (weights * gram[:, chosen]).sum(axis=1)).max() > _LOOKUP_ERROR**2 * patterns[0].size:
            continue
        weights[chosen] = np.eye(size)
        weights[np.abs(weights) < _NO_WEIGHT] = 0.0
        if all(np.abs(part - weights @ part[chosen]).max(initial=0.0) <= _LOOKUP_ERROR for part in precise()):
            return chosen, weights
    return list(range(count)), np.eye(count)


class ModulatedLight:
    """Light whose power is modulated in time, and the correlations that a time-of-flight imager takes.

    Image k is the mean of the arriving light times the imager's demodulation, 1 + m_k cos(2 pi f_k L / c - delta_k):
    for continuous-wave modulation with frequency f, contrast m (of light and pixel together; one number, or one for
    each image) and reference phase delta (Lange & Seitz, IEEE J. Quantum Electron. 37, 2001).
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
        self.contrasts = [dr.opaque(mi.Float, float(m)) for m in contrasts]
        self.turns_per_mm = [dr.opaque(mi.Float, float(f / LIGHT_MM_S)) for f in frequencies]
        self.deltas = [dr.opaque(mi.Float, float(d)) for d in deltas]

    def values(self, uv: Any, length: Any, active: Any) -> list[Any]:
        """Relative correlation of each image for light of optical length ``length`` [mm]."""
        out = []
        for turns, delta, contrast in zip(self.turns_per_mm, self.deltas, self.contrasts, strict=True):
            phase = length * turns
            phase -= dr.floor(phase)  # whole turns off first: single precision
            out.append(1.0 + contrast * dr.cos(2.0 * dr.pi * phase - delta))
        return out

    def images(self, codes: list[Any]) -> list[Any]:
        """Every image is a code of its own."""
        return codes


class ProjectorLight(Eye):
    """A projector at a pose, seen from a surface.

    ``bounds`` (2, 3) [mm] of the scene, in the world: photons are sent there alone.
    """

    def __init__(
        self, world_from_sensor: Transform, projector: Projector, bounds: NDArray[np.floating] | None = None
    ) -> None:
        optics = projector.optics
        super().__init__(world_from_sensor @ optics.sensor_from_camera)
        self.size = (optics.width, optics.height)
        self.bend = Distortion(optics)
        self.irradiance = dr.opaque(mi.Float, projector.plane_irradiance)
        self.radius = float(0.5 * projector.aperture_mm)
        self.inverse_focus = float(1.0 / projector.focus_mm)
        world_from_lamp = world_from_sensor @ optics.sensor_from_camera
        low, high = _beam(self.bend, projector, world_from_lamp, bounds)
        self.bounds = [
            (dr.opaque(mi.Float, float(a)), dr.opaque(mi.Float, float(b - a))) for a, b in zip(low, high, strict=True)
        ]
        self.area = dr.opaque(mi.Float, float(np.prod(high - low)))
        self.vignetting = float(projector.corner_illumination) ** -0.5 - 1.0
        cx, cy = optics.matrix[0, 2], optics.matrix[1, 2]
        self.principal = (float(cx), float(cy))
        self.farthest = float(np.hypot(max(cx, optics.width - 1 - cx), max(cy, optics.height - 1 - cy)))

    def light(
        self, scene: Any, surface: Any, ray_direction: Any, lens: Any, shift: Any, active: Any
    ) -> tuple[Any, Any, Any, Any]:
        """Light that arrives at a surface by way of one place of the aperture.

        Parameters
        ----------
        scene
            That may stand in between; None where nothing can.
        lens
            Place in the unit disc of the aperture.
        shift
            Displacement [mm], world, at which the code is read, or None: speckle moves it.

        Returns
        -------
        toward, arriving, uv, distance
            Unit direction to the lamp; radiant intensity / r^2 [W/mm^2], 0 in shadow; texture place; [mm].
        """
        position = self.position
        if self.radius > 0:
            position = position + self.axes[0] * (lens.x * self.radius) + self.axes[1] * (lens.y * self.radius)
        to_lamp = position - surface.p
        distance = dr.norm(to_lamp)
        toward = to_lamp / distance
        local = self.local(-to_lamp)
        in_front = active & (local.z > 0)
        z = dr.select(in_front, local.z, 1.0)
        read = local if shift is None else local + self.local(shift)
        x, y = read.x / z, read.y / z
        if self.radius > 0:  # where the ray from the lens crosses the plane of focus, as seen from the lens's middle
            x += lens.x * (self.radius * self.inverse_focus)
            y += lens.y * (self.radius * self.inverse_focus)
        u, v, inside = self.bend.image(x, y, in_front)
        facing = inside & (dr.dot(surface.n, toward) * dr.dot(surface.n, -ray_direction) > 0)
        if scene is not None:
            facing &= ~scene.ray_test(shadow_ray(surface, toward, distance), facing)
        cosine = z / distance
        arriving = self.irradiance / (dr.square(cosine) * cosine * dr.square(distance))
        if self.vignetting > 0:
            arriving *= self._corner_loss(u, v)
        return toward, dr.select(facing, arriving, 0.0), self._texture(u, v), distance

    def send(self, place: Any, lens: Any) -> tuple[Any, Any, Any, Any]:
        """A photon: one place in the image and one in the aperture make a ray.

        Parameters
        ----------
        place
            In the unit square, which is laid over the rectangle that photons go through in the ideal image plane.
        lens
            Place in the unit disc of the aperture.

        Returns
        -------
        origin, direction, flux, uv
            Ray in the world; radiant intensity over the density of directions [W], 0 beside the image; texture place.
        """
        x, y = (low + p * extent for p, (low, extent) in zip((place.x, place.y), self.bounds, strict=True))
        u, v, inside = self.bend.image(x, y, True)
        flux = self.irradiance * self.area
        if self.vignetting > 0:
            flux *= self._corner_loss(u, v)
        local, origin = mi.Vector3f(x, y, 1.0), self.position
        if self.radius > 0:
            origin = origin + self.axes[0] * (lens.x * self.radius) + self.axes[1] * (lens.y * self.radius)
            local -= mi.Vector3f(lens.x, lens.y, 0.0) * (self.radius * self.inverse_focus)
        return origin, self.turn(dr.normalize(local)), dr.select(inside, flux, 0.0), self._texture(u, v)

    def density(self, toward: Any, distance: Any) -> Any:
        """Photons of :meth:`send` on a surface across their way, per area and photon [1/mm^2].

        A cos^3(theta) d^2 is the area that one photon stands for, if A is that of the rectangle in the plane z = 1.
        """
        cosine = dr.maximum(-dr.dot(self.axes[2], toward), 1e-6)
        return 1.0 / (self.area * dr.square(cosine) * cosine * dr.square(distance))

    def _corner_loss(self, u: Any, v: Any) -> Any:
        off = (dr.square(u - self.principal[0]) + dr.square(v - self.principal[1])) / self.farthest**2
        return 1.0 / dr.square(1.0 + self.vignetting * off)

    def _texture(self, u: Any, v: Any) -> Any:
        return mi.Point2f((u + 0.5) / self.size[0], (v + 0.5) / self.size[1])


def _beam(
    bend: Distortion, projector: Projector, world_from_lamp: Transform, bounds: NDArray[np.floating] | None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rectangle (low, high) in the ideal image plane that holds the image, or the scene if that is less."""
    low, high = bend.border.min(axis=0), bend.border.max(axis=0)
    margin = _MARGIN * (high - low)  # the border is known at 65 points a side, and bends between them
    low, high = low - margin, high + margin
    if bounds is None:
        return low, high
    corners = np.stack(np.meshgrid(*bounds.T, indexing="ij"), axis=-1).reshape(8, 3)
    local = world_from_lamp.inverse().points(corners)
    if local[:, 2].min() <= 0:
        return low, high
    # from another place of the aperture the same point lies elsewhere in the image, unless it is in focus
    blur = 0.5 * projector.aperture_mm * np.abs(1.0 / projector.focus_mm - 1.0 / local[:, 2:])
    seen = local[:, :2] / local[:, 2:]
    near, far = np.min(seen - blur, axis=0) - margin, np.max(seen + blur, axis=0) + margin
    # a scene beside the image is lit by nothing, but the rectangle must not be empty
    inner_low, inner_high = np.clip(near, low, high), np.clip(far, low, high)
    return inner_low, np.maximum(inner_high, inner_low + margin)
