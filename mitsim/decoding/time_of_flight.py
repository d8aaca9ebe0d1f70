"""Decode time-of-flight images: correlations at several frequencies to an organised point cloud.

Signal chain: images [DN] -> phase and amplitude at each frequency
(:func:`mitsim.decoding.structured_light.phase_shift.fit_phases`) -> one optical path L for all frequencies -> distance
on the pixel's view ray -> points in the sensor frame [mm], and their expected noise along the ray.

The phase phi_i = 2 pi f_i L / c is known up to whole turns. Let f_a be the highest of the F frequencies, and n its
whole turns. All n within the unambiguous path c / gcd(f) are tested. The ratios are r_i = f_i / f_a, and the weights
w_i the inverse variances of the phases. For a shift y of L, in turns of f_a, the cost of n is

    J(n) = min over y of   sum_i w_i e_i^2,      e_i = r_i (phi_a / 2 pi + n + y) - phi_i / 2 pi

with each e_i less its nearest whole number of turns. The n with the least cost is the most likely one. The estimate of
least variance is then

    L = (c / f_a) (phi_a / 2 pi + n + y)

J follows a chi-square distribution with F - 1 degrees of freedom. A large J reveals phases that contradict one another.

Source of the search: Jaremo Lawin, Forssen and Ovren, ECCV 2016, section 3, cited from memory. They rank all hypotheses
by the weighted disagreement of the frequencies, and also use neighbouring pixels. Here each pixel is decoded alone.

The points with one path length from the camera over the point to the light source form an ellipsoid. Its foci are the
camera and the light source. On a view ray with unit direction d, and with the light source at p from the camera,

    L = t + |t d - p|    =>    t = (L^2 - p.p) / (2 (L - d.p))

This is exact, since d includes the lens distortion. With s_i the noise of phase i in turns, the noise of the path is

    sigma_L^2 = sum w_i^2 r_i^2 s_i^2 / (sum w_i r_i^2)^2 (c / f_a)^2

and the noise along the ray is sigma_L dt/dL, with dt/dL = (L^2 - 2 L d.p + p.p) / (2 (L - d.p)^2).

Each pixel is decoded alone, so a region of interest has the same points as in the whole image.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from math import gcd, lcm

import numpy as np
from numpy.typing import NDArray

from characterisation.files.errors import InputError
from characterisation.point_cloud import PointCloud, Status, ViewGrid
from characterisation.region_of_interest import checked_roi
from mitsim.decoding.blocks import in_blocks
from mitsim.decoding.grey_levels import check_full_scale
from mitsim.decoding.grid_cloud import cloud_on_grid
from mitsim.decoding.image_context import ImageContext
from mitsim.decoding.structured_light.geometry import camera_grid
from mitsim.decoding.structured_light.phase_shift import fit_phases, rejection_status
from mitsim.sensor.camera import Camera, Rig
from mitsim.sensor.imager import Imager
from mitsim.sensor.modulation import LIGHT_MM_S, AmplitudeModulation, TimeOfFlightSettings, sample_variance

#: largest number of candidate turns of the highest frequency: 160 m of optical path at 120 MHz
_MAXIMUM_TURNS = 64

#: number of depths between near and far at which the field of the light source is tested
_DEPTHS = 5


@dataclass(frozen=True)
class TimeOfFlightGeometry:
    """Geometry of a camera and its light source, computed once."""

    #: ``camera_name``, ``camera``: the camera
    camera_name: str
    camera: Camera
    ray: NDArray[np.float64]  # (H, W, 3) unit view direction of each raw pixel in the sensor frame
    light_source: NDArray[np.float64]  # (3,) position p [mm] relative to the camera's centre, in the sensor frame
    projection: NDArray[np.float64]  # (H, W) [mm] d.p, the projection of p on each ray
    cosine: NDArray[np.float64]  # (H, W) cosine of the angle between ray and camera axis
    seen: NDArray[np.bool_]  # (H, W) whether the light source reaches the ray between near and far
    #: ``grid``, ``baseline``: pixels of the cloud, and unit vector (3,) from the camera to the light source
    grid: ViewGrid
    baseline: NDArray[np.float64]


def time_of_flight_geometry(rig: Rig, near_mm: float, far_mm: float) -> TimeOfFlightGeometry:
    """Prepare the first camera of a rig and its light source, which takes the place of the rig's projector.

    ``near_mm`` and ``far_mm`` are depths along the camera's axis. Raises InputError if the rig has no light source.
    """
    if rig.projector is None:
        raise InputError("rig", "projector", "none", "the light source of the time-of-flight camera")
    camera_name, camera = next(iter(rig.cameras.items()))
    local_ray = camera.rays(camera.pixel_grid())
    ray = camera.sensor_from_camera.directions(local_ray)
    light_source = rig.projector.centre - camera.centre
    seen = np.zeros(ray.shape[:2], bool)
    limit = np.array([rig.projector.width, rig.projector.height]) - 0.5
    for inverse_depth in np.linspace(1 / far_mm, 1 / near_mm, _DEPTHS):
        with np.errstate(invalid="ignore", divide="ignore"):
            position = rig.projector.project(camera.centre + ray / (local_ray[..., 2:] * inverse_depth))
            seen |= ((position >= -0.5) & (position <= limit)).all(axis=-1)
    distance = np.linalg.norm(light_source)
    baseline = light_source / distance if distance > 0 else np.array([1.0, 0.0, 0.0])
    return TimeOfFlightGeometry(
        camera_name,
        camera,
        ray,
        light_source,
        ray @ light_source,
        local_ray[..., 2],
        seen,
        camera_grid(camera, local_ray),
        baseline,
    )


def unambiguous_path(code: AmplitudeModulation) -> float:
    """Return the optical path [mm] that phases determine uniquely: c / gcd(f), at most the search limit."""
    return _candidate_count(code) * LIGHT_MM_S / float(code.frequencies_hz[-1])


def decode_time_of_flight(
    stack: NDArray[np.generic],
    geometry: TimeOfFlightGeometry,
    code: AmplitudeModulation,
    settings: TimeOfFlightSettings,
    context: ImageContext,
) -> PointCloud:
    """Decode the images of one capture to a cloud on the camera's own pixels, sensor frame [mm].

    - ``SATURATED``: an image is at full scale, or at 0 where another is not.
    - ``LOW_MODULATION``: the amplitude at one frequency at least is too small. The surface is dark or in shadow, or
      near and far light in one pixel cancel.
    - ``NO_SURFACE``: the same, where the light source does not reach the ray.
    - ``PHASE_INCONSISTENT``: no path fits all phases.
    - ``OUT_OF_RANGE``: the depth of the path is not between near and far.
    - ``UNCALIBRATED``: the pixel has no ray, since the distortion of the camera folds over before it.

    ``stack``: (P, H, W) differences of the taps [DN], all delays of the lowest frequency first. ``context``: its
    ``roi`` is a region of the image; ``read_out`` is not used. Without an :class:`Imager` ``sigma`` is None, and phases
    are compared by quantisation and ``systematic_rad`` alone: measured noise does not replace it. Raises InputError if
    the stack does not fit the code, the range exceeds the unambiguous path, or the ``roi`` does not lie in the images.
    """
    camera, full_scale = geometry.camera, context.full_scale
    imager = context.imager if isinstance(context.imager, Imager) else None
    if stack.shape != (code.count, camera.height, camera.width):
        raise InputError(
            f"images of {geometry.camera_name}",
            "shape",
            stack.shape,
            f"({code.count}, {camera.height}, {camera.width})",
        )
    check_full_scale(stack, full_scale)
    longest = _longest_path(geometry, settings.far_mm)
    if longest >= unambiguous_path(code):
        raise InputError(
            "decoder settings",
            "far_mm",
            f"{settings.far_mm:g} mm, an optical path of {longest:.0f} mm",
            f"paths under {unambiguous_path(code):.0f} mm",
            "the frequencies repeat after that: choose others",
        )
    roi = checked_roi(context.roi, camera.width, camera.height, "decode_time_of_flight")
    region = roi.slices
    stack = np.ascontiguousarray(stack[:, *region])
    phases = fit_phases(stack, [code.delays] * len(code.frequencies_mhz))
    noise = np.empty_like(phases.phase)
    for phase_variance, amplitude, contrast in zip(noise, phases.modulation, code.contrasts, strict=True):
        variance = sample_variance(amplitude, float(contrast), imager)
        phase_variance[:] = variance * np.float32(2 / code.steps) / np.maximum(amplitude, np.float32(1e-3)) ** 2
    path, sigma_path, chi_square = joint_path(phases.phase, noise, code, settings.systematic_rad)
    points, sigma, in_range = _points(path, sigma_path, geometry, settings, region)
    low_amplitude = phases.modulation.min(axis=0) < settings.minimum_amplitude_dn * full_scale / 255
    most, least = stack.max(axis=0), stack.min(axis=0)
    clipped = (most >= full_scale) | ((least <= 0) & (most > 0))  # a difference can leave the scale at either end
    status = rejection_status(clipped, low_amplitude, chi_square > settings.consistency_sigma**2)
    status[(status == Status.VALID) & ~in_range] = Status.OUT_OF_RANGE
    status[(status == Status.LOW_MODULATION) & ~geometry.seen[region]] = Status.NO_SURFACE
    status[np.isnan(geometry.ray[region]).any(axis=-1)] = Status.UNCALIBRATED
    missing = status != Status.VALID
    points[missing], sigma[missing] = np.nan, np.nan
    cloud_sigma = None if imager is None else sigma
    return cloud_on_grid(points, status, cloud_sigma, roi, geometry, context.sensor, context.source)


def joint_path(
    phase: NDArray[np.float32], variance: NDArray[np.float32], code: AmplitudeModulation, systematic_rad: float
) -> tuple[NDArray[np.float64], NDArray[np.float32], NDArray[np.float32]]:
    """Return the optical path that fits the phases of all frequencies.

    Returns ``path``, ``sigma``: (H, W) optical path L [mm], 0 to the unambiguous one, and its standard deviation by
    noise [mm]; ``chi_square``: (H, W) J of the most likely number of turns.

    Parameters
    ----------
    phase, variance
        (F, H, W) phases [rad] of the frequencies of ``code``, and their variances by noise [rad^2].
    code
        Frequencies of the modulation.
    systematic_rad
        Standard deviation of the systematic phase error [rad], which is added to the noise in the weights.

    See Also
    --------
    unambiguous_path : the range of the path
    """
    candidate_count = _candidate_count(code)
    ratio = (code.frequencies_hz / code.frequencies_hz[-1]).astype(np.float32)
    shape, count = phase.shape[1:], len(phase)
    flat_phase, flat_variance = phase.reshape(count, -1), variance.reshape(count, -1)
    path = np.empty(flat_phase.shape[1])
    sigma, chi_square = np.empty((2, flat_phase.shape[1]), np.float32)
    per_turn = np.float32(1 / (2 * np.pi))

    def estimate(blocks: list[slice]) -> None:
        for block in blocks:
            cycles = flat_phase[:, block] * per_turn
            noise_variance = flat_variance[:, block] * per_turn**2
            weight = np.asarray(
                1 / (noise_variance + np.float32((systematic_rad / (2 * np.pi)) ** 2 + 1e-12)), np.float32
            )
            base = ratio[:, None] * cycles[-1] - cycles
            weighted_ratio = weight * ratio[:, None]
            normaliser = ratio @ weighted_ratio
            turns, least_cost = _most_likely(base, weight, weighted_ratio, normaliser, code, candidate_count)
            error = base + ratio[:, None] * turns
            error -= np.rint(error)
            shift = -np.einsum("ij,ij->j", weighted_ratio, error) / normaliser
            chi_square[block] = least_cost
            path[block] = (cycles[-1].astype(np.float64) + turns + shift) * (LIGHT_MM_S / code.frequencies_hz[-1])
            sigma_turns = np.sqrt(np.einsum("ij,ij,ij->j", weighted_ratio, weighted_ratio, noise_variance)) / normaliser
            sigma[block] = sigma_turns * np.float32(LIGHT_MM_S / code.frequencies_hz[-1])

    in_blocks(estimate, flat_phase.shape[1])
    return path.reshape(shape), sigma.reshape(shape), chi_square.reshape(shape)


def _most_likely(
    base: NDArray[np.float32],
    weight: NDArray[np.float32],
    weighted_ratio: NDArray[np.float32],
    normaliser: NDArray[np.float32],
    code: AmplitudeModulation,
    candidate_count: int,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the turns of the highest frequency with the least J, and this J, for a block of pixels (n,).

    ``base`` (F, n) is e_i at n = 0 and y = 0 [turns]; ``weight`` w_i, ``weighted_ratio`` w_i r_i, both (F, n);
    ``normaliser`` (n,) sum w_i r_i^2.
    """
    turns, least_cost = np.zeros(base.shape[1], np.float32), np.full(base.shape[1], np.inf, np.float32)
    error, shifted, term = np.empty_like(least_cost), np.empty_like(least_cost), np.empty_like(least_cost)
    cost, gradient = np.empty_like(least_cost), np.empty_like(least_cost)
    for n in range(candidate_count):
        cost[:], gradient[:] = 0, 0
        for index in range(len(base) - 1):  # before the shift, the error of the highest frequency is 0
            advance = code.frequencies_mhz[index] / code.frequencies_mhz[-1] * n
            np.add(base[index], np.float32(advance - np.rint(advance)), out=shifted)
            np.rint(shifted, out=error)
            np.subtract(shifted, error, out=error)
            np.multiply(weighted_ratio[index], error, out=term)
            gradient += term
            np.multiply(weight[index], error, out=term)
            term *= error
            cost += term
        gradient *= gradient
        gradient /= normaliser
        cost -= gradient
        better = cost < least_cost
        np.copyto(least_cost, cost, where=better)
        np.copyto(turns, np.float32(n), where=better)
    return turns, least_cost


