"""The point cloud that every sensor, simulated or real, is judged by.

A cloud is *organised*: it keeps the sensor's pixel grid, because the fraction of points recovered needs to know how
many points there could have been. Points are in mm in the sensor frame (x right, y down, z forward), missing points
are NaN, and each missing point has a :class:`Status` that says why.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating]


class Status(IntEnum):
    """Why a pixel has, or has not, a point."""

    VALID = 0
    NO_SURFACE = 1  #: nothing there to be seen, or outside the images
    OUT_OF_RANGE = 2  #: nearer or farther than the sensor searches
    SATURATED = 3  #: too bright for at least one camera: self-blinding
    LOW_MODULATION = 4  #: the projected light cannot be told from the noise
    SHADOWED = 5  #: the projector does not reach it
    HIDDEN = 6  #: the second camera does not see it, or disagrees
    AMBIGUOUS = 7  #: several places fit equally well
    PHASE_INCONSISTENT = 8  #: the code's images contradict one another
    INTERREFLECTION = 9  #: light that came by way of another surface
    DROPPED = 10  #: removed at random by the performance map (predicted clouds)


@dataclass(frozen=True)
class ViewGrid:
    """Pinhole grid on which a cloud is organised.

    ``fx, fy, cx, cy`` [px], pixel centres at integers; ``rotation`` (3, 3) takes grid coordinates to the sensor frame
    (not the identity for a rectified grid); the grid looks from ``origin`` (3,) [mm] in the sensor frame.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    rotation: NDArray[np.float64] = field(default_factory=lambda: np.eye(3))
    origin: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))

    @property
    def angular_pitch(self) -> float:
        """Lambda of the talk: angle between neighbouring pixels on the axis [rad]."""
        return float(1.0 / np.sqrt(self.fx * self.fy))

    def rays(self) -> NDArray[np.float64]:
        """Unit view directions in the sensor frame, (height, width, 3)."""
        columns, rows = np.meshgrid(np.arange(self.width), np.arange(self.height))
        local = np.stack([(columns - self.cx) / self.fx, (rows - self.cy) / self.fy, np.ones(columns.shape)], axis=-1)
        local /= np.linalg.norm(local, axis=-1, keepdims=True)
        return np.asarray(local @ self.rotation.T)

    def project(self, points: Floats) -> NDArray[np.float64]:
        """Grid positions (..., 2) as (column, row) of points (..., 3) in the sensor frame; NaN behind the grid."""
        local = (points - self.origin) @ self.rotation
        with np.errstate(divide="ignore", invalid="ignore"):
            x, y = local[..., 0] / local[..., 2], local[..., 1] / local[..., 2]
        pixels = np.stack([self.cx + self.fx * x, self.cy + self.fy * y], axis=-1)
        return np.where((local[..., 2] > 0)[..., None], pixels, np.nan)

    def cos_off_axis(self, directions: Floats) -> NDArray[np.float64]:
        """Cosine of the angle phi between view directions (..., 3) and the grid's axis.

        One pixel covers a solid angle of lambda^2 cos^3(phi): a flat imager sees less of the world off its axis.
        """
        axis = self.rotation[:, 2]
        return np.asarray(directions @ axis / np.linalg.norm(directions, axis=-1))


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
        The pinhole grid of the pixels.
    sensor, source
        Name of the sensor; ``simulated | predicted | device | replay | emulator``.
    baseline
        (3,) unit vector in the sensor frame from the reference camera to the second eye: a sensor is not symmetric
        about its axis, so normals are expressed relative to it.
    feature
        (H, W) int16 index into ``feature_names``, -1 where a pixel belongs to no feature; None when unlabelled.
    sigma
        (H, W) float32 [mm], standard deviation along the view ray that the map foretells; predicted clouds only.
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
        """(H, W) mask of the pixels that have a point."""
        return np.isfinite(self.points[..., 2])

    def of_feature(self, name: str) -> NDArray[np.float64]:
        """Points of one feature, (n, 3) [mm], sensor frame."""
        if self.feature is None:
            raise ValueError("this cloud has no feature labels")
        mask = self.valid & (self.feature == self.feature_names.index(name))
        return np.asarray(self.points[mask], np.float64)

    def reasons(self) -> Mapping[str, int]:
        """How many pixels have each status, by name, most frequent first."""
        values, counts = np.unique(self.status, return_counts=True)
        order = np.argsort(-counts)
        return {Status(values[i]).name.lower(): int(counts[i]) for i in order}
