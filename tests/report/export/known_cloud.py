"""A cloud on a turned grid away from the sensor's origin, half of whose points have a known sigma."""

import numpy as np
from scipy.spatial.transform import Rotation

from characterisation.point_cloud import PointCloud, Status, ViewGrid
from mitsim.sensor.transforms import Transform

TURN = Rotation.from_rotvec([0.1, -0.2, 0.3]).as_matrix()
POSE = Transform(Rotation.from_rotvec([0.7, 1.9, -0.4]).as_matrix(), np.array([120.0, -340.0, 560.0]))


def known_cloud() -> PointCloud:
    grid = ViewGrid(60.0, 62.0, 15.2, 11.7, 32, 24, TURN, np.array([5.0, -3.0, 1.0]))
    rng = np.random.default_rng(4)
    status = np.where(rng.random((24, 32)) < 0.3, Status.LOW_MODULATION, Status.VALID).astype(np.uint8)
    points = grid.origin + grid.rays() * rng.uniform(480, 520, (24, 32, 1))
    points[status != Status.VALID] = np.nan
    sigma = np.where(np.arange(32) < 16, 0.05 + 0.001 * np.arange(24)[:, None], np.nan)
    sigma[status != Status.VALID] = np.nan
    feature = np.where(np.arange(24)[:, None] < 12, 1, -1) * np.ones((1, 32), int)
    return PointCloud(
        points.astype(np.float32),
        status,
        grid,
        "test-sensor",
        "predicted",
        feature=feature.astype(np.int16),
        feature_names=("plane", "bore"),
        sigma=sigma.astype(np.float32),
    )


def expected(cloud: PointCloud, pose: Transform | None, scale: float = 1.0) -> dict[str, np.ndarray]:
    """Points and covariances (n, 3, 3) pixel by pixel: the closed form, written down another way."""
    points, covariances, place = [], [], []
    for row, col in zip(*np.nonzero(cloud.valid), strict=True):
        local = np.array([(col - cloud.grid.cx) / cloud.grid.fx, (row - cloud.grid.cy) / cloud.grid.fy, 1.0])
        ray = cloud.grid.rotation @ local / np.sqrt(local @ local)
        point = cloud.points[row, col].astype(float)
        if pose is not None:
            ray, point = pose.rotation @ ray, pose.rotation @ point + pose.translation
        along = float(cloud.sigma[row, col]) * ray
        points.append(point * scale)
        covariances.append(np.outer(along, along) * scale**2)
        place.append((row, col))
    return {"points": np.array(points), "covariance": np.array(covariances), "place": np.array(place)}


def symmetric(upper: np.ndarray) -> np.ndarray:
    """Matrices (n, 3, 3) of their upper triangles (n, 6)."""
    return upper[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
