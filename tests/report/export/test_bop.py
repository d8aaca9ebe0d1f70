"""A BOP data set of rendered captures, read by a minimal reader that knows the format's own page and nothing of mitsim.

The page is docs/bop_datasets_format.md of bop_toolkit, which is not on PyPI.
"""

import json
from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from scipy.ndimage import minimum_filter
from typer.testing import CliRunner

from characterisation.files.errors import InputError
from characterisation.point_cloud import PointCloud, Status, ViewGrid
from mitsim.cli.program import app
from mitsim.report.export import bop
from mitsim.report.export.bop import find_sources, write_bop
from mitsim.report.export.bop_frame import depth_scale, on_pinhole
from tests.report.export.test_export_command import export

ROOT = Path(__file__).resolve().parents[3]
SCENE = ROOT / "scenes/two_pillars/two_pillars.xml"
PLAN = """
[views]
subdivisions = 0
standoff_mm = 500
lowest_elevation_deg = 80
[[finishes]]
name = "fine"
parameters = { plane_Ra = 0.4, pillar_Ra = 0.4 }
[[finishes]]
name = "rough"
parameters = { plane_Ra = 0.8, pillar_Ra = 0.8 }
"""


class BopReader:
    """A split of a BOP data set: scene_camera, scene_gt and scene_gt_info by scene and image, and images."""

    def __init__(self, folder, split):
        self.scenes = sorted((folder / split).iterdir())
        self.models = json.loads((folder / "models/models_info.json").read_text())
        self.model = {int(k): trimesh.load(folder / f"models/obj_{int(k):06d}.ply", process=False) for k in self.models}

    def frames(self):
        for scene in self.scenes:
            tables = [json.loads((scene / f"scene_{name}.json").read_text()) for name in ("camera", "gt", "gt_info")]
            assert list(tables[0]) == list(tables[1]) == list(tables[2])
            for key in tables[0]:
                camera, poses, info = (table[key] for table in tables)
                images = {
                    kind: np.array(Image.open(scene / kind / f"{int(key):06d}.png"))
                    for kind in ("gray", "depth", "status", "feature", "depth_true")
                }
                masks = [
                    (
                        np.array(Image.open(scene / "mask" / f"{int(key):06d}_{k:06d}.png")),
                        np.array(Image.open(scene / "mask_visib" / f"{int(key):06d}_{k:06d}.png")),
                    )
                    for k in range(len(poses))
                ]
                yield camera, poses, info, images, masks


