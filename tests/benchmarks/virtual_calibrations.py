"""What a calibration of each preset leaves of its accuracy, alone and with drift: a row for each sensor.

With ``--causes``: the relative error of a ball bar that each cause alone gives, to first order [1e-6, one sigma].

python tests/benchmarks/virtual_calibrations.py [--causes] [SENSOR ...]
"""

import sys
from dataclasses import replace

import numpy as np

from mitsim.sensor.drift import Drift
from mitsim.sensor.preset import load_sensor
from mitsim.sensor.preset_covariance import with_drift
from mitsim.sensor.rig_covariance import RigCovariance
from mitsim.sensor.rig_parameters import PATH_NAMES, moved, path_error
from mitsim.study.calibration.accuracy import _BARS, measured_points, measuring_volume
from mitsim.study.calibration.board import default_board
from mitsim.study.calibration.bundle import BoardSetup, linearise
from mitsim.study.calibration.virtual_calibration import (
    POSES,
    _with_path,
    board_views,
    calibrate,
    sensor_drift,
)

SENSORS = (
    "ensenso-n10",
    "ensenso-n35",
    "oak-d-pro",
    "realsense-d435",
    "primesense-carmine-1.09",
    "photoneo-phoxi-s",
    "david-sls-3",
    "zivid-2-m70",
    "zivid-2-plus-m60",
    "zivid-2-plus-l110",
    "zivid-2-plus-m130",
    "xema",
    "kinect-v2",
)
FIGURES = {
    "ball bar SD, one sigma [mm]": "sphere_spacing_sigma_mm",
    "flatness, median [mm]": "flatness_median_mm",
    "distance, one sigma [mm]": "depth_sigma_mm",
}
#: causes of drift, and the terms of :class:`Drift` that hold them
DRIFTS = {
    "vergence": ("vergence_mrad",),
    "row error": ("row_mrad",),
    "roll": ("roll_mrad",),
    "focal length": ("focal_relative",),
    "temperature": ("baseline_per_kelvin", "temperature_k"),
}


def main(names: list[str]) -> None:
    """Print the table."""
    heads = ["sensor", "board", "corner [px]", "at, diagonal [mm]", *FIGURES]
    print("| " + " | ".join(heads) + " |\n" + "| --- " * len(heads) + "|")
    for name in names:
        found = calibrate(load_sensor(name))
        corner = [view.camera_px for view in found.setup.views]
        alone, drifted = found.accuracy.numbers(), found.accuracy_drifted.numbers()
        cells = [
            name,
            f"{found.setup.board.square_mm:g} mm, {found.setup.board.grade}",
            f"{min(corner):.3f} to {max(corner):.3f}",
            f"{alone['middle_mm']:.0f}, {alone['diagonal_mm']:.0f}",
            *(f"{alone[key]:.3g}, {drifted[key]:.3g}" for key in FIGURES.values()),
        ]
        print("| " + " | ".join(cells) + " |", flush=True)


def tell_causes(names: list[str]) -> None:
    """Print the table of causes."""
    heads = ["sensor", "corner noise", "board: scale", "board: bending", *DRIFTS]
    print("| " + " | ".join(heads) + " |\n" + "| --- " * len(heads) + "|")
    for name in names:
        print("| " + " | ".join([name, *(f"{1e6 * one:.0f}" for one in causes(name))]) + " |", flush=True)


def causes(name: str) -> list[float]:
    """Return the relative error of a ball bar by each cause, root mean square over the bars of VDI/VDE 2634-2."""
    sensor = load_sensor(name)
    eyes = sensor.measuring_eyes
    board = default_board(sensor.rig.reference, float(np.sqrt(np.prod(sensor.working_range_mm))))
    views = board_views(sensor, eyes, board, POSES, 1)
    linear = linearise(BoardSetup(sensor.measuring_rig, eyes, board, views))
    flight = sensor.technology == "time_of_flight"
    parameters = (*linear.names, *PATH_NAMES) if flight else linear.names
    modes = np.arange(len(linear.board_sigma))
    parts = [replace(linear, board_sigma=0 * linear.board_sigma)]
    parts += [
        replace(linear, noise=0 * linear.noise, board_sigma=np.where(here, linear.board_sigma, 0.0))
        for here in (modes == 0, (modes >= 1) & (modes <= 3))
    ]
    covariances = [
        RigCovariance(parameters, _with_path(part, board, views) if flight else part.covariance(), "", {})
        for part in parts
    ]
    nothing = RigCovariance(parameters, np.zeros((len(parameters),) * 2), "", {})
    drift = sensor_drift(sensor)
    for terms in DRIFTS.values():
        alone = replace(Drift.none(), **{term: getattr(drift, term) for term in terms})
        covariances.append(with_drift(nothing, sensor, alone))
    bars = measuring_volume(eyes, sensor.working_range_mm).points(_BARS)
    lengths = np.linalg.norm(bars[:, 1] - bars[:, 0], axis=1)

    def measured(values: np.ndarray) -> np.ndarray:
        true = moved(sensor.rig, parameters, values)
        found = measured_points(sensor, bars.reshape(-1, 3), true, path_error(parameters, values)).reshape(bars.shape)
        return np.linalg.norm(found[:, 1] - found[:, 0], axis=1)

    out = []
    for one in covariances:
        variances, vectors = np.linalg.eigh(one.correlation)
        root = one.one_sigma[:, None] * vectors * np.sqrt(np.clip(variances, 0, None))
        changes = [(measured(step) - measured(-step)) / 2 / lengths for step in root.T if step.any()]
        out.append(float(np.sqrt(np.sum(np.square(changes)) / len(lengths))))
    return out


if __name__ == "__main__":
    asked = [one for one in sys.argv[1:] if one != "--causes"] or list(SENSORS)
    (tell_causes if "--causes" in sys.argv else main)(asked)
