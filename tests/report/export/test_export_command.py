"""``mitsim export`` as a user runs it: what it writes by the end of a name, and what it says of bad input."""

import json
import shutil

import pytest
import trimesh
from typer.testing import CliRunner

from characterisation.cloud_files import write_cloud
from characterisation.files.errors import InputError
from mitsim.cli.program import app
from tests.report.choice_run import write_choice
from tests.report.export.known_cloud import POSE, expected, known_cloud
from tests.report.view_sphere_run import write_expecting_run


def export(*arguments):
    done = CliRunner().invoke(app, ["export", *map(str, arguments)])
    if done.exception is not None:
        raise done.exception
    return done.stderr


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory):
    return write_expecting_run(tmp_path_factory.mktemp("run") / "run")


def test_a_cloud_goes_into_the_part_frame_in_metres(tmp_path):
    write_cloud(known_cloud(), tmp_path / "cloud.ply")
    (tmp_path / "pose.json").write_text(json.dumps({"world_from_sensor": POSE.matrix().tolist(), "covariance": None}))
    said = export(
        "cloud",
        tmp_path / "cloud.ply",
        "--pose",
        tmp_path / "pose.json",
        "--in",
        "part",
        "--unit",
        "m",
        "-o",
        tmp_path / "new/part.ply",
    )
    wanted = expected(known_cloud(), POSE, 0.001)["points"]
    assert trimesh.load(tmp_path / "new/part.ply").vertices == pytest.approx(wanted, rel=1e-5)
    known = int((known_cloud().sigma > 0).sum())
    assert f"{len(wanted)} points, {known} of them with a covariance" in said


@pytest.mark.parametrize("suffix", [".pcd", ".e57", ".mcap"])
def test_a_cloud_without_points_is_written(tmp_path, suffix):
    from dataclasses import replace

    cloud = known_cloud()
    empty = replace(cloud, points=cloud.points * float("nan"), status=cloud.status * 0 + 1)
    write_cloud(empty, tmp_path / "cloud.ply")
    assert "0 points" in export("cloud", tmp_path / "cloud.ply", "-o", tmp_path / f"out{suffix}")
    assert (tmp_path / f"out{suffix}").stat().st_size > 0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["-o", "cloud.las"], r"--output: found cloud.las; allowed: a name that ends in .ply, .pcd, .e57, .mcap"),
        (["-o", "out.ply", "--in", "part"], "--in: found part, without --pose"),
        (["-o", "out.ply", "--in", "world"], "--in: found 'world'; allowed: sensor or part"),
        (["-o", "out.ply", "--unit", "inch"], "--unit: found 'inch'"),
        (["-o", "out.ply", "--pose", "none.json"], "none.json"),
        (["-o", "out.ply", "--pose", "bent.json"], "not a rigid motion"),
    ],
)
def test_bad_options_of_a_cloud_are_told(tmp_path, monkeypatch, options, message):
    monkeypatch.chdir(tmp_path)
    write_cloud(known_cloud(), tmp_path / "cloud.ply")
    bent = POSE.matrix()
    bent[0, 0] += 0.1
    (tmp_path / "bent.json").write_text(json.dumps({"world_from_sensor": bent.tolist()}))
    with pytest.raises(InputError, match=message):
        export("cloud", "cloud.ply", *options)
    assert sorted(one.name for one in tmp_path.iterdir()) == ["bent.json", "cloud.ply"]


@pytest.mark.parametrize("suffix", [".glb", ".usda", ".rrd", ".mcap", ".e57"])
def test_a_run_is_written_by_the_end_of_the_name(run_folder, tmp_path, suffix):
    said = export("run", run_folder, "-o", tmp_path / f"run{suffix}")
    assert (tmp_path / f"run{suffix}").stat().st_size > 1000
    assert ("4 views, 7 clouds" if suffix in (".rrd", ".mcap", ".e57") else "4 views") in said
    assert ("cloud" in said) == (suffix in (".rrd", ".mcap", ".e57"))  # glTF and USD hold none


@pytest.mark.parametrize("command", [("run",), ("results",), ("targets", "--robot", "ur")])
def test_of_a_comparison_the_best_sensor_is_exported(run_folder, tmp_path, monkeypatch, command):
    folder = write_choice(tmp_path / "choice")
    best = folder / "sensor-a-of-a-long-name"
    shutil.rmtree(best)
    shutil.copytree(run_folder, best)
    poses = [{"view": n, "part_from_sensor": POSE.matrix().tolist()} for n in range(12)]
    (best / "poses").mkdir()
    (best / "poses/poses.json").write_text(json.dumps({"views": poses}))
    monkeypatch.chdir(tmp_path)
    name = {"run": "out.glb", "results": "out.csv", "targets": "out.script"}[command[0]]
    if command == ("results",):  # the names of this run could not be in a task: reading gets as far as the task
        with pytest.raises(InputError, match=rf"{best.name}/task\.json: found no such file"):
            export(*command, "choice", "-o", name)
    else:
        said = export(*command, "choice", "-o", name)
        assert f"the export is of the best, {best.name}" in said and (tmp_path / name).stat().st_size > 100
    document = json.loads((folder / "choice.json").read_text())
    for change, message in (
        ({"finished": False}, "finished: found false.*mitsim study choose again"),
        ({"sensors": document["sensors"][2:]}, "no sensor with a statement"),
    ):
        (folder / "choice.json").write_text(json.dumps(document | change))
        with pytest.raises(InputError, match=message):
            export(*command, "choice", "-o", f"no_{name}")
    assert not (tmp_path / f"no_{name}").exists()


def test_bad_options_of_a_run_are_told(run_folder, tmp_path):
    with pytest.raises(InputError, match=r"a name that ends in .glb"):
        export("run", run_folder, "-o", tmp_path / "run.gltf")
    with pytest.raises(InputError, match="none of these views has a cloud"):
        export("run", run_folder, "--views", "11", "-o", tmp_path / "run.mcap")
    with pytest.raises(InputError, match="no such folder"):
        export("run", tmp_path / "nothing", "-o", tmp_path / "run.glb")
    assert not list(tmp_path.iterdir())
