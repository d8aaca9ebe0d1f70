"""What a million captures cost: processor time, bytes kept and bytes moved, from one capture of every preset.

    python tests/benchmarks/million.py [--captures N] [--parts N] [--finishes N] [--sensors NAME ...]

Each preset takes the two pillars in ground aluminium as ``mitsim render --many`` does: the whole image, light of three
surfaces, 16 samples per pixel, from as near as it can measure all of them; then it is decoded. The second capture
counts, as the first compiles. Time is that of processors, all threads together, so that it holds on a machine that
others use too (within the third that hyper-threads take from one another); on a CUDA device it is that of the clock.
Bytes are those of the capture folder as it is written, of the cloud as PLY, and of the images before they are packed.
The sum shares the captures evenly among the sensors; where sensor, finish and part are all combined, so many views are
left of each.
"""

from __future__ import annotations

import argparse
import os
import time

from mitsim.capture.simulated.rendering import Rendering
from mitsim.scene import backend

ROW = "| {:<25} | {:>8} | {:>8} | {:>9} | {:>9} | {:>9} |"


def cost(name: str) -> tuple[float, float, int, int, int]:
    """Seconds of a capture and of its decoding; bytes of folder, cloud and images."""
    import tempfile
    from pathlib import Path

    import numpy as np

    from characterisation.cloud_files import write_cloud
    from mitsim.capture.capture import Capture
    from mitsim.capture.packed_files import packed
    from mitsim.capture.simulated.simulate import SimulatedSensor
    from mitsim.decoding.cloud import capture_cloud, sensor_geometry
    from mitsim.scene.load import load_scene
    from mitsim.sensor.preset import load_sensor
    from mitsim.sensor.transforms import look_at
    from mitsim.sensor.working_volume import nearest_standoff

    sensor = load_sensor(name)
    scene = load_scene(Path(__file__).parents[2] / "scenes/two_pillars/two_pillars.xml", sensor.wavelength_nm)
    height = nearest_standoff(sensor, float(np.linalg.norm(scene.bounds[1] - scene.bounds[0])) / 2)
    eye = sensor.rig.reference.sensor_from_camera.inverse()
    pose = look_at(scene.centre + height * np.array([0, -0.5, 0.866]), scene.centre, [0, 0, 1]) @ eye
    simulated, geometry = SimulatedSensor(sensor), sensor_geometry(sensor)
    clock = time.perf_counter if "cuda" in backend.activate() else time.process_time

    def take(seed: int, samples: int) -> Capture:
        return simulated.capture(scene, pose, rendering=Rendering(samples=samples, depth=3), seed=seed)

    take(1, 1)
    began = clock()
    capture = take(2, 16)
    taken = clock()
    cloud = capture_cloud(capture, sensor.settings, geometry, imager=sensor.imager)
    decoded = clock()
    kept = sum(map(len, packed(capture, "c").values()))
    with tempfile.TemporaryDirectory() as folder:
        write_cloud(cloud, Path(folder) / "c.ply")
        points = (Path(folder) / "c.ply").stat().st_size
    plain = sum(stack.nbytes for stack in capture.images.values())
    return taken - began, decoded - taken, kept, points, plain


def main() -> None:
    """Print a row for each sensor, and the sum."""
    asked = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    asked.add_argument("--captures", type=int, default=1_000_000)
    asked.add_argument("--parts", type=int, default=500)
    asked.add_argument("--finishes", type=int, default=20)
    asked.add_argument("--sensors", nargs="+")
    given = asked.parse_args()
    from mitsim.sensor.preset import presets

    names = given.sensors or presets()
    print(
        f"{backend.activate()}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}"
        + ("" if backend.cuda_devices() else "; no CUDA device: hours of a GPU need one")
        + "\n"
    )
    print(ROW.format("sensor", "capture", "decode", "folder", "cloud", "images"))
    print(ROW.format("---", "---:", "---:", "---:", "---:", "---:"))
    rows = []
    for name in names:
        rows.append(cost(name))
        taken, decoded, *sizes = rows[-1]
        told = [f"{taken:.1f} s", f"{decoded:.1f} s", *(f"{size / 1e6:.1f} MB" for size in sizes)]
        print(ROW.format(f"`{name}`", *told), flush=True)
    each = given.captures / len(rows)
    hours = [each * sum(row[k] for row in rows) / 3600 for k in (0, 1)]
    stored = [each * sum(row[k] for row in rows) / 1e12 for k in (2, 3, 4)]
    print(
        f"\n{given.captures:,} captures: {hours[0]:,.0f} core hours to take, {hours[1]:,.0f} to decode; "
        f"{stored[0]:.1f} TB of folders, {stored[1]:.1f} TB of clouds, {stored[2]:.1f} TB of images unpacked; "
        f"{given.captures / (len(rows) * given.parts * given.finishes):.1f} views of each sensor, part and finish"
    )


if __name__ == "__main__":
    main()
