"""What a point averages: the coordinate that a second eye has of the surface, over the footprint of a pixel or a block.

Signal chain: pixel -> rays through the nodes of its footprint -> surface, the light that it sends back of each part of
the projector's aperture -> where the second eye sees it -> mean, weighed by the light -> depth along the pixel's own
ray that has this mean.

Only the shape that the pixel itself shows is averaged, in single precision; a shape has as many footprints as pixels
asked for.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mitsim.scene.backend import dr, mi
from mitsim.scene.eye import shadow_ray
from mitsim.scene.load import Scene
from mitsim.scene.raycast import PixelRays
from mitsim.sensor.frames import Transform


@dataclass(frozen=True)
class SecondEye:
    """A coordinate that triangulates, in the sensor frame: ``along``.(P - ``centre``) / ``ahead``.(P - ``centre``).

    ``matched`` to the same coordinate of the rays' own origin: it is the difference of the two, a disparity, that a
    footprint averages; else the footprint stands still and the coordinate alone is averaged, as of a projected code.
    """

    centre: NDArray[np.float64]
    along: NDArray[np.float64]
    ahead: NDArray[np.float64]
    matched: bool

    def tangent(self, points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The coordinate (n,) of points (n, 3), and their depth (n,) [mm] before this eye."""
        place = points - self.centre
        depth = place @ self.ahead
        return (place @ self.along) / depth, depth

    def reach(
        self, coordinate: NDArray[np.float64], origin: NDArray[np.float64], ray: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """How far (n,) [mm] from their ``origin`` (n, 3) rays (n, 3) meet the plane of points with a ``coordinate``."""
        normal = self.along - coordinate[:, None] * self.ahead
        return np.asarray((normal * (self.centre - origin)).sum(-1) / (normal * ray).sum(-1))


@dataclass(frozen=True)
class FootprintLamp:
    """Where the light comes from, in the sensor frame: the middle of an aperture, ``centre`` (3,) [mm].

    Where the projector is not in ``focus`` [mm], light from a part of the aperture that lies aside along the second
    eye's coordinate carries another coordinate, tan + aside (1 / ``focus`` - 1 / Z), Z being the depth before that eye.
    """

    centre: NDArray[np.float64]
    focus: float = math.inf


class FootprintRays:
    """Rays of pixels, and by how much they turn from pixel to pixel, laid on the device once.

    ``rays`` of the grid, whose neighbours are ``step`` pixels of the sensor apart.
    """

    def __init__(self, rays: PixelRays, directions: NDArray[np.floating], step: int) -> None:
        self.rays = rays
        turns = np.gradient(np.asarray(directions, float), axis=(1, 0))
        self.turns = [mi.Vector3f((turn / step).astype(np.float32).reshape(-1, 3).T) for turn in turns]


def footprint_displacement(
    scene: Scene, footprint: FootprintRays, world_from_sensor: Transform, pixel: NDArray[np.integer],
    nodes: NDArray[np.floating], width: NDArray[np.floating], lamp: FootprintLamp, second: SecondEye, power: float,
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:  # fmt: skip
    """By how much points lie too far along their rays (n,) [mm], for a footprint is averaged; NaN where there is none.

    And where some node, but not every one, has no light, (n,).

    Parameters
    ----------
    pixel
        (n,) flat indices into the grid.
    nodes
        (k, 4) of a quadrature: column and row, for a footprint of unit standard deviation, how far aside in the
        aperture [mm], weight.
    width
        (n,) standard deviation of the footprint at each pixel [px].
    lamp
        Where the light comes from.
    power
        Of the light in the weight: 1 where light is added, 2 where a contrast's square is.
    """
    frame = footprint.rays.frame(world_from_sensor)
    centre, own = _point(world_from_sensor.points(second.centre)), frame.position
    along, ahead = (frame.turn(_point(v)) for v in (second.along, second.ahead))

    number = np.asarray(pixel, np.uint32)
    ray = dr.gather(mi.Vector3f, footprint.rays.directions, mi.UInt32(number))
    middle = _meet(scene, own, frame.turn(ray))
    coordinate, depth = _tangent(middle.p - centre, along, ahead)
    slope = (dr.dot(along, frame.turn(ray)) - coordinate * dr.dot(ahead, frame.turn(ray))) / depth
    home, _ = _tangent(middle.p - own, along, ahead)
    identity = dr.select(middle.is_valid(), dr.reinterpret_array(mi.UInt32, middle.shape), 0)
    dr.eval(coordinate, slope, home, identity)

    # one element for every pixel and node: a loop over them would trace as many kernels into one
    columns, rows, asides, weights = np.asarray(nodes, float).T
    shape = (len(number), len(weights))

    def laid_out(values: NDArray[Any], kind: type[np.generic]) -> NDArray[Any]:
        return np.broadcast_to(values, shape).ravel().astype(kind)

    which = mi.UInt32(laid_out(np.arange(len(number))[:, None], np.uint32))
    at = mi.UInt32(laid_out(number[:, None], np.uint32))
    ray = dr.gather(mi.Vector3f, footprint.rays.directions, at)
    for turn, offset in zip(footprint.turns, (columns, rows), strict=True):
        away = mi.Float(laid_out(width[:, None] * offset, np.float32))
        ray += dr.gather(mi.Vector3f, turn, at) * away
    met = _meet(scene, own, frame.turn(dr.normalize(ray)))
    same = met.is_valid() & (dr.reinterpret_array(mi.UInt32, met.shape) == dr.gather(mi.UInt32, identity, which))
    shifted, depth = _tangent(met.p - centre, along, ahead)
    shifted -= dr.gather(mi.Float, coordinate, which)
    if second.matched:
        shifted -= _tangent(met.p - own, along, ahead)[0] - dr.gather(mi.Float, home, which)
    aside = mi.Float(laid_out(asides, np.float32))
    shifted += aside * (1 / lamp.focus - 1 / depth)
    light = _lit(scene, met, _point(world_from_sensor.points(lamp.centre)) + along * aside, same)
    dr.eval(light, shifted)

    share = np.asarray(light, float).reshape(shape)
    lit = share > 0
    share = np.where(lit, share**power, 0.0) * weights
    total = share.sum(1)
    mean = np.where(lit, share * np.asarray(shifted, float).reshape(shape), 0.0).sum(1)
    with np.errstate(invalid="ignore", divide="ignore"):
        moved = np.where((np.asarray(identity) > 0) & (total > 0), mean / total / np.asarray(slope, float), np.nan)
    return moved, np.asarray(lit.any(1) & ~lit.all(1))


def _tangent(place: Any, along: Any, ahead: Any) -> tuple[Any, Any]:
    """Coordinate of a place from an eye, and its depth before it [mm]."""
    depth = dr.dot(ahead, place)
    return dr.dot(along, place) / depth, depth


def _meet(scene: Scene, origin: Any, direction: Any) -> Any:
    return scene.mitsuba.ray_intersect(mi.Ray3f(origin, direction))


def _lit(scene: Scene, surface: Any, source: Any, active: Any) -> Any:
    """Light of a point source that a surface sends back along the ray that met it, up to a common factor."""
    toward = source - surface.p
    length = dr.norm(toward)
    toward = toward / length
    bsdf = surface.bsdf()
    value = bsdf.eval(mi.BSDFContext(), surface, surface.to_local(toward), active)[0] / length**2
    lit = active & (value > 0)
    return dr.select(lit & ~scene.mitsuba.ray_test(shadow_ray(surface, toward, length), lit), value, 0)


def _point(values: NDArray[np.floating]) -> Any:
    return mi.Vector3f(*[dr.opaque(mi.Float, float(v)) for v in values])
