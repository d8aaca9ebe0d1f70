"""Length errors of a preset over distance by its stated calibration, beside the maker's own curve.

python tests/benchmarks/zivid_lengths.py [SENSOR] [--vergence MRAD ...]

Rigs are drawn from the preset's calibration with its drift, or with another vergence. Each measures bars of 8 % of the
distance, along, across and oblique to the image, in the middle and at the four sides of the field, without noise. The
share of the maker's curve of |error| / length is printed at its distances, and the geometric mean of their ratios, by
which the preset's vergence was chosen.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mitsim.sensor.drift import Drift
from mitsim.sensor.preset import load_sensor
from mitsim.sensor.preset_covariance import preset_covariance, with_drift
from mitsim.sensor.rig_covariance import RigCovariance
from mitsim.sensor.rig_parameters import moved
from mitsim.sensor.sensor import Sensor
from mitsim.study.calibration.accuracy import measured_points

Floats = NDArray[np.float64]
DRAWS, SEED, BAR = 200, 1, 0.08
#: middle and sides of the field, as shares of the distance; directions of the bars
PLACES = ((0, 0), (-0.25, 0), (0.25, 0), (0, -0.15), (0, 0.15))
DIRECTIONS = ((1, 0, 0), (0, 1, 0), (0.7071, 0, 0.7071))


def length_errors(sensor: Sensor, covariance: RigCovariance, distance: float) -> Floats:
    """Return the relative errors (draws, bars) of lengths at a distance [mm]."""
    middles = np.array([[x * distance, y * distance, distance] for x, y in PLACES])
    half = BAR * distance / 2 * np.array(DIRECTIONS)
    bars = np.stack([middles[:, None] - half, middles[:, None] + half], axis=2).reshape(-1, 2, 3)
    points = bars.reshape(-1, 3)
    lengths = np.linalg.norm(bars[:, 1] - bars[:, 0], axis=1)
    nominal = measured_points(sensor, points, sensor.rig)
    out = []
    for stream in np.random.default_rng(SEED).spawn(DRAWS):
        true = moved(sensor.rig, covariance.names, covariance.draw(stream))
        found = (measured_points(sensor, points, true) - nominal + points).reshape(-1, 2, 3)
        out.append(np.linalg.norm(found[:, 1] - found[:, 0], axis=1) / lengths - 1)
    return np.array(out)


def main(arguments: list[str]) -> None:
    """Print a table: distance, the maker's error, and that of each vergence."""
    parser = argparse.ArgumentParser()
    parser.add_argument("sensor", nargs="?", default="zivid-2-m70")
    parser.add_argument("--vergence", type=float, nargs="+", help="mrad, in place of the preset's")
    given = parser.parse_args(arguments)
    sensor = load_sensor(given.sensor)
    curve, own = sensor.published_lengths, sensor.unknowns.calibration.drift()
    if curve is None:
        sys.exit(f"{sensor.name} has no [published_lengths]")
    alone = preset_covariance(sensor, Drift.none())
    for vergence in given.vergence or [own.vergence_mrad]:
        covariance = with_drift(alone, sensor, replace(own, vergence_mrad=vergence))
        ratios = []
        print(f"\nvergence {vergence:g} mrad")
        print(f"| distance [mm] | maker, {100 * curve.share:.0f} % within | the same, stated |\n|---|---|---|")
        for distance, error in zip(curve.distance_mm, curve.error, strict=True):
            stated = float(np.quantile(np.abs(length_errors(sensor, covariance, distance)), curve.share))
            ratios.append(stated / error)
            print(f"| {distance:g} | {100 * error:.3f} % | {100 * stated:.3f} % |")
        print(f"ratio, geometric mean: {np.exp(np.mean(np.log(ratios))):.3f}")


if __name__ == "__main__":
    main(sys.argv[1:])
