"""Fit circles of holes and points of edges, from where the points of a face end on the grid of an organised cloud.

Signal chain: fitted plane of the face -> pixels whose point lies on it -> for each row that crosses the nominal edge
(or column, where the edge is less steep), the last pixel that shows the face -> edge half a pixel beyond it, and (1 -
F) / F pixels more for randomly lost points -> place on the plane along the ray -> robust fit of the figure in the plane
-> covariance from the scatter of the places.

Pixels near edges have no label, because a matching block there contains two surfaces. Therefore every point within a
limit of the plane along its ray is used, with or without a label. Points with larger noise count as lost.

The following biases are not corrected:

- Points at an edge are mixed. Decoders interpolate between the two surfaces. Blocks extend a near face beyond its edge
  (a hole shrinks) or lose part of it (a hole grows), by up to half the block. This property of the sensor is the same
  all round the edge, so it affects sizes much more than places. A decoder that smooths displaces more points than its
  noise tells: rims of 12 mm grow by 1.1 mm (Zivid, smoothed by 1.5 px), not by 0.3.
- Where the wall of a hole is visible, its points within the limit count as points of the face. The edge there moves
  inward by up to m, the limit (along the ray) times the sine of the incidence angle. This moves the centre by m/2 away
  from the wall, and reduces the radius by m/pi. An edge whose other face is visible moves outward likewise.
- A chamfered or rounded edge is found where the plane ends.
- A surface that covers the face is not told from a wall at the edge if it is as near as that could be.
- Points are lost near an edge more often than elsewhere. F is counted on the face beside the edge, and corrects only
  for loss that is equal everywhere.

Crossings are evenly spaced rather than random, so their errors are not quite independent. For simulated holes of 6 to
30 px radius, F 0.8 to 1 (200 positions), the rms error of centre and radius is 0.95 to 1.2 times the predicted one. The
radius is too large by up to a fifth of its standard uncertainty.
"""

from __future__ import annotations

from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from characterisation.features.credibility import check_figure
from characterisation.features.figures import ACROSS_THE_EDGE, Circle, EdgePoint
from characterisation.features.fitted import CircleFit, EdgePointFit, PlaneFit
from characterisation.features.robust_fit import FitError, covariance_of, robust_fit
from characterisation.features.vectors import tangents
from characterisation.point_cloud import PointCloud

Array = NDArray[np.float64]

#: largest distance behind the plane at which a point lies on it, in standard deviations of the plane's points. In front
#: it is twice that, because walls of holes and adjoining faces lie behind; *assumed*
NEAR_STD = 2.0

#: the same in mm, if that is more; *assumed*
NEAR_MM = 0.02

#: least number of crossings for a figure; *assumed*
LEAST_CROSSINGS = 12

#: least F of the face beside the edge for which its place is fitted; *assumed*
LEAST_FRACTION = 0.3

#: terms of the sampling errors that noise dithers; chosen: the rest is 1/50 of their variance at most
HARMONICS = 30


class Crossings(NamedTuple):
    """Points where an edge crosses rows and columns of the grid."""

    points: Array  # (n, 3) [mm] on the plane, sensor frame
    spread: float  # [mm]: expected standard deviation of one point along its row or column
    fraction: float  # F of the face beside the edge
    shared: float  # [mm]: common displacement of all points by one standard error of F
    steps: Array  # (n, 3) [mm] on the plane, to the next pixel of its row or column


_NONE = Crossings(np.empty((0, 3)), 0.0, 0.0, 0.0, np.empty((0, 3)))


