"""Verify a calibration by one capture of a known board or plate: are its errors those that the statement allows?

Signal chain: capture -> corners of a board in every eye, or dots of a plate in the cloud -> points -> scale of the
known lengths, and rows of both cameras, which must be equal -> the same errors of rigs drawn from the covariance of the
calibration, with drift and temperature since then -> standard uncertainties -> one sentence: use, or calibrate again.

A length error e is compared with u^2 = u_rig^2 + u_board^2 + u_points^2: what the calibration allows, the error of the
board's own scale, and the scatter of its points. The mean row error is compared with that of the drawn rigs. Both count
as larger than stated beyond 1.96 u (95 %).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from characterisation.features.fits import fit_plane
from characterisation.features.robust_fit import FitError
from characterisation.files.arrays import Floats
from characterisation.files.errors import InputError
from characterisation.point_cloud import PointCloud
from mitsim.capture.capture import Capture
from mitsim.decoding.plate import Plate, image_on_grid, plate_dots, plate_scale
from mitsim.sensor.camera import Rig
from mitsim.sensor.published_figures import PublishedLengths
from mitsim.sensor.rig_covariance import RigCovariance
from mitsim.sensor.rig_parameters import PATH_NAMES, moved, parameter_names, path_error
from mitsim.sensor.sensor import Sensor
from mitsim.study.calibration.accuracy import measured_points, triangulated
from mitsim.study.calibration.board import Board
from mitsim.study.calibration.corner_files import found_corners

#: number of rigs drawn: a standard deviation follows to 5 %; chosen
_DRAWS = 200

#: seed of the draws: the same sensor gives the same figures
_SEED = 1

#: a normal error lies within this many standard uncertainties with 95 %
_INSIDE = 1.959964

#: radius [px] about a corner in which points of the cloud determine the plane of the board
_NEAR_PX = 6.0


@dataclass(frozen=True)
class KnownPoints:
    """Measured points of known spacing: ``points`` (n, 3) [mm], and ``scale`` of their lengths over the true ones.

    - ``scatter``: standard uncertainty of the scale by the scatter of the points.
    - ``board``: standard uncertainty of the known lengths, relative.
    - ``rows_px`` (n,): row of each point in the second camera less that in the first, after rectification; empty for
      one camera.
    - ``extent_mm``: largest distance between two of the points.
    """

    points: Floats
    scale: float
    scatter: float
    board: float
    rows_px: Floats
    extent_mm: float


@dataclass(frozen=True)
class Verification:
    """Errors of a capture beside what a statement allows, all standard uncertainties.

    - ``length_error`` relative, ``length_uncertainty`` of it with all parts, ``rig_uncertainty`` by the calibration.
    - ``row_error_px`` and ``row_uncertainty_px``; NaN for one camera.
    - ``maker`` one sigma of a length by the maker, relative; NaN without a curve at ``distance_mm``.
    """

    artefact: KnownPoints
    distance_mm: float
    length_error: float
    length_uncertainty: float
    rig_uncertainty: float
    row_error_px: float
    row_uncertainty_px: float
    maker: float

    @property
    def usable(self) -> bool:
        """Return whether no error exceeds its 95 % limit."""
        return not self.too_large

    @property
    def too_large(self) -> list[str]:
        """Return the errors beyond their limits, in words."""
        out = []
        if not abs(self.length_error) <= _INSIDE * self.length_uncertainty:
            out.append("lengths")
        if abs(self.row_error_px) > _INSIDE * self.row_uncertainty_px:
            out.append("rows")
        return out

    def sentence(self) -> str:
        """Return the conclusion."""
        if self.usable:
            return "Use it: all errors are within the 95 % limits of the stated calibration."
        words = {"lengths": "the error of lengths", "rows": "the difference of rows"}
        spacing = (
            f" First check the spacing of the points: it measures {1 + self.length_error:.4f} times the one given."
            if "lengths" in self.too_large
            else ""
        )
        return (
            f"Calibrate again: {' and '.join(words[name] for name in self.too_large)} exceeds the 95 % limits of the "
            f"stated calibration.{spacing}"
        )

    def rows(self) -> list[str]:
        """Return the table, line by line."""
        length, limit = 1e3 * self.length_error, 1e3 * _INSIDE * self.length_uncertainty
        out = [
            f"points of known spacing\t{len(self.artefact.points)}, up to {self.artefact.extent_mm:.0f} mm apart, at "
            f"{self.distance_mm:.0f} mm",
            f"error of lengths\t{length:+.2f} per mille, 95 % limit {limit:.2f} (calibration, drift, temperature "
            f"{1e3 * _INSIDE * self.rig_uncertainty:.2f}, board {1e3 * _INSIDE * self.artefact.board:.2f}, scatter "
            f"{1e3 * _INSIDE * self.artefact.scatter:.2f})",
        ]
        if math.isfinite(self.row_error_px):
            scatter = float(np.std(self.artefact.rows_px))
            out.append(
                f"difference of rows\t{self.row_error_px:+.3f} px, 95 % limit {_INSIDE * self.row_uncertainty_px:.3f}; "
                f"scatter {scatter:.3f} px"
            )
        if math.isfinite(self.maker):
            out.append(f"maker's own limit\t{1e3 * _INSIDE * self.maker:.2f} per mille, 95 % of a normal error")
        return out


def corners_of_board(capture: Capture, board: Board, cloud: PointCloud | None) -> KnownPoints:
    """Return the corners of a chequerboard in space: by two cameras, or by one and a cloud on its grid.

    Raises
    ------
    InputError
        If a camera does not show the whole board, or the cloud has no plane there.
    """
    pixels = {}
    for name in capture.images:
        corners = found_corners(capture.brightness(name), board)
        if corners is None:
            raise InputError(
                "--board", name, "no such board in its image", f"all {len(board.corners)} corners of {board}"
            )
        pixels[name] = corners
    names = list(capture.rig.cameras)
    if len(names) > 1 and all(name in pixels for name in names[:2]):
        first, second = (capture.rig.cameras[name] for name in names[:2])
        rays = second.rays(pixels[names[1]])
        orders = [triangulated(first, pixels[names[0]], second, order) for order in (rays, rays[::-1])]
        points, rows = min(orders, key=lambda order: float(np.mean(order[1] ** 2)))  # as a board after half a turn
    elif cloud is not None and names[0] in pixels:
        points, rows = _on_plane(capture, pixels[names[0]], cloud), np.empty(0)
    else:
        raise InputError("capture", "images", ", ".join(pixels) or "none", "images of the board by every camera")
    scale, scatter = _similarity(points, board.corners)
    extent = float(np.linalg.norm(np.ptp(board.corners, axis=0)))
    return KnownPoints(points, scale, scatter, board.made.scale, rows, extent)


def dots_of_plate(capture: Capture, plate: Plate, cloud: PointCloud, printed: float) -> KnownPoints:
    """Return the dots of a plate in a cloud.

    Parameters
    ----------
    capture
        Its reference camera shows the dots.
    plate
        Window, pitch and colour of the dots.
    cloud
        Of the capture.
    printed
        Relative standard uncertainty of the pitch.

    Raises
    ------
    InputError
        If the dots are not found.
    """
    try:
        dots = plate_dots("plate", plate, cloud, image_on_grid(capture, cloud.grid))
    except FitError as error:
        raise InputError("--dots", "", str(error), "a plate of dots in the window") from None
    scale, scatter, *_ = plate_scale(dots, plate.pitch)
    extent = float(np.linalg.norm(np.ptp(dots.centres, axis=0)))
    return KnownPoints(dots.centres, scale, scatter, printed, np.empty(0), extent)


def verify(
    artefact: KnownPoints,
    sensor: Sensor,
    rig: Rig,
    covariance: RigCovariance,
    published: PublishedLengths | None = None,
) -> Verification:
    """Compare the errors of measured points with those that the covariance of a calibration allows.

    Parameters
    ----------
    artefact
        Points of known spacing in the capture.
    sensor
        Sensor of the capture: its decoder.
    rig
        Calibration with which the capture was measured.
    covariance
        Of the calibration, with drift and temperature since then.
    published
        The maker's own length errors.

    See Also
    --------
    corners_of_board, dots_of_plate : the points
    """
    stated, names = _stated_rig(sensor, rig, covariance)
    eyes, by_pair = {name.partition(".")[0] for name in names}, len(artefact.rows_px) > 0
    if by_pair and not set(list(stated.cameras)[:2]) <= eyes:
        found = f"errors of {', '.join(sorted(eyes))} alone, but two cameras measured the board"
        hint = "measure a plate of dots in the cloud: --dots"
        raise InputError("--sensor", "covariance of the calibration", found, "errors of both cameras", hint)
    measuring = replace(sensor, rig=stated)
    nominal, _ = _measured(artefact, measuring, stated)
    scales, shifts = [], []
    for stream in np.random.default_rng(_SEED).spawn(_DRAWS):
        values = covariance.draw(stream)
        points, row_errors = _measured(artefact, measuring, moved(stated, names, values), path_error(names, values))
        scales.append(_spread(points) / _spread(nominal))
        if by_pair:
            shifts.append(float(np.mean(row_errors)))
    rigs = float(np.sqrt(np.mean((np.array(scales) - 1) ** 2)))
    distance = float(np.linalg.norm(artefact.points - rig.reference.centre, axis=1).mean())
    rows = artefact.rows_px
    by_rows = math.nan
    if shifts:
        by_rows = math.hypot(float(np.sqrt(np.mean(np.square(shifts)))), float(np.std(rows)) / math.sqrt(len(rows)))
    return Verification(
        artefact,
        distance,
        artefact.scale - 1,
        math.sqrt(rigs**2 + artefact.board**2 + artefact.scatter**2),
        rigs,
        float(np.mean(rows)) if len(rows) else math.nan,
        by_rows,
        math.nan if published is None else published.one_sigma(distance),
    )


def _stated_rig(sensor: Sensor, rig: Rig, covariance: RigCovariance) -> tuple[Rig, tuple[str, ...]]:
    """Return the rig that the covariance of a sensor moves, and the names of all parameters of the covariance in it.

    A capture may name its cameras otherwise: those that the sensor does not name then follow in the order of those that
    the capture does not name. A capture that lacks an eye or a parameter, such as a device's own cloud, is described by
    the calibration of the sensor.
    """
    same = set(sensor.measuring_rig.cameras) <= set(rig.cameras)
    own, others = (
        [name for name in names if name not in shown]
        for names, shown in ((sensor.rig.cameras, rig.cameras), (rig.cameras, sensor.rig.cameras))
    )
    eyes = {} if same else dict(zip(own, others, strict=False))
    split = [name.partition(".") for name in covariance.names]
    names = tuple(f"{eyes.get(eye, eye)}.{parameter}" for eye, _, parameter in split)
    if set(names) <= {*parameter_names(rig), *PATH_NAMES}:
        return rig, names
    return sensor.rig, covariance.names


def _measured(
    artefact: KnownPoints, sensor: Sensor, true: Rig, path: tuple[float, float] = (0.0, 0.0)
) -> tuple[Floats, Floats]:
    """Return the points (n, 3) [mm] as the sensor measures them if ``true`` is its rig, and the row errors of a pair.

    Points that two cameras measured are triangulated again, whatever the sensor's own decoder does.
    """
    if len(artefact.rows_px) == 0:
        return measured_points(sensor, artefact.points, true, path), np.empty(0)
    first, second = list(sensor.rig.cameras.values())[:2]
    pixels, second_pixels = (eye.project(artefact.points) for eye in list(true.cameras.values())[:2])
    return triangulated(first, pixels, second, second.rays(second_pixels))


def _on_plane(capture: Capture, pixels: Floats, cloud: PointCloud) -> Floats:
    """Return where the rays of the reference camera's corners (n, 2) [px] meet the plane of the cloud's points."""
    camera = capture.rig.reference
    rays = camera.sensor_from_camera.directions(camera.rays(pixels))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    at = cloud.grid.project(camera.centre + 1e3 * rays)
    low = np.maximum(np.floor(np.nanmin(at, axis=0) - _NEAR_PX).astype(int), 0)
    high = np.ceil(np.nanmax(at, axis=0) + _NEAR_PX).astype(int)
    points = cloud.points[low[1] : high[1], low[0] : high[0]].reshape(-1, 3)
    try:
        plane = fit_plane(points, cloud.grid.origin)
    except FitError as error:
        raise InputError("--board", "", f"the cloud of the board: {error}", "points on the board") from None
    along = (plane.point - camera.centre) @ plane.normal / (rays @ plane.normal)
    return np.asarray(camera.centre + along[:, None] * rays)


def _spread(points: Floats) -> float:
    return float(np.sqrt(((points - points.mean(axis=0)) ** 2).sum()))


def _similarity(points: Floats, true: Floats) -> tuple[float, float]:
    """Return the scale from true to measured points (n, 3), and its standard uncertainty by their scatter (Umeyama)."""
    from_middle, of_true = points - points.mean(axis=0), true - true.mean(axis=0)
    u, _, vt = np.linalg.svd(of_true.T @ from_middle)
    turn = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    square = float((of_true**2).sum())
    scale = float(((of_true @ turn) * from_middle).sum()) / square
    left = from_middle - scale * of_true @ turn
    stretch = (left * (of_true @ turn)).sum(axis=1)  # as of a plate of dots: mitsim.decoding.plate
    degrees = 2 * len(points)
    return scale, float(np.sqrt((stretch**2).sum() * degrees / max(degrees - 4, 1)) / square)
