"""``mitsim map predict`` as a user runs it: with independent and with correlated noise."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from characterisation.cloud_files import read_cloud
from characterisation.coupon.residual_field import autocorrelation
from characterisation.point_cloud import PointCloud
from mitsim.cli.program import app


def predicted(scenes: Path, folder: Path, *options: str) -> PointCloud:
    file = folder / "cloud.ply"
    done = CliRunner().invoke(
        app,
        [
            "map",
            "predict",
            str(scenes / "two_pillars/two_pillars.xml"),
            "--map",
            "ensenso-n10",
            "--position",
            "120",
            "-330",
            "330",
            "--target",
            "0",
            "0",
            "20",
            *options,
            "-o",
            str(file),
        ],
    )
    assert done.exit_code == 0, done.output
    cloud = read_cloud(file)
    assert f"valid\t{cloud.valid.sum()}" in done.stdout
    return cloud


def plate_errors(cloud: PointCloud) -> np.ndarray:
    """Errors along the rays about the plate's plane in units of sigma, (H, W), NaN elsewhere."""
    mask = cloud.valid & (cloud.feature == cloud.feature_names.index("plane"))
    rays, distance = cloud.grid.rays()[mask], np.linalg.norm(cloud.points[mask], axis=1)
    # 1 / distance is linear in the ray
    fit = np.linalg.lstsq(rays, 1 / distance, rcond=None)[0]
    out = np.full(mask.shape, np.nan)
    out[mask] = (distance - 1 / (rays @ fit)) / cloud.sigma[mask]
    return out


def test_noise_is_independent_unless_it_is_asked_to_be_correlated(scenes: Path, tmp_path: Path) -> None:
    correlate = ("--noise", "correlated")
    plain, again = (predicted(scenes, tmp_path, *options) for options in ((), ("--noise", "independent")))
    correlated, other = (predicted(scenes, tmp_path, *correlate, "--seed", seed) for seed in ("1", "2"))
    assert np.array_equal(plain.points, again.points, equal_nan=True)
    # the same pixels are lost, by the same seed
    assert np.array_equal(plain.status, correlated.status)
    assert not np.array_equal(correlated.points, other.points, equal_nan=True)
    neighbours = [autocorrelation(plate_errors(cloud), 4).values[4, 5] for cloud in (plain, correlated)]
    assert abs(neighbours[0]) < 4 / np.sqrt(10_000)
    # noise areas of the map about this pose are over 12 px^2: rho(1) over exp(-pi / 10) = 0.73
    assert neighbours[1] > 0.73


def test_a_noise_that_there_is_not_is_told(scenes: Path, tmp_path: Path) -> None:
    scene, cloud = scenes / "two_pillars/two_pillars.xml", tmp_path / "cloud.ply"
    pose = ("--position", "0", "-400", "300")
    arguments = ["map", "predict", str(scene), "--map", "ensenso-n10", *pose, "--noise", "pink", "-o", str(cloud)]
    done = CliRunner().invoke(app, arguments)
    assert done.exit_code == 2
    assert "'pink' is not one of 'independent', 'correlated'" in " ".join(done.output.split())
    assert not cloud.exists()


@pytest.mark.parametrize("option", ["--noise", "--seed"])
def test_the_help_names_what_a_draw_depends_on(option: str) -> None:
    assert option in CliRunner().invoke(app, ["map", "predict", "--help"]).output