def _points(
    path: NDArray[np.float64],
    sigma_path: NDArray[np.float32],
    geometry: TimeOfFlightGeometry,
    settings: TimeOfFlightSettings,
    region: tuple[slice, slice],
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]:
    """Return points (h, w, 3) and noise along the ray (h, w) [mm] of a region, and whether they are in range (h, w)."""
    projection = geometry.projection[region]
    baseline_squared = float(geometry.light_source @ geometry.light_source)
    path = np.where(path * path > baseline_squared, path, np.nan)  # no path over a point is shorter than the baseline
    difference = path - projection
    distance = (path * path - baseline_squared) / (2 * difference)
    slope = (difference * difference + baseline_squared - projection**2) / (2 * difference * difference)
    depth = distance * geometry.cosine[region]
    in_range = (depth >= settings.near_mm) & (depth <= settings.far_mm)
    points = (geometry.camera.centre + geometry.ray[region] * distance[..., None]).astype(np.float32)
    return points, np.asarray(slope * sigma_path, np.float32), np.asarray(in_range)


def _longest_path(geometry: TimeOfFlightGeometry, far_mm: float) -> float:
    """Return the longest optical path [mm] to a depth of ``far_mm`` within the image."""
    distance = far_mm / geometry.cosine
    from_source = np.sqrt(
        np.maximum(distance**2 - 2 * distance * geometry.projection + geometry.light_source @ geometry.light_source, 0)
    )
    return float(np.nanmax(distance + from_source))  # NaN: a pixel whose ray no lens has


def _candidate_count(code: AmplitudeModulation) -> int:
    """Return the number of turns of the highest frequency after which all phases repeat; frequencies to 1e-3 MHz."""
    frequencies = [Fraction(f).limit_denominator(1000) for f in code.frequencies_mhz]
    denominator = lcm(*(f.denominator for f in frequencies))
    common_frequency = Fraction(gcd(*(int(f * denominator) for f in frequencies)), denominator)
    return min(round(frequencies[-1] / common_frequency), _MAXIMUM_TURNS)
