"""What one tracing for all patterns costs, beside stock Mitsuba and beside the bare rays, in one run.

    python tests/benchmarks/transport.py

752 x 480 pixels, 16 samples each, the two-pillar part in metal. Every figure is the median of several runs taken in
turn, so that a slow minute of the machine slows them all; quote the ratios, not the seconds.

At depth 3 a stock render follows paths from the camera alone. The row without photons does the same work; with photons
there is more work and less noise, and the last column says how long stock renders would take to get as little: their
time is multiplied by the ratio of the variances, over the lit pixels and several seeds.
"""

from __future__ import annotations

import statistics
import time
from pathlib import Path

import numpy as np

from characterisation.region_of_interest import Roi
from mitsim.scene.backend import dr, mi
from mitsim.scene.light_transport.light_paths import LightPaths
from mitsim.scene.light_transport.projected_codes import ProjectedPatterns
from mitsim.scene.light_transport.transport import trace
from mitsim.scene.load import load_scene
from mitsim.scene.ray_casting.camera_rays import CameraRays
from mitsim.scene.ray_casting.eye import Eye
from mitsim.sensor.preset import load_sensor
from mitsim.sensor.transforms import look_at
from tests.stock_mitsuba import mitsuba_to_world

SCENE = Path(__file__).parents[2] / "scenes/two_pillars/two_pillars.xml"
SAMPLES, ROUNDS = 16, 7


def main() -> None:
    """Measure and print the table."""
    sensor = load_sensor("ensenso-n10")
    scene = load_scene(SCENE, sensor.wavelength_nm)
    rays = CameraRays(sensor.rig.reference)
    rng = np.random.default_rng(1)
    optics = sensor.projector.optics
    stack = rng.random((48, optics.height, optics.width), dtype=np.float32)
    lit = {count: ProjectedPatterns(stack[:count], sensor.projector) for count in (1, 24, 48)}
    jobs = {"bare primary and shadow rays": lambda pose, seed: bare_rays(scene, rays, lit[1], pose, seed)}
    for depth in (1, 3):
        for count in (1, 24, 48):
            jobs[f"{count} patterns, depth {depth}"] = lambda pose, seed, c=count, d=depth: trace(
                scene, rays, lit[c], pose, LightPaths(samples=SAMPLES, seed=seed, depth=d)
            )
        if depth > 1:
            jobs[f"24 patterns, depth {depth}, no photons"] = lambda pose, seed, d=depth: trace(
                scene, rays, lit[24], pose, LightPaths(samples=SAMPLES, seed=seed, depth=d, photons=0)
            )
        stock = stock_scene(scene, sensor, stack[0], depth)
        jobs[f"stock Mitsuba, 1 pattern, depth {depth}"] = lambda pose, seed, s=stock: np.array(
            mi.render(s, spp=SAMPLES, seed=seed)
        )
    jobs["later light of 24, depth 3"] = lambda pose, seed: trace(
        scene, rays, lit[24], pose, LightPaths(samples=SAMPLES, seed=seed, depth=3, indirect_only=True)
    )
    jobs["all of 24 less direct, depth 3"] = lambda pose, seed: (
        trace(scene, rays, lit[24], pose, LightPaths(samples=SAMPLES, seed=seed, depth=3))
        - trace(scene, rays, lit[24], pose, LightPaths(samples=SAMPLES, seed=seed))
    )
    times: dict[str, list[float]] = {name: [] for name in jobs}
    for turn in range(ROUNDS + 1):
        pose = look_at([150 + 3 * turn, -400, 280], [0, 0, 30], [0, 0, 1])
        for name, job in jobs.items():
            start = time.perf_counter()
            job(pose, turn)
            if turn:  # the first compiles
                times[name].append(time.perf_counter() - start)
    variance = {name: noise_variance(jobs[name]) for name in jobs if "depth 3" in name and name[:2] in ("24", "st")}
    bare = statistics.median(times["bare primary and shadow rays"])
    print(f"{'':36} {'median s':>9} {'/ bare rays':>12} {'24 stock renders /':>19} {'at equal noise':>16}")
    for name, values in times.items():
        median = statistics.median(values)
        ratio = ""
        if name.startswith("24"):
            peer = f"stock Mitsuba, 1 pattern, {name.split(', ')[1]}"
            stock = 24 * statistics.median(times[peer]) / median
            ratio = f"{stock:18.1f}x"
            if name in variance:
                ratio += f"{stock * variance[peer] / variance[name]:15.1f}x"
        print(f"{name:36} {median:9.3f} {median / bare:11.2f}x {ratio}")
    from_pose_to_pose(scene, rays, lit[24])


