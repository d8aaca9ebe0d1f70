"""What a point averages: the coordinate that a second eye has of the surface, over the footprint of a pixel or a block.

Signal chain: pixel -> rays through the nodes of its footprint -> surface, the light that it sends back of each part of
the projector's aperture -> where the second eye sees it -> mean, weighed by the light -> depth along the pixel's own
ray that has this mean.

Only the shape that the pixel itself shows is averaged, in single precision; a shape has as many footprints as pixels
asked for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mitsim.scene.backend import dr, mi
from mitsim.scene.eye import Eye, shadow_ray
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


@dataclass(frozen=True)
class LampNodes:
    """A quadrature of a lamp's aperture along the axis of a projected code, in the sensor frame.

    ``places`` (m, 3) [mm]; ``weights`` (m,); ``aside`` (m,) [mm] of the aperture's middle. Where the projector is not
    in focus, light from aside carries another coordinate, tan + ``aside`` (1 / ``focus`` - 1 / Z), Z being the depth
    before the second eye.
    """

    places: NDArray[np.float64]
    weights: NDArray[np.float64]
    aside: NDArray[np.float64]
    focus: float


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
    nodes: Sequence[tuple[float, float, float]], width: NDArray[np.floating], lamp: LampNodes, second: SecondEye,
    power: float,
) -> NDArray[np.float64]:  # fmt: skip
    """By how much points lie too far along their rays (n,) [mm], for a footprint is averaged; NaN where there is none.

    Parameters
    ----------
    pixel
        (n,) flat indices into the grid.
    nodes
        Column, row and weight of a quadrature for a footprint of unit standard deviation.
    width
        (n,) standard deviation of the footprint at each pixel [px].
    lamp
        Where the light comes from.
    power
        Of the light in the weight: 1 where light is added, 2 where a contrast's square is.
    """
    index = mi.UInt32(np.asarray(pixel, np.uint32))
    frame = Eye(Transform(world_from_sensor.rotation, world_from_sensor.points(footprint.rays.origin)))
    sources = [_point(place) for place in world_from_sensor.points(lamp.places)]
    centre, own = _point(world_from_sensor.points(second.centre)), frame.position
    along, ahead = (frame.turn(_point(v)) for v in (second.along, second.ahead))
    ray, *turns = (dr.gather(mi.Vector3f, v, index) for v in (footprint.rays.directions, *footprint.turns))
    sigma = mi.Float(np.asarray(width, np.float32))

    middle = _meet(scene, own, frame.turn(ray))
    place = middle.p - centre
    depth = dr.dot(ahead, place)
    coordinate = dr.dot(along, place) / depth
    direction = frame.turn(ray)
    slope = (dr.dot(along, direction) - coordinate * dr.dot(ahead, direction)) / depth
    total, moved = mi.Float(0), mi.Float(0)
    for column, row, weight in nodes:
        offset = dr.normalize(ray + turns[0] * (column * sigma) + turns[1] * (row * sigma))
        met = _meet(scene, own, frame.turn(offset))
        same = met.is_valid() & (met.shape == middle.shape)
        there = met.p - centre
        apart = dr.dot(ahead, there)
        shifted = dr.dot(along, there) / apart - coordinate
        if second.matched:
            here, home = met.p - own, middle.p - own
            shifted -= dr.dot(along, here) / dr.dot(ahead, here) - dr.dot(along, home) / dr.dot(ahead, home)
        for source, share, aside in zip(sources, lamp.weights, lamp.aside, strict=True):
            light = _lit(scene, met, source, same)
            light = dr.select(light > 0, weight * share * light**power, 0)
            total += light
            moved += dr.select(light > 0, light * (shifted + aside * (1 / lamp.focus - 1 / apart)), 0)
    out = dr.select(middle.is_valid() & (total > 0), moved / total / slope, dr.nan)
    return np.asarray(out, float)


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
