"""Constants of lost points: given back from drawn points, with intervals that hold them, and from renders."""

import shutil
from functools import partial

import numpy as np
import pytest
from typer.testing import CliRunner

from characterisation.files.documents import read_toml
from mitsim.maps.prediction.interreflections import LossCurve, Losses, losses
from tests.proofs import loss_fit
from tests.proofs.__main__ import app
from tests.proofs.loss_fit import SeenPoints, fitted_loss, losses_document
from tests.smaller_sensors import coarse_sensor

HALF, STEEPNESS = 1.8, 1.5


def drawn_views(rng, views, points=400):
    """Views whose points are found by the law."""
    out = []
    for _ in range(views):
        fraction, rho = rng.uniform(0.6, 1.0, points), 10 ** rng.uniform(-3, 1.5, points)
        out.append(SeenPoints(fraction, rho, rng.random(points) < fraction / (1 + (rho / HALF) ** STEEPNESS)))
    return out


def test_drawn_points_give_the_constants_back_within_their_intervals():
    """Of 20 fits to 12 cases of 4 views 95 % of the intervals hold the truth: 16 or more but once in 400 times."""
    rng, held = np.random.default_rng(3), np.zeros(2)
    for seed in range(20):
        found = fitted_loss([drawn_views(rng, 4, 60) for _ in range(12)], seed, resamples=40)
        held += [
            found.half_interval[0] <= HALF <= found.half_interval[1],
            found.steepness_interval[0] <= STEEPNESS <= found.steepness_interval[1],
        ]
    assert (held >= 16).all()
    assert found.half == pytest.approx(HALF, rel=0.25) and found.steepness == pytest.approx(STEEPNESS, rel=0.25)


def test_points_without_interreflections_do_not_enter_the_fit():
    none = SeenPoints(np.ones(10), np.zeros(10), np.ones(10, bool))
    with pytest.raises(ValueError, match="no points"):
        fitted_loss([[none]])


def test_the_data_file_is_read_as_it_was_written(tmp_path):
    loss = LossCurve(half=2.0, half_interval=(1.5, 2.5), steepness=1.0, steepness_interval=(0.5, 1.5))
    (tmp_path / "losses.toml").write_text(losses_document("command", ["a", "b"], {"matched": loss, "coded": loss}))
    found = read_toml(tmp_path / "losses.toml", Losses)
    assert found == Losses(command="command", cases=["a", "b"], matched=loss, coded=loss)


@pytest.fixture
def coarse_cases(scenes, tmp_path):
    """Two of the cases that the shipped numbers come from, a matcher and a code; the camera of the code is coarse.

    The part has one finish: every finish of a part is compiled into each of its kernels.
    """
    shutil.copytree(scenes / "parts/balls_on_plate", tmp_path / "balls_on_plate")
    text = (scenes / "parts/validation.toml").read_text(encoding="utf-8")
    text = text.replace('"photoneo-phoxi-s"', f'"{coarse_sensor("photoneo-phoxi-s", 4, tmp_path)}"')
    file = tmp_path / "validation.toml"
    file.write_text(text, encoding="utf-8")
    return file


def test_the_command_gives_the_shipped_numbers_back_from_a_few_views(coarse_cases, tmp_path, monkeypatch):
    """Two views of a matcher and two of a code: intervals overlap."""
    monkeypatch.setattr(loss_fit, "fitted_loss", partial(fitted_loss, resamples=40))
    out = tmp_path / "losses.toml"
    given = ["losses", str(coarse_cases), "-o", str(out), "--views", "2"]
    ran = CliRunner().invoke(
        app, [*given, "--only", "balls_on_plate__ensenso-n10", "--only", "balls_on_plate__photoneo"]
    )
    assert ran.exit_code == 0, ran.output
    found, shipped = read_toml(out, Losses), losses()
    for kind in ("matched", "coded"):
        one, known = getattr(found, kind), getattr(shipped, kind)
        (low, high), (least, most) = one.half_interval, known.half_interval
        assert low <= most and least <= high
    assert found.cases == ["balls_on_plate__ensenso-n10__Ra0.46", "balls_on_plate__photoneo-phoxi-s__Ra0.37"]