@pytest.fixture(scope="module")
def data_set(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bop")
    (folder / "plan.toml").write_text(PLAN)
    # the part stands between these depths: the matcher has to search no others
    preset = (files("mitsim.sensor") / "presets/ensenso-n10.toml").read_text(encoding="utf-8")
    sensor = preset.replace("near_mm = 330", "near_mm = 410").replace("far_mm = 950", "far_mm = 600")
    (folder / "sensor.toml").write_text(sensor, encoding="utf-8")
    call = ["render", SCENE, "--sensor", folder / "sensor.toml", "--many", folder / "plan.toml"]
    call += ["-o", folder / "captures", "--samples", 2, "--depth", 1]
    done = CliRunner().invoke(app, [*map(str, call)])
    assert done.exit_code == 0, (done.exception, done.stderr)
    assert "data set" in export("bop", folder / "captures", "-o", folder / "data")
    return folder


def test_images_are_what_bop_asks_for(data_set):
    reader = BopReader(data_set / "data", "train")
    assert [scene.name for scene in reader.scenes] == ["000001", "000002"]
    frames = list(reader.frames())
    assert len(frames) == 2
    camera_file = json.loads((data_set / "data/camera.json").read_text())
    for camera, _, (info,), images, ((mask, visible),) in frames:
        assert images["gray"].dtype == mask.dtype == np.uint8 and images["depth"].dtype == np.uint16
        assert {image.shape for image in images.values()} == {(camera_file["height"], camera_file["width"])}
        assert camera["cam_K"][0] == camera_file["fx"] and camera["depth_scale"] == camera_file["depth_scale"]
        assert set(np.unique(mask)) == {0, 255} and np.array_equal(mask, visible)
        assert info["px_count_all"] == (mask > 0).sum()
        assert info["px_count_valid"] == ((mask > 0) & (images["depth"] > 0)).sum() > 1000
        x, y, width, height = info["bbox_obj"]
        assert mask[y : y + height, x : x + width].sum() == mask.sum()
        assert mask[y].any() and mask[y + height - 1].any() and mask[:, x].any() and mask[:, x + width - 1].any()


def test_depth_is_missing_where_the_status_says_so_and_only_there(data_set):
    names = json.loads((data_set / "data/statuses.json").read_text())
    assert names == {str(one.value): one.name.lower() for one in Status}
    for _, _, _, images, ((mask, _),) in BopReader(data_set / "data", "train").frames():
        assert np.array_equal(images["depth"] > 0, images["status"] == Status.VALID)
        assert len(np.unique(images["status"][mask > 0])) > 1  # some of the part is missing, with a reason
        assert np.array_equal(images["feature"] > 0, mask > 0)
    features = json.loads((data_set / "data/features.json").read_text())
    assert {"plane", "pillar1"} <= set(features.values()) and min(map(int, features)) == 1


def test_the_model_in_its_pose_is_what_the_images_show(data_set):
    reader = BopReader(data_set / "data", "train")
    for camera, (pose,), _, images, ((mask, _),) in reader.frames():
        K = np.reshape(camera["cam_K"], (3, 3))
        turn, shift = np.reshape(pose["cam_R_m2c"], (3, 3)), np.array(pose["cam_t_m2c"])
        np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-9)
        points = reader.model[pose["obj_id"]].sample(4000, seed=1) @ turn.T + shift
        pixels = points @ K.T
        column, row = np.rint(pixels[:, :2] / pixels[:, 2:]).astype(int).T
        inside = (column >= 0) & (row >= 0) & (column < mask.shape[1]) & (row < mask.shape[0])
        assert inside.mean() > 0.99 and (mask[row[inside], column[inside]] > 0).mean() > 0.99
        true = images["depth_true"] * camera["depth_scale"]
        front = minimum_filter(np.where(true > 0, true, np.inf), 3)  # a point may round to the next pixel
        assert (front[row, column][inside] <= points[inside, 2] + 0.1).all()  # nothing lies before what is seen
        shown = np.abs(true[row, column] - points[:, 2])[inside] < 0.5
        assert 0.4 < shown.mean() < 0.9  # tops and plate are seen, what they hide is not
        measured = images["depth"] * camera["depth_scale"]
        both = (measured > 0) & (images["depth_true"] > 0)
        error = (measured - images["depth_true"] * camera["depth_scale"])[both]
        assert abs(np.median(error)) < 0.3 and np.percentile(np.abs(error), 75) < 3
        lit = images["gray"].astype(float)
        assert lit[mask > 0].mean() > 2 * lit[mask == 0].mean()  # the image shows the part where the mask has it


def test_model_and_its_information_are_those_of_the_part(data_set):
    reader = BopReader(data_set / "data", "train")
    (info,), (model,) = reader.models.values(), reader.model.values()
    assert (data_set / "data/models/obj_000001.ply").read_bytes().startswith(b"ply\nformat ascii")
    low, high = model.bounds
    np.testing.assert_allclose([info[f"min_{a}"] for a in "xyz"], low, atol=1e-4)
    np.testing.assert_allclose([info[f"size_{a}"] for a in "xyz"], high - low, atol=1e-4)
    corners = np.unique(model.vertices.round(6), axis=0)
    far = max(np.linalg.norm(corners - one, axis=1).max() for one in corners)
    assert info["diameter"] == pytest.approx(far, rel=1e-5)


def test_a_flat_object_has_a_diameter_at_any_tilt():
    plate = np.array([[-80.0, -50, 0], [80, -50, 0], [-80, 50, 0], [80, 50, 0], [3, 4, 0]])
    for turn in np.radians([0, 7, 45]):
        tilted = plate @ [[1, 0, 0], [0, np.cos(turn), np.sin(turn)], [0, -np.sin(turn), np.cos(turn)]] + [5, 9, 300]
        assert bop._diameter(tilted) == pytest.approx(np.hypot(160, 100))
    assert bop._diameter(np.outer([0.0, 1, 4], [1, 1, 1])) == pytest.approx(4 * 3**0.5)  # on a line


