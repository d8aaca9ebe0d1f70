"""From a projector coordinate to the depth on a pixel's own view ray, exactly for distorted lenses on both sides.

Signal chain: raw pixel -> its view ray -> projector coordinate u of points along the ray -> polynomial w(u), w = 1/Z
the inverse depth, for each pixel.

On one view ray u is a smooth function of the inverse depth w = 1/Z; for pinholes (a + b w) / (c + d w), nearly
straight for nearly parallel axes. It is computed exactly, with the distortion of both lenses, at a few w between near
and far (Chebyshev points of the part that is within reach of the projector), once for a rig; w(u) is then the
polynomial through them, Newton's with divided differences, so that decoding needs no iteration. How many points it
takes is found by trying: between them it is to be right within :data:`EXACT_PX`, and must be within :data:`WORST_PX`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from characterisation.errors import InputError, nearest
from characterisation.point_cloud import ViewGrid
from mitsim.sensor.camera import Camera, Rig
from mitsim.sensor.image_role import Axis
from mitsim.sensor.light_code import LightCode, axes

Floats = NDArray[np.float64]

#: how far the polynomial w(u) may be from the exact projection [projector px]
EXACT_PX = 1e-5

#: how far it may be at the very worst, with all points that are tried [projector px]: a tenth of good phase noise
WORST_PX = 1e-3

#: numbers of points of the polynomial that are tried
_POINTS = (6, 8, 10, 13, 16)

#: rays beyond the projector's edge that still count as within its reach, as a share of its field
_REACH = 0.03

#: a view ray along which the coordinate changes less than this from near to far [projector px] tells no depth
LEAST_CHANGE_PX = 0.5


@dataclass(frozen=True)
class StructuredLightGeometry:
    """All that decoding needs of a camera and a projector, computed once.

    ``axis`` of the coordinate; ``near``, ``far`` [mm] depths along the camera's axis; ``ray`` (H, W, 3) of each raw
    pixel in the sensor frame, as long as its depth is 1; ``nodes`` (K, H, W) coordinates u_k [projector px] and
    ``differences`` (K, H, W) divided differences of w(u) [1/mm/px^k], both ends of the range among the nodes; ``seen``
    (H, W): the projector reaches the ray between near and far.
    """

    camera_name: str
    camera: Camera
    projector: Camera
    axis: Axis
    near: float
    far: float
    ray: Floats
    nodes: Floats
    differences: Floats
    seen: NDArray[np.bool_]
    grid: ViewGrid
    baseline: Floats


def structured_light_geometry(
    rig: Rig, camera: str, code: LightCode, near_mm: float, far_mm: float
) -> StructuredLightGeometry:
    """Prepare one camera of a rig and its projector for a code.

    A code with both axes is triangulated along the one in which projector and camera lie farther apart.

    Raises
    ------
    InputError
        If there is no such camera or no projector, the code's coordinate does not change with depth anywhere, or it
        changes so unevenly that no polynomial follows it.
    """
    if camera not in rig.cameras:
        hint = nearest(camera, list(rig.cameras))
        raise InputError("rig", "cameras", repr(camera), ", ".join(rig.cameras), hint)
    if rig.projector is None:
        raise InputError("rig", "projector", "none", "a calibrated projector, for structured light of one camera")
    eye, projector = rig.cameras[camera], rig.projector
    apart = projector.sensor_from_camera.inverse().directions(eye.centre - projector.centre)
    both = axes(code)
    axis = both[0] if len(both) == 1 or abs(apart[0]) >= abs(apart[1]) else both[1]
    component = 0 if axis == "columns" else 1

    rays = eye.rays(eye.pixel_grid())
    with np.errstate(divide="ignore", invalid="ignore"):
        local = rays / rays[..., 2:]
    ray = eye.sensor_from_camera.directions(local)
    low, high = _reach(eye, projector, ray, near_mm, far_mm)
    seen = (high > low) & np.isfinite(local).all(axis=-1)
    low, high = np.where(seen, low, 1 / far_mm), np.where(seen, high, 1 / near_mm)

    def coordinate(inverse_depth: Floats, rays: Floats) -> Floats:
        return _projected(projector, eye.centre + rays / inverse_depth[..., None], component)

    # every seventh pixel each way tells how many points the polynomial needs
    some = np.s_[::7, ::7]
    for count in _POINTS:
        nodes, differences = _polynomial(coordinate, ray[some], low[some], high[some], count)
        change = np.diff(nodes, axis=0)
        told = seen[some] & _monotonic(change)
        between = low[some] + (high - low)[some] * np.linspace(0.02, 0.98, 2 * count + 1)[:, None, None]
        wanted = np.stack([coordinate(w, ray[some]) for w in between])
        found, slope = zip(*(evaluate(nodes, differences, u) for u in wanted), strict=True)
        with np.errstate(divide="ignore", invalid="ignore"):
            error = np.abs((np.stack(found) - between) / np.stack(slope))[:, told]
        worst = float(error.max(initial=0.0))
        if worst < EXACT_PX:
            break
    if worst > WORST_PX:
        raise InputError(
            "rig",
            "projector",
            f"a coordinate along view rays that {count} points describe to {worst:.2g} px only",
            f"{WORST_PX:g} px",
            "shorten the range near_mm to far_mm, or mend the distortion of the projector",
        )
    nodes, differences = _polynomial(coordinate, ray, low, high, count)
    change = np.diff(nodes, axis=0)
    seen &= _monotonic(change) & (np.abs(change.sum(axis=0)) > LEAST_CHANGE_PX)
    if not seen.any():
        raise InputError(
            "pattern",
            "axis",
            repr(axis),
            "an axis along which the coordinate changes with depth",
            f"no pixel of {camera} sees it change by {LEAST_CHANGE_PX:g} px from {near_mm:g} to {far_mm:g} mm: "
            "the code runs across the baseline, or the projector lights nothing there",
        )
    baseline = projector.centre - eye.centre
    return StructuredLightGeometry(
        camera,
        eye,
        projector,
        axis,
        near_mm,
        far_mm,
        ray,
        nodes,
        differences,
        seen,
        camera_grid(eye, local),
        baseline / np.linalg.norm(baseline),
    )


def camera_grid(camera: Camera, local: Floats | None = None) -> ViewGrid:
    """The grid of a camera's raw pixels; ``local`` (H, W, 3) are its rays in its own frame, if they are known."""
    place, K = camera.sensor_from_camera, camera.matrix
    pinhole = ViewGrid(
        float(K[0, 0]),
        float(K[1, 1]),
        float(K[0, 2]),
        float(K[1, 2]),
        camera.width,
        camera.height,
        place.rotation,
        place.translation,
    )
    if camera.model == "perspective" and not camera.distortion.any():
        return pinhole
    if local is None:
        local = camera.rays(camera.pixel_grid())
    return replace(pinhole, normalised=(local[..., :2] / local[..., 2:]).astype(np.float32))


