"""How fast clouds are predicted, where the time goes, and the same rays in Open3D, in one run.

    python tests/benchmarks/prediction.py [rounds]

The two-pillar part before an Ensenso N10, 752 x 480 pixels, with the map that comes with mitsim: as it is, 490 mm away,
where it covers 7 % of the image, and with its plate 1.2 m wide, so that all pixels show something. A point is a pixel
that meets a surface in sight of every eye and has F and sigma looked up; "valid" are those that were kept. All rows run
in turns, round after round, so that a slow moment of the machine falls on all of them. Quote medians of one run.
"CPU" is the time of all threads together, which says less of what else the machine does.

Rays are one for each pixel of the grid, and one from every hit to the second camera and the projector; what they meet
stays on the device. Open3D's are laid out beforehand, those from hits as well; ours are made on the way. Open3D knows
triangles alone: it is given those of :mod:`mitsim.scene.ray_casting.triangles`, and so are ours in a row of their own.
mitsim does not need it: pip install open3d.
"""

from __future__ import annotations

import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import trimesh

from mitsim.decoding.cloud import sensor_geometry
from mitsim.maps.prediction import CharacterisedScene, Predictor, performance
from mitsim.scene.backend import dr, mi
from mitsim.scene.load import Scene, load_scene, scene_from_dict
from mitsim.scene.ray_casting.eye import Eye, shadow_ray
from mitsim.scene.ray_casting.triangles import triangles
from mitsim.sensor.preset import load_sensor
from mitsim.sensor.transforms import Transform, look_at
from mitsim.study import read_map

try:
    import open3d
except ImportError:
    open3d = None

SCENE = Path(__file__).parents[2] / "scenes/two_pillars/two_pillars.xml"
SENSOR = "ensenso-n10"
WIDE = ('<scale x="90" y="60"/>', '<scale x="600" y="600"/>')


def rays_alone(scene: Scene, predictor: Predictor, pose: Transform) -> None:
    """Primary ray of every pixel, and from every hit one to each other eye; what they meet stays on the device."""
    rays = predictor.rays
    frame = Eye(Transform(pose.rotation, pose.points(rays.origin)))
    ray = mi.Ray3f(frame.position, frame.to_world(rays.directions))
    surface = scene.mitsuba.ray_intersect(ray, ray_flags=mi.RayFlags.Minimal, coherent=True)
    free = []
    for eye in pose.points(np.array([eye.centre for eye in predictor.eyes])):
        to_eye = mi.Point3f(*[dr.opaque(mi.Float, float(v)) for v in eye]) - surface.p
        length = dr.norm(to_eye)
        free.append(~scene.mitsuba.ray_test(shadow_ray(surface, to_eye / length, length), surface.is_valid()))
    dr.eval(surface.t, surface.n, free)
    dr.sync_thread()


def peer(scene: Scene, predictor: Predictor, pose: Transform) -> Callable[[], object]:
    """The same rays in Open3D."""
    corners = triangles(scene).astype(np.float32)
    there = open3d.t.geometry.RaycastingScene()
    faces = np.arange(3 * len(corners), dtype=np.uint32).reshape(-1, 3)
    there.add_triangles(open3d.core.Tensor(corners.reshape(-1, 3)), open3d.core.Tensor(faces))
    directions = pose.directions(predictor.directions)
    origin = np.broadcast_to(pose.points(predictor.rays.origin), directions.shape)
    primary = np.concatenate([origin, directions], axis=1).astype(np.float32)
    met = there.cast_rays(open3d.core.Tensor(primary))["t_hit"].numpy()
    hit = np.isfinite(met)
    at = origin[hit] + directions[hit] * met[hit, None] * (1 - 1e-5)
    sent = [open3d.core.Tensor(primary)]
    for eye in pose.points(np.array([eye.centre for eye in predictor.eyes])):
        sent.append(open3d.core.Tensor(np.concatenate([at, eye - at], axis=1).astype(np.float32)))

    def cast() -> None:
        there.cast_rays(sent[0])
        for shadow in sent[1:]:
            there.test_occlusions(shadow, tfar=1.0)

    return cast


