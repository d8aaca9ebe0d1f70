"""Compute the acceptance figures of VDI/VDE 2634-2: flatness measurement error, probing error, sphere-spacing error.

Signal chain: points of a calibrated plane, sphere or pair of spheres -> rejection of a few per mille of the worst
points -> least-squares surface, with equal weights -> range of the deviations, error of the size or of the distance.

These are tests of one artefact in one place, with *ranges*: the largest deviation minus the smallest. A range grows
with the number of points, for Gaussian noise as about 2 sigma sqrt(2 ln n). It is comparable only with a range over as
many points. The guideline requires tests at many places in the measuring volume, and compares the worst with the
maker's limit; this is left to the caller.

Reliability of the definitions:

- *Confirmed*: sphere spacing is the measured minus the calibrated distance of the centres (wenglor's glossary quotes
  the guideline).
- *Assumed*, as the guideline itself was not available: PF is the range of the radial deviations about the least-squares
  sphere of free radius. PS is its diameter minus the calibrated one. The flatness measurement error is the range of the
  distances from the least-squares plane. A few per mille of the points may be rejected.

The figures are neither standard deviations nor uncertainties. They do not apply to surfaces that scatter poorly: the
guideline, like ISO 10360-13, is about cooperative ones.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import least_squares

from characterisation.files.arrays import Floats
from characterisation.files.errors import InputError

#: share of the points, those farthest from the surface, that may be rejected; *assumed*
REJECTED_SHARE = 0.003


#: least root mean square distance of points from their plane, over their extent; 0.0063 for a cap of 5 deg half angle
LEAST_BULGE = 0.006


@dataclass(frozen=True)
class ProbingError:
    """Errors of a sphere: ``form`` PF and ``size`` PS (measured minus calibrated) [mm], ``centre`` (3,) [mm]."""

    form: float
    size: float
    centre: Floats


def flatness_error(points: ArrayLike, rejected_share: float = REJECTED_SHARE) -> float:
    """Return the flatness measurement error of VDI/VDE 2634-2 [mm].

    It is the range of the signed distances of ``points`` (n, 3) [mm] of a calibrated plane from the least-squares
    plane; rows with NaN are ignored. A ``rejected_share`` of the points, 0..0.1, may be rejected; the plane is fitted
    again without them. Its uncertainty: :func:`characterisation.acceptance.range_uncertainty.flatness_uncertainty`.
    Raises InputError if there are fewer than 4 points, or the share is out of range.
    """
    points = _usable("flatness_error", points, 4, rejected_share)
    kept = _nearest(plane_distances(points), rejected_share)
    return float(np.ptp(plane_distances(points[kept])))


def probing_error(
    points: ArrayLike, calibrated_diameter: float, rejected_share: float = REJECTED_SHARE
) -> ProbingError:
    """Return the probing errors of VDI/VDE 2634-2: form PF and size PS of a sphere of free radius.

    ``points`` (n, 3) [mm] are of the sphere; rows with NaN are ignored. A ``rejected_share`` of them, 0..0.1, may be
    rejected; the sphere is fitted again without them. ``calibrated_diameter`` in mm. The uncertainty of the form:
    :func:`characterisation.acceptance.range_uncertainty.form_error_uncertainty`. Raises InputError if there are fewer
    than 5 points, they do not curve enough for a sphere, or an argument is out of range.
    """
    if not calibrated_diameter > 0:
        raise InputError("probing_error", "calibrated_diameter", calibrated_diameter, "a positive length in mm")
    points = _usable("probing_error", points, 5, rejected_share)
    centre, radius = _sphere(points)
    kept = _nearest(np.linalg.norm(points - centre, axis=1) - radius, rejected_share)
    centre, radius = _sphere(points[kept])
    form = float(np.ptp(np.linalg.norm(points[kept] - centre, axis=1)))
    return ProbingError(form, 2.0 * radius - calibrated_diameter, centre)


def sphere_spacing_error(first: ArrayLike, second: ArrayLike, calibrated_distance: float) -> float:
    """Return the sphere-spacing error SD of VDI/VDE 2634-2 [mm]: measured minus calibrated distance of the centres.

    The points (n, 3) [mm] are those of the two spheres of a ball bar, the distance in mm. Raises InputError as
    :func:`probing_error`, or if the calibrated distance is not positive.
    """
    if not calibrated_distance > 0:
        raise InputError("sphere_spacing_error", "calibrated_distance", calibrated_distance, "a positive length in mm")
    # the diameter does not affect the centre
    first_centre, second_centre = (probing_error(points, calibrated_distance).centre for points in (first, second))
    return float(np.linalg.norm(first_centre - second_centre) - calibrated_distance)


def plane_distances(points: Floats) -> Floats:
    """Return signed orthogonal distances (n,) [mm] of points (n, 3) from their least-squares plane, positive to +z."""
    centred = points - points.mean(axis=0)
    normal = np.linalg.svd(centred, full_matrices=False)[2][-1]
    return np.asarray(centred @ (normal if normal[2] > 0 else -normal))


def _sphere(points: Floats) -> tuple[Floats, float]:
    """Fit the least-squares sphere of the orthogonal distance; return its centre (3,) and radius."""
    middle = points.mean(axis=0)
    local = points - middle
    extent = float(np.ptp(points, axis=0).max())
    # |p|^2 = 2 c.p + (r^2 - |c|^2) is linear in the unknowns: a starting value
    square = (local**2).sum(axis=1)
    start = np.linalg.lstsq(np.column_stack([2 * local, np.ones(len(local))]), square, rcond=None)[0]
    start[3] = np.sqrt(max(start[3] + start[:3] @ start[:3], 1e-12))

    def deviations(sphere: Floats) -> Floats:
        return np.asarray(np.linalg.norm(local - sphere[:3], axis=1) - sphere[3])

    def slopes(sphere: Floats) -> Floats:
        out = sphere[:3] - local
        return np.column_stack([out / np.linalg.norm(out, axis=1, keepdims=True), -np.ones(len(local))])

    solution = least_squares(deviations, start, slopes, method="lm", xtol=1e-14, ftol=1e-14).x
    # a flat piece fits spheres of any size: the points must deviate from their plane
    flat = np.linalg.svd(local, compute_uv=False)[2] / np.sqrt(len(local)) < LEAST_BULGE * extent
    if flat or not 0 < solution[3] < 100 * extent:
        allowed = "a cap that determines a sphere, of 5 deg half angle or more"
        raise InputError("probing_error", "points", f"{len(points)} points that hardly curve", allowed)
    return middle + solution[:3], float(solution[3])


def _usable(where: str, values: ArrayLike, least: int, rejected_share: float) -> Floats:
    points: Floats = np.array(values, np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(where, "points", f"shape {points.shape}", "(n, 3)", "cloud.of_feature(name) gives such points")
    if not 0 <= rejected_share <= 0.1:
        raise InputError(where, "rejected_share", rejected_share, "0 to 0.1", "the guideline allows a few per mille")
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) < least:
        raise InputError(where, "points", f"{len(points)} points", f"{least} or more")
    return points


def _nearest(deviation: Floats, rejected_share: float) -> NDArray[np.intp]:
    """Return the indices of the points without ``rejected_share``, rounded down, of the largest deviations."""
    stay = len(deviation) - int(rejected_share * len(deviation))
    return np.asarray(np.argsort(np.abs(deviation), kind="stable")[:stay])