def noise_variance(job, seeds=6) -> float:  # type: ignore[no-untyped-def]
    """Mean variance from seed to seed of a lit pixel of the first image, over the square of its mean."""
    pose = look_at([150, -400, 280], [0, 0, 30], [0, 0, 1])
    images = np.stack([np.squeeze(np.asarray(job(pose, 100 + seed)))[:480] for seed in range(seeds)])
    images = images if images.ndim == 3 else images[:, 0]
    mean = images.mean(axis=0)
    return float(images.var(axis=0, ddof=1)[mean > 0].mean() / mean[mean > 0].mean() ** 2)


def from_pose_to_pose(scene, rays, lit) -> None:  # type: ignore[no-untyped-def]
    """What a call costs beside the kernels that it runs: the later captures of a campaign, at changing windows."""
    print(f"\n{'later captures, 24 patterns':36} {'call s':>9} {'kernels s':>10} {'ratio':>7} {'compiled':>9}")
    for depth in (1, 3):
        for window in (None, (200, 150, 260, 180)):
            calls, kernels, compiled = [], [], 0
            dr.set_flag(dr.JitFlag.KernelHistory, True)
            for turn in range(12):
                pose = look_at([150 + 3 * turn, -400, 280], [0, 0, 30], [0, 0, 1])
                part = None if window is None else Roi(window[0] + turn, *window[1:3], window[3] - turn)
                dr.kernel_history_clear()
                start = time.perf_counter()
                trace(scene, rays, lit, pose, LightPaths(samples=SAMPLES, seed=turn, depth=depth), roi=part)
                taken = time.perf_counter() - start
                history = [k for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT]
                if turn >= 2:
                    calls.append(taken)
                    kernels.append(sum(k["execution_time"] for k in history) / 1000)
                    compiled += sum(not k["cache_hit"] for k in history)
            dr.set_flag(dr.JitFlag.KernelHistory, False)
            call, kernel = statistics.median(calls), statistics.median(kernels)
            name = f"depth {depth}, {'whole image' if window is None else 'window'}"
            print(f"{name:36} {call:9.3f} {kernel:10.3f} {call / kernel:7.2f} {compiled:9}")


def bare_rays(scene, rays, lit, pose, seed):  # type: ignore[no-untyped-def]
    """Every primary ray and its shadow ray, and nothing else."""
    camera = Eye(pose @ rays.camera.sensor_from_camera)
    lamp = Eye(pose @ lit.projector.optics.sensor_from_camera)
    width, height = rays.camera.width, rays.camera.height
    count = width * height
    index = dr.arange(mi.UInt32, count)
    corner = index // width * (width + 1) + index % width
    x, y = dr.gather(mi.Float, rays.x, corner), dr.gather(mi.Float, rays.y, corner)
    random = mi.PCG32(size=count, initstate=dr.opaque(mi.UInt64, seed))
    total = dr.opaque(mi.UInt32, SAMPLES)

    def step(sample, seen, random):  # type: ignore[no-untyped-def]
        local = mi.Vector3f(x + random.next_float32() * 1.6e-3, y + random.next_float32() * 1.6e-3, 1.0)
        surface = scene.mitsuba.ray_intersect(mi.Ray3f(camera.position, camera.to_world(dr.normalize(local))))
        to_lamp = lamp.position - surface.p
        ray = surface.spawn_ray(dr.normalize(to_lamp))
        ray.maxt = dr.norm(to_lamp)
        return sample + 1, seen + dr.select(scene.mitsuba.ray_test(ray, surface.is_valid()), 0.0, 1.0), random

    start = (dr.zeros(mi.UInt32, count), dr.zeros(mi.Float, count), random)
    _, seen, _ = dr.while_loop(start, lambda sample, *_: sample < total, step)
    return np.array(seen)


def stock_scene(scene, sensor, pattern, depth):  # type: ignore[no-untyped-def]
    """The same view as stock Mitsuba can have it: without distortion and principal points."""
    camera, optics = sensor.rig.reference, sensor.projector.optics
    pose = look_at([150, -400, 280], [0, 0, 30], [0, 0, 1])

    def fov(eye):  # type: ignore[no-untyped-def]
        return float(np.degrees(2 * np.arctan(eye.width / 2 / eye.matrix[0, 0])))

    film = {
        "type": "hdrfilm",
        "width": camera.width,
        "height": camera.height,
        "pixel_format": "luminance",
        "rfilter": {"type": "box"},
    }
    description = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": depth + 1, "rr_depth": 1000},
        "sensor": {
            "type": "perspective",
            "fov": fov(camera),
            "fov_axis": "x",
            "film": film,
            "to_world": mi.ScalarTransform4f(mitsuba_to_world(pose)),
        },
        "lamp": {
            "type": "projector",
            "fov": fov(optics),
            "to_world": mi.ScalarTransform4f(mitsuba_to_world(pose @ optics.sensor_from_camera)),
            "irradiance": {"type": "bitmap", "bitmap": mi.Bitmap(pattern[..., None]), "raw": True},
        },
    }
    return mi.load_dict(description | {f"shape{i}": s for i, s in enumerate(scene.shapes)}, optimize=False)


if __name__ == "__main__":
    main()
