"""Views are measured once, kept, and measured again only where something that decides has changed."""

import json
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from scipy.stats import rankdata, spearmanr

from characterisation.errors import InputError
from characterisation.scores.score_validation import UNCERTAINTY, V_M
from mitsim.capture.cloud import sensor_geometry
from mitsim.capture.simulate import SimulatedSensor
from mitsim.predict import Predictor
from mitsim.validation.baselines import COSINE, NORMAL, POINTS, RANDOM, WHITE, by_uncertainty, said_of_views
from mitsim.validation.checked_views import check_views
from mitsim.validation.measured_views import FIELDS, write_measured
from mitsim.validation.score_plan import read_score_validation
from mitsim.validation.score_run import run_score_validation

FEW = (
    ("lowest_elevation_deg = 0", "lowest_elevation_deg = 5"),
    ("samples_per_pixel = 16", "samples_per_pixel = 4"), ("light_path_depth = 2", "light_path_depth = 1"),
)  # fmt: skip


class Counting:
    """A simulated sensor that counts its captures, and can be stopped before one of them."""

    def __init__(self, sensor, stop_before=None):
        self.inner, self.count, self.stop_before = SimulatedSensor(sensor), 0, stop_before

    def capture(self, *arguments, **options):
        if self.count == self.stop_before:
            raise KeyboardInterrupt
        self.count += 1
        return self.inner.capture(*arguments, **options)


def test_a_stopped_check_goes_on_and_ends_as_one_that_was_not(written, tmp_path):
    check = read_score_validation(written(*FEW))[0]
    sensor = check.study.sensor
    geometry = sensor_geometry(sensor)
    predictor, views = Predictor.of_sensor(sensor, geometry), len(check.study.views)
    assert views >= 3

    def run(folder, simulated):
        return check_views(check, simulated, geometry, predictor, tmp_path / folder)

    whole = Counting(sensor)
    expected = run("whole", whole)
    assert whole.count == 2 * views
    assert expected["error"].shape == (7, views, 2)
    assert np.isfinite(expected["error"].values).mean() > 0.5
    # the part was put down anew, so no two repeats are the same
    apart = np.diff(expected["error"].values, axis=-1)
    assert (np.abs(apart[np.isfinite(apart)]) > 0).all()

    with pytest.raises(KeyboardInterrupt):
        run("stopped", Counting(sensor, stop_before=3))
    left = Counting(sensor)
    assert run("stopped", left).identical(expected)
    assert left.count == 2 * (views - 1)

    none = Counting(sensor, stop_before=0)
    assert run("whole", none).identical(expected)
    more = replace(check, file=check.file.model_copy(update={"repeats": 3}))
    third = Counting(sensor)
    again = check_views(more, third, geometry, predictor, tmp_path / "whole")
    assert third.count == views
    assert again.isel(repeat=slice(2)).identical(expected)
    place = tmp_path / "whole" / check.folder / "view_0001.json"
    for spoilt in ("{", json.dumps(json.loads(place.read_text()) | {"digest": "0" * 16}), "{}"):
        place.write_text(spoilt)
        again = Counting(sensor)
        assert run("whole", again).identical(expected)
        assert again.count == 2


def test_views_that_were_measured_elsewhere_are_not_measured_again(written, tmp_path):
    """One file for a sensor, in single precision; another seed, or a sample that is not in it, is measured."""
    path = written(*FEW)
    check = read_score_validation(path)[0]
    sensor = check.study.sensor
    geometry = sensor_geometry(sensor)
    predictor, views = Predictor.of_sensor(sensor, geometry), len(check.study.views)
    expected = check_views(check, SimulatedSensor(sensor), geometry, predictor, tmp_path / "first")
    write_measured(read_score_validation(path), tmp_path / "first")
    (path.parent / "measured").mkdir()
    (tmp_path / "first/ensenso-n10.nc").rename(path.parent / "measured/ensenso-n10.nc")

    def captures(text, number=0):
        path.write_text(text)
        again, counting = read_score_validation(path)[number], Counting(sensor)
        found = check_views(again, counting, geometry, predictor, tmp_path / f"again_{len(list(tmp_path.iterdir()))}")
        return counting.count, found

    shipped = path.read_text()  # with measured = "measured"
    count, found = captures(shipped)
    assert count == 0
    # what a run took from the file is in the file that it writes
    again, own = read_score_validation(path), tmp_path / "own"
    own.mkdir()
    write_measured(again, own)
    xr.testing.assert_identical(
        xr.load_dataset(own / "ensenso-n10.nc"), xr.load_dataset(path.parent / "measured/ensenso-n10.nc")
    )
    for name in FIELDS:
        np.testing.assert_allclose(found[name], expected[name], rtol=1e-6)
    count, found = captures(shipped.replace("repeats = 2", "repeats = 3"))
    assert count == views
    np.testing.assert_allclose(found["error"].isel(repeat=slice(2)), expected["error"], rtol=1e-6)
    assert captures(shipped.replace("repeats = 2", "repeats = 1").replace("seed = 1", "seed = 2"))[0] == views
    assert captures(shipped.replace("repeats = 2", "repeats = 1"), number=1)[0] == views
    (path.parent / "measured/ensenso-n10.nc").write_bytes(b"CDF")
    with pytest.raises(InputError, match="validate scores"):
        captures(shipped)


