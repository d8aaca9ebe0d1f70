"""A 5-megapixel camera and 48 patterns: peak memory of one capture, and its time.

    python tests/benchmarks/large_sensor.py

The part is the two-pillar artefact in metal, direct light, 16 samples per pixel; the capture is 48 images of 12 bits.
"""

from __future__ import annotations

import resource
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.scene.load import load_scene
from mitsim.sensor.camera import Camera, Rig
from mitsim.sensor.light_code import PhaseShift
from mitsim.sensor.preset import load_sensor
from mitsim.sensor.transforms import look_at

ROOT = Path(__file__).parents[2]


def main() -> None:
    """Take the capture and print what it took."""
    small = load_sensor(ROOT / "tests/data/fringes.toml")
    matrix = np.array([[3450.0, 0, 1223.5], [0, 3450.0, 1023.5], [0, 0, 1]])
    camera = Camera(matrix, np.array([-0.1, 0.05, 0, 0, 0]), 2448, 2048)
    code = PhaseShift(periods_px=[2000, 260, 34, 18], steps=12)
    optics = replace(small.projector.optics, width=1920, height=1200)
    projector = replace(small.projector, optics=optics)
    sensor = replace(small, rig=Rig({"camera": camera}, optics), projector=projector, pattern=code)
    scene = load_scene(ROOT / "scenes/two_pillars/two_pillars.xml", sensor.wavelength_nm)
    base = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024**2
    start = time.perf_counter()
    simulated = SimulatedSensor(sensor)
    ready = time.perf_counter()
    capture = simulated.capture(scene, look_at([0, -400, 300], [0, 0, 30], [0, 0, 1]), seed=1)
    done = time.perf_counter()
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024**2
    images = capture.images["camera"]
    count, height, width = images.shape
    print(f"{count} images of {width} x {height}, {images.nbytes / 1024**3:.2f} GiB of {images.dtype}")
    print(
        f"peak resident size {peak:.2f} GiB (before: {base:.2f}); sensor laid out in {ready - start:.1f} s, "
        f"captured in {done - ready:.1f} s"
    )


if __name__ == "__main__":
    main()
