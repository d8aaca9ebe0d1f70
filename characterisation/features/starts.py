"""A cylinder to start a fit from, where nothing but its points is known.

Signal chain: points -> normal of each of some points, from the plane through its neighbours -> axis, the direction to
which all normals are upright -> circle through the points seen along the axis (Pratt's algebraic fit) -> cylinder.

The neighbours are so many that noise of a tenth of their extent still leaves a normal. A few points of another surface
turn the axis by some degrees, which the robust fit that starts from here forgives
(:func:`~characterisation.features.fits.fit_cylinder`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import eig
from scipy.spatial import cKDTree

from characterisation.features.robust_fit import FitError, usable
from characterisation.features.surfaces import Cylinder, tangents

Array = NDArray[np.float64]

#: points whose normals are taken, and the smallest and largest number of neighbours for each
_NORMALS, _LEAST_NEIGHBOURS, _MOST_NEIGHBOURS = 400, 20, 300

#: share of the points that are a point's neighbours
_NEIGHBOUR_SHARE = 0.03


def cylinder_start(points: ArrayLike) -> Cylinder:
    """Estimate a cylinder from points (n, 3) [mm] alone, good to some degrees and a fraction of the radius.

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
    """Centre (2,) and radius of the circle through places (n, 2), by Pratt's algebraic fit.

    Of a short arc the plain algebraic fit (Kasa) gives too small a circle; Pratt's constraint B^2 + C^2 - 4 A D = 1
    does not (Chernov, Circular and Linear Regression, CRC 2010, section 5.5).
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