def test_a_fault_of_a_model_costs_no_views(data_set, tmp_path, monkeypatch):
    open_air = '<shape type="sphere" id="air"><float name="radius" value="9"/><bsdf type="null"/></shape></scene>'
    (tmp_path / "air.xml").write_text(SCENE.read_text().replace("</scene>", open_air))
    source = replace(find_sources(data_set / "captures")[0], scene=tmp_path / "air.xml")
    monkeypatch.setattr(bop, "bop_frame", lambda *a: pytest.fail("a view is decoded"))
    with pytest.raises(InputError, match=r"air, which light passes.*solid"):
        write_bop([source], tmp_path / "data", patterns=["pillar1*", "air"])
    assert not (tmp_path / "data").exists()


def test_objects_are_groups_of_shapes_that_hide_one_another(data_set, tmp_path):
    export("bop", data_set / "captures", "--object", "pillar1*", "--object", "plane", "-o", tmp_path / "data")
    reader, names = BopReader(tmp_path / "data", "train"), json.loads((tmp_path / "data/features.json").read_text())
    plane = next(int(number) for number, name in names.items() if name == "plane")
    low, high = reader.model[1].bounds
    np.testing.assert_allclose([low, high], [[-55, -20, 0], [-15, 20, 60]], atol=0.02)  # pillar and its top
    for _, poses, (pillar, plate), images, ((standing, seen), (under, shown)) in reader.frames():
        assert [one["obj_id"] for one in poses] == [1, 2] and poses[0]["cam_t_m2c"] == poses[1]["cam_t_m2c"]
        assert np.array_equal(standing, seen) and pillar["visib_fract"] == 1.0  # nothing stands before it
        assert (under[standing > 0] > 0).mean() > 0.8 and not (shown[standing > 0] > 0).any()
        assert np.array_equal(shown > 0, images["feature"] == plane)
        assert plate["px_count_all"] == (under > 0).sum() > plate["px_count_visib"] == (shown > 0).sum()
        assert plate["visib_fract"] == plate["px_count_visib"] / plate["px_count_all"]


def test_a_folder_of_two_scenes_has_the_images_of_each_or_is_refused(data_set, tmp_path):
    first, other = find_sources(data_set / "captures")
    (tmp_path / "moved.xml").write_text(SCENE.read_text().replace('x="35"', 'x="45"'))
    sources = [first, replace(other, finish=first.finish, scene=tmp_path / "moved.xml")]
    write_bop(sources, tmp_path / "data", patterns=["pillar1*"])
    features, names = [], json.loads((tmp_path / "data/features.json").read_text())
    for _, _, _, images, _ in BopReader(tmp_path / "data", "train").frames():
        features.append([int(name) for name in names if names[name] == "pillar2_top"] == images["feature"])
    assert features[0].sum() > 500 and (features[0] != features[1]).sum() > 500
    with pytest.raises(InputError, match=r"moved\.xml .*differ from the first capture.*the same objects"):
        write_bop(sources, tmp_path / "whole")  # one model for two parts
    assert not (tmp_path / "whole").exists()


def test_what_cannot_be_exported_is_told(data_set, tmp_path):
    with pytest.raises(InputError, match="which exists"):
        export("bop", data_set / "captures", "-o", data_set / "data")
    for options, message in (
        (["--object", "pilar*"], "a pattern of shapes: .*pillar1"),
        (["--object", "p*", "--object", "pl*"], r"p\* and pl\*, which both have plane"),
    ):
        with pytest.raises(InputError, match=message):
            export("bop", data_set / "captures", *options, "-o", tmp_path / "data")
    with pytest.raises(InputError, match="no captures"):
        export("bop", tmp_path, "-o", tmp_path / "data")
    with pytest.raises(InputError, match="train, val or test"):
        export("bop", data_set / "captures", "--split", "all", "-o", tmp_path / "data")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("text", "told"),
    [("[" * 100_000, "not JSON"), ('{"many": {"scene": "a", "view": 1e999}}', "many: found unreadable")],
)
def test_settings_that_are_not_of_many_captures_are_refused(tmp_path, text, told):
    """Before, a RecursionError and an OverflowError."""
    (tmp_path / "cast/view_0001").mkdir(parents=True)
    (tmp_path / "cast/view_0001/settings.json").write_text(text)
    with pytest.raises(InputError, match=told):
        find_sources(tmp_path)


