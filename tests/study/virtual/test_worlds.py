"""Worlds: what decides them, what they share, and how large what is drawn is."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import kstest

from characterisation.files.errors import InputError
from mitsim.scene.surface.scatter import Deviation
from mitsim.sensor.preset import load_sensor
from mitsim.sensor.preset_covariance import preset_covariance, with_drift
from mitsim.sensor.rig_covariance import RigCovariance
from mitsim.sensor.rig_parameters import parameter_names
from mitsim.sensor.room_light import room_irradiance
from mitsim.sensor.unknowns import MeasuredFinish, UnknownsTable, unknowns_of
from mitsim.study.virtual.drawn_finish import DRAWN, finish_deviation, finish_numbers
from mitsim.study.virtual.influences import influences
from mitsim.study.virtual.stated import budget_groups
from mitsim.study.virtual.world import (
    FRESH,
    GROUPS,
    JUDGING_DAYS,
    SET_DAYS,
    STATEMENT_DAYS,
    Trial,
    Unknowns,
)


@pytest.fixture(scope="module")
def unknowns():
    sensor = load_sensor("ensenso-n10")
    table = UnknownsTable()
    covariance = preset_covariance(sensor, table.calibration.drift())
    return Unknowns(table, sensor.rig, covariance, 850.0, 23e-6, np.array([1.0, 2.0, 3.0]), 7)


def told(world):
    """Everything of a world by group."""
    return {
        "calibration": np.concatenate([camera.matrix.ravel() for camera in world.rig.cameras.values()]),
        "finish": world.finish,
        "form": world.form,
        "light": (world.room, world.power, world.exposure),
        "temperature": world.expansion,
        "unit": world.unit,
        "pose": np.concatenate([world.placed.matrix().ravel(), world.assumed.matrix().ravel()]),
        "noise": world.seed,
        "beyond_map": world.beyond,
        "decoder": world.decoder,
        "coat": world.coat,
    }


def same(one, other):
    return np.array_equal(np.ravel(one), np.ravel(other))


@pytest.mark.parametrize(
    ("source", "sizes", "included"),
    [("map", 0.0, True), ("map", 1.0, True), ("render", 1.0, True), ("render", 0.0, False)],
)
def test_a_finish_that_is_drawn_is_listed_as_included(source, sizes, included):
    """A trial from a map draws the errors of the map, of whatever size the unknowns of the finish are."""
    table = UnknownsTable()
    finish = table.finish.model_copy(update=dict.fromkeys(MeasuredFinish.model_fields, sizes))
    (found,) = (
        one
        for one in influences(table.model_copy(update={"finish": finish}), source, 1)
        if one.name == "finish of the part"
    )
    assert found.included == included


@pytest.mark.parametrize(
    ("calibration", "flight", "drawn"),
    [
        ({}, False, {"row error", "vergence", "roll", "focal length"}),
        ({}, True, {"focal length", "offset of the path"}),
        ({"vergence_mrad": 0, "roll_mrad": 0, "focal_relative": 0}, False, {"row error"}),
        ({"vergence_mrad": 0, "row_mrad": 0, "roll_mrad": 0, "focal_relative": 0}, False, set()),
        ({"scale": 0}, False, set()),
    ],
)
def test_the_drift_that_is_drawn_is_listed(calibration, flight, drawn):
    """A covariance without errors of its own has those of the drift that is listed."""
    table = UnknownsTable.model_validate({"calibration": calibration})
    listed = {one.name: one for one in influences(table, "render", 1, flight=flight)}
    drift = listed["drift since the calibration"]
    assert drift.included == bool(drawn) and (not drawn or drift.how == "drawn: " + ", ".join(drift_in_order(drawn)))
    assert listed["calibration of the sensor"].included == ("scale" not in calibration)
    sensor = load_sensor("kinect-v2" if flight else "ensenso-n10")
    nothing = RigCovariance((), np.zeros((0, 0)), "exact")
    kinds = {
        name.rpartition(".")[2].partition("_")[0]
        for name in with_drift(nothing, sensor, table.calibration.drift()).names
    }
    if "scale" not in calibration:
        assert kinds == set().union(
            *({"focal length": {"focal"}, "offset of the path": {"offset"}}.get(one, {"rotation"}) for one in drawn)
        )
    unknowns = Unknowns(table, sensor.rig, nothing, 850.0, 0.0, np.zeros(3), 7)
    assert ("calibration" in budget_groups(unknowns, "render", sensor)) == ("scale" not in calibration)


@pytest.mark.parametrize(("name", "included"), [("ensenso-n10", True), ("zivid-2-m70", False)])
def test_exposures_that_are_drawn_are_listed(name, included):
    sensor = load_sensor(name)
    table = unknowns_of(sensor.unknowns)
    nothing = RigCovariance((), np.zeros((0, 0)), "exact")
    unknowns = Unknowns(table, sensor.rig, nothing, 850.0, 0.0, np.zeros(3), 7)
    assert (np.ptp([unknowns.draw(Trial(day)).exposure for day in range(9)]) > 0) == included
    for source in ("render", "map"):
        listed = {one.name: one for one in influences(table, source, 1)}["resolution of the exposure setting"]
        assert listed.included == (included and source == "render") and listed.simulated
        assert listed.how.startswith("drawn") == listed.included  # it was "drawn within 0 %"


def drift_in_order(drawn):
    return [one for one in ("row error", "vergence", "roll", "focal length", "offset of the path") if one in drawn]


def test_a_trial_decides_its_world(unknowns):
    one, again = told(unknowns.draw(Trial(5))), told(unknowns.draw(Trial(5)))
    assert all(same(one[group], again[group]) for group in GROUPS)
    other = told(replace(unknowns, seed=8).draw(Trial(5)))
    assert not any(same(one[group], other[group]) for group in GROUPS if group != "finish")


def test_captures_of_a_day_share_what_is_common_and_nothing_else(unknowns):
    one, other = told(unknowns.draw(Trial(5, 0))), told(unknowns.draw(Trial(5, 1)))
    for group in GROUPS:
        assert same(one[group], other[group]) == (group not in FRESH), group


def test_some_days_of_a_statement_keep_a_seed_of_the_day_before_and_nothing_else(unknowns):
    kept = []
    for day in range(8):
        one, other = (told(unknowns.draw(Trial(STATEMENT_DAYS + k))) for k in (day, day + 1))
        kept.append(
            {group for group in ("calibration", "form", "unit", "beyond_map") if same(one[group], other[group])}
        )
    assert kept == 2 * [{"unit", "beyond_map"}, set(), {"form"}, set()]
    race = [unknowns.draw(Trial(day)).unit for day in range(8)]
    assert len(set(race)) == 8


def test_a_group_that_is_not_varied_stays_at_its_best_estimate(unknowns):
    nominal = replace(unknowns, varied=())
    worlds = [nominal.draw(Trial(day)) for day in range(3)]
    for world in worlds:
        assert same(told(world)["calibration"], told(worlds[0])["calibration"])
        assert (world.finish, world.form, world.unit, world.decoder) == (-1, 0, 0, 0)
        assert (world.power, world.expansion) == (1.0, 0.0)
        np.testing.assert_array_equal(world.placed.matrix(), np.eye(4))
    only = replace(unknowns, varied=("light",))
    assert only.draw(Trial(1)).power != only.draw(Trial(2)).power
    assert only.draw(Trial(1)).seed == only.draw(Trial(2)).seed


def test_poses_scatter_as_the_table_says_about_the_middle(unknowns):
    table = UnknownsTable.model_validate(
        {"pose": {"placement_mm": 0.7, "placement_deg": 0.0, "told_mm": 0.1, "told_deg": 0.2}}
    )
    only = replace(unknowns, table=table)
    worlds = [only.draw(Trial(day)) for day in range(400)]
    shifts = np.array([world.placed.translation for world in worlds])
    assert shifts.std(axis=0) == pytest.approx(0.7 * np.ones(3), rel=0.12)
    errors = [world.assumed @ world.placed.inverse() for world in worlds]
    turns = np.array([one.rotation[[2, 0, 1], [1, 2, 0]] for one in errors])
    assert np.degrees(turns).std(axis=0) == pytest.approx(0.2 * np.ones(3), rel=0.12)
    middle = np.array([one.points(unknowns.centre) for one in errors]) - unknowns.centre
    assert middle.std(axis=0) == pytest.approx(0.1 * np.ones(3), rel=0.12)


def test_the_covariance_of_the_calibration_is_drawn(unknowns):
    quiet = UnknownsTable.model_validate({"temperature": {"sensor_kelvin": 0.0}})
    only = replace(unknowns, table=quiet)
    nominal, names = unknowns.rig, [f"left.{name}" for name in ("focal_x_px", "k1")]
    drawn = np.array(
        [
            [
                world.rig.cameras["left"].matrix[0, 0] - nominal.cameras["left"].matrix[0, 0],
                world.rig.cameras["left"].distortion[0] - nominal.cameras["left"].distortion[0],
            ]
            for world in (only.draw(Trial(day)) for day in range(800))
        ]
    )
    covariance = unknowns.calibration
    places = [covariance.names.index(name) for name in names]
    expected = covariance.covariance[np.ix_(places, places)]
    np.testing.assert_allclose(np.sqrt(np.diag(np.cov(drawn.T))), np.sqrt(np.diag(expected)), rtol=0.1)
    correlation = expected[0, 1] / np.sqrt(expected[0, 0] * expected[1, 1])
    assert np.corrcoef(drawn.T)[0, 1] == pytest.approx(correlation, abs=0.12)
    assert set(covariance.names) <= set(parameter_names(nominal))


def test_the_temperature_of_the_sensor_stretches_its_baseline(unknowns):
    table = UnknownsTable.model_validate({"temperature": {"sensor_kelvin": 10.0, "body_per_kelvin": 2e-5}})
    only = replace(unknowns, table=table, varied=("temperature",))
    nominal = np.linalg.norm(unknowns.rig.cameras["right"].centre)
    drawn = [np.linalg.norm(only.draw(Trial(day)).rig.cameras["right"].centre) / nominal - 1 for day in range(400)]
    assert np.std(drawn) == pytest.approx(2e-4, rel=0.12)


def test_finishes_have_the_spread_of_a_normal_distribution(unknowns):
    """Of 2000 draws, the mean within 4.5 and the standard deviation within 4.5 of its own sigma."""
    alphas, others = (
        np.array([finish_deviation(unknowns, number, name).alpha for number in range(2000)])
        for name in ("plate", "pillar")
    )
    assert abs(alphas.mean()) < 4.5 / np.sqrt(2000) and alphas.std() == pytest.approx(1, abs=4.5 / np.sqrt(4000))
    assert abs(np.corrcoef(alphas, others)[0, 1]) < 4.5 / np.sqrt(2000)
    assert finish_deviation(unknowns, -1, "plate").alpha == 0
    fitted = {"finish": {"measured": {"plate": {"alpha": (1.4, 0.2), "lay": (-0.5, 1.0)}}}}
    fitted = replace(unknowns, table=UnknownsTable.model_validate(fitted))
    assert finish_deviation(fitted, -1, "plate") == Deviation(alpha=1.4, lay=-0.5)
    assert finish_deviation(fitted, -1, "pillar") == Deviation()
    known = replace(unknowns, table=UnknownsTable.model_validate({"finish": {"alpha": 0.0, "lay": 0.0}}))
    assert finish_deviation(known, 3, "plate").alpha == 0 and finish_deviation(known, 3, "plate").lay_deg is None


@pytest.mark.parametrize("first", [0, JUDGING_DAYS, STATEMENT_DAYS, SET_DAYS])
def test_every_day_has_a_finish_of_its_own_and_its_captures_share_it(unknowns, first):
    days = [unknowns.draw(Trial(first + day)).finish for day in range(200)]
    assert len(set(days)) == 200
    assert unknowns.draw(Trial(first, capture=3)).finish == days[0]
    assert replace(unknowns, varied=("noise",)).draw(Trial(first)).finish == -1
    # and the seed of the study decides which
    assert not set(days) & {
        replace(unknowns, seed=unknowns.seed + 1).draw(Trial(first + day)).finish for day in range(200)
    }


def test_the_lay_has_any_direction_and_properties_are_independent(unknowns):
    numbers = range(2000)
    directions = np.array([finish_deviation(unknowns, number, "plate").lay_deg for number in numbers])
    assert kstest(directions / 180.0, "uniform").pvalue > 1e-3
    drawn = np.array([list(finish_numbers(unknowns, number, "plate").values()) for number in numbers])
    assert drawn.shape == (2000, len(DRAWN))
    np.testing.assert_allclose(np.corrcoef(drawn.T), np.eye(len(DRAWN)), atol=4 / np.sqrt(2000))
    assert finish_numbers(unknowns, -1, "plate") == dict.fromkeys(DRAWN, 0.0)
    known = replace(unknowns, table=UnknownsTable.model_validate({"finish": {"alpha": 0.0, "lay": 0.0}}))
    left = {name: finish_numbers(unknowns, 99, "plate")[name] for name in ("wide_angle", "reflectance", "tail")}
    assert finish_numbers(known, 99, "plate") == left


def test_a_measured_finish_replaces_its_prior_alone(unknowns):
    measured = {"plate": {"alpha": [-0.5, 0.1], "tail": [0.3, 0.0]}}
    known = replace(unknowns, table=UnknownsTable.model_validate({"finish": {"measured": measured}}))
    numbers = range(800)
    drawn = [finish_deviation(known, number, "plate") for number in numbers]
    alphas = np.array([one.alpha for one in drawn])
    assert alphas.mean() == pytest.approx(-0.5, abs=4 * 0.1 / np.sqrt(800))
    assert alphas.std() == pytest.approx(0.1, rel=0.1) and {one.tail for one in drawn} == {0.3}
    for number in numbers[:5]:
        assert finish_deviation(known, number, "pillar") == finish_deviation(unknowns, number, "pillar")
        was, now = finish_deviation(unknowns, number, "plate"), finish_deviation(known, number, "plate")
        assert (was.wide_angle, was.reflectance, was.lay_deg) == (now.wide_angle, now.reflectance, now.lay_deg)


def test_a_study_overrules_the_sensor_key_by_key():
    sensor = UnknownsTable.model_validate({"calibration": {"vergence_mrad": 0.05}, "light": {"filter_nm": 40.0}})
    study = UnknownsTable.model_validate({"light": {"room": "dark cell"}, "pose": {"told_mm": 0.0}})
    both = unknowns_of(sensor, study)
    assert both.calibration.vergence_mrad == 0.05 and both.light.filter_nm == 40.0
    assert both.light.illuminance == 0.0 and both.pose.told_mm == 0.0
    assert both.pose.placement_mm == UnknownsTable().pose.placement_mm


@pytest.mark.parametrize(
    "table",
    [
        {"light": {"room": "cellar"}},
        {"light": {"room": -1.0}},
        {"calibration": {"vergence": 0.1}},
        {"finish": {"alpha": 2.0}},
        {"lights": {}},
        {"pose": {"told_mm": float("nan")}},
    ],
)
def test_what_is_no_unknown_is_refused(table):
    from characterisation.files.documents import validate

    with pytest.raises(InputError):
        validate("study.toml", table, UnknownsTable)


def test_light_of_a_room_by_closed_forms():
    # a band that holds all of the lamps' light: 320 lm/W
    assert room_irradiance(320.0, 0.0, 555.0, 400.0) == pytest.approx(1e-6)
    assert room_irradiance(320.0, 0.0, 850.0, 50.0) == 0.0
    # a spectrum that hardly changes over V(lambda): its irradiance per nm is the illuminance over 683 lm/W and 107 nm
    narrow = room_irradiance(683.0, 1.0, 560.0, 1.0)
    assert narrow == pytest.approx(1e-6 / 107.0, rel=0.05)
    assert room_irradiance(1000.0, 0.3, 700.0, 100.0) == pytest.approx(2 * room_irradiance(500.0, 0.3, 700.0, 100.0))
