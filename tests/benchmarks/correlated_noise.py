"""Compare the correlation of predicted errors with that of a decoded render: residuals of the plate of two pillars.

    python tests/benchmarks/correlated_noise.py [map.nc] [repeats]

A view of the two-pillar part by an Ensenso N10 is rendered and decoded. It is also predicted from the map, once with
independent and once with correlated noise. Each is repeated several times with fresh noise. A plane is fitted to the
plate's points by least squares along their rays. The columns are means over the repeats:

- the standard deviation of the residuals,
- their autocorrelation rho on the pixel grid, and the length at which it falls under 1/e,
- the noise area, a sum over rho,
- the distance of the fitted plane from the plate at its points, root mean square: the error that does not average out.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from characterisation.coupon.residual_field import autocorrelation
from characterisation.point_cloud import PointCloud
from mitsim.capture.simulated.rendering import Rendering
from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.decoding.cloud import capture_cloud, sensor_geometry
from mitsim.maps.prediction import CharacterisedScene, Predictor
from mitsim.scene.load import load_scene
from mitsim.sensor.preset import load_sensor
from mitsim.sensor.transforms import Transform, look_at
from mitsim.study import read_map

SCENE = Path(__file__).parents[2] / "scenes/two_pillars/two_pillars.xml"
SENSOR, FEATURE, LAGS = "ensenso-n10", "plane", (1, 2, 3, 4, 6, 8)
POSE = look_at([120, -330, 330], [0, 0, 20], [0, 0, 1])

#: an error farther from the fitted plane than so many robust standard deviations is an outlier
OUTLIER = 5.0


def residuals(cloud: PointCloud, pose: Transform) -> tuple[np.ndarray, float]:
    """Errors (H, W) along the rays about the plate's own plane, NaN elsewhere, and how far that is from the plate."""
    mask = cloud.valid & (cloud.feature == cloud.feature_names.index(FEATURE))
    rays, points = cloud.grid.rays()[mask], cloud.points[mask].astype(float)
    # the plate is z = 0 of the world
    normal = pose.inverse().directions(np.array([0.0, 0.0, 1.0]))
    away = (pose.inverse().translation - cloud.grid.origin) @ normal / (rays @ normal)
    error = np.linalg.norm(points - cloud.grid.origin, axis=1) - away
    # 1 / distance along a ray is linear in the ray on a plane, and so is a small error over distance squared
    design = rays * away[:, None] ** 2
    kept = np.ones(len(error), bool)
    for _ in range(3):
        fit = np.linalg.lstsq(design[kept], error[kept], rcond=None)[0]
        left = error - design @ fit
        kept = np.abs(left) < OUTLIER * 1.4826 * np.median(np.abs(left))
    out = np.full(mask.shape, np.nan)
    out[mask] = np.where(kept, left, np.nan)
    return out, float(np.sqrt(np.mean((design @ fit) ** 2)))


def main(map_file: str = SENSOR, repeats: int = 6) -> None:
    """Print the table."""
    sensor = load_sensor(SENSOR)
    performance_map, scene = read_map(Path(map_file), sensor), load_scene(SCENE, sensor.wavelength_nm)
    geometry, simulated = sensor_geometry(sensor), SimulatedSensor(sensor)
    predictor = Predictor.of_sensor(sensor, geometry)
    characterised = CharacterisedScene(scene, performance_map)

    def rendered(seed: int) -> PointCloud:
        capture = simulated.capture(scene, POSE, rendering=Rendering(samples=16), seed=seed)
        labels = predictor.labels(scene, POSE, predictor.surfaces(scene, POSE))
        cloud = capture_cloud(capture, sensor.settings, geometry)
        return replace(cloud, feature=labels, feature_names=scene.names)

    ways = {
        "rendered": rendered,
        "predicted, correlated": lambda seed: predictor.predict(characterised, POSE, np.random.default_rng(seed), True),
        "predicted, independent": lambda seed: predictor.predict(characterised, POSE, np.random.default_rng(seed)),
    }
    print(f"{'':24s}{'points':>7s}{'sigma mm':>10s}{'length px':>11s}", end="")
    print("".join(f"{f'rho({lag})':>8s}" for lag in LAGS) + f"{'plane mm':>10s}")
    for name, cloud in ways.items():
        rows, rhos = [], []
        for seed in range(1, repeats + 1):
            field, plane = residuals(cloud(seed), POSE)
            rho = autocorrelation(field, 16)
            row, column = np.nonzero(np.isfinite(field))
            part = field[row.min() : row.max() + 1, column.min() : column.max() + 1]
            rows.append([np.isfinite(part).sum(), np.nanstd(part), rho.length(), plane])
            length, along = rho.radial()
            rhos.append(np.interp(LAGS, length, along))
        count, sigma, length, _ = np.mean(rows, axis=0)
        off = np.sqrt(np.mean(np.array(rows)[:, 3] ** 2))
        print(f"{name:24s}{count:7.0f}{sigma:10.3f}{length:11.2f}", end="")
        print("".join(f"{value:8.2f}" for value in np.mean(rhos, axis=0)) + f"{off:10.3f}")


if __name__ == "__main__":
    main(*sys.argv[1:2], *(int(argument) for argument in sys.argv[2:3]))