def test_every_score_speaks_of_every_measurement_and_view(written, tmp_path):
    checks = read_score_validation(written(*FEW, ('name = "Ra 0.74"', 'name = "metal"')))
    found = run_score_validation(checks, tmp_path / "run")["ensenso-n10"]
    assert {(one.sample, one.measurement) for one in found} == {
        (sample, name) for sample in ("matt white", "metal") for name in checks[0].study.task.measurements
    }
    views = len(checks[0].study.views)
    for one in found:
        assert list(one.scores) == [RANDOM, NORMAL, POINTS, COSINE, WHITE, V_M, UNCERTAINTY]
        assert all(score.shape == (views,) for score in one.scores.values())
        able = np.isfinite(one.predicted_uncertainty)
        # a chance under 1 sets a view that is possible behind its place by u, and the others come after them
        order = one.scores[UNCERTAINTY]
        assert (-order[able] >= rankdata(one.predicted_uncertainty[able]) / views - 1e-12).all()
        assert spearmanr(-order[able], one.predicted_uncertainty[able]).statistic > 0.9
        assert not able.any() or not (order[~able] >= order[able].min()).any()
    white = [one for one in found if one.sample == "matt white"]
    metal = [one for one in found if one.sample == "metal"]
    for one, other in zip(white, metal, strict=True):  # neither material nor map is in these
        for name in (RANDOM, NORMAL, COSINE, WHITE):
            np.testing.assert_array_equal(one.scores[name], other.scores[name])
        np.testing.assert_allclose(one.scores[WHITE], one.scores[V_M], rtol=1e-12)  # summed in another order


def test_squareness_and_the_cosine_over_the_square_have_closed_forms(written):
    check = read_score_validation(written(*FEW, ("subdivisions = 0", "subdivisions = 1")))[0]
    study = check.study
    predictor = Predictor.of_sensor(study.sensor, sensor_geometry(study.sensor))
    from mitsim.score import score_candidates
    from mitsim.study import MINIMUM_POINTS

    scores, _ = score_candidates(study.scene, study.task, study.views, predictor, study.performance_map, MINIMUM_POINTS)
    said = said_of_views(scores, study.scene, study.task, study.views, predictor, 1)
    names = list(study.task.measurements)
    up = np.array([view.direction[2] for view in study.views])
    level = np.sqrt(1 - up**2)
    np.testing.assert_allclose(said[NORMAL][names.index("pillar1_radius")], level)
    np.testing.assert_allclose(said[NORMAL][names.index("plane_pillar1_angle")], (up + level) / 2)
    np.testing.assert_allclose(said[NORMAL][names.index("point1_point2_distance")], (up + 2 * level) / 3)
    # straight above, what a pillar shows is a ring of wall at grazing incidence: nearly nothing
    zenith = int(np.argmax(up))
    radius = said[COSINE][names.index("pillar1_radius")]
    assert radius[zenith] < 0.2 * radius.max()
    # in matt white every visible pixel near normal incidence is recovered: points are visible pixels, each about
    # cos / |V|^2 = 1 / standoff^2 there
    plane_like = said[POINTS][names.index("point1_point2_distance")]
    assert plane_like.argmax() != zenith


def test_a_views_place_by_its_uncertainty_is_the_one_to_be_expected():
    scores = xr.Dataset({
        "predicted_uncertainty": (("measurement", "view"), [[1.0, 2.0, 3.0, 0.5, np.nan, np.nan, np.nan]]),
        "chance": (("measurement", "view"), [[1.0, 1.0, 0.5, 0.0, 0.0, np.nan, np.nan]]),
    })  # fmt: skip
    seen = np.array([[9.0, 9.0, 9.0, 1.0, 5.0, 2.0, 0.0]])
    (found,) = by_uncertainty(scores, seen)
    sevenths = np.arange(1, 8) / 7
    # the fourth has no chance, so that it is the first by u means nothing: it goes by what it sees, and is last there
    expected = [-sevenths[0], -sevenths[1], -(0.5 * sevenths[2] + 0.5), -1 - sevenths[2], -1 - sevenths[0],
                -1 - sevenths[1], np.nan]  # fmt: skip
    np.testing.assert_allclose(found, expected)
