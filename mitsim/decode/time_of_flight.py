"""Time of flight: correlations at several frequencies to an organised point cloud.

Signal chain: images [DN] -> phase and amplitude at every frequency
(:func:`mitsim.decode.structured_light.phase_shift.fit_phases`) -> one optical path L for all of them -> distance on the
pixel's own view ray -> points in the sensor frame [mm], and the noise along the ray to expect.

A phase phi_i = 2 pi f_i L / c is known up to whole turns. All numbers n of turns of the highest frequency a within
the unambiguous path c / gcd(f) are tried. With r_i = f_i / f_a, y a shift of L in turns of a, and weights w_i the
inverse variances of the phases, the number with the least

    J(n) = min over y of   sum_i w_i e_i^2,      e_i = r_i (phi_a / 2 pi + n + y) - phi_i / 2 pi, less whole turns

is the most likely one, and L = (c / f_a) (phi_a / 2 pi + n + y) the estimate of least variance. (A search of all
hypotheses, ranked by the weighted disagreement of the frequencies: Jaremo Lawin, Forssen & Ovren, ECCV 2016, section
3, recalled, who then look at neighbouring pixels as well; here each pixel stands for itself.) J is a chi-square of
F - 1 degrees of freedom, which tells phases that contradict one another.

The path camera - point - lamp is an ellipsoid with its foci in camera and lamp. On a view ray of unit direction d, with
the lamp at p from the camera,

    L = t + |t d - p|    =>    t = (L^2 - p.p) / (2 (L - d.p))

exactly, lens distortion being in d. sigma_L^2 = sum w_i^2 r_i^2 s_i^2 / (sum w_i r_i^2)^2 (c / f_a)^2, s_i the noise of
phase i in turns, goes to the ray by dt/dL = (L^2 - 2 L d.p + p.p) / (2 (L - d.p)^2).

Every pixel is decoded from its own grey levels, so a region of interest may be decoded alone, up to its very edge.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from math import gcd, lcm

import numpy as np
from numpy.typing import NDArray

from characterisation.errors import InputError
from characterisation.point_cloud import PointCloud, Status, ViewGrid
from mitsim.decode.blocks import in_blocks
from mitsim.decode.grey_levels import check_full_scale
from mitsim.decode.grid_cloud import placed_cloud
from mitsim.decode.image_context import ImageContext
from mitsim.decode.structured_light.geometry import camera_grid
from mitsim.decode.structured_light.phase_shift import fit_phases, refusals
from mitsim.sensor.camera import Camera, Rig
from mitsim.sensor.imager import Imager
from mitsim.sensor.modulation import LIGHT_MM_S, AmplitudeModulation, TimeOfFlightSettings, sample_variance
from mitsim.sensor.roi import checked_roi

#: more turns of the highest frequency than this are not searched: 160 m of optical path at 120 MHz
_MOST_TURNS = 64

#: depths between near and far at which the lamp's reach is looked at
_DEPTHS = 5


@dataclass(frozen=True)
class TimeOfFlightGeometry:
    """All that decoding needs of a camera and its lamp, computed once.

    ``camera`` by ``camera_name``; ``ray`` (H, W, 3) unit view direction of each raw pixel in the sensor frame;
    ``lamp`` (3,) [mm] from the camera's centre, and ``along`` (H, W) [mm] its projection on each ray; ``cosine`` (H, W)
    of the angle between ray and axis; ``seen`` (H, W): the lamp reaches the ray between near and far.
    """

    camera_name: str
    camera: Camera
    ray: NDArray[np.float64]
    lamp: NDArray[np.float64]
    along: NDArray[np.float64]
    cosine: NDArray[np.float64]
    seen: NDArray[np.bool_]
    grid: ViewGrid
    baseline: NDArray[np.float64]


def time_of_flight_geometry(rig: Rig, camera: str, near_mm: float, far_mm: float) -> TimeOfFlightGeometry:
    """Prepare one camera of a rig and the lamp that stands in the place of its projector.

    Raises
    ------
    InputError
        If there is no such camera, or no lamp.
    """
    if camera not in rig.cameras:
        raise InputError("rig", "cameras", repr(camera), ", ".join(rig.cameras))
    if rig.projector is None:
        raise InputError("rig", "projector", "none", "the lamp of the time-of-flight camera")
    eye = rig.cameras[camera]
    local = eye.rays(eye.pixel_grid())
    ray = eye.sensor_from_camera.directions(local)
    lamp = rig.projector.centre - eye.centre
    seen = np.zeros(ray.shape[:2], bool)
    edge = np.array([rig.projector.width, rig.projector.height]) - 0.5
    for inverse in np.linspace(1 / far_mm, 1 / near_mm, _DEPTHS):
        with np.errstate(invalid="ignore", divide="ignore"):
            place = rig.projector.project(eye.centre + ray / (local[..., 2:] * inverse))
            seen |= ((place >= -0.5) & (place <= edge)).all(axis=-1)
    apart = np.linalg.norm(lamp)
    baseline = lamp / apart if apart > 0 else np.array([1.0, 0.0, 0.0])
    return TimeOfFlightGeometry(
        camera, eye, ray, lamp, ray @ lamp, local[..., 2], seen, camera_grid(eye, local), baseline
    )


def unambiguous_path(code: AmplitudeModulation) -> float:
    """Optical path [mm] up to which phases tell one path from another.

    c / gcd(f), after which all frequencies are back at the same phases, or what is searched, if that is less.
    """
    return _turns(code) * LIGHT_MM_S / float(code.frequencies_hz[-1])


def decode_time_of_flight(
    stack: NDArray[np.generic],
    geometry: TimeOfFlightGeometry,
    code: AmplitudeModulation,
    settings: TimeOfFlightSettings,
    context: ImageContext,
) -> PointCloud:
    """Decode the images of one capture.

    Parameters
    ----------
    stack
        (P, H, W) differences of the taps [DN], all delays of the lowest frequency first.
    context
        Of the images; its ``roi`` is one of the image, ``read_out`` is not used. Without an imager (noise
        that was measured is none) ``sigma`` is None, and phases are compared with quantisation and ``systematic_rad``
        alone.

    Returns
    -------
    PointCloud
        On the camera's own pixels. ``LOW_MODULATION``: too little amplitude at one frequency at least, by darkness or
        shadow, or because near and far light in one pixel cancel; ``PHASE_INCONSISTENT``: no path fits all phases;
        ``OUT_OF_RANGE``: the path does, but its depth is not between near and far.

    Raises
    ------
    InputError
        If the stack is not what the code says, the range is longer than the code can tell, or the region of interest
        does not lie in the images.
    """
    eye, full_scale = geometry.camera, context.full_scale
    imager = context.imager if isinstance(context.imager, Imager) else None
    if stack.shape != (code.count, eye.height, eye.width):
        raise InputError(
            f"images of {geometry.camera_name}", "shape", stack.shape, f"({code.count}, {eye.height}, {eye.width})"
        )
    check_full_scale(stack, full_scale)
    most = _longest_path(geometry, settings.far_mm)
    if most >= unambiguous_path(code):
        raise InputError(
            "decoder settings",
            "far_mm",
            f"{settings.far_mm:g} mm, an optical path of {most:.0f} mm",
            f"paths under {unambiguous_path(code):.0f} mm",
            "the frequencies repeat after that: take others",
        )
    roi = checked_roi(context.roi, eye.width, eye.height, "decode_time_of_flight")
    part = roi.slices
    stack = np.ascontiguousarray(stack[:, *part])
    phases = fit_phases(stack, [code.delays] * len(code.frequencies_mhz))
    noise = np.empty_like(phases.phase)
    for each, amplitude, contrast in zip(noise, phases.modulation, code.contrasts, strict=True):
        variance = sample_variance(amplitude, float(contrast), imager)
        each[:] = variance * np.float32(2 / code.steps) / np.maximum(amplitude, np.float32(1e-3)) ** 2
    path, sigma_path, chi_square = joint_path(phases.phase, noise, code, settings.systematic_rad)
    points, sigma, in_range = _points(path, sigma_path, geometry, settings, part)
    faint = phases.modulation.min(axis=0) < settings.minimum_amplitude_dn * full_scale / 255
    status = refusals(stack.max(axis=0) >= full_scale, faint, chi_square > settings.consistency_sigma**2)
    status[(status == Status.VALID) & ~in_range] = Status.OUT_OF_RANGE
    status[(status == Status.LOW_MODULATION) & ~geometry.seen[part]] = Status.NO_SURFACE
    missing = status != Status.VALID
    points[missing], sigma[missing] = np.nan, np.nan
    told = None if imager is None else sigma
    return placed_cloud(points, status, told, roi, geometry, context.sensor, context.source)


def joint_path(
    phase: NDArray[np.float32], variance: NDArray[np.float32], code: AmplitudeModulation, systematic_rad: float
) -> tuple[NDArray[np.float64], NDArray[np.float32], NDArray[np.float32]]:
    """The optical path that fits the phases of all frequencies.

    Parameters
    ----------
    phase, variance
        (F, H, W) phases [rad] and their variances by noise [rad^2].
    systematic_rad
        Standard deviation added to every phase for what is not noise.

    Returns
    -------
    path, sigma, chi_square
        (H, W) path L [mm], 0 to the unambiguous one; its standard deviation by noise [mm]; J of the best hypothesis.
    """
    turns = _turns(code)
    ratio = (code.frequencies_hz / code.frequencies_hz[-1]).astype(np.float32)
    shape, count = phase.shape[1:], len(phase)
    flat, spread = phase.reshape(count, -1), variance.reshape(count, -1)
    path = np.empty(flat.shape[1])
    sigma, best = np.empty((2, flat.shape[1]), np.float32)
    per_turn = np.float32(1 / (2 * np.pi))

    def join(blocks: list[slice]) -> None:
        for block in blocks:
            a = flat[:, block] * per_turn
            noise = spread[:, block] * per_turn**2
            weight = np.asarray(1 / (noise + np.float32((systematic_rad / (2 * np.pi)) ** 2 + 1e-12)), np.float32)
            base = ratio[:, None] * a[-1] - a
            pull = weight * ratio[:, None]
            total = ratio @ pull
            number, least = _most_likely(base, weight, pull, total, code, turns)
            error = base + ratio[:, None] * number
            error -= np.rint(error)
            shift = -np.einsum("ij,ij->j", pull, error) / total
            best[block] = least
            path[block] = (a[-1].astype(np.float64) + number + shift) * (LIGHT_MM_S / code.frequencies_hz[-1])
            spread_of = np.sqrt(np.einsum("ij,ij,ij->j", pull, pull, noise)) / total
            sigma[block] = spread_of * np.float32(LIGHT_MM_S / code.frequencies_hz[-1])

    in_blocks(join, flat.shape[1])
    return path.reshape(shape), sigma.reshape(shape), best.reshape(shape)


def _most_likely(
    base: NDArray[np.float32],
    weight: NDArray[np.float32],
    pull: NDArray[np.float32],
    total: NDArray[np.float32],
    code: AmplitudeModulation,
    turns: int,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Whole turns of the highest frequency with the least J, and that J, of a block of pixels (n,)."""
    number, least = np.zeros(base.shape[1], np.float32), np.full(base.shape[1], np.inf, np.float32)
    error, moved, term = np.empty_like(least), np.empty_like(least), np.empty_like(least)
    cost, lever = np.empty_like(least), np.empty_like(least)
    for n in range(turns):
        cost[:], lever[:] = 0, 0
        for index in range(len(base) - 1):  # of the highest frequency itself there is no error before the shift
            whole = code.frequencies_mhz[index] / code.frequencies_mhz[-1] * n
            np.add(base[index], np.float32(whole - np.rint(whole)), out=moved)
            np.rint(moved, out=error)
            np.subtract(moved, error, out=error)
            np.multiply(pull[index], error, out=term)
            lever += term
            np.multiply(weight[index], error, out=term)
            term *= error
            cost += term
        lever *= lever
        lever /= total
        cost -= lever
        better = cost < least
        np.copyto(least, cost, where=better)
        np.copyto(number, np.float32(n), where=better)
    return number, least


