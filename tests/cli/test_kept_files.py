"""No command writes over a file that it reads, or that a capture or a run consists of."""

import json

import pytest

from characterisation.cloud_files import write_cloud
from tests.report.export.known_cloud import known_cloud
from tests.report.view_sphere_run import write_expecting_run
from tests.shell import mitsim_here


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("kept")
    write_cloud(known_cloud(), folder / "cloud.ply")
    (folder / "link.ply").symlink_to("cloud.ply")
    write_expecting_run(folder / "run")
    images = folder / "capture" / "images"
    images.mkdir(parents=True)
    (images / "left_000.png").write_bytes(b"an image")
    (folder / "capture" / "capture.json").write_text(json.dumps({"files": [{"path": "images/left_000.png"}]}))
    for name in ("sensor.toml", "corners.yml"):
        (folder / name).write_text("mine")
    return folder


@pytest.mark.parametrize(
    ("command", "kept"),
    [
        (("export", "cloud", "cloud.ply", "-o", "cloud.ply"), "cloud.ply"),
        (("export", "cloud", "cloud.ply", "--unit", "m", "--output=link.ply"), "link.ply"),
        (("measure", "cloud.ply", "--plane", "a", "--picture", "cloud.ply"), "cloud.ply"),
        (("measure", "cloud.ply", "--plane", "a", "--picture", "capture/images/left_000.png"), "capture"),
        (("fit", "capture", "-o", "run/statement.json"), "run/statement.json"),
        (("fit", "capture", "-o", "fit.json", "--figure", "run/run.json"), "run/run.json"),
        (("calibrate", "sensor.toml", "-o", "sensor.toml"), "sensor.toml"),
        (("calibrate", "corners.yml", "-o", "corners.toml", "--board", "11x8x30:glass"), "corners.yml"),
    ],
)
def test_no_command_writes_over_what_it_reads(command, kept, folder):
    files = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    done = mitsim_here(*command, code=2, cwd=folder)
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == files
    assert kept in done.stderr


def test_an_output_may_be_written_again(folder):
    for _ in range(2):
        mitsim_here("export", "cloud", "cloud.ply", "-o", "run/again.ply", cwd=folder)
