"""The kernel that goes with an exported map against the map's own queries, and against ``mitsim map predict``."""

import json
import subprocess
import sys

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from characterisation.coupon.view_frame import in_view_frame
from characterisation.files.errors import InputError
from characterisation.maps.performance_map import PerformanceMap
from characterisation.maps.shipped import map_path
from characterisation.point_cloud import Status, ViewGrid
from mitsim.report.export.map_export import write_map_kernel
from mitsim.report.export.map_kernel import SensorMap, normals_from_depth
from mitsim.sensor.preset import load_sensor
from tests.report.export.test_export_command import export

#: the map's own look-up places a normal among 97 nodes in single precision, to 6e-6 of the way between two; ln sigma
#: differs by up to 2 between these, and with a node missing the others' weights grow by up to 2
SINGLE = 2.5e-5

K = np.array([[300.0, 0, 39.2], [0, 305.0, 28.9], [0, 0, 1]])


def exported(performance_map, tmp_path, baseline=(1.0, 0.0, 0.0)):
    write_map_kernel(performance_map, tmp_path / "kernel", np.array(baseline))
    return SensorMap(tmp_path / "kernel/map.npz")


def check(kernel, performance_map, finish, roughness, distance, normals):
    fraction, sigma = kernel.look_up(distance, normals, finish, roughness)
    known = performance_map.query(finish, roughness, distance, normals)
    assert np.array_equal(np.isnan(fraction), np.isnan(known.fraction))
    np.testing.assert_allclose(fraction, known.fraction, atol=SINGLE)
    told = np.isfinite(fraction)
    assert np.array_equal(np.isnan(sigma[told]), np.isnan(known.sigma[told]))
    np.testing.assert_allclose(sigma[told], known.sigma[told], rtol=SINGLE)
    return told


@pytest.mark.parametrize("sensor", ["ensenso-n10", "kinect-v2", "photoneo-phoxi-s"])
def test_look_up_is_the_query_of_the_map(sensor, tmp_path, rng):
    performance_map = PerformanceMap.load(map_path(sensor))
    kernel = exported(performance_map, tmp_path)
    ends = performance_map.data["distance"].values[[0, -1]]
    told = []
    for finish, known in (
        (name, [ra for one, ra in performance_map.samples if one == name]) for name in performance_map.finishes
    ):
        for roughness in {known[0], known[-1], np.sqrt(known[0] * known[-1])}:
            normals = Rotation.random(20000, random_state=rng).as_matrix()[:, 2]
            distance = rng.uniform(0.9 * ends[0], 1.1 * ends[1], 20000)
            distance[:3000] = rng.choice(performance_map.data["distance"].values, 3000)  # at knots too
            told.append(check(kernel, performance_map, finish, roughness, distance, normals))
    share = np.mean(told)
    assert 0.1 < share < 0.9  # the map answers for some of them


def test_look_up_with_unknown_nodes_and_one_distance(tmp_path, rng):
    performance_map = PerformanceMap.load(map_path("ensenso-n10"))
    data = performance_map.data.copy(deep=True)
    holes = rng.random(data["ray_noise_std"].shape)
    data["ray_noise_std"] = data["ray_noise_std"].where(holes > 0.2)
    data["recovered_fraction"] = data["recovered_fraction"].where(holes < 0.9)
    normals = Rotation.from_rotvec(np.c_[rng.uniform(-1, 1, (5000, 2)), np.zeros(5000)]).as_matrix()[:, 2]
    for number, part in enumerate((data, data.isel(distance=[1]))):
        holed = PerformanceMap(part)
        kernel = exported(holed, tmp_path / str(number))
        distance = rng.uniform(400, 800, 5000) if number == 0 else np.full(5000, part["distance"].values[0])
        for finish, roughness in (("aluminium/ground", 0.5), ("aluminium/ground", 0.37), ("matt_white", np.nan)):
            assert check(kernel, holed, finish, roughness, distance, normals).any()


def test_image_is_what_predict_predicts(tmp_path, scenes):
    from mitsim.maps.prediction import CharacterisedScene, Predictor
    from mitsim.scene.load import load_scene
    from mitsim.sensor.transforms import look_at

    sensor = load_sensor("ensenso-n10")
    performance_map = PerformanceMap.load(map_path("ensenso-n10"))
    grid = ViewGrid(K[0, 0], K[1, 1], K[0, 2], K[1, 2], 80, 60)
    predictor = Predictor(sensor.rig, grid, np.ones((60, 80), bool), sensor.name)
    scene = load_scene(scenes / "coupon/coupon.xml", sensor.wavelength_nm, {"Ra": "0.5"})
    pose = look_at([150.0, -200.0, 480.0], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0], 20.0)
    seen = predictor.look_up(CharacterisedScene(scene, performance_map), pose).seen
    kernel = exported(performance_map, tmp_path, sensor.rig.baseline_direction)
    rows, columns = seen.roi.slices
    rays = grid.rays()
    normal = pose.rotation.T @ [0.0, 0.0, 1.0]  # of the coupon, z of the world
    with np.errstate(invalid="ignore"):
        depth = -(pose.rotation.T @ pose.translation @ normal) / (rays @ normal) * rays[..., 2]
    normals = np.broadcast_to(normal, (60, 80, 3))
    fraction, sigma = kernel.image(depth, normals, K, "aluminium/ground", 0.5)
    shown = seen.status == Status.VALID
    assert shown.sum() > 1000
    np.testing.assert_allclose(fraction[rows, columns][shown], seen.fraction[shown], atol=2e-4)
    np.testing.assert_allclose(sigma[rows, columns][shown], seen.sigma[shown], rtol=2e-4)

    # and what it draws has that spread along the ray, and comes back that often
    draws = np.stack(
        [kernel.draw(depth, normals, K, "aluminium/ground", 0.5, rng=np.random.default_rng(k)) for k in range(400)]
    )
    there = shown & (seen.fraction > 0.5)
    along = (draws / rays[..., 2])[:, rows, columns][:, there]
    deviation = np.nanstd(along, axis=0) / seen.sigma[there]
    assert abs(deviation.mean() - 1) < 0.01  # each to 3.5 %, hundreds of them
    returned = np.isfinite(along).mean(0) - seen.fraction[there]
    assert abs(returned.mean()) < 0.005


