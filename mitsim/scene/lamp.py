"""The projector as light: what of it reaches a surface, and what code that light carries.

Signal chain: surface point -> a place in the projector's aperture, if nothing is in between -> ideal image point in
the plane of focus -> distortion -> projector coordinate (u, v) and irradiance -> value of every image's code.

A code is a function of (u, v), for patterns (:class:`LitPatterns`), or of the optical length L from the projector by
way of the scene to the camera, for a time-of-flight sensor (:class:`ModulatedLight`). Both are evaluated on the same
paths by the same loop.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsim.errors import InputError
from mitsim.scene.backend import dr, mi
from mitsim.scene.eye import Eye, shadow_ray
from mitsim.sensor.camera import Camera
from mitsim.sensor.frames import Transform
from mitsim.sensor.projector import Projector

#: speed of light [mm/s]
LIGHT_MM_S = 299792458e3

#: light is sent this far beyond the image's border, in shares of the farthest corner's ideal radius; beyond it a
#: distortion polynomial may fold back into the image
_BEYOND = 1.02


class Light(Protocol):
    """A projector and the codes of all images of a capture."""

    projector: Projector
    count: int

    def values(self, uv: Any, length: Any, active: Any) -> list[Any]:
        """Relative light of each image at texture place ``uv`` and optical length ``length`` [mm]."""


class LitPatterns:
    """Patterns laid on the device: (P, H, W) values 0..1 relative to white.

    Between the middles of projector pixels the light is interpolated; with a pixel gap every pixel is a square with
    dark lines around it, as bright as keeps the flux.
    """

    def __init__(self, patterns: NDArray[np.floating], projector: Projector) -> None:
        optics = projector.optics
        if patterns.ndim != 3 or patterns.shape[1:] != (optics.height, optics.width):
            raise InputError("patterns", "shape", patterns.shape, f"(P, {optics.height}, {optics.width})")
        self.count = patterns.shape[0]
        self.projector = projector
        stack = np.empty((optics.height, optics.width, self.count), np.float32)
        for index, pattern in enumerate(patterns):
            stack[..., index] = projector.emit(pattern)
        pixels = dr.FilterMode.Nearest if projector.pixel_gap > 0 else dr.FilterMode.Linear
        self.texture = mi.Texture2f(mi.TensorXf(stack), wrap_mode=dr.WrapMode.Clamp, filter_mode=pixels)

    def values(self, uv: Any, length: Any, active: Any) -> list[Any]:
        """Relative light of each pattern at texture place ``uv``."""
        gap = float(self.projector.pixel_gap)
        values = list(self.texture.eval(uv, active))
        if gap > 0:
            optics = self.projector.optics
            across, down = uv.x * optics.width, uv.y * optics.height
            edge = 0.5 * gap
            lit = (
                (dr.abs(across - dr.floor(across) - 0.5) < 0.5 - edge)
                & (dr.abs(down - dr.floor(down) - 0.5) < 0.5 - edge)
            )  # fmt: skip
            factor = dr.select(lit, 1.0 / (1.0 - gap) ** 2, 0.0)
            values = [value * factor for value in values]
        return values


class ModulatedLight:
    """Light whose power is modulated in time, and the correlations that a time-of-flight imager takes.

    Image k is the mean of the arriving light times the imager's demodulation, 1 + m cos(2 pi f_k L / c - delta_k):
    for continuous-wave modulation with frequency f, contrast m (of light and pixel together) and reference phase
    delta (Lange & Seitz, IEEE J. Quantum Electron. 37, 2001).
    """

    def __init__(self, projector: Projector, frequencies_hz: ArrayLike, phases: ArrayLike, contrast: float) -> None:
        frequencies, deltas = np.atleast_1d(np.asarray(frequencies_hz, float)), np.atleast_1d(np.asarray(phases, float))
        if frequencies.shape != deltas.shape or frequencies.ndim != 1 or not np.all(frequencies > 0):
            raise InputError("time of flight", "frequencies_hz, phases", (frequencies.shape, deltas.shape),
                             "one frequency over 0 and one phase for each image")  # fmt: skip
        self.projector = projector
        self.count = len(frequencies)
        self.contrast = dr.opaque(mi.Float, contrast)
        self.turns_per_mm = [dr.opaque(mi.Float, float(f / LIGHT_MM_S)) for f in frequencies]
        self.deltas = [dr.opaque(mi.Float, float(d)) for d in deltas]

    def values(self, uv: Any, length: Any, active: Any) -> list[Any]:
        """Relative correlation of each image for light of optical length ``length`` [mm]."""
        out = []
        for turns, delta in zip(self.turns_per_mm, self.deltas, strict=True):
            phase = length * turns
            phase -= dr.floor(phase)  # whole turns off first: single precision
            out.append(1.0 + self.contrast * dr.cos(2.0 * dr.pi * phase - delta))
        return out


class Lamp(Eye):
    """A projector at a pose, seen from a surface."""

    def __init__(self, world_from_sensor: Transform, projector: Projector) -> None:
        optics = projector.optics
        super().__init__(world_from_sensor @ optics.sensor_from_camera)
        self.size = (optics.width, optics.height)
        self.bend = _Distortion(optics)
        self.irradiance = dr.opaque(mi.Float, projector.plane_irradiance)
        self.radius = float(0.5 * projector.aperture_mm)
        self.inverse_focus = float(1.0 / projector.focus_mm)
        self.reach = _ideal_radius(optics) * _BEYOND
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
        sent = in_front & (dr.square(x) + dr.square(y) < self.reach**2)
        u, v = self.bend.pixel(x, y)
        inside = sent & (u > -0.5) & (u < self.size[0] - 0.5) & (v > -0.5) & (v < self.size[1] - 0.5)
        facing = inside & (dr.dot(surface.n, toward) * dr.dot(surface.n, -ray_direction) > 0)
        blocked = scene.ray_test(shadow_ray(surface, toward, distance), facing)
        cosine = z / distance
        arriving = self.irradiance / (dr.square(cosine) * cosine * dr.square(distance))
        if self.vignetting > 0:
            off = (dr.square(u - self.principal[0]) + dr.square(v - self.principal[1])) / self.farthest**2
            arriving /= dr.square(1.0 + self.vignetting * off)
        uv = mi.Point2f((u + 0.5) / self.size[0], (v + 0.5) / self.size[1])
        return toward, dr.select(facing & ~blocked, arriving, 0.0), uv, distance


class _Distortion:
    """OpenCV's forward camera model on the device: ideal image point -> pixel.

    Rational radial k1..k6, tangential p1 p2, thin prism s1..s4, tilt tx ty (OpenCV, calib3d), or the fisheye model
    (Kannala & Brandt 2006).
    """

    def __init__(self, optics: Camera) -> None:
        k = optics.matrix
        self.focal = (float(k[0, 0]), float(k[1, 1]))
        self.principal = (float(k[0, 2]), float(k[1, 2]))
        self.fisheye = optics.model == "fisheye"
        self.coefficients = np.concatenate([optics.distortion, np.zeros(14)])[:14].tolist()
        self.tilt = _tilt(*self.coefficients[12:])

    def pixel(self, x: Any, y: Any) -> tuple[Any, Any]:
        """Pixel (column, row) of the ideal image point (x, y)."""
        if self.fisheye:
            x, y = self._fisheye(x, y)
        elif any(self.coefficients):
            x, y = self._perspective(x, y)
        return self.focal[0] * x + self.principal[0], self.focal[1] * y + self.principal[1]

    def _fisheye(self, x: Any, y: Any) -> tuple[Any, Any]:
        k1, k2, k3, k4 = self.coefficients[:4]
        radius = dr.sqrt(x * x + y * y)
        theta = dr.atan(radius)
        t2 = theta * theta
        scale = dr.select(
            radius > 1e-6, theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))) / dr.maximum(radius, 1e-6), 1.0
        )
        return x * scale, y * scale

    def _perspective(self, x: Any, y: Any) -> tuple[Any, Any]:
        k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4, *_ = self.coefficients
        r2 = x * x + y * y
        radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
        x, y = (
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + r2 * (s1 + r2 * s2),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y + r2 * (s3 + r2 * s4),
        )
        if self.tilt is not None:
            t = self.tilt
            w = t[2][0] * x + t[2][1] * y + t[2][2]
            x, y = (t[0][0] * x + t[0][1] * y + t[0][2]) / w, (t[1][0] * x + t[1][1] * y + t[1][2]) / w
        return x, y


def _tilt(tx: float, ty: float) -> list[list[float]] | None:
    """Homography of an imager tilted by ``tx``, ``ty`` [rad] about x and y (OpenCV's tauX, tauY)."""
    if tx == 0 and ty == 0:
        return None
    about_x = np.array([[1, 0, 0], [0, np.cos(tx), np.sin(tx)], [0, -np.sin(tx), np.cos(tx)]])
    about_y = np.array([[np.cos(ty), 0, -np.sin(ty)], [0, 1, 0], [np.sin(ty), 0, np.cos(ty)]])
    R = about_y @ about_x
    project = np.array([[R[2, 2], 0, -R[0, 2]], [0, R[2, 2], -R[1, 2]], [0, 0, 1]])
    return [[float(value) for value in row] for row in project @ R]


def _ideal_radius(optics: Camera) -> float:
    """Largest ideal image radius on the border of an image."""
    columns, rows = np.linspace(-0.5, optics.width - 0.5, 65), np.linspace(-0.5, optics.height - 0.5, 65)
    border = np.concatenate([
        np.stack([columns, np.full(65, -0.5)], 1), np.stack([columns, np.full(65, optics.height - 0.5)], 1),
        np.stack([np.full(65, -0.5), rows], 1), np.stack([np.full(65, optics.width - 0.5), rows], 1),
    ])  # fmt: skip
    rays = optics.rays(border)
    return float(np.max(np.hypot(rays[:, 0], rays[:, 1]) / rays[:, 2]))