def fit_circle(cloud: PointCloud, plane: PlaneFit, nominal: Circle, near: float | None = None) -> CircleFit:
    """Fit the circle of a hole in a plane.

    Raises FitError if too little of the edge is visible, or the fit is not credible
    (:mod:`characterisation.features.credibility`).

    Parameters
    ----------
    cloud
        Organised cloud, with or without labels.
    plane
        Fitted to the face, sensor frame.
    nominal
        Nominal circle of the hole, sensor frame. The edge may lie half a radius from it. The face must have no other
        edge within a radius beyond it, because F is counted there.
    near
        Distance [mm] behind the plane, along the ray, within which a point belongs to it; in front, twice this
        distance. By default :data:`NEAR_STD` times the standard deviation of the plane's points, at least
        :data:`NEAR_MM`.

    See Also
    --------
    fit_edge_point
    """
    nominal = nominal.seen_from(cloud.grid.origin).on_moved_plane(plane)
    crossings = _crossings(cloud, plane, nominal, near)
    circle, kept = _fit(nominal, crossings)
    if not 0.5 < circle.radius / nominal.radius < 1.5:
        raise FitError(f"the edge leads away from the nominal circle (radius {circle.radius:.4g} mm)")
    circle = circle.seen_from(cloud.grid.origin)
    residual, jacobian, _ = circle.linearised(np.zeros(3), crossings.points[kept])
    covariance, residual_std, count = covariance_of(residual, jacobian, circle.kind)
    covariance[2, 2] += crossings.shared**2
    fit = CircleFit(circle.centre, circle.normal, circle.radius, circle.ray, covariance, residual_std, count)
    check_figure(fit, nominal, nominal.radius)
    return fit


def fit_edge_point(
    cloud: PointCloud, plane: PlaneFit, nominal: EdgePoint, reach: float, near: float | None = None
) -> EdgePointFit:
    """Fit the point where a line in a plane crosses the edge of the face.

    The sampling errors of its crossings are not independent, since the angle of the edge to the pixels relates them
    (:func:`_straight_covariance`): along a row or at 45 deg all are the same, at most other angles they nearly cancel.

    Parameters
    ----------
    cloud, plane, near
        As in :func:`fit_circle`.
    nominal
        Nominal point, sensor frame.
    reach
        Distance [mm] from the nominal point, along the line and across it, within which the edge is searched and
        assumed straight.

    See Also
    --------
    fit_circle : the edge of a hole
    """
    nominal = nominal.seen_from(cloud.grid.origin).on_moved_plane(plane)
    crossings = _crossings(cloud, plane, nominal, near, reach)
    edge, kept = _fit(nominal, crossings)
    edge = edge.seen_from(cloud.grid.origin)
    points, steps = crossings.points[kept], crossings.steps[kept]
    residual, jacobian, _ = edge.linearised(np.zeros(2), points)
    _, residual_std, count = covariance_of(residual, jacobian, edge.kind)
    pitch = edge.linearised(np.zeros(2), points + steps)[0] - residual
    covariance = _straight_covariance(residual, jacobian, pitch, crossings.fraction)
    covariance[0, 0] += crossings.shared**2
    fit = EdgePointFit(edge.point, edge.direction, edge.normal, edge.slope, edge.ray, covariance, residual_std, count)
    check_figure(fit, nominal, reach)
    return fit


Figure = TypeVar("Figure", Circle, EdgePoint)


def _fit(nominal: Figure, crossings: Crossings) -> tuple[Figure, NDArray[np.bool_]]:
    count = len(crossings.points)
    if count < LEAST_CROSSINGS:
        raise FitError(f"{count} crossings of the edge, at least {LEAST_CROSSINGS} are required")
    if crossings.fraction < LEAST_FRACTION:
        raise FitError(f"only {100 * crossings.fraction:.0f} % of the points of the face beside the edge are recovered")

    def linearised(
        figure: Figure, parameters: Array, chosen: NDArray[Any], along_rays: bool
    ) -> tuple[Array, Array, Array]:
        return figure.linearised(parameters, crossings.points[chosen])

    return robust_fit(nominal, linearised, count, crossings.spread)


def _covered(points: Array, rays: Array, behind: Array, axis: int) -> NDArray[np.bool_]:
    """Return which pixels (h, w) show a surface that covers the face, rather than one that begins at its edge.

    A wall at the edge stands at most one ``step`` along the ``axis`` from the face's last place, so it is no farther
    in front of the plane, along the ray, than the step over the share of the ray that goes along it.
    """
    step = np.gradient(points, axis=axis)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(behind < -np.sum(step**2, axis=-1) / np.abs(np.sum(rays * step, axis=-1)))


class _Ends(NamedTuple):
    """Places where the face ends along rows or columns.

    ``last`` (k, 3) [mm] is the last place on the face, ``following`` (k, 3) that of the next pixel. ``deeper`` is the
    number of pixels deeper in the face, ``shown`` that of those which show it.
    """

    last: Array
    following: Array
    shown: int
    deeper: int


