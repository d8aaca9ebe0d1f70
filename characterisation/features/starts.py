"""Estimate a plane, a sphere or a cylinder from its points alone, as the starting value of a fit.

Signal chain of a cylinder: points -> normals of some of them, from the plane through the neighbours of each -> axis,
the direction perpendicular to all normals, or the longest extent of a thin rod -> circle through the points projected
along the axis (Pratt's algebraic fit) -> cylinder.

The number of neighbours is large enough for a normal if noise is up to a tenth of their extent.

Least squares gives each start. A window about a ball or a rod also shows what is beside it, which turns or widens a
shape of least squares. So where the points do not lie on that shape, shapes through the fewest points are tried, and
the one that is nearest to half of the points is used if it is much nearer (least median of squares: Rousseeuw, J. Am.
Stat. Assoc. 79 (1984) 871). A window of which a third shows another surface then has a good start.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import eig
from scipy.spatial import cKDTree

from characterisation.features.robust_fit import SMALLEST_SCALE, FitError, usable
from characterisation.features.surfaces import Cylinder, Plane, Sphere, Surface
from characterisation.features.vectors import tangents

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

    Raises FitError if there are fewer than 6 points, or they lie in a plane.
    """
    points = usable(points, Cylinder.kind, Cylinder.parameter_count)
    count = min(max(_LEAST_NEIGHBOURS, round(_NEIGHBOUR_SHARE * len(points))), _MOST_NEIGHBOURS, len(points))
    sample = points[:: 1 + len(points) // _NORMALS]
    _, index = cKDTree(points).query(sample, count)
    patches = points[index] - points[index].mean(axis=1, keepdims=True)
    middle = points.mean(axis=0)
    across = _about(_across(np.linalg.svd(patches, full_matrices=False)[2][:, -1]), middle, points)
    # the neighbours of a point of a thin rod surround it, so that all normals are the same
    along = _about(np.linalg.eigh((points - middle).T @ (points - middle))[1][:, -1], middle, points)
    cylinder, extent = along[:2] if along[2] * _MORE < across[2] else across[:2]
    if not 0 < cylinder.radius < 100 * extent:
        raise FitError(f"{len(points)} points that do not curve enough to determine a cylinder")
    return cylinder


def _about(axis: Array, middle: Array, points: Array) -> tuple[Cylinder, float, float]:
    """Return the cylinder along an axis (3,) through most points (n, 3), their width, and median distance from it."""
    basis = tangents(axis)
    local = (points - middle) @ basis.T
    centre, radius = _nearer(local, *_circle(local))
    distance = float(np.median(np.abs(np.linalg.norm(local - centre, axis=1) - radius)))
    return Cylinder(middle + centre @ basis, axis, radius), _width(local), distance


def _across(normals: Array) -> Array:
    """Return the direction (3,) perpendicular to most of the normals (n, 3)."""
    squares: Array = np.linalg.eigh(normals.T @ normals)[1][:, 0]
    sines = np.abs(normals @ squares)
    if np.mean(sines**2) < _FLAT**2:
        return squares
    first, second = _some_of(normals, 2).swapaxes(0, 1)
    axes = np.cross(first, second)
    lengths = np.linalg.norm(axes, axis=1)
    apart = lengths > _FLAT
    if not apart.any():
        return squares
    axes = axes[apart] / lengths[apart, None]
    medians = np.median(np.abs(normals @ axes.T), axis=0)
    best = axes[np.argmin(medians)]
    nearest = np.abs(normals @ best)
    half = normals[nearest <= np.median(nearest)]
    axis: Array = np.linalg.eigh(half.T @ half)[1][:, 0]
    return axis if np.median(np.abs(normals @ axis)) * _MUCH < np.median(sines) else squares


def _circle(points: Array) -> tuple[Array, float]:
    """Return centre (2,) and radius of the circle through points (n, 2), by Pratt's algebraic fit.

    For a short arc, the simple algebraic fit (Kasa) gives too small a circle. Pratt's constraint B^2 + C^2 - 4 A D = 1
    avoids this (Chernov, Circular and Linear Regression, CRC 2010, section 5.5).
    """
    scale = float(np.abs(points).max())
    x, y = (points / scale).T
    design = np.column_stack([x**2 + y**2, x, y, np.ones(len(x))])
    constraint = np.zeros((4, 4))
    constraint[0, 3] = constraint[3, 0] = -2.0
    constraint[1, 1] = constraint[2, 2] = 1.0
    values, vectors = eig(design.T @ design, constraint)
    values = np.where(np.isfinite(values) & (np.abs(values.imag) < 1e-9), values.real, -1.0)
    allowed = np.flatnonzero(values > -1e-9)
    if not len(allowed):
        raise FitError(f"{len(points)} points that do not determine a circle")
    a, b, c, d = vectors[:, allowed[np.argmin(values[allowed])]].real
    if abs(a) < 1e-12:
        return np.zeros(2), np.inf
    centre = -np.array([b, c]) / (2 * a)
    return centre * scale, float(np.sqrt(max(centre @ centre - d / a, 0.0)) * scale)


def sphere_start(points: Array) -> Sphere:
    """Return a sphere from which a fit to points (n, 3) [mm] may start, also if a third of them lie elsewhere.

    That of least squares solves |p|^2 = 2 c.p + (r^2 - |c|^2), which is linear in the unknowns.
    """
    middle = points.mean(axis=0)
    local = points - middle
    solution, *_ = np.linalg.lstsq(_linear(local), np.sum(local**2, axis=1), rcond=None)
    radius = float(np.sqrt(max(solution[3] + solution[:3] @ solution[:3], 1e-12)))
    centre, radius = _nearer(local, solution[:3], radius)
    return Sphere(middle + centre, radius)


def _linear(local: Array) -> Array:
    """Return the design (..., n, d + 1) of a circle or sphere through points (..., n, d)."""
    return np.concatenate([2 * local, np.ones((*local.shape[:-1], 1))], axis=-1)


def _nearer(local: Array, centre: Array, radius: float) -> tuple[Array, float]:
    """Return a circle or sphere, or the one through a few of the points (n, d) that is much nearer to half of them."""
    off = np.abs(np.linalg.norm(local - centre, axis=1) - radius)
    extent = _width(local)
    if extent == 0 or np.mean(off**2) <= (_ROUND * extent) ** 2:
        return centre, radius
    corners = _some_of(local, local.shape[1] + 1)
    middles = corners.mean(axis=1)
    sizes = np.maximum(np.ptp(corners, axis=1).max(axis=1), 1e-9 * extent)
    scaled_corners = (corners - middles[:, None]) / sizes[:, None, None]
    designs = _linear(scaled_corners)
    usable = np.abs(np.linalg.det(designs)) > 1e-6
    if not usable.any():
        return centre, radius
    solved = np.linalg.solve(designs[usable], np.sum(scaled_corners[usable] ** 2, axis=-1)[..., None])[..., 0]
    centres = solved[:, :-1]
    radii = sizes[usable] * np.sqrt(np.maximum(solved[:, -1] + np.sum(centres**2, axis=1), 0.0))
    centres = middles[usable] + sizes[usable, None] * centres
    sample = local[:: 1 + len(local) // _SOME]
    apart = np.linalg.norm(sample[:, None] - centres, axis=-1)
    medians = np.median(np.abs(apart - radii), axis=0)
    best = int(np.argmin(medians))
    if medians[best] * _MORE < np.median(off):
        return centres[best], float(radii[best])
    return centre, radius


def _width(points: Array) -> float:
    """Return the largest width over the axes of points (n, d), without the outer fifth of them on each axis."""
    low, high = np.quantile(points, (0.1, 0.9), axis=0)
    return float((high - low).max())


def _some_of(rows: Array, count: int) -> Array:
    """Return :data:`_TRIES` random choices (tries, count, d) of rows (n, d); the same rows give the same."""
    rng = np.random.default_rng(len(rows))
    return np.asarray(rows[rng.integers(len(rows), size=(_TRIES, count))])


def plane_start(points: Array) -> tuple[Plane, Array]:
    """Return a plane from which a fit to points (n, 3) [mm] may start, also if a third of them lie elsewhere.

    With it come the points to fit: all, or those of the larger of two surfaces with a gap between them. If both have
    nearly as many points, a robust fit would run from any start to a plane across both.

    Its least squares are total. A step of a few millimetres turns them, as do the outliers of a matcher, which may lie
    farther from the surface than it is wide. The plane of three points is that of the half of the points nearest to it.
    """
    middle = points.mean(axis=0)
    about = points - middle
    moments, axes = np.linalg.eigh(about.T @ about)
    squares = Plane(middle, axes[:, 0])
    if moments[0] < _THIN**2 * moments[1]:
        return squares, points
    rng = np.random.default_rng(len(points))
    sample = points if len(points) <= _SOME else points[rng.choice(len(points), _SOME, replace=False)]
    corners = sample[rng.integers(len(sample), size=(_TRIPLES, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    usable = lengths > 1e-9 * lengths.max(initial=1e-300)
    if not usable.any():
        return squares, points
    normals, corners = normals[usable] / lengths[usable, None], corners[usable]
    offsets = np.abs(sample @ normals.T - np.einsum("ij,ij->i", corners[:, 0], normals))
    medians = np.median(offsets, axis=0)
    best = int(np.argmin(medians))
    half = sample[offsets[:, best] <= medians[best]]
    centre = half.mean(axis=0)
    normal = np.linalg.eigh((half - centre).T @ (half - centre))[1][:, 0]
    start, nearest = squares, np.median(np.abs((sample - centre) @ normal))
    if nearest * _MUCH < np.median(np.abs((sample - middle) @ squares.normal)):
        start = Plane(centre, normal)
    depths = np.unique(sample[:, np.argmax(np.abs(normal))])
    if len(depths) < max(_FEWEST, len(sample) / 10):  # few points, or rounded ones, have gaps on one surface
        return start, points
    for _ in range(_HALVES):  # three noisy points are tilted; the half nearest to their plane has one that is less so
        apart = (sample - centre) @ normal
        half = sample[np.abs(apart) <= np.median(np.abs(apart))]
        centre = half.mean(axis=0)
        normal = np.linalg.eigh((half - centre).T @ (half - centre))[1][:, 0]
    fewest = len(sample) // 4
    apart = np.sort((sample - centre) @ normal)
    at = fewest + int(np.argmax(np.diff(apart[fewest : len(sample) - fewest])))
    if apart[at + 1] - apart[at] <= _GAP * (apart[-1 - len(sample) // 20] - apart[len(sample) // 20]):
        return start, points
    beyond = (points - centre) @ normal > (apart[at] + apart[at + 1]) / 2
    return Plane(centre, normal), points[beyond == (2 * np.count_nonzero(beyond) > len(points))]


def rounding_scale(points: Array, surface: Surface) -> float:
    """Return the least scale [mm] of the residuals of a surface through points (n, 3), in the frame of their rounding.

    Most points of a plane across an axis may have the same rounded coordinate. The median of their residuals is then 0,
    and all others would count as outliers. With a scale of half a step, points two steps away are kept.
    """
    if not isinstance(surface, Plane):
        return SMALLEST_SCALE
    column = points[:: 1 + len(points) // _MOST_ROUNDED, np.argmax(np.abs(surface.normal))]
    counts = np.unique(column, return_counts=True)[1]
    if counts.max() < _TIED * len(column):
        return SMALLEST_SCALE
    step = rounding_step(points, surface.normal)
    if len(counts) == 2:  # noise mixes two steps; the two faces of a part lie apart
        step *= bool(np.mean(column[1:] != column[:-1]) > np.prod(counts / len(column)))
    return max(step / 2, SMALLEST_SCALE)


def rounding_step(points: Array, normal: Array) -> float:
    """Return the step [mm] to which points (n, 3) are rounded on the axis nearest to a ``normal`` (3,), 0 if to none.

    The points are in the frame of their rounding.
    """
    values = np.unique(points[:: 1 + len(points) // _MOST_ROUNDED, np.argmax(np.abs(normal))])
    step = float(np.diff(values).min(initial=np.inf))
    steps = (values - values[0]) / step if len(values) else values
    rounded = LEAST_STEP_MM < step < np.inf and np.abs(steps - np.rint(steps)).max() < _OFF_STEP
    return step if rounded else 0.0


#: about the largest number of points that are tried; chosen
_SOME = 1000

#: triples of them that are tried: a triple without an outlier has a probability of 0.3 for a third of them
_TRIPLES = 60

#: times that the half of the points nearest to a plane is chosen; chosen
_HALVES = 10

#: fewest points, and different depths, between which a gap is looked for; chosen
_FEWEST = 100

#: least gap between two surfaces, each with a quarter of the points, over the range of nine tenths of all; chosen. No
#: bowed face has one
_GAP = 0.4

#: choices of the fewest points of a circle, a sphere or an axis: of four points without one of 40 % outliers, 26 in 200
_TRIES = 200

#: largest rms distance from a circle or sphere, over the width of the points, of points that lie on it; assumed
_ROUND = 2e-3

#: largest rms sine of the angle between normals and the plane across one axis; assumed
_FLAT = 0.1

#: largest thickness over width of points whose plane no step can turn: 0.1 deg; assumed
_THIN = 2e-3

#: ratio of the medians from which the shape of a few points replaces that of least squares; of a bowed plane it is 2
_MUCH = 3.0

#: the same of a circle or sphere; of normal noise it is about 1
_MORE = 2.0

#: about the largest number of points whose rounding is looked for; chosen
_MOST_ROUNDED = 4000

#: least share of points with one rounded coordinate, at which the median of the residuals may be 0; chosen below a half
_TIED = 0.4

#: least step of rounded coordinates [mm] that matters; float32 rounds those 10 m away to 1e-3 mm
LEAST_STEP_MM = 1e-3

#: largest distance of a rounded coordinate from a multiple of the step, in steps, from float32; chosen
_OFF_STEP = 0.05
