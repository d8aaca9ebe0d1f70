"""Virtual measurements from the map: the same unknowns, without rendering."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from characterisation.files.errors import InputError
from characterisation.maps.performance_map import PerformanceMap
from characterisation.maps.shipped import map_path
from characterisation.tasks.folded import folded_value
from mitsim.maps.prediction.shared_errors import terms
from mitsim.sensor.sensor_file import MisalignmentTable
from mitsim.sensor.transforms import Transform
from mitsim.study import MINIMUM_POINTS, StudyFile, open_study
from mitsim.study.calibration.accuracy import measured_points
from mitsim.study.virtual.beyond_map import beyond_map
from mitsim.study.virtual.mapped import MappedMeasurements, drawn_map, moved_by_calibration
from mitsim.study.virtual.plan import measured_by, measurements_of, trial_digest
from mitsim.study.virtual.race import Job
from mitsim.study.virtual.rendered import RenderedMeasurements
from mitsim.study.virtual.screening import shared_errors
from mitsim.study.virtual.stated import budget_groups
from mitsim.study.virtual.study_unknowns import study_unknowns
from mitsim.study.virtual.world import BEYOND, Trial
from mitsim.views.view_scores import score_candidates
from tests.characterisation.maps.test_lay_directions import of_a_lay, query
from tests.smaller_sensors import coarse_sensor

SCENES = Path(__file__).parents[3] / "scenes" / "two_pillars"
DISTANCE, ANGLE = "pillar1_pillar2_distance", "plane_pillar1_angle"


def study_of(sensor, **more):
    table = {
        "scene": "matt_white.xml",
        "task": "task.toml",
        "sensor": sensor,
        "measure": {"by": "map"},
        "score": {"light_path_depth": 1},
        "views": {"subdivisions": 0, "rolls_deg": [0], "lowest_elevation_deg": 20},
        **more,
    }
    return open_study(SCENES / "study.toml", StudyFile.model_validate(table))


@pytest.fixture(
    scope="module", params=[("ensenso-n10", 2), ("david-sls-3", 3), ("kinect-v2", 1)], ids=lambda one: one[0]
)
def drawn(request, tmp_path_factory):
    study = study_of(str(coarse_sensor(*request.param, tmp_path_factory.mktemp("sensor"))))
    maker = measurements_of(study, study_unknowns(study, ("noise",)))
    view = min(study.views, key=lambda one: abs(one.elevation_deg - 45))
    return study, maker, view


def test_points_move_as_the_decoder_would_place_them(drawn):
    study, maker, view = drawn
    cloud, world, _, _ = maker._take(Job(view, Trial(0)))
    everything = study_unknowns(study).draw(Trial(5))
    moved = moved_by_calibration(cloud, study.sensor, replace(world, rig=everything.rig))
    some = np.flatnonzero(cloud.valid.ravel())[3::97]
    points = cloud.points.reshape(-1, 3)[some].astype(float)
    expected = measured_points(study.sensor, points, everything.rig)
    expected += points - measured_points(study.sensor, points, study.sensor.rig)
    size = np.abs(expected - points).max()
    error = np.abs(moved.reshape(-1, 3)[some] - expected)
    assert size > 0.005  # there is something to follow
    assert np.median(error) < 0.02 * size and np.percentile(error, 99) < 0.1 * size + 2e-4


def test_a_misaligned_camera_moves_points_of_a_map_and_its_screening():
    """A camera that rolls by e moves a point at height y / z by z^2 y e / (b z) in depth."""
    study = study_of("ensenso-n10")
    view = min(study.views, key=lambda one: abs(one.elevation_deg - 45))
    rolled = replace(study, sensor=replace(study.sensor, misalignment=MisalignmentTable(roll_mrad=1.0)))
    maker, straight = (measurements_of(one, study_unknowns(one, ("noise",))) for one in (rolled, study))
    cloud, world, _, _ = maker._take(Job(view, Trial(0)))
    assert np.array_equal(moved_by_calibration(cloud, study.sensor, world), cloud.points, equal_nan=True)
    change = (moved_by_calibration(cloud, rolled.sensor, world) - cloud.points)[..., 2][cloud.valid]
    _, y, z = cloud.points[cloud.valid].T
    expected = 1e-3 * y * z / 100.775
    assert np.abs(expected).max() > 0.1
    assert np.abs(change - expected).max() < 0.1 * np.abs(expected).max()
    points = cloud.points[cloud.valid].astype(float)
    fields = [shared_errors(one.study, one.unknowns).coefficients for one in (maker, straight)]
    size, without = (((terms(points) @ field)[..., 2] ** 2).sum(axis=0) for field in fields)
    assert np.sqrt(np.mean(size - without)) == pytest.approx(np.sqrt(np.mean(expected**2)), rel=0.1)


def test_a_longer_baseline_shrinks_what_is_measured(drawn):
    study, maker, view = drawn
    if study.sensor.technology == "time_of_flight":
        pytest.skip("a time of flight has no baseline that scales its points")
    taken = maker._take(Job(view, Trial(0)))
    world = taken[1]
    scale = 1.002
    if len(study.sensor.measuring_rig.cameras) == 2:
        name = list(world.rig.cameras)[1]
        eye = world.rig.cameras[name]
        longer = replace(eye, sensor_from_camera=Transform(eye.sensor_from_camera.rotation, scale * eye.centre))
        rig = replace(world.rig, cameras=world.rig.cameras | {name: longer})
    else:
        eye = world.rig.projector
        longer = replace(eye, sensor_from_camera=Transform(eye.sensor_from_camera.rotation, scale * eye.centre))
        rig = replace(world.rig, projector=longer)
    nominal = maker._finish(taken, Job(view, Trial(0))).errors
    changed = maker._finish((taken[0], replace(world, rig=rig), *taken[2:]), Job(view, Trial(0))).errors
    assert changed[DISTANCE] - nominal[DISTANCE] == pytest.approx(70 / scale - 70, rel=0.1)


def test_the_map_is_drawn_within_its_own_errors():
    study = study_of("ensenso-n10")
    unknowns = study_unknowns(study)
    known = PerformanceMap.load(map_path("ensenso-n10"))
    assert drawn_map(known, unknowns, -1) is known
    maps = [drawn_map(known, unknowns, number) for number in range(8)]
    sigma = known.data["ray_noise_std"].values
    size = np.sqrt(
        np.nan_to_num(known.data["ray_noise_std_error"].values) ** 2
        + np.nan_to_num(known.data["ray_noise_std_spread"].values) ** 2
    )
    sure = np.isfinite(sigma) & (size > 0) & (size < 0.2 * sigma)
    z = np.array([(one.data["ray_noise_std"].values - sigma)[sure] / size[sure] for one in maps])
    assert np.sqrt((z**2).mean()) == pytest.approx(1, abs=0.25)
    fraction = maps[0].data["recovered_fraction"].values
    assert np.nanmin(fraction) >= 0 and np.nanmax(fraction) <= 1
    again = drawn_map(known, unknowns, 0).data["ray_noise_std"].values
    np.testing.assert_array_equal(again, maps[0].data["ray_noise_std"].values)


def test_the_directions_of_a_lay_are_drawn_within_their_own_errors():
    """A face with a known lay had the same F in all trials: errors were drawn for the mean over directions alone."""
    fraction, sigma = (lambda n, psi: 0.5 + 0.2 * np.cos(2 * psi) + 0 * n[..., 0]), (lambda n, psi: 0.1 + 0 * n[..., 0])
    known = of_a_lay(fraction, sigma)
    unknowns = study_unknowns(study_of("ensenso-n10"))
    maps = [drawn_map(known, unknowns, number) for number in range(8)]
    for name, error in (("lay_recovered_fraction", 0.01), ("lay_ray_noise_std", 0.002)):
        moved = np.array([one.data[name].values - known.data[name].values for one in maps])
        assert np.nanstd(moved) == pytest.approx(error, rel=0.05)
    normals = np.tile([0.0, 0.0, 1.0], (1, 1))
    answers = [query(one, normals, 20.0).fraction[0] for one in maps]
    assert 0.001 < np.std(answers) < 0.01


def plain_map(known, sigma):
    """Every point comes back with independent noise of one standard deviation [mm], known without error."""
    data = known.data.copy(deep=True)
    for name in data.data_vars:
        if name.endswith(("_error", "_spread", "_share")):
            data[name][:] = 0.0
    data["recovered_fraction"][:], data["ray_noise_std"][:], data["noise_area"][:] = 1.0, sigma, 1.0
    return PerformanceMap(data)


def test_the_linear_uncertainty_is_that_of_the_trials_where_nothing_but_noise_is_unknown():
    """Of a map without losses, correlation and bias, a hundred trials: seven per cent, one sigma, for each ratio.

    An angle whose nominal value is 0 is the length of two normal errors, so sizes are compared, bias included.
    """
    study = study_of("kinect-v2")
    study = replace(study, performance_map=plain_map(study.performance_map, 1.0))
    maker = MappedMeasurements(study, study_unknowns(study, ("noise",)))
    view = min(study.views, key=lambda one: abs(one.elevation_deg - 45))
    trials = [outcome.errors for _, outcome in maker.run([Job(view, Trial(k)) for k in range(100)])]
    scores, _ = score_candidates(
        study.scene, study.task, [view], maker.predictor, study.performance_map, MINIMUM_POINTS, []
    )
    for name in study.task.measurements:
        found = np.sqrt(np.mean([errors[name] ** 2 for errors in trials]))
        predicted = float(scores["predicted_uncertainty"].sel(measurement=name).values[0])
        assert found == pytest.approx(predicted, rel=0.21), name


def test_what_is_beyond_the_map_is_added_in_predicted_uncertainties(drawn):
    study, plain, view = drawn
    maker = MappedMeasurements(study, study_unknowns(study, ("noise", BEYOND)))
    jobs = [Job(view, Trial(day)) for day in range(3)] + [Job(view, Trial(1, capture=1))]
    outcomes = [[outcome for _, outcome in one.run(jobs)] for one in (plain, maker)]
    without, with_it = ([outcome.errors[DISTANCE] for outcome in some] for some in outcomes)
    added = np.subtract(with_it, without)
    sizes = beyond_map().of(study.sensor)
    assert (np.abs(added) <= maker._predicted[view.number][DISTANCE] * sizes.size[-1] * (1 + 1e-9)).all()
    assert len(set(added[:3].round(12).tolist())) == 3
    assert added[3] == pytest.approx(added[1], abs=1e-9)  # of one day: it does not average out
    # an angle of nominally 0 is moved as a vector, and so stays above 0
    folded = folded_value(study.task, ANGLE)
    vectors = [[np.reshape(one.deviations[ANGLE], folded.shape) for one in some] for some in outcomes]
    moves = folded.size(np.subtract(*vectors))
    assert moves[3] == pytest.approx(moves[1], abs=1e-9) and (moves > 0).all()
    assert [one.errors[ANGLE] for one in outcomes[1]] == pytest.approx(folded.size(np.array(vectors[1])))


def test_rendered_trials_do_not_depend_on_what_is_beyond_the_map():
    study = study_of("ensenso-n10")
    some = study_unknowns(study)
    less = replace(some, varied=tuple(group for group in some.varied if group != BEYOND))
    assert trial_digest(study, some, "render") == trial_digest(study, less, "render")
    assert trial_digest(study, some, "map") != trial_digest(study, less, "map")
    assert BEYOND in budget_groups(some, "map", study.sensor)
    assert BEYOND not in budget_groups(some, "render", study.sensor)


def test_trials_repeat_and_differ(drawn):
    _, maker, view = drawn
    jobs = [Job(view, Trial(day)) for day in (3, 4)]
    first, again = (list(maker.run(jobs)) for _ in range(2))
    assert first == again or all(
        np.array_equal(list(a[1].errors.values()), list(b[1].errors.values()), equal_nan=True)
        for a, b in zip(first, again, strict=True)
    )
    assert first[0][1].errors[DISTANCE] != first[1][1].errors[DISTANCE]


def test_what_measures_follows_the_source_of_the_map():
    assert measured_by(study_of("ensenso-n10")) == "map"
    simulated = study_of("ensenso-n10", measure={})
    assert measured_by(simulated) == "render"
    device = replace(
        simulated, performance_map=PerformanceMap(simulated.performance_map.data.assign_attrs(source="device"))
    )
    assert measured_by(device) == "map"
    assert isinstance(measurements_of(device, study_unknowns(device)), MappedMeasurements)
    assert isinstance(measurements_of(simulated, study_unknowns(simulated)), RenderedMeasurements)
    with pytest.raises(InputError, match=r"measure\.by"):
        measured_by(replace(study_of("ensenso-n10"), performance_map=None))
    groups = budget_groups(study_unknowns(device), "map", device.sensor)
    assert not {"light", "unit", "decoder"} & set(groups) and "calibration" in groups
