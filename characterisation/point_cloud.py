"""The point cloud of one capture, simulated or real.

A cloud is *organised*: it keeps the sensor's pixel grid, because the recovered fraction divides by the number of
possible points. Points are in mm in the sensor frame (x right, y down, z forward), missing points are NaN, and each
missing point has a :class:`Status` that says why.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import IntEnum
from importlib import import_module
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from characterisation.files.errors import MissingEnvironmentError

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from characterisation.region_of_interest import Roi

#: a point farther than this share of |V| from the surface that its pixel shows, along its ray, is a false match: it is
#: no point recovered, no noise, and no point of a feature. The talk does not say what it did with them; a sensor that
#: invents points must not gain by it. It is wide: 6 mm at 600 mm, where a pixel of disparity is worth 6 mm to an
#: Ensenso N10
FALSE_SHARE_OF_DISTANCE = 0.01


class Status(IntEnum):
    """Reason why a pixel has, or lacks, a point."""

    VALID = 0
    NO_SURFACE = 1  #: nothing there to be seen, or outside the images
    OUT_OF_RANGE = 2  #: nearer or farther than the sensor searches
    SATURATED = 3  #: too bright for at least one camera: self-blinding
    LOW_MODULATION = 4  #: the projected light cannot be distinguished from the noise
    SHADOWED = 5  #: the projector does not reach it
    HIDDEN = 6  #: the second camera does not see it, or disagrees
    AMBIGUOUS = 7  #: several places fit equally well
    PHASE_INCONSISTENT = 8  #: the code's images contradict one another
    INTERREFLECTION = 9  #: light that came over another surface
    DROPPED = 10  #: removed at random by the performance map (predicted clouds)
    UNCALIBRATED = 11  #: the calibrated lens distortion gives the pixel no unique ray, or no unique depth on it


@dataclass(frozen=True)
class ViewGrid:
    """Pixel grid of an organised cloud: a pinhole, or a camera with lens distortion.

    ``fx, fy, cx, cy`` are in [px], with pixel centres at integers. ``rotation`` (3, 3) takes grid coordinates to the
    sensor frame; for a rectified grid it is not the identity. ``origin`` (3,) [mm] is the optical centre in the sensor
    frame.

    ``normalised`` (height, width, 2) float32 holds x/z and y/z of each pixel's ray in grid coordinates, for a camera
    with lens distortion. For a pinhole it is None, and the rays follow from ``fx, fy, cx, cy``. With distortion these
    four describe the camera's axis and its angular pitch there. It is NaN for a pixel without a unique ray, which no
    point has.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    rotation: NDArray[np.float64] = field(default_factory=lambda: np.eye(3))
    origin: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    normalised: NDArray[np.float32] | None = None

    def __post_init__(self) -> None:
        if self.normalised is not None and self.normalised.shape != (self.height, self.width, 2):
            raise ValueError(f"grid: normalised is {self.normalised.shape}, the grid {(self.height, self.width)}")

    @property
    def angular_pitch(self) -> float:
        """Angle [rad] between neighbouring pixels on the axis, lambda in the talk."""
        return float(1.0 / np.sqrt(self.fx * self.fy))

    def same_rays(self, other: ViewGrid) -> bool:
        """Return whether every pixel has the ray of the other grid, to a hundredth of a pixel and a micrometre."""
        if (self.width, self.height) != (other.width, other.height):
            return False
        if np.abs(self.origin - other.origin).max() > 1e-3:
            return False
        rows, columns = np.arange(self.height), np.arange(self.width)
        if self.normalised is None and other.normalised is None:  # the rays of pinholes differ most in the corners
            rows, columns = rows[[0, -1]], columns[[0, -1]]
        pixels = np.meshgrid(columns, rows)
        rays, others = self.rays_at(*pixels), other.rays_at(*pixels)
        near = np.linalg.norm(rays - others, axis=-1) < 0.01 * self.angular_pitch
        return bool((near | (np.isnan(rays) & np.isnan(others)).all(axis=-1)).all())

    def thinned(self, step: int) -> ViewGrid:
        """Return the grid of every ``step``-th pixel and row, starting at ``step // 2``."""
        first = step // 2
        rows, columns = range(first, self.height, step), range(first, self.width, step)
        return replace(
            self,
            **{name: getattr(self, name) / step for name in ("fx", "fy")},
            **{name: (getattr(self, name) - first) / step for name in ("cx", "cy")},
            width=len(columns),
            height=len(rows),
            normalised=None if self.normalised is None else self.normalised[first::step, first::step],
        )

    def cropped(self, roi: Roi) -> ViewGrid:
        """Return the grid of a region."""
        bent = None if self.normalised is None else self.normalised[roi.slices]
        cx, cy = self.cx - roi.left, self.cy - roi.top
        return replace(self, cx=cx, cy=cy, width=roi.width, height=roi.height, normalised=bent)

    def rays(self) -> NDArray[np.float64]:
        """Return unit view directions (height, width, 3) in the sensor frame."""
        columns, rows = np.meshgrid(np.arange(self.width), np.arange(self.height))
        return self.rays_at(columns, rows)

    def rays_at(self, columns: NDArray[np.integer], rows: NDArray[np.integer]) -> NDArray[np.float64]:
        """Return unit view directions (..., 3), in the sensor frame, of chosen pixels."""
        if self.normalised is None:
            x, y = (columns - self.cx) / self.fx, (rows - self.cy) / self.fy
        else:
            x, y = np.moveaxis(self.normalised[rows, columns].astype(np.float64), -1, 0)
        local = np.stack([x, y, np.ones(x.shape)], axis=-1) / np.sqrt(x * x + y * y + 1)[..., None]
        return np.asarray(local @ self.rotation.T)

    def project(self, points: NDArray[np.floating]) -> NDArray[np.float64]:
        """Project points (..., 3) of the sensor frame to (column, row) (..., 2); NaN for points behind the grid."""
        local = (points - self.origin) @ self.rotation
        with np.errstate(divide="ignore", invalid="ignore"):
            x, y = local[..., 0] / local[..., 2], local[..., 1] / local[..., 2]
        pixels = np.stack([self.cx + self.fx * x, self.cy + self.fy * y], axis=-1)
        pixels = np.where((local[..., 2] > 0)[..., None], pixels, np.nan)
        return pixels if self.normalised is None else self._bent(pixels)

    def _bent(self, pinhole: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the grid positions (..., 2) that see what a pinhole would see at positions (..., 2).

        Fixed-point iteration p <- p + (wanted - shown at p), which converges while the distortion changes by less than
        1 px per px. Rays are interpolated between pixels (to 1e-3 px for ordinary lenses) and extrapolated beyond the
        edge, and beyond pixels without a ray; a position on such a pixel is NaN.
        """
        table = self.pinhole_positions()
        lost = np.isnan(table[..., 0])
        if lost.any() and not lost.all():
            row, column = distance_transform_edt(lost, return_distances=False, return_indices=True)
            rows, columns = np.indices(lost.shape)
            table = table[row, column] + np.stack([columns - column, rows - row], axis=-1)
        last = np.array([self.width, self.height]) - 1
        at = pinhole
        for _ in range(60):
            inside = np.clip(np.nan_to_num(at), 0, last)
            column, row = np.moveaxis(np.minimum(inside.astype(np.intp), np.maximum(last - 1, 0)), -1, 0)
            right, below = np.minimum(column + 1, last[0]), np.minimum(row + 1, last[1])
            a, b = np.moveaxis(inside - np.stack([column, row], axis=-1), -1, 0)[..., None]
            upper = (1 - a) * table[row, column] + a * table[row, right]
            lower = (1 - a) * table[below, column] + a * table[below, right]
            step = pinhole - ((1 - b) * upper + b * lower + at - inside)
            at = at + step
            if not (np.abs(step) > 1e-9).any():
                break
        if lost.any():
            nearest = np.clip(np.rint(np.nan_to_num(at)), 0, last).astype(np.intp)
            at = np.where(lost[nearest[..., 1], nearest[..., 0]][..., None], np.nan, at)
        return at

    def pinhole_positions(self) -> NDArray[np.float64]:
        """Return the positions (height, width, 2) at which a pinhole would see what each distorted pixel sees."""
        assert self.normalised is not None
        return self.normalised.astype(np.float64) * [self.fx, self.fy] + [self.cx, self.cy]

    def cos_off_axis(self, directions: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return the cosine of the angle phi between view directions (..., 3) and the grid's axis.

        One pixel of a pinhole covers the solid angle lambda^2 cos^3(phi), because the imager is flat.
        """
        axis = self.rotation[:, 2]
        return np.asarray(directions @ axis / np.linalg.norm(directions, axis=-1))


class HasPlane(Protocol):
    """A plane through ``point`` (3,) [mm] with the unit ``normal`` (3,)."""

    @property
    def point(self) -> NDArray[np.float64]:
        """Return a point of the plane (3,) [mm]."""

    @property
    def normal(self) -> NDArray[np.float64]:
        """Return its unit normal (3,)."""


@dataclass(frozen=True)
class PointCloud:
    """Organised cloud of one capture.

    Parameters
    ----------
    points
        (H, W, 3) float32 [mm], sensor frame, NaN where missing.
    status
        (H, W) uint8 of :class:`Status`; ``VALID`` exactly where the point is finite.
    grid
        The grid of the pixels.
    sensor
        Name of the sensor.
    source
        ``simulated``, ``predicted``, ``device``, ``replay`` or ``emulator``.
    baseline
        (3,) unit vector in the sensor frame from the reference camera to the second camera or projector. A sensor is
        not symmetric about its axis, so normals are expressed relative to the baseline.
    feature
        (H, W) int16 index into ``feature_names``, -1 where a pixel belongs to no feature; None when unlabelled.
    sigma
        (H, W) float32 [mm], expected standard deviation along the view ray: from the performance map for a predicted
        cloud, from the imager's noise for a decoded one. None if unknown: no imager is stated, and its noise cannot be
        measured in the images (from 2000 usable pixels on).
    """

    points: NDArray[np.float32]
    status: NDArray[np.uint8]
    grid: ViewGrid
    sensor: str
    source: str
    baseline: NDArray[np.float64] = field(default_factory=lambda: np.array([1.0, 0.0, 0.0]))
    feature: NDArray[np.int16] | None = None
    feature_names: tuple[str, ...] = ()
    sigma: NDArray[np.float32] | None = None

    def __post_init__(self) -> None:
        shape = (self.grid.height, self.grid.width)
        for name, array in (("points", self.points[..., 0]), ("status", self.status), ("feature", self.feature)):
            if array is not None and array.shape != shape:
                raise ValueError(f"cloud: {name} is {array.shape}, the grid is {shape}")

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Mask (H, W) of the pixels that have a point."""
        return np.isfinite(self.points[..., 2])

    def _labelled(self, name: str) -> NDArray[np.intp]:
        if self.feature is None:
            raise ValueError("this cloud has no feature labels")
        return np.flatnonzero(self.feature == self.feature_names.index(name))

    def of_feature(self, name: str) -> NDArray[np.float64]:
        """Return the points (n, 3) [mm] of one feature, in the sensor frame."""
        labelled = self.points.reshape(-1, 3)[self._labelled(name)]
        return np.asarray(labelled[np.isfinite(labelled[:, 2])], np.float64)

    def rays_of_feature(self, name: str, most: int | None = None) -> NDArray[np.float64]:
        """Return the unit view directions (n, 3), sensor frame, of a feature's pixels, with or without a point.

        Of more than ``most`` pixels, evenly chosen ones.
        """
        labelled = self._labelled(name)
        step = 1 if most is None else max(-(-len(labelled) // most), 1)
        rows, columns = np.divmod(labelled[::step], self.grid.width)
        return self.grid.rays_at(columns, rows)

    def to_open3d(self) -> Any:
        """Return the points as an Open3D cloud; Open3D must be installed separately.

        Returns
        -------
        open3d.geometry.PointCloud
            The valid points (n, 3) [mm] in the sensor frame, row by row, as in ``points[valid]``.

        Raises
        ------
        MissingEnvironmentError
            If Open3D is not installed.

        Examples
        --------
        >>> import characterisation
        >>> cloud = characterisation.read_cloud("cloud.ply")
        >>> shown = cloud.to_open3d()  # doctest: +SKIP
        """
        try:
            open3d = import_module("open3d")
        except ImportError:
            raise MissingEnvironmentError(
                "to_open3d needs open3d, which is not installed: pip install open3d"
            ) from None
        out = open3d.geometry.PointCloud()
        out.points = open3d.utility.Vector3dVector(self.points[self.valid].astype(np.float64))
        return out

    def plot(self, ax: Axes | None = None, *, plane: HasPlane | None = None) -> Axes:
        """Draw the depth of every point, and why the other pixels have none.

        Parameters
        ----------
        ax
            Axes to draw into; by default those of a new figure.
        plane
            A plane with ``point`` (3,) [mm] and unit ``normal`` (3,) in the sensor frame, as
            :func:`characterisation.fit_plane` returns. The distance of the points from it, positive on the side of the
            normal, is then drawn instead of their depth.

        Returns
        -------
        matplotlib.axes.Axes
            x is the column and y the row of a pixel. Colours are the depth z in the sensor frame [mm], or the distance
            from the plane [mm].

        Raises
        ------
        InputError
            If ``ax`` is something else.

        Examples
        --------
        >>> import characterisation
        >>> cloud = characterisation.read_cloud("coupon.ply")
        >>> cloud.plot().get_xlabel()
        'column [px]'
        >>> plane = characterisation.fit_plane(cloud.points[cloud.valid], viewpoint=(0, 0, 0))
        >>> axes = cloud.plot(plane=plane)
        >>> axes.figure.savefig("residuals.png")
        """
        # imported here because a cloud alone does not need matplotlib
        from characterisation.plots.clouds import draw_cloud
        from characterisation.plots.style import axes_for

        values, label = self.points[..., 2], "depth z, sensor frame [mm]"
        if plane is not None:
            values = (self.points - np.asarray(plane.point)) @ np.asarray(plane.normal)
            label = "distance from the plane [mm]"
        wide = 6.4
        with axes_for(ax, (1, 1), (wide, min(0.72 * wide * self.grid.height / self.grid.width, 8.0) + 1.7)) as grid:
            axes: Axes = grid[0, 0]
            draw_cloud(axes, values, self.status, {s.value: s.name for s in Status}, label, plane is not None)
            axes.set_title(f"{self.sensor}, {self.source}: {self.valid.sum()} points of {self.status.size} pixels")
        return axes

    def reasons(self) -> Mapping[str, int]:
        """Count the pixels of each status, by name, most frequent first."""
        values, counts = np.unique(self.status, return_counts=True)
        order = np.argsort(-counts)
        return {Status(values[i]).name.lower(): int(counts[i]) for i in order}
