"""What a calibration of each preset leaves of its accuracy, alone and with drift: a row for each sensor.

python tests/benchmarks/virtual_calibrations.py [SENSOR ...]
"""

import sys

from mitsim.calibration.virtual_calibration import calibrate
from mitsim.sensor.preset import load_sensor

SENSORS = (
    "ensenso-n10",
    "ensenso-n35",
    "oak-d-pro",
    "realsense-d435",
    "primesense-carmine-1.09",
    "photoneo-phoxi-s",
    "david-sls-3",
    "zivid-2-m70",
    "kinect-v2",
)
FIGURES = {
    "ball bar SD, one sigma [mm]": "sphere_spacing_sigma_mm",
    "flatness, median [mm]": "flatness_median_mm",
    "distance, one sigma [mm]": "depth_sigma_mm",
}


def main(names: list[str]) -> None:
    """Print the table."""
    heads = ["sensor", "board", "corner [px]", "at, diagonal [mm]", *FIGURES]
    print("| " + " | ".join(heads) + " |\n" + "| --- " * len(heads) + "|")
    for name in names:
        found = calibrate(load_sensor(name))
        corner = [view.camera_px for view in found.views]
        alone, drifted = found.accuracy.numbers(), found.accuracy_drifted.numbers()
        cells = [
            name,
            f"{found.board.square_mm:g} mm, {found.board.grade}",
            f"{min(corner):.3f} to {max(corner):.3f}",
            f"{alone['middle_mm']:.0f}, {alone['diagonal_mm']:.0f}",
            *(f"{alone[key]:.3g}, {drifted[key]:.3g}" for key in FIGURES.values()),
        ]
        print("| " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:] or list(SENSORS))
