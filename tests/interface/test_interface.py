"""The interface against the commands, and what it refuses."""

import json
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr
from typer.testing import CliRunner

import mitsim as ms
from mitsim.cli.program import app

POSE = ms.look_at((0, -300, 400))


def run(*arguments):
    result = CliRunner().invoke(app, [str(one) for one in arguments], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result


def test_render_gives_the_images_of_the_command(workplace):
    run(
        "render",
        "two_pillars.xml",
        "--sensor",
        "small.toml",
        "--position",
        0,
        -300,
        400,
        "--samples",
        2,
        "--depth",
        1,
        "--seed",
        5,
        "-o",
        "by_command",
    )
    sensor = ms.load_sensor("small.toml")
    scene = ms.load_scene("two_pillars.xml", sensor)
    capture = ms.render(scene, sensor, POSE, seed=5, samples=2, depth=1, check=False)
    theirs = ms.read_capture("by_command")
    for camera, images in capture.images.items():
        assert np.array_equal(images, theirs.images[camera])
    assert np.array_equal(theirs.world_from_sensor.matrix(), POSE.matrix())


def test_predict_gives_the_cloud_of_the_command(workplace):
    run(
        "map",
        "predict",
        "two_pillars.xml",
        "--map",
        "ensenso-n10",
        "--position",
        0,
        -300,
        400,
        "--noise",
        "correlated",
        "--seed",
        3,
        "-o",
        "predicted.ply",
    )
    sensor = ms.load_sensor("ensenso-n10")
    scene, known = ms.load_scene("two_pillars.xml", sensor), ms.performance_map("ensenso-n10")
    cloud = ms.predict(scene, sensor, known, POSE.matrix(), seed=3, correlated=True)
    theirs = ms.read_cloud("predicted.ply")
    assert np.array_equal(cloud.points, theirs.points, equal_nan=True)
    assert np.array_equal(cloud.status, theirs.status)
    measured = ms.measure(cloud, ms.read_task("task.toml"), POSE)
    assert abs(measured["pillar1_radius"].error) < 5 * measured["pillar1_radius"].uncertainty + 0.5


def test_score_has_the_figures_of_the_command(workplace):
    run("study", "score", "study.toml", "-o", "scores")
    scores = ms.score(ms.open_study("study.toml"))
    with xr.open_dataset("scores/scores.nc") as theirs:
        for name in ("predicted_uncertainty", "uncertainty_rank", "V_m"):
            assert np.array_equal(scores[name].values, theirs[name].values, equal_nan=True)


def test_statement_has_the_figures_of_the_command(workplace):
    text = (workplace / "study.toml").read_text() + "\n[statement]\ntrials = 3\n"
    (workplace / "short.toml").write_text(text)
    CliRunner().invoke(app, ["study", "state", "short.toml", "--view", "4", "-o", "budget"], catch_exceptions=False)
    theirs = json.loads((workplace / "budget/statement.json").read_text())["measurements"]
    for one in ms.statement(ms.open_study("study.toml"), 4, trials=3, folder="mine"):
        assert one.trials == 3
        assert one.standard_uncertainty == pytest.approx(theirs[one.measurement]["standard_uncertainty"], nan_ok=True)
    kept, mine = (workplace / one / "trials/view_0004.jsonl" for one in ("budget", "mine"))
    assert kept.read_bytes() == mine.read_bytes()


def test_a_rendered_capture_is_decoded_by_the_sensor_that_took_it(workplace):
    sensor = ms.load_sensor("small.toml")
    capture = ms.render(ms.load_scene("matt_white.xml", sensor), sensor, POSE, samples=8, depth=1, check=False)
    cloud = ms.decode(capture)
    for same in (ms.decode(capture, sensor), ms.decode(capture, "small.toml")):
        assert np.array_equal(same.points, cloud.points, equal_nan=True)
    # the capture keeps the sensor's settings; without them the usual ones are taken, and they are others
    usual = ms.decode(replace(capture, decoding=capture.decoding.model_copy(update={"decoder": None})))
    assert not np.array_equal(usual.points, cloud.points, equal_nan=True)
    near = ms.decode(capture, range_mm=(330, 480))
    assert 0 < np.nanmax(near.points[..., 2]) < 500 < np.nanmax(cloud.points[..., 2])


def test_decode_issues_the_warnings_that_the_command_prints(workplace):
    capture = ms.read_capture("capture")
    told = "the rig has moved since its calibration"
    ms.write_capture(replace(capture, settings=capture.settings | {"warnings": [told]}), "moved")
    with pytest.warns(UserWarning) as warned:
        cloud = ms.decode(ms.read_capture("moved"))
    done = CliRunner().invoke(app, ["decode", "moved", "-o", "moved.ply"], catch_exceptions=False)
    assert [str(one.message) for one in warned] == [told]
    assert f"warning: {told}" in done.stderr
    assert np.array_equal(ms.read_cloud("moved.ply").points, cloud.points, equal_nan=True)


def test_a_rendering_that_is_noisier_than_the_sensor_or_empty_is_told(workplace):
    """Before, only the command told it, and a program took the error of the rendering for one of the sensor."""
    sensor = ms.load_sensor("small.toml")
    scene = ms.load_scene("two_pillars.xml", sensor)
    with pytest.warns(
        UserWarning,
        match=r"^render noise .* times the sensor's noise.*about [0-9]+ samples reduce the noise to 0.2 times, or",
    ):
        capture = ms.render(scene, sensor, POSE, samples=1, depth=3)
    with pytest.warns(UserWarning, match=r"about [0-9]+ samples reduce the noise to 0.2 times$"):
        smoothed = ms.render(scene, sensor, POSE, samples=1, depth=3, smoothing_px=1.5)
    noise = [each.settings["render_residual"]["noise"] for each in (capture, smoothed)]
    # white noise of a pixel over a Gaussian of 1.5 px: a factor of 2 sqrt(pi) 1.5, less where shapes end
    assert noise[0] > 0.2 and 2.5 < noise[0] / noise[1] < 6.5
    assert smoothed.settings["indirect_light"] == {"samples": 1, "smoothing_px": 1.5}
    away = ms.look_at((0, -300, 400), (0, -4000, 400))
    with pytest.warns(UserWarning, match="no pixel of the camera left, camera right, projector shows the part"):
        ms.render(scene, sensor, away, samples=1, depth=1)
    # errors of a matt part in direct light are small with many samples: no warning, which would be an error here
    plain = ms.load_scene("matt_white.xml", sensor)
    fine = ms.render(plain, sensor, POSE, samples=256, depth=1)
    unchecked = ms.render(plain, sensor, POSE, samples=256, depth=1, check=False)
    assert 0 <= fine.settings["render_residual"]["quadrature"] < 0.2
    assert "render_residual" not in unchecked.settings
    np.testing.assert_array_equal(fine.images["left"], unchecked.images["left"])


def test_labels_are_those_of_the_part(workplace):
    sensor = ms.load_sensor("small.toml")
    cloud = ms.label(ms.read_cloud("cloud.ply"), ms.load_scene("matt_white.xml", sensor), sensor, POSE)
    tops = POSE.points(cloud.of_feature("pillar1_top"))
    assert len(tops) > 20
    assert np.median(tops[:, 2]) == pytest.approx(60, abs=2)
    assert np.abs(tops[:, 0] + 35).max() < 25


def test_a_pose_looks_where_it_says_and_its_matrix_is_a_pose(workplace):
    pose = ms.look_at((30, -200, 350), (10, 5, 20), roll_deg=40)
    ahead = pose.points(np.array([0, 0, np.linalg.norm([20, -205, 330])]))
    assert ahead == pytest.approx([10, 5, 20], abs=1e-9)
    sensor = ms.load_sensor("david-sls-3")
    eye = ms.look_at((0, 0, 500), sensor=sensor, up=(0, 1, 0)) @ sensor.rig.reference.sensor_from_camera
    assert eye.translation == pytest.approx([0, 0, 500], abs=1e-9)


@pytest.mark.parametrize(
    ("call", "match"),
    [
        (lambda sensor, scene: ms.look_at((0, 0)), "three numbers"),
        (lambda sensor, scene: ms.look_at((0, 0, 0)), "the target itself"),
        (lambda sensor, scene: ms.render(scene, sensor, 2 * np.eye(4)), "not a rigid motion"),
        (lambda sensor, scene: ms.render(scene, sensor, np.eye(3)), r"\(4, 4\) matrix"),
        (lambda sensor, scene: ms.render(scene, sensor, POSE, samples=0), "1 to 65536"),
        (lambda sensor, scene: ms.render(scene, sensor, POSE, noise="shoot"), "did you mean 'shot'"),
        (lambda sensor, scene: ms.load_scene("two_pillars.xml", sensor, {"Rz": 1}), "allowed: plane_Ra, pillar_Ra"),
        (lambda sensor, scene: ms.measure(ms.read_cloud("cloud.ply"), ms.read_task("task.toml"), POSE), "mitsim.label"),
        (lambda sensor, scene: ms.performance_map("ensenso-n11"), "did you mean 'ensenso-n10'"),
        (lambda sensor, scene: ms.predict(scene, sensor, ms.performance_map("kinect-v2"), POSE), "measured with"),
        (lambda sensor, scene: ms.statement(ms.open_study("study.toml"), 99), "0 to 5"),
        (lambda sensor, scene: ms.statement(ms.open_study("study.toml"), 0, trials=1), "2 to 1000000"),
        (lambda sensor, scene: ms.read_capture("nowhere"), "no such folder"),
        (lambda sensor, scene: ms.write_capture(ms.read_capture("capture"), "capture"), "capture"),
    ],
)
def test_what_cannot_be_is_refused_with_a_reason(workplace, call, match):
    sensor = ms.load_sensor("small.toml")
    scene = ms.load_scene("two_pillars.xml", sensor)
    with pytest.raises(ms.InputError, match=match):
        call(sensor, scene)


def test_open3d_gets_the_valid_points(workplace, monkeypatch):
    stand_in = SimpleNamespace(
        geometry=SimpleNamespace(PointCloud=SimpleNamespace), utility=SimpleNamespace(Vector3dVector=np.array)
    )
    monkeypatch.setitem(sys.modules, "open3d", stand_in)
    cloud = ms.read_cloud("cloud.ply")
    points = cloud.to_open3d().points
    assert points.shape == (cloud.valid.sum(), 3)
    assert points.dtype == np.float64
    assert np.array_equal(points, cloud.points[cloud.valid])


def test_without_open3d_it_is_asked_for(workplace, monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(ms.MissingEnvironmentError, match="pip install open3d"):
        ms.read_cloud("cloud.ply").to_open3d()
