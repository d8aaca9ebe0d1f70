"""Part, views and clouds of a run as glTF, USD and Rerun, read back by other readers."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from characterisation.files.errors import InputError
from characterisation.point_cloud import Status
from mitsim.report.export.gltf import write_glb
from mitsim.report.export.rerun_recording import write_rrd
from mitsim.report.export.run_scene import frustum, read_run_scene
from mitsim.report.export.usd import write_usd
from tests.report.view_sphere_run import WITH_CLOUD, write_expecting_run


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return read_run_scene(write_expecting_run(tmp_path_factory.mktemp("run") / "run"))


def test_views_are_chosen(scene, tmp_path):
    assert [view.number for view in scene.views] == WITH_CLOUD
    folder = write_expecting_run(tmp_path / "run")
    assert len(read_run_scene(folder, "all").views) == 12
    few = read_run_scene(folder, "11, 3")
    assert [view.number for view in few.views] == [3, 11] and not any(view.clouds for view in few.views)
    assert few.grid is not None  # of another view's cloud
    for wrong in ("12", "3;4", ""):
        with pytest.raises(InputError, match="--views"):
            read_run_scene(folder, wrong)


def test_frustum_ends_at_the_corners_of_the_image(scene):
    places, edges = frustum(scene.grid, 100.0)
    pixels = (places[1:, :2] / 100) * [scene.grid.fx, scene.grid.fy] + [scene.grid.cx, scene.grid.cy]
    assert pixels.tolist() == [[-0.5, -0.5], [31.5, -0.5], [31.5, 23.5], [-0.5, 23.5]]
    assert len(edges) == 8 and sorted(np.bincount(np.ravel(edges))) == [3, 3, 3, 3, 4]


def test_gltf_is_read_by_trimesh(scene, tmp_path):
    pytest.importorskip("pygltflib")
    write_glb(scene, tmp_path / "run.glb")
    read = trimesh.load_scene(tmp_path / "run.glb")
    up = Rotation.from_euler("x", -90, degrees=True).as_matrix()  # z of the part is y of glTF
    (name,) = [node for node in read.graph.nodes_geometry if node == "part"]
    matrix, geometry = read.graph[name]
    places = trimesh.transform_points(read.geometry[geometry].vertices, matrix)
    np.testing.assert_allclose(places, scene.part.vertices @ up.T / 1000, atol=1e-7)
    assert np.array_equal(read.geometry[geometry].faces, scene.part.faces)
    for view in scene.views:
        matrix, _ = read.graph[view.name]
        np.testing.assert_allclose(matrix[:3, 3], up @ view.part_from_sensor.translation / 1000, atol=1e-6)
        np.testing.assert_allclose(matrix[:3, :3], up @ view.part_from_sensor.rotation, atol=1e-6)
    cameras = [node for node in read.graph.nodes if node.endswith("_camera")]
    assert len(cameras) == len(scene.views) - 1  # trimesh takes one for its own
    for node in cameras:  # looks along -z, toward the part's origin
        matrix, _ = read.graph[node]
        np.testing.assert_allclose(-matrix[:3, 2], -matrix[:3, 3] / np.linalg.norm(matrix[:3, 3]), atol=1e-6)


def test_gltf_camera_shows_the_field_of_view(scene, tmp_path):
    gltf = pytest.importorskip("pygltflib")
    write_glb(scene, tmp_path / "run.glb")
    (camera,) = gltf.GLTF2().load(str(tmp_path / "run.glb")).cameras
    rays = scene.grid.rays()
    top, bottom, left, right = rays[0, 15], rays[-1, 15], rays[11, 0], rays[11, -1]
    angle = np.arccos(top @ bottom / np.linalg.norm(top) / np.linalg.norm(bottom))
    assert angle < camera.perspective.yfov < angle * 25 / 23  # of the pixels' centres, and half a pixel on each side
    across = np.arccos(left @ right)
    wide = 2 * np.arctan(camera.perspective.aspectRatio * np.tan(camera.perspective.yfov / 2))
    assert across < wide < across * 33 / 31


@pytest.mark.parametrize("suffix", [".usda", ".usdc", ".usdz", ".USDZ"])
def test_usd_is_read_by_usd(scene, tmp_path, suffix):
    usd, geometry = pytest.importorskip("pxr.Usd"), pytest.importorskip("pxr.UsdGeom")
    path = tmp_path / f"run{suffix}"
    write_usd(scene, path)
    assert [one.name for one in tmp_path.iterdir()] == [path.name]
    stage = usd.Stage.Open(str(path))
    assert geometry.GetStageMetersPerUnit(stage) == 0.001 and geometry.GetStageUpAxis(stage) == "Z"
    mesh = geometry.Mesh(stage.GetPrimAtPath("/part_frame/part"))
    np.testing.assert_allclose(np.array(mesh.GetPointsAttr().Get()), scene.part.vertices, rtol=1e-6)
    assert np.array_equal(np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3), scene.part.faces)
    view = scene.views[0]
    prim = stage.GetPrimAtPath(f"/part_frame/{view.name}/camera")
    frustum_read = geometry.Camera(prim).GetCamera(usd.TimeCode.Default()).frustum
    np.testing.assert_allclose(frustum_read.GetPosition(), view.part_from_sensor.translation, atol=1e-6)
    np.testing.assert_allclose(frustum_read.ComputeViewDirection(), view.part_from_sensor.rotation[:, 2], atol=1e-9)
    np.testing.assert_allclose(frustum_read.ComputeUpVector(), -view.part_from_sensor.rotation[:, 1], atol=1e-9)
    places, _ = frustum(scene.grid, 1.0)
    low, high = frustum_read.GetWindow().GetMin(), frustum_read.GetWindow().GetMax()
    np.testing.assert_allclose([low[0], high[0]], [places[1, 0], places[2, 0]], rtol=1e-6)
    np.testing.assert_allclose([low[1], high[1]], [-places[3, 1], -places[1, 1]], rtol=1e-6)  # up is up


def test_rerun_recording_is_read_by_rerun(scene, tmp_path):
    pytest.importorskip("rerun")
    reader = pytest.importorskip("rerun.chunk")
    write_rrd(scene, tmp_path / "run.rrd", "a-run")
    file = reader.RrdReader(tmp_path / "run.rrd")
    (recording,) = file.recordings()
    assert (recording.application_id, recording.recording_id) == ("mitsim", "a-run")
    chunks = {}
    for chunk in file.stream():
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            chunks[chunk.entity_path, name.rpartition(":")[2]] = batch.column(name).to_pylist()[0]
    view = scene.views[0]
    cloud, place = view.clouds["predicted"], f"/views/{view.name}"
    np.testing.assert_allclose(chunks[f"{place}/predicted", "positions"], cloud.points[cloud.valid], rtol=1e-6)
    np.testing.assert_allclose(chunks[f"{place}/predicted", "sigma"], cloud.sigma[cloud.valid])
    rays = cloud.grid.rays()[cloud.valid]
    variance = np.reshape(chunks[f"{place}/predicted", "covariance"], (-1, 6))[:, [0, 3, 5]]
    np.testing.assert_allclose(variance, (cloud.sigma[cloud.valid][:, None] * rays) ** 2, rtol=1e-5)
    (status,) = chunks[f"{place}/grid/predicted_status", "buffer"]
    assert np.array_equal(np.reshape(status, cloud.status.shape), cloud.status)
    (matrix,) = chunks[f"{place}/grid", "image_from_camera"]
    row, column = np.nonzero(cloud.valid)
    inside = (cloud.points[cloud.valid] - cloud.grid.origin) @ cloud.grid.rotation
    shown = inside / inside[:, 2:] @ np.reshape(matrix, (3, 3))  # Rerun writes columns, and shows pixel k at k to k + 1
    np.testing.assert_allclose(shown[:, :2], np.column_stack([column, row]) + 0.5, atol=1e-3)
    (translation,) = chunks[place, "translation"]
    np.testing.assert_allclose(translation, view.part_from_sensor.translation, rtol=1e-6)
    (context,) = [value for (path, name), value in chunks.items() if path == "/views" and name == "context"]
    assert {one["class_id"]: one["class_description"]["info"]["label"] for one in context[0]} == {
        status.value: status.name.lower() for status in Status
    }
    assert len(chunks["/part", "vertex_positions"]) == len(scene.part.vertices)