def _crossings(
    cloud: PointCloud, plane: PlaneFit, figure: Circle | EdgePoint, near: float | None, reach: float = 0.0
) -> Crossings:
    """Return the places where the points of the plane end, toward the hole or over the edge."""
    rows, columns = _window(cloud, figure, reach)
    if rows.size == 0:
        return _NONE
    rays = cloud.grid.rays_at(columns, rows)
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = (plane.point - cloud.grid.origin) @ plane.normal / (rays @ plane.normal)
    points = cloud.grid.origin + distance[..., None] * rays
    limit = max(NEAR_STD * plane.residual_std, NEAR_MM) if near is None else near
    with np.errstate(invalid="ignore"):
        behind = np.sum((cloud.points[rows, columns] - points) * rays, axis=-1)
        on_face = (behind <= limit) & (behind >= -2 * limit)
    signed_distance, band = _signed_distance(figure, points, reach)
    down, right = np.gradient(signed_distance)
    steep = np.abs(right) >= np.abs(down)  # the edge crosses this row more steeply than this column
    covered = [_covered(points, rays, behind + 2 * limit, axis) for axis in (1, 0)]
    along_rows = _ends(on_face, covered[0], signed_distance, band, steep, np.sign(right), points)
    turned = points.swapaxes(0, 1)
    along_columns = _ends(on_face.T, covered[1].T, signed_distance.T, band.T, ~steep.T, np.sign(down).T, turned)
    shown, deeper = along_rows.shown + along_columns.shown, along_rows.deeper + along_columns.deeper
    last, following = (np.concatenate(pair) for pair in zip(along_rows[:2], along_columns[:2], strict=True))
    if len(last) == 0 or shown == 0:
        return _NONE
    fraction = shown / deeper
    steps = following - last
    positions = last + (0.5 + (1 - fraction) / fraction) * steps
    pitch = float(np.median(np.linalg.norm(steps, axis=1)))
    spread = float(pitch * np.sqrt(1 / 12 + (1 - fraction) / fraction**2))
    shared = float(pitch * np.sqrt(ACROSS_THE_EDGE * fraction * (1 - fraction) / deeper) / fraction**2)
    return Crossings(positions, spread, fraction, shared, steps)


def _ends(
    on_face: NDArray[np.bool_],
    covered: NDArray[np.bool_],
    signed_distance: Array,
    band: NDArray[np.bool_],
    steep: NDArray[np.bool_],
    sign: Array,
    points: Array,
) -> _Ends:
    """Find the ends of the face along each row, from the pixels that are ``on_face``.

    It does not end where another surface has ``covered`` the next pixel, and covered pixels tell nothing of F.
    ``signed_distance`` grows in the direction ``sign`` (+1 or -1) along the row. Ends are searched within ``band``, and
    kept where ``steep`` is true.
    """
    row, column = np.nonzero(band)
    key = 2 * row + (sign[row, column] > 0)  # a hole meets a row twice, once in each direction
    depth, shows = signed_distance[row, column], on_face[row, column]
    # sorted by key, then pixels on the face last, of these the outermost last
    order = np.lexsort((depth, shows, key))
    key, depth, shows, row, column = key[order], depth[order], shows[order], row[order], column[order]
    last = np.flatnonzero(np.diff(key, append=-1) != 0)
    next_column = column[last] + sign[row[last], column[last]].astype(np.intp)
    usable = shows[last] & steep[row[last], column[last]] & (next_column >= 0) & (next_column < on_face.shape[1])
    last, next_column = last[usable], next_column[usable]
    # otherwise the band ends here or another surface covers it, and not the face
    inside = band[row[last], next_column] & ~covered[row[last], next_column]
    last, next_column = last[inside], next_column[inside]
    # F is counted deeper in the face than the last pixel, which shows the face by selection
    end = np.full(int(key.max(initial=0)) + 1, -np.inf)
    end[key[last]] = depth[last]
    deeper = (depth < end[key]) & ~covered[row, column]
    return _Ends(
        points[row[last], column[last]],
        points[row[last], next_column],
        int((shows & deeper).sum()),
        int(deeper.sum()),
    )


