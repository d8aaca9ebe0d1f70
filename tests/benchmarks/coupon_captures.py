"""How many captures of a coupon a campaign takes in a second, and where their time goes.

    python tests/benchmarks/coupon_captures.py [--sensors NAME ...] [--poses N] [--samples N] [--profile FILE]

Each row is one sensor before the coupon of scenes/coupon (ground aluminium, Ra 0.4), at poses up to 45 deg from its
axis, in the middle of its working range. A capture around the coupon, its cloud and its patches are made as in a
campaign, and the capture is written to a folder. Two rows are a sensor of 752 x 480 pixels and 24 images, made from the
David SLS-3, so near that the coupon fills the image or a quarter of it. The first two poses, which compile, are left
out.

Captures per second and CPU time (of all cores) are without the disk. The first rate is that of a campaign, where one
capture is decoded and measured while the next is rendered. The rest of the table is of captures one after the other.
The shares are of the time with the disk. On a machine with other users, compare CPU times.
"""

from __future__ import annotations

import argparse
import cProfile
import math
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

import mitsim.capture.simulated.simulate as simulate
from characterisation.coupon.patches import Coupon, measure_patches
from characterisation.point_cloud import PointCloud
from mitsim.capture.capture import Capture
from mitsim.capture.folder import write_capture
from mitsim.capture.simulated.rendering import Rendering
from mitsim.decoding.cloud import sensor_geometry
from mitsim.maps.campaign.acquire import coupon_cloud, one_ahead
from mitsim.maps.campaign.plan import coupon_pose
from mitsim.scene.load import load_scene
from mitsim.sensor.preset import load_sensor, presets
from mitsim.sensor.sensor import Sensor
from mitsim.sensor.transforms import Transform

COUPON = Path(__file__).parents[2] / "scenes/coupon/coupon.xml"
SIZE_MM = 120.0
STAGES = ("rendering", "speckle", "exposing", "decoding", "metrics", "disk")
WARM_UP = 2

#: what becomes of the David SLS-3: focal length [px] with which the coupon, facing, fills the image or a quarter of it
SMALL = {"752 x 480, 24 images, full": 752 / SIZE_MM * 510, "752 x 480, 24 images, quarter": 300 / SIZE_MM * 510}