def test_a_lens_that_bends_is_taken_out():
    """A tilted plane seen through barrel distortion has, on the pinhole, the depth of the pinhole's own rays."""
    pinhole = ViewGrid(90.0, 90.0, 39.5, 29.5, 80, 60)
    columns, rows = np.meshgrid(np.arange(80), np.arange(60))
    x, y = (columns - 39.5) / 90, (rows - 29.5) / 90
    stretch = 1 + 0.6 * (x**2 + y**2)
    bent = np.stack([x * stretch, y * stretch], axis=-1).astype(np.float32)
    grid = ViewGrid(90.0, 90.0, 39.5, 29.5, 80, 60, normalised=bent)
    normal = np.array([0.2, 0.1, -1.0])

    def depth_of(rays):
        return -500 / (rays @ normal) * rays[..., 2]

    rays = grid.rays()
    points = rays / rays[..., 2:] * depth_of(rays)[..., None]
    status = np.zeros((60, 80), np.uint8)
    status[10:20, 50:60], points[10:20, 50:60] = Status.SATURATED, np.nan
    cloud = PointCloud(points.astype(np.float32), status, grid, "test", "simulated")
    depth, reason = on_pinhole(cloud, pinhole)
    there = np.isfinite(depth)
    # a ray half a pixel aside errs by what the lens bends within a pixel and a half, not by the slope of the plane
    bends = [np.abs(two).max() for one in np.gradient(depth_of(rays)) for two in np.gradient(one)]
    error = np.abs(depth - depth_of(pinhole.rays()))[there]
    assert there.mean() > 0.9 and error.max() < 0.5 * 0.5 * 1.5 * sum(bends) + 1e-3  # points are in single precision
    assert error.max() < 0.1 * sum(np.abs(one).max() for one in np.gradient(depth_of(rays)))
    assert np.array_equal(there, reason == Status.VALID)
    hole = np.argwhere(reason == Status.SATURATED)
    place = grid.project(rays[[10, 19], [50, 59]] * 1000)  # where it lay stays where it is on the bent grid
    np.testing.assert_allclose(place, [[50, 10], [59, 19]], atol=1e-3)
    outward = (hole.mean(0) - [29.5, 39.5]) / (np.array([14.5, 54.5]) - [29.5, 39.5])
    assert (outward > 1.03).all()  # and further from the middle on the pinhole: x/z there is larger


def test_depth_is_not_carried_over_an_edge():
    columns, rows = np.meshgrid(np.arange(20), np.arange(10))
    aside = np.stack([(columns - 9.2) / 90, (rows - 4.8) / 90], axis=-1).astype(np.float32)  # 0.3 px off the pinhole
    grid = ViewGrid(90.0, 90.0, 9.5, 4.5, 20, 10, normalised=aside)
    z = np.where(columns < 10, 500.0, 600.0 + 5 * rows)
    points = np.concatenate([aside * z[..., None], z[..., None]], axis=-1).astype(np.float32)
    points[:, 15] = np.nan
    status = np.where(np.isfinite(points[..., 0]), 0, Status.SATURATED).astype(np.uint8)
    depth, _ = on_pinhole(PointCloud(points, status, grid, "test", "simulated"), replace(grid, normalised=None))
    np.testing.assert_allclose(depth[1:-1, 1:10], 500, atol=1e-3)
    np.testing.assert_allclose(depth[1:-1, 10:15], (z + 5 * 0.3)[1:-1, 10:15], atol=0.02)
    assert np.isnan(depth[:, 15]).all() and np.isfinite(depth[1:-1, 16:19]).all()


@given(st.floats(60, 20000))
def test_depth_scale_is_the_finest_round_one_that_reaches(far):
    scale = depth_scale(far)
    assert scale * 65535 >= far * (1 - 1e-9) and scale * 65535 <= far * 2.5 * (1 + 1e-9)
    digit = scale / 10 ** np.floor(np.log10(scale) + 1e-9)
    assert min(abs(digit - k) for k in (1, 2, 5)) < 1e-6
