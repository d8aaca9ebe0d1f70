"""Compute the light of the projector on a surface, and the code that it carries.

Signal chain: surface point -> position in the projector's aperture, if nothing blocks it -> ideal image point in the
plane of focus -> distortion (:mod:`mitsim.scene.ray_casting.distortion`) -> projector coordinate (u, v) and irradiance
-> value of the code of each image.

The codes are those of :mod:`mitsim.scene.light_transport.projected_codes`. The radiometry is that of
:mod:`mitsim.sensor.projector`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mitsim.scene.backend import dr, mi
from mitsim.scene.device import opaque
from mitsim.scene.ray_casting.distortion import Distortion
from mitsim.scene.ray_casting.eye import Eye, of_lane, shadow_ray
from mitsim.sensor.projector import Projector
from mitsim.sensor.transforms import Transform

#: margin on each side of the rectangle that photons pass through, as a share of the size of the projector's image
_MARGIN = 2e-3


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

        Returns ``toward``: unit direction to the projector, world frame; ``arriving``: radiant intensity / distance^2
        [W/mm^2], 0 in shadow; ``uv``: texture coordinate; ``distance``: distance to the position in the aperture [mm].

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

        ``position``: position in the unit square, which is mapped to the rectangle in the ideal image plane that
        photons pass through. ``lens``: position in the unit disc of the aperture. Returns ``origin``, ``direction``:
        ray in the world frame [mm, unit]; ``flux``: radiant intensity over the density of directions [W]; 0 outside the
        image; ``uv``: texture coordinate.
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
    """Return the rectangle (low, high) in the ideal image plane of the image, or of the scene if that is smaller."""
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