def _signed_distance(figure: Circle | EdgePoint, points: Array, reach: float) -> tuple[Array, NDArray[np.bool_]]:
    """Return how far points (..., 3) on the plane lie outside the face [mm], and which lie where its edge is searched.

    The distance grows toward the middle of a hole, and along the line over an edge.
    """
    if isinstance(figure, Circle):
        local = (points - figure.centre) @ tangents(figure.normal).T
        signed_distance = figure.radius - np.linalg.norm(local, axis=-1)
        return signed_distance, (signed_distance >= -figure.radius) & (signed_distance <= figure.radius / 2)
    local = points - figure.point
    signed_distance = local @ figure.direction
    sideways = local @ np.cross(figure.normal, figure.direction)
    return signed_distance, (np.abs(signed_distance) <= reach) & (np.abs(sideways) <= reach)


def _window(cloud: PointCloud, figure: Circle | EdgePoint, reach: float) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return rows and columns (h, w) of the part of the grid about a figure, with one pixel more on each side."""
    middle = figure.centre if isinstance(figure, Circle) else figure.point
    far = 2.0 * figure.radius if isinstance(figure, Circle) else np.sqrt(2.0) * reach
    angle = np.linspace(0, 2 * np.pi, 32, endpoint=False)
    around = far * np.column_stack([np.cos(angle), np.sin(angle)]) @ tangents(figure.normal)
    pixels = cloud.grid.project(middle + around)
    empty = np.empty((0, 0), np.intp)
    if not np.isfinite(pixels).all():
        return empty, empty
    low = np.maximum(np.floor(pixels.min(axis=0)).astype(int) - 1, 0)
    high = np.minimum(np.ceil(pixels.max(axis=0)).astype(int) + 2, [cloud.grid.width, cloud.grid.height])
    if (high - low < 2).any():
        return empty, empty
    columns, rows = np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1]))
    return rows, columns


def _straight_covariance(residual: Array, jacobian: Array, pitch: Array, fraction: float) -> Array:
    """Return the covariance (2, 2) of a straight edge through crossings with residuals (n,) [mm], derivatives (n, 2).

    Where the edge lies between two pixels a ``pitch`` (n,) [mm] apart is uniform, but the same for all crossings: they
    differ by their residuals r = pitch p. The errors of two crossings, over all places of the edge, have the covariance

        d_i d_j (1/12 - t (1 - t) / 2),      t = p_i - p_j modulo 1

    The remaining variance of the residuals is that of random losses and noise, which are independent. Losses move a
    crossing by whole pixels. Noise, with a variance of s^2 pixels^2, also dithers the places between pixels: it
    multiplies the term of d_i d_j cos(2 pi k t) / (2 pi^2 k^2), of which the covariance above is the sum over k, by
    exp(-(2 pi k s)^2). Losses with the ``fraction`` F have a variance of (1 - F) / F^2 pixels^2; s^2 is what exceeds
    it by more than a standard error.

    :func:`characterisation.features.figures.edge_covariance` is the one expected before there are crossings.
    """
    count = len(residual)
    normal = jacobian.T @ jacobian
    inverse = np.linalg.inv(normal)
    phase = residual / pitch
    apart = (phase[:, None] - phase) % 1.0
    weights = (jacobian * pitch[:, None]) @ inverse

    def parts(jitter: float) -> tuple[Array, float]:
        between = 1 / 12 - apart * (1 - apart) / 2
        for harmonic in 2 * np.pi * np.arange(1, HARMONICS + 1) if jitter else ():
            between -= 2 / harmonic**2 * -np.expm1(-(harmonic**2) * jitter) * np.cos(harmonic * apart)
        np.fill_diagonal(between, 1 / 12)
        sampling = np.asarray(weights.T @ between @ weights)
        squares = float(residual @ residual - pitch @ pitch / 12 + np.sum(normal * sampling))
        return sampling, max(squares, 0.0) / (count - 2)

    _, remaining = parts(0.0)
    lost = (1 - fraction) / fraction**2
    # the numbers of lost pixels have the kurtosis 9 + 1 / lost
    lost += np.sqrt(lost * (8 * lost + 1) / count)
    sampling, remaining = parts(max(remaining / float(np.mean(pitch**2)) - lost, 0.0))
    return np.asarray(sampling + remaining * inverse)
