r"""Return the points of a cloud with their covariances, in a chosen frame and unit.

Signal chain: organised cloud -> its points and their view rays -> covariance of each point -> frame -> unit.

mitsim knows the noise of a point along its view ray, sigma. The error across the ray is a fraction of a pixel's
footprint, which is much smaller, and is not stated. The covariance therefore has rank 1,

    C = sigma^2 r r^T,

with r the unit view ray of the point's pixel. It is NaN where sigma is unknown. An algorithm that inverts C
(generalised ICP, Segal et al., RSS 2009) must first add a small multiple of the identity.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from characterisation.files.arrays import Floats
from characterisation.point_cloud import PointCloud
from mitsim.sensor.transforms import Transform

#: upper triangle of a symmetric 3 x 3 matrix, in the order of the files
COVARIANCE = ("cov_xx", "cov_xy", "cov_xz", "cov_yy", "cov_yz", "cov_zz")
_UPPER = np.triu_indices(3)

#: names of a point's properties, in the order of the files, and their types
FIELDS: dict[str, str] = {
    **dict.fromkeys(("x", "y", "z", "sigma", *COVARIANCE), "<f4"),
    "row": "<u2",
    "col": "<u2",
    "feature": "<i2",
}


@dataclass(frozen=True)
class CloudPoints:
    """The n valid points of a cloud, in row order of their pixels."""

    points: Floats  # (n, 3), in ``frame`` and in ``unit``
    sigma: Floats  # (n,) standard deviation along the view ray, in ``unit``; NaN where unknown
    rays: Floats  # (n, 3) unit view rays, in ``frame``
    #: ``row``, ``col``, ``feature``: (n,) position in the sensor's grid; index into ``feature_names``, -1 for none
    row: NDArray[np.uint16]
    col: NDArray[np.uint16]
    feature: NDArray[np.int16]
    feature_names: tuple[str, ...]
    #: ``frame``, ``unit``: name of the frame; ``mm`` or ``m``
    frame: str
    unit: str
    #: ``sensor``, ``source``: as of the cloud
    sensor: str
    source: str

    @property
    def covariance(self) -> Floats:
        """Return the upper triangles xx, xy, xz, yy, yz, zz of the points' covariances, (n, 6), in ``unit`` squared."""
        i, j = _UPPER
        return np.asarray(self.sigma[:, None] ** 2 * self.rays[:, i] * self.rays[:, j])

    def in_metres(self) -> CloudPoints:
        """Return the same in metres."""
        if self.unit == "m":
            return self
        return replace(self, points=self.points / 1000, sigma=self.sigma / 1000, unit="m")

    def table(self) -> NDArray[np.void]:
        """Return all data as a structured array (n,) with the fields :data:`FIELDS`."""
        out = np.zeros(len(self.points), np.dtype(list(FIELDS.items())))
        for values, names in ((self.points, ("x", "y", "z")), (self.covariance, COVARIANCE)):
            for k, name in enumerate(names):
                out[name] = values[:, k]
        for name in ("sigma", "row", "col", "feature"):
            out[name] = getattr(self, name)
        return out


def cloud_points(cloud: PointCloud, part_from_sensor: Transform | None = None) -> CloudPoints:
    """Extract the points of a cloud, in the sensor frame or, with a pose, in the part frame [mm]."""
    rows, columns = np.nonzero(cloud.valid)
    points = cloud.points[rows, columns].astype(np.float64)
    rays = cloud.grid.rays_at(columns, rows)
    if part_from_sensor is not None:
        points, rays = part_from_sensor.points(points), part_from_sensor.directions(rays)
    sigma = np.full(len(rows), np.nan) if cloud.sigma is None else cloud.sigma[rows, columns].astype(np.float64)
    feature = np.full(len(rows), -1) if cloud.feature is None else cloud.feature[rows, columns]
    pixels = rows.astype(np.uint16), columns.astype(np.uint16), feature.astype(np.int16), cloud.feature_names
    frame = "sensor" if part_from_sensor is None else "part"
    return CloudPoints(points, sigma, rays, *pixels, frame, "mm", cloud.sensor, cloud.source)