def _points(
    path: NDArray[np.float64],
    sigma_path: NDArray[np.float32],
    geometry: TimeOfFlightGeometry,
    settings: TimeOfFlightSettings,
    part: tuple[slice, slice],
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]:
    """Points (h, w, 3) and their noise (h, w) along the ray [mm], and whether they lie within range, of a part."""
    along = geometry.along[part]
    apart = float(geometry.lamp @ geometry.lamp)
    path = np.where(path * path > apart, path, np.nan)  # no way by a point is shorter than from camera to lamp
    lever = path - along
    distance = (path * path - apart) / (2 * lever)
    slope = (lever * lever + apart - along**2) / (2 * lever * lever)
    depth = distance * geometry.cosine[part]
    in_range = (depth >= settings.near_mm) & (depth <= settings.far_mm)
    points = (geometry.camera.centre + geometry.ray[part] * distance[..., None]).astype(np.float32)
    return points, np.asarray(slope * sigma_path, np.float32), np.asarray(in_range)


def _longest_path(geometry: TimeOfFlightGeometry, far_mm: float) -> float:
    """Longest optical path [mm] to a depth of ``far_mm`` within the image."""
    distance = far_mm / geometry.cosine
    back = np.sqrt(np.maximum(distance**2 - 2 * distance * geometry.along + geometry.lamp @ geometry.lamp, 0))
    return float((distance + back).max())


def _turns(code: AmplitudeModulation) -> int:
    """Turns of the highest frequency after which all are at the same phases again; frequencies to a thousandth MHz."""
    exact = [Fraction(f).limit_denominator(1000) for f in code.frequencies_mhz]
    below = lcm(*(f.denominator for f in exact))
    common = Fraction(gcd(*(int(f * below) for f in exact)), below)
    return min(round(exact[-1] / common), _MOST_TURNS)
