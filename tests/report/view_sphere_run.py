"""The synthetic run with closed forms in what its views let expect, hostile names and two measurements.

Views 0 to 5 stand at an elevation of 60 deg, 6 to 10 at 20 deg, a sixth of a turn apart; view 11 looks as view 10 does,
from farther away and rolled. Of measurement 0 the uncertainty is 0.01 (1 + view), so its order is that of the numbers;
views 5 and 9 cannot make it. Of measurement 1 it is the other way round, and view 3 has an uncertainty but hardly a
chance. Views 1 and 0 differ on the limiting feature by known factors.
"""

import json
from pathlib import Path

import numpy as np
import trimesh
import xarray as xr

from characterisation.cloud_files import write_cloud
from characterisation.files.atomic_io import write_netcdf
from characterisation.point_cloud import PointCloud, Status, ViewGrid
from mitsim.sensor.transforms import look_at
from tests.report.conftest import CHECKED, FEATURES, MEASUREMENTS, expect, write_run

VIEWS, IMPOSSIBLE = 12, (5, 9)
WITH_CLOUD = sorted({*CHECKED, 2})
TOLERANCE = (0.52, np.nan)
SET = {
    "limits": {MEASUREMENTS[1]: 0.05},
    "views": [2, 7],
    "uncertainty": {MEASUREMENTS[1]: 0.04},
    "feasible": {MEASUREMENTS[1]: True},
    "exact": True,
    "tried": [{"views": [4, 7], "excess": 1.3}, {"views": [5], "excess": None}, {"views": [2, 7], "excess": 0.9}],
}


def write_expecting_run(folder: Path) -> Path:
    write_run(folder)
    scores = xr.load_dataset(folder / "scores.nc")
    numbers = np.arange(VIEWS)
    u = np.stack([0.01 * (1.0 + numbers), 0.01 * (12.0 - numbers)])
    u[0, list(IMPOSSIBLE)] = np.nan
    chance = np.where(np.isfinite(u), 0.99, 0.0)
    chance[1, 3] = 0.3
    expect(scores, u, chance)
    limit = np.where(np.isfinite(u), "noise", "occlusion").astype(object)
    limit[1, 3], limit[0, 9] = "few points", "short arc"
    scores["limit"] = (("measurement", "view"), limit.astype(str))
    scores["tolerance"] = ("measurement", list(TOLERANCE))
    scores["nominal"], scores["unit"] = ("measurement", [0.0, 20.0]), ("measurement", ["deg", "mm"])

    # on the second feature, view 1 against view 0: a quarter of the pixels, 1/2.25 of them free, all given back, 0.8 of
    # the noise; so the factors are 2, 1.5, 1 and 0.8, and of the 2 between their uncertainties geometry has 1/1.2
    alone, free, n = np.full((VIEWS, 2), 4000.0), np.full((VIEWS, 2), 0.9), np.zeros((VIEWS, 2))
    alone[1, 1], free[1, 1] = 1000.0, 0.4
    free[5] = 0.0
    alone[3, 1] = 50.0
    n[:] = alone * free * 0.5
    sigma = np.where(n > 0, 0.2, np.nan)
    sigma[1, 1] = 0.16
    by = ("view", "feature")
    scores["n"], scores["R_f"], scores["n_only_white"], scores["mean_sigma"] = (
        (by, values) for values in (n, free, alone, sigma)
    )
    standoff = np.full(VIEWS, 500.0)
    standoff[11] = 600.0
    azimuth, elevation = np.arange(VIEWS) * 60.0, np.where(numbers < 6, 60.0, 20.0)
    azimuth[11] = azimuth[10]
    a, e = np.radians(azimuth), np.radians(elevation)
    direction = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=-1)
    poses = [look_at(s * d, [0, 0, 0], [0, 0, 1]).matrix() for s, d in zip(standoff, direction, strict=True)]
    scores["direction"], scores["world_from_sensor"] = (("view", "xyz"), direction), (("view", "i", "j"), poses)
    scores["azimuth_deg"], scores["standoff_mm"] = ("view", azimuth), ("view", standoff)
    write_netcdf(scores, folder / "scores.nc")

    for view in WITH_CLOUD:
        write_cloud(cloud_of(view), folder / "clouds" / f"predicted_{view:04d}.ply")
    trimesh.creation.box((240, 240, 1)).export(folder / "part.ply")
    about = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    (folder / "run.json").write_text(json.dumps(about | {"view_sets": [SET]}), encoding="utf-8")
    return folder


def cloud_of(view: int) -> PointCloud:
    """A slanted square 500 mm before the sensor, half of it the first feature; on the grid of the rendered clouds."""
    grid = ViewGrid(40.0, 40.0, 15.5, 11.5, 32, 24)
    rays = grid.rays()
    points = (rays * (500 + 40 * rays[..., :1] + view) / rays[..., 2:]).astype(np.float32)
    status = np.full(points.shape[:2], Status.NO_SURFACE, np.uint8)
    status[5:20, 8:28] = Status.VALID
    points[status != Status.VALID] = np.nan
    columns = np.broadcast_to(np.arange(32), status.shape)
    feature = np.where(columns < 14, 1, np.where(columns < 24, 0, -1)).astype(np.int16)
    sigma = np.where(status == Status.VALID, 0.05 * 1.1**columns, np.nan).astype(np.float32)
    names = (FEATURES[1], FEATURES[0])  # a cloud numbers the shapes of its scene, in the scene's own order
    about = {"feature": feature, "feature_names": names, "sigma": sigma}
    return PointCloud(points, status, grid, "test-sensor", "predicted", **about)