def of_triangles(scene: Scene, wavelength_nm: float) -> Scene:
    """The scene as one mesh."""
    corners = triangles(scene)
    mesh = trimesh.Trimesh(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3), process=False)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "part.ply"
        mesh.export(file)
        return scene_from_dict({"part": {"type": "ply", "filename": str(file), "face_normals": True}}, wavelength_nm)


def former(scene: Scene, predictor: Predictor, pose: Transform, performance_map):  # type: ignore[no-untyped-def]
    """The prediction by way of numpy, which is the reference."""
    surfaces = predictor.surfaces(scene, pose)
    ideal = predictor.ideal(surfaces)
    fraction, sigma = performance(ideal, scene, performance_map)
    labels = predictor.labels(scene, pose, surfaces)
    return predictor.draw(scene, ideal, labels, fraction, sigma, np.random.default_rng(1))


def table(name: str, scene: Scene, pose: Transform, rounds: int) -> None:
    """Measure and print what one view costs."""
    sensor = load_sensor(SENSOR)
    predictor = Predictor.of_sensor(sensor, sensor_geometry(sensor))
    performance_map = read_map(Path(SENSOR), sensor)
    characterised = CharacterisedScene(scene, performance_map)
    mesh = of_triangles(scene, sensor.wavelength_nm)
    jobs: dict[str, Callable[[], object]] = {
        "rays alone": lambda: rays_alone(scene, predictor, pose),
        "rays alone, on triangles": lambda: rays_alone(mesh, predictor, pose),
    }
    if open3d is not None:
        jobs["Open3D's RaycastingScene, on triangles"] = peer(scene, predictor, pose)
    jobs["rays, frustum, F and sigma"] = lambda: predictor.look_up(characterised, pose)
    jobs["whole prediction"] = lambda: predictor.predict(characterised, pose, np.random.default_rng(1))
    jobs["whole prediction, correlated noise"] = lambda: predictor.predict(
        characterised, pose, np.random.default_rng(1), correlated=True
    )
    jobs["the reference, by way of numpy"] = lambda: former(scene, predictor, pose, performance_map)
    times: dict[str, list[float]] = {job: [] for job in jobs}
    work: dict[str, list[float]] = {job: [] for job in jobs}
    for turn in range(rounds + 2):
        for job, run in jobs.items():
            start, used = time.perf_counter(), time.process_time()
            run()
            if turn > 1:  # the first ones compile
                times[job].append(time.perf_counter() - start)
                work[job].append(time.process_time() - used)
    points = int(np.isfinite(predictor.look_up(characterised, pose).seen.fraction).sum())
    valid = int(predictor.predict(characterised, pose, np.random.default_rng(1)).valid.sum())
    pixels = predictor.seen.size
    print(f"\n{name}: {pixels} pixels, {points} points, {valid} valid; {rounds} rounds; millions a second")
    print(f"{'':40s}{'median ms':>10s}{'best ms':>9s}{'CPU ms':>8s}{'points':>8s}{'valid':>7s}{'pixels':>8s}")
    for job, values in times.items():
        median = statistics.median(values)
        rates = "".join(f"{count / median / 1e6:{width}.1f}" for count, width in ((points, 8), (valid, 7), (pixels, 8)))
        cores = statistics.median(work[job])
        print(f"{job:40s}{median * 1e3:10.1f}{min(values) * 1e3:9.1f}{cores * 1e3:8.1f}{rates}")
    if open3d is None:
        print(f"{'Open3D':40s}not installed")


def main(rounds: int = 15) -> None:
    """Print both tables."""
    wavelength = load_sensor(SENSOR).wavelength_nm
    table("the part", load_scene(SCENE, wavelength), look_at([0, -400, 300], [0, 0, 20], [0, 0, 1]), rounds)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "wide.xml"
        file.write_text(SCENE.read_text().replace(*WIDE))
        wide = load_scene(file, wavelength)
    table("its plate 1.2 m wide", wide, look_at([0, -300, 440], [0, 0, 20], [0, 0, 1]), rounds)


if __name__ == "__main__":
    main(*(int(argument) for argument in sys.argv[1:]))
