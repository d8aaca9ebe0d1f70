"""Estimate a cylinder or a plane from its points alone, as the starting value of a fit.

Signal chain of a cylinder: points -> normals of some of them, from the plane through the neighbours of each -> axis,
the direction perpendicular to all normals -> circle through the points projected along the axis (Pratt's algebraic fit)
-> cylinder.

The number of neighbours is large enough for a normal if noise is up to a tenth of their extent. A few points of another
surface tilt the axis by some degrees, which the subsequent robust fit tolerates
(:func:`~characterisation.features.fits.fit_cylinder`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import eig
from scipy.spatial import cKDTree

from characterisation.features.robust_fit import FitError, usable
from characterisation.features.surfaces import Cylinder, Plane, tangents

Array = NDArray[np.float64]

#: number of points whose normals are estimated
_NORMALS = 400

#: smallest number of neighbours of each
_LEAST_NEIGHBOURS = 20

#: largest number of neighbours of each
_MOST_NEIGHBOURS = 300

#: neighbours of a point, as a share of all points
_NEIGHBOUR_SHARE = 0.03


def cylinder_start(points: ArrayLike) -> Cylinder:
    """Estimate a cylinder from points (n, 3) [mm] alone, to within some degrees and a fraction of the radius.

    Raises
    ------
    FitError
        If there are fewer than 6 points, or they lie in a plane.
    """
    points = usable(points, Cylinder.kind, Cylinder.parameter_count)
    count = min(max(_LEAST_NEIGHBOURS, round(_NEIGHBOUR_SHARE * len(points))), _MOST_NEIGHBOURS, len(points))
    some = points[:: 1 + len(points) // _NORMALS]
    _, index = cKDTree(points).query(some, count)
    patches = points[index] - points[index].mean(axis=1, keepdims=True)
    normals = np.linalg.svd(patches, full_matrices=False)[2][:, -1]
    axis = np.linalg.eigh(normals.T @ normals)[1][:, 0]
    basis = tangents(axis)
    middle = points.mean(axis=0)
    centre, radius = _circle((points - middle) @ basis.T)
    extent = float(np.ptp((points - middle) @ basis.T, axis=0).max())
    if not 0 < radius < 100 * extent:
        raise FitError(f"{len(points)} points that do not curve enough to determine a cylinder")
    return Cylinder(middle + centre @ basis, axis, radius)


def _circle(places: Array) -> tuple[Array, float]:
    """Return centre (2,) and radius of the circle through places (n, 2), by Pratt's algebraic fit.

    For a short arc, the simple algebraic fit (Kasa) gives too small a circle. Pratt's constraint B^2 + C^2 - 4 A D = 1
    avoids this (Chernov, Circular and Linear Regression, CRC 2010, section 5.5).
    """
    scale = float(np.abs(places).max())
    x, y = (places / scale).T
    design = np.column_stack([x**2 + y**2, x, y, np.ones(len(x))])
    constraint = np.zeros((4, 4))
    constraint[0, 3] = constraint[3, 0] = -2.0
    constraint[1, 1] = constraint[2, 2] = 1.0
    values, vectors = eig(design.T @ design, constraint)
    values = np.where(np.isfinite(values) & (np.abs(values.imag) < 1e-9), values.real, -1.0)
    allowed = np.flatnonzero(values > -1e-9)
    if not len(allowed):
        raise FitError(f"{len(places)} points that do not determine a circle")
    a, b, c, d = vectors[:, allowed[np.argmin(values[allowed])]].real
    if abs(a) < 1e-12:
        return np.zeros(2), np.inf
    centre = -np.array([b, c]) / (2 * a)
    return centre * scale, float(np.sqrt(max(centre @ centre - d / a, 0.0)) * scale)


def plane_start(points: Array) -> Plane:
    """Return a plane from which a fit to points (n, 3) [mm] may start, also if a third of them are far outliers.

    It is the plane of total least squares. If the points are not flat about it, a plane through three of the points is
    used that is much nearer to half of them (least median of squares: Rousseeuw, J. Am. Stat. Assoc. 79 (1984) 871). So
    the outliers of a matcher, which may lie farther from the surface than it is wide, do not turn the start.
    """
    middle = points.mean(axis=0)
    about = points - middle
    moments, axes = np.linalg.eigh(about.T @ about)
    squares = Plane(middle, axes[:, 0])
    if moments[0] < _FLAT**2 * moments[1]:
        return squares
    rng = np.random.default_rng(len(points))
    some = points if len(points) <= _SOME else points[rng.choice(len(points), _SOME, replace=False)]
    corners = some[rng.integers(len(some), size=(_TRIPLES, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    usable = lengths > 1e-9 * lengths.max(initial=1e-300)
    if not usable.any():
        return squares
    normals, corners = normals[usable] / lengths[usable, None], corners[usable]
    offsets = np.abs(some @ normals.T - np.einsum("ij,ij->i", corners[:, 0], normals))
    medians = np.median(offsets, axis=0)
    best = int(np.argmin(medians))
    if medians[best] * _MUCH < np.median(np.abs((some - middle) @ squares.normal)):
        return Plane(corners[best, 0], normals[best])
    return squares


#: points and triples of them that are tried: a triple without an outlier has a probability of 0.3 for a third of them
_SOME, _TRIPLES = 1000, 60

#: largest thickness over width of points that are flat; assumed
_FLAT = 0.1

#: ratio of the medians from which the plane of three points replaces that of least squares; assumed
_MUCH = 4.0