def _reach(eye: Camera, projector: Camera, ray: Floats, near: float, far: float) -> tuple[Floats, Floats]:
    """Inverse depths (H, W) between which each ray is within range and within reach of the projector's field.

    A point at inverse depth w is proportional to ray + w (eye - projector); each side of the field, as a plane through
    the projector's centre, is an inequality linear in w.
    """
    columns = np.concatenate([np.linspace(-0.5, projector.width - 0.5, 33)] * 2 + [np.full(33, -0.5)] * 2)
    columns[-33:] = projector.width - 0.5
    rows = np.concatenate([np.full(33, -0.5)] * 2 + [np.linspace(-0.5, projector.height - 0.5, 33)] * 2)
    rows[33:66] = projector.height - 0.5
    edge = projector.rays(np.stack([columns, rows], axis=-1))
    edge = edge[:, :2] / edge[:, 2:]
    slack = _REACH * (edge.max(axis=0) - edge.min(axis=0))
    least, most = edge.min(axis=0) - slack, edge.max(axis=0) + slack

    to_projector = projector.sensor_from_camera.inverse()
    direction, start = to_projector.directions(ray), to_projector.points(eye.centre)
    low, high = (np.full(ray.shape[:2], 1 / depth) for depth in (far, near))
    for side, bound, component in ((1, least[0], 0), (-1, most[0], 0), (1, least[1], 1), (-1, most[1], 1)):
        constant = side * (direction[..., component] - bound * direction[..., 2])
        slope = side * (start[component] - bound * start[2])
        if slope > 0:
            low = np.maximum(low, -constant / slope)
        elif slope < 0:
            high = np.minimum(high, -constant / slope)
        else:
            high = np.where(constant >= 0, high, -np.inf)
    return low, high


def _projected(projector: Camera, points: Floats, component: int) -> Floats:
    """One coordinate (...) of the projections of points (..., 3): 0 the column, 1 the row [projector px]."""
    if projector.model == "perspective" and not projector.distortion.any():
        # OpenCV takes a microsecond for each point even then
        local = projector.sensor_from_camera.inverse().points(points)
        depth = np.where(local[..., 2] > 0, local[..., 2], np.nan)
        return np.asarray(
            projector.matrix[component, component] * (local[..., component] / depth) + projector.matrix[component, 2]
        )
    return projector.project(points)[..., component]


def _polynomial(
    coordinate: Callable[[Floats, Floats], Floats], ray: Floats, low: Floats, high: Floats, count: int
) -> tuple[Floats, Floats]:
    """Newton's polynomial w(u) through ``count`` exact points of each ray: its nodes and divided differences."""
    place = (1 - np.cos(np.pi * np.arange(count) / (count - 1))) / 2  # Chebyshev-Lobatto: both ends are among them
    differences = low + (high - low) * place[:, None, None]
    nodes = np.stack([coordinate(inverse_depth, ray) for inverse_depth in differences])
    with np.errstate(invalid="ignore", divide="ignore"):
        for order in range(1, count):
            differences[order:] = (differences[order:] - differences[order - 1 : -1]) / (
                nodes[order:] - nodes[: count - order]
            )
    return nodes, differences


def evaluate(nodes: Floats, differences: Floats, u: Floats) -> tuple[Floats, Floats]:
    """w(u) and dw/du by Horner's scheme; nodes and differences (K, ...), u (...)."""
    value, slope = differences[-1].copy(), np.zeros_like(u)
    for node, difference in zip(nodes[-2::-1], differences[-2::-1], strict=True):
        step = u - node
        slope *= step
        slope += value
        value *= step
        value += difference
    return value, slope


def _monotonic(change: Floats) -> NDArray[np.bool_]:
    """Where all steps (K - 1, H, W) have the same sign."""
    return np.asarray((change > 0).all(axis=0) | (change < 0).all(axis=0))