def main() -> None:
    """Measure and print the table."""
    words = (__doc__ or "").splitlines()[0]
    parser = argparse.ArgumentParser(description=words, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("--sensors", nargs="+", default=[*presets(), *SMALL], help="presets, or rows of the table")
    parser.add_argument("--poses", type=int, default=20, help="poses that count")
    parser.add_argument("--samples", type=int, default=16, help="samples per pixel")
    parser.add_argument("--profile", help="write what cProfile finds, of all rows together, to this file")
    options = parser.parse_args()
    profile = cProfile.Profile() if options.profile else None
    columns = [
        "sensor",
        "campaign/s",
        "captures/s",
        "ms each",
        "CPU ms",
        *(f"{stage} %" for stage in STAGES),
        "patches",
        "mean F",
    ]
    print(f"| {' | '.join(columns)} |\n|---|{'---:|' * (len(columns) - 1)}")
    for name in options.sensors:
        sensor = small_sensor(SMALL[name]) if name in SMALL else load_sensor(name)
        bench = Bench(sensor, options.samples)
        taken, patches, recovered = measured(bench, options.poses, profile)
        whole = sum(taken[stage] for stage in STAGES)
        capture, busy = (whole - taken["disk"]) / options.poses, taken["CPU"] / options.poses
        cells = [
            name,
            f"{overlapped(bench, options.poses):.2f}",
            f"{1 / capture:.2f}",
            f"{1e3 * capture:.0f}",
            f"{1e3 * busy:.0f}",
        ]
        cells += [f"{100 * taken[stage] / whole:.0f}" for stage in STAGES]
        print(f"| {' | '.join([*cells, str(patches), f'{recovered:.2f}'])} |", flush=True)
    if profile is not None:
        profile.dump_stats(options.profile)


def small_sensor(focal_px: float) -> Sensor:
    """The David SLS-3 with a camera of 752 x 480 pixels and 24 images of three periods."""
    text = (files("mitsim.sensor") / "presets/david-sls-3.toml").read_text(encoding="utf-8")
    changes = {
        'name = "david-sls-3"': 'name = "small-structured-light"',
        "width = 1920": "width = 752",
        "height = 1200": "height = 480",
        "focal_px = [2048.0, 2048.0]": f"focal_px = [{focal_px}, {focal_px}]",
        "principal_px = [959.5, 599.5]": "principal_px = [375.5, 239.5]",
        'kind = "gray_code_phase_shift"\nperiod_px = 16': 'kind = "phase_shift"\nperiods_px = [1290, 140, 15]',
    }
    for old, new in changes.items():
        assert old in text
        text = text.replace(old, new)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "small.toml"
        path.write_text(text, encoding="utf-8")
        return load_sensor(path)


def normals(count: int) -> np.ndarray:
    """Unit normals (count, 3) up to 45 deg from the axis, spread evenly over the cap."""
    turn = math.pi * (3 - math.sqrt(5)) * np.arange(count)
    cosine = 1 - (1 - math.cos(math.radians(45))) * (np.arange(count) + 0.5) / count
    sine = np.sqrt(1 - cosine**2)
    return np.stack([sine * np.cos(turn), sine * np.sin(turn), cosine], axis=-1)


class Bench:
    """A sensor that is shown the coupon at one pose after another."""

    def __init__(self, sensor: Sensor, samples: int) -> None:
        self.sensor, self.samples = sensor, samples
        self.scene = load_scene(COUPON, sensor.wavelength_nm)
        self.simulated, self.geometry = simulate.SimulatedSensor(sensor), sensor_geometry(sensor)

    def coupon(self, normal: np.ndarray) -> tuple[Transform, Coupon]:
        """Where the coupon is, in the sensor's frame."""
        axis = self.sensor.rig.reference.sensor_from_camera.rotation[:, 2]
        pose = coupon_pose(normal, float(np.mean(self.sensor.working_range_mm)), axis)
        across, facing = pose.rotation[:, 0], pose.rotation[:, 2]
        return pose, Coupon(pose.translation, facing, across, SIZE_MM, SIZE_MM)

    def capture(self, normal: np.ndarray, seed: int) -> Capture:
        """A capture around the coupon."""
        pose, coupon = self.coupon(normal)
        return self.simulated.capture(
            self.scene, pose.inverse(), rendering=Rendering(samples=self.samples), seed=seed, around=coupon.corners()
        )

    def cloud(self, capture: Capture, normal: np.ndarray) -> PointCloud:
        """Decode the coupon's part."""
        return coupon_cloud(capture, self.coupon(normal)[1], self.geometry, self.sensor)


def overlapped(bench: Bench, poses: int) -> float:
    """Captures per second as a campaign takes them, without the disk."""
    shots = list(enumerate(normals(poses)))
    start = time.perf_counter()
    done = one_ahead(
        shots,
        lambda shot: bench.capture(shot[1], shot[0]),
        lambda capture, shot: measure_patches(bench.cloud(capture, shot[1]), bench.coupon(shot[1])[1]),
    )
    count = sum(1 for _ in done)
    return count / (time.perf_counter() - start)


def measured(bench: Bench, poses: int, profile: cProfile.Profile | None) -> tuple[dict[str, float], int, float]:
    """Seconds in each stage over all poses, patches in all, and their mean recovered fraction."""
    every = normals(poses)
    taken: defaultdict[str, float] = defaultdict(float)
    fractions: list[float] = []
    with tempfile.TemporaryDirectory() as folder, timed(bench.simulated, taken):
        for number in range(-WARM_UP, poses):
            if number == 0:
                taken.clear()
                fractions.clear()
                if profile is not None:
                    profile.enable()
            _, coupon = bench.coupon(every[number])
            start, busy = time.perf_counter(), time.process_time()
            inner = taken["rendering"] + taken["speckle"]
            capture = bench.capture(every[number], number + WARM_UP)
            exposed = time.perf_counter()
            taken["exposing"] += exposed - start - (taken["rendering"] + taken["speckle"] - inner)
            cloud = bench.cloud(capture, every[number])
            decoded = time.perf_counter()
            taken["decoding"] += decoded - exposed
            table = measure_patches(cloud, coupon)
            judged = time.perf_counter()
            taken["metrics"] += judged - decoded
            taken["CPU"] += time.process_time() - busy
            write_capture(capture, Path(folder) / "capture", overwrite=True)
            taken["disk"] += time.perf_counter() - judged
            fractions += table.recovered_fraction.values.tolist()
        if profile is not None:
            profile.disable()
    return dict(taken), len(fractions), float(np.mean(fractions)) if fractions else math.nan


@contextmanager
def timed(simulated: simulate.SimulatedSensor, taken: dict[str, float]) -> Iterator[None]:
    """Add up what a sensor's captures spend on rendering and speckle."""

    def clock(stage: str, work: Callable[..., Any]) -> Callable[..., Any]:
        def run(*arguments: Any, **options: Any) -> Any:
            start = time.perf_counter()
            result = work(*arguments, **options)
            taken[stage] += time.perf_counter() - start
            return result

        return run

    draw = simulate.draw_speckle
    simulated.radiance = clock("rendering", simulated.radiance)  # type: ignore[method-assign]
    simulate.draw_speckle = clock("speckle", draw)
    try:
        yield
    finally:
        simulate.draw_speckle = draw


if __name__ == "__main__":
    main()
