"""A run folder is read whole, or refused with the file and the field."""

import json
import shutil

import numpy as np
import pytest
import xarray as xr

from characterisation.cloud_files import write_cloud
from characterisation.files.atomic_io import write_netcdf
from characterisation.files.errors import InputError
from characterisation.point_cloud import PointCloud, ViewGrid
from mitsim.study.run_folder import read_run
from tests.report.conftest import CHECKED, MEASUREMENTS


@pytest.fixture
def folder(run_folder, tmp_path):
    """A copy that may be damaged."""
    shutil.copytree(run_folder, tmp_path / "run")
    return tmp_path / "run"


def read_all(folder):
    run = read_run(folder)
    for view in run.checked:
        run.predicted(view), run.decoded(view), run.capture(view)
    return run


def test_reads_what_was_written(run_folder):
    run = read_all(run_folder)
    assert run.measurements == list(MEASUREMENTS) and run.checked == CHECKED
    assert run.scores["possible"].dtype == run.scores["uncertainty_possible"].dtype == bool
    assert run.about.seed == 7 and run.about.measurements[MEASUREMENTS[1]].unit == "mm"


@pytest.mark.parametrize(
    "name",
    [
        "run.json",
        "map.nc",
        "scores.nc",
        "checks.nc",
        "clouds/rendered_0004.ply",
        "clouds/predicted_0009.ply",
        "captures/view_0000/images/left_000.png",
        "captures/view_0000/capture.json",
    ],
)
@pytest.mark.parametrize("damage", ["missing", "garbage"])
def test_a_missing_or_broken_file_is_named(folder, name, damage):
    (folder / name).unlink()
    if damage == "garbage":
        (folder / name).write_bytes(b"\x00\xffgarbage")
    with pytest.raises(InputError) as caught:
        read_all(folder)
    assert str(folder / name) in str(caught.value)


def test_broken_samples_are_named_and_missing_ones_are_allowed(folder):
    (folder / "samples.nc").write_bytes(b"garbage")
    with pytest.raises(InputError, match=r"samples\.nc"):
        read_run(folder)
    (folder / "samples.nc").unlink()
    assert read_run(folder).patches is None


@pytest.mark.parametrize(
    ("key", "value"), [("schema_version", 2), ("seed", "x"), ("source", None), ("light_path_depth", 1.5)]
)
def test_a_wrong_value_in_run_json_is_named(folder, key, value):
    about = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    (folder / "run.json").write_text(json.dumps(about | {key: value}), encoding="utf-8")
    with pytest.raises(InputError, match=rf"run\.json: {key}"):
        read_run(folder)


def test_files_of_different_runs_are_refused(folder):
    checks = xr.load_dataset(folder / "checks.nc")
    write_netcdf(checks.assign_coords(measurement=["one", "two"]), folder / "checks.nc")
    with pytest.raises(InputError, match="found one, two"):
        read_run(folder)
    write_netcdf(checks.assign_coords(view=[0, 1, 99]), folder / "checks.nc")
    with pytest.raises(InputError, match="found 99"):
        read_run(folder)


@pytest.mark.parametrize("name", ["predicted_uncertainty", "uncertainty_possible", "chance", "limit", "n_only_white"])
def test_a_run_of_before_is_refused_with_what_to_do(folder, name):
    scores = xr.load_dataset(folder / "scores.nc")
    write_netcdf(scores.drop_vars(name), folder / "scores.nc")
    with pytest.raises(InputError, match=rf"scores\.nc: {name}") as caught:
        read_run(folder)
    assert "run the study again: mitsim run" in str(caught.value)


def test_a_cloud_on_another_grid_is_refused(folder):
    points, status = np.full((4, 5, 3), np.nan, np.float32), np.ones((4, 5), np.uint8)
    other = PointCloud(points, status, ViewGrid(1, 1, 0, 0, 5, 4), "s", "simulated")
    write_cloud(other, folder / "clouds" / "rendered_0004.ply")
    with pytest.raises(InputError, match="found 4 x 5 pixels; allowed: 24 x 32"):
        read_all(folder)


def test_features_of_other_scores_are_refused(folder):
    scores = xr.load_dataset(folder / "scores.nc")
    names = scores["feature"].values.astype(object)
    scores["feature"] = ("feature", ["another", *names[1:]])
    scores.attrs.pop("content_sha256", None)
    write_netcdf(scores, folder / "scores.nc")
    with pytest.raises(InputError, match=r"run\.json: measurements\..*features"):
        read_run(folder)


def test_a_folder_that_is_not_there(tmp_path):
    with pytest.raises(InputError, match="no such folder"):
        read_run(tmp_path / "nowhere")