def test_normals_from_depth_are_those_of_a_tilted_plane():
    normal = np.array([0.3, -0.2, -0.93]) / np.linalg.norm([0.3, -0.2, -0.93])
    rays = ViewGrid(K[0, 0], K[1, 1], K[0, 2], K[1, 2], 80, 60).rays()
    depth = -500 / (rays @ normal) * rays[..., 2]
    found = normals_from_depth(depth, K)
    np.testing.assert_allclose(found[1:-1, 1:-1], np.broadcast_to(normal, (58, 78, 3)), atol=1e-9)
    assert np.isnan(found[0]).all() and np.isnan(found[:, -1]).all()


def test_view_frame_is_that_of_the_map(tmp_path, rng):
    kernel = exported(PerformanceMap.load(map_path("ensenso-n10")), tmp_path, (0.6, 0.8, 0.0))
    rays, normals = (Rotation.random(50, random_state=rng).as_matrix()[:, 2] for _ in range(2))
    found = kernel._in_view_frame(normals, rays)
    np.testing.assert_allclose(found, in_view_frame(normals, rays, np.array([0.6, 0.8, 0.0])), atol=1e-12)


def test_what_is_written_needs_numpy_alone(tmp_path):
    said = export("map", "zivid-2-m70", "-o", tmp_path / "kernel")
    assert "5 surfaces of zivid-2-m70" in said
    script = """
import json, sys
import numpy as np
from sensor_map import SensorMap
sensor = SensorMap("map.npz")
fraction, sigma = sensor.look_up(np.array([700.0]), np.array([[0, 0, 1.0]]), "matt_white")
other = sorted(one for one in sys.modules if one.partition(".")[0] in ("mitsim", "characterisation", "scipy", "xarray"))
print(json.dumps([fraction[0], sigma[0], other, sensor.sensor]))
"""
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", script],
        cwd=tmp_path / "kernel",
        check=True,
        capture_output=True,
        text=True,
        env={"PATH": ""},
    )
    fraction, sigma, other, name = json.loads(done.stdout)
    known = PerformanceMap.load(map_path("zivid-2-m70")).query("matt_white", np.nan, [700.0], np.array([[0, 0, 1.0]]))
    assert fraction == pytest.approx(known.fraction[0], abs=1e-6) and sigma == pytest.approx(known.sigma[0], rel=1e-6)
    assert (other, name) == ([], "zivid-2-m70")
    assert "SPDX-License-Identifier: Apache-2.0" in (tmp_path / "kernel/sensor_map.py").read_text()


def test_faults_are_told(tmp_path):
    kernel = exported(PerformanceMap.load(map_path("ensenso-n10")), tmp_path)
    one = np.array([[0, 0, 1.0]])
    with pytest.raises(ValueError, match="finish 'chalk': the map has aluminium/ground, matt_white"):
        kernel.look_up([500.0], one, "chalk")
    with pytest.raises(ValueError, match=r"Ra 3 um: the map has 0\.09 to 0\.74"):
        kernel.look_up([500.0], one, "aluminium/ground", 3.0)
    assert np.isnan(kernel.look_up([3000.0], one, "matt_white")[0])
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/thesis.txt").write_text("all of it")
    with pytest.raises(InputError, match="which has other files"):
        export("map", "ensenso-n10", "-o", tmp_path / "mine")
    with pytest.raises(InputError, match=r"ensenso-n10, the sensor of the map"):
        export("map", "ensenso-n10", "--sensor", "kinect-v2", "-o", tmp_path / "other")
    assert (tmp_path / "mine/thesis.txt").exists() and not (tmp_path / "other").exists()


def test_an_export_replaces_its_own_files_alone(tmp_path):
    """Before, a program beside the kernel that it imports was deleted by the next export."""
    exported(PerformanceMap.load(map_path("ensenso-n10")), tmp_path)
    (tmp_path / "kernel/my_simulator.py").write_text("import sensor_map")
    export("map", "kinect-v2", "-o", tmp_path / "kernel")
    assert "kinect-v2" in (tmp_path / "kernel/README.md").read_text()
    assert (tmp_path / "kernel/my_simulator.py").read_text() == "import sensor_map"
