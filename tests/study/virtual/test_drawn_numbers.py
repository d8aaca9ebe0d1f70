"""What trials drew, as numbers: against the draws themselves."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from characterisation.statements.budget import INTERACTION
from mitsim.sensor.preset import load_sensor
from mitsim.sensor.preset_covariance import preset_covariance
from mitsim.sensor.rig_parameters import parameter_values
from mitsim.sensor.unknowns import UnknownsTable
from mitsim.study.dependence_words import _PHRASES
from mitsim.study.virtual.drawn_finish import finish_deviation, finish_numbers
from mitsim.study.virtual.drawn_numbers import drawn_numbers, named_numbers, related, seeds, statement_trials
from mitsim.study.virtual.world import STATEMENT_DAYS, Trial, Unknowns

GROUPS = ("calibration", "finish", "form", "light", "temperature", "unit", "pose", "noise")

#: a part in one finish, whose second shape has none
STUDY = SimpleNamespace(
    scene=SimpleNamespace(
        shapes=[
            SimpleNamespace(bsdf=lambda name=name: SimpleNamespace(id=lambda: name)) for name in ("plate", "table")
        ],
        finishes=("aluminium/ground", None),
    )
)


@pytest.fixture(scope="module")
def unknowns():
    sensor = load_sensor("ensenso-n10")
    table = UnknownsTable.model_validate({"light": {"exposure_relative": 0.2}, "finish": {"reflectance": 0.0}})
    covariance = preset_covariance(sensor, table.calibration.drift())
    return Unknowns(table, sensor.rig, covariance, 850.0, 23e-6, np.array([1.0, 2.0, 3.0]), 7)


def numbers_of(unknowns, trials):
    return drawn_numbers(STUDY, unknowns, "render", trials, GROUPS)


def test_a_statement_repeats_every_fifth_trial_and_fewer_trials_are_the_first_of_more():
    trials = statement_trials(200)
    assert len(set(trials)) == 200 and {trial.capture for trial in trials} == {0, 1}
    assert sum(trial.capture for trial in trials) == 40
    assert all(Trial(trial.day) in trials for trial in trials)
    for count in (2, 7, 41):
        assert statement_trials(count) == trials[:count]


def test_the_numbers_are_those_behind_the_draws(unknowns):
    trials, table = [*statement_trials(6), Trial(7)], unknowns.table
    found = numbers_of(unknowns, trials)
    assert set(found) == {"calibration", "finish", "light", "temperature", "pose"}
    for i, trial in enumerate(trials):
        world = unknowns.draw(trial)
        light = found["light"][i]
        assert world.power == pytest.approx(1 + table.light.power_relative * light[1])
        assert world.exposure == pytest.approx(1 + table.light.exposure_relative * light[2] / np.sqrt(3))
        dark = replace(unknowns, varied=())
        assert world.room == pytest.approx(dark.draw(trial).room * table.light.room_factor ** light[0])
        assert light[3:] == pytest.approx((light[:3] ** 2 - 1) / np.sqrt(2))
        assert world.expansion == pytest.approx(23e-6 * table.temperature.part_kelvin * found["temperature"][i, 1])
        pose = found["pose"][i]
        turn = Rotation.from_matrix(world.placed.rotation).as_rotvec(degrees=True)
        assert turn == pytest.approx(table.pose.placement_deg * pose[:3])
        error = world.assumed @ world.placed.inverse()
        shift = error.points(unknowns.centre) - unknowns.centre
        assert shift == pytest.approx(table.pose.told_mm * pose[9:])
        own = finish_deviation(unknowns, world.finish, "plate")
        assert found["finish"][i, :2] == pytest.approx([own.alpha, own.wide_angle])
        assert found["finish"][i, 2] == own.tail
        double = 2 * np.radians(own.lay_deg)
        assert found["finish"][i, 4:6] == pytest.approx(np.sqrt(2) * np.array([np.cos(double), np.sin(double)]))
        assert found["finish"].shape[1] == 12  # the reflectance is known; one finish, and squares


def test_the_errors_of_the_rig_are_linear_in_the_numbers_of_the_calibration(unknowns):
    only = replace(unknowns, varied=("calibration",))
    trials = [Trial(STATEMENT_DAYS + 4 * day) for day in range(150)]
    names = unknowns.calibration.names
    nominal = np.array(parameter_values(unknowns.rig, names))
    numbers = numbers_of(only, trials)["calibration"]
    moved = np.array([parameter_values(only.draw(trial).rig, names) for trial in trials]) - nominal
    moved = moved / np.maximum(unknowns.calibration.one_sigma, 1e-300)
    solution, *_ = np.linalg.lstsq(numbers, moved, rcond=None)
    assert np.abs(moved - numbers @ solution).max() < 1e-3 * np.abs(moved).max()
    assert len(trials) > 2 * numbers.shape[1]


def test_captures_of_a_day_differ_in_the_numbers_of_the_pose_alone(unknowns):
    found = numbers_of(unknowns, [Trial(STATEMENT_DAYS), Trial(STATEMENT_DAYS, 1)])
    for group, (one, other) in found.items():
        assert np.array_equal(one, other) == (group != "pose"), group


def test_seeds_are_equal_where_the_draws_are(unknowns):
    trials = statement_trials(30)
    found = seeds(trials, GROUPS)
    assert list(found) == ["form", "unit", INTERACTION]
    worlds = [unknowns.draw(trial) for trial in trials]
    for group in ("form", "unit"):
        values = np.array([getattr(world, group) for world in worlds])
        same = found[group][:, None] == found[group]
        assert np.array_equal(values[:, None] == values, same) and same.sum() > len(trials)
    together = related(trials)[:, None] == related(trials)
    assert all(together[one[:, None] == one].all() for one in found.values())


def test_the_numbers_of_a_finish_are_in_standard_deviations(unknowns):
    half = replace(unknowns, table=UnknownsTable.model_validate({"finish": {"alpha": 0.5}}))
    whole = replace(unknowns, table=UnknownsTable())
    for number in (2, 12345):
        assert finish_numbers(half, number, "plate") == pytest.approx(finish_numbers(whole, number, "plate"))


@pytest.mark.parametrize("group", ["light", "temperature", "pose"])
def test_a_group_has_as_many_numbers_as_its_draw_takes(unknowns, monkeypatch, group):
    """A number that the draw of a group takes and this module does not would be missing from the budget."""
    streams, plain = [], Unknowns.stream

    def kept(self, name, trial):
        stream = plain(self, name, trial)
        if name == group:
            streams.append(stream)
        return stream

    monkeypatch.setattr(Unknowns, "stream", kept)
    unknowns.draw(Trial(3))
    drawn_numbers(STUDY, unknowns, "render", [Trial(3)], [group])
    draw, numbers = (stream.bit_generator.state for stream in streams)
    assert draw == numbers


@pytest.mark.parametrize("sensor", ["ensenso-n10", "david-sls-3"])
def test_the_numbers_with_names_are_those_of_a_day_and_have_words(unknowns, sensor):
    study = SimpleNamespace(scene=STUDY.scene, sensor=load_sensor(sensor))
    trials = statement_trials(5)
    assert trials[0].day == trials[4].day
    named = named_numbers(study, unknowns, trials, (*GROUPS, "decoder"))
    assert {(one.group, one.name) for one in named} <= set(_PHRASES)
    assert {(one.group, one.of) for one in named} == {("finish", "plate"), ("decoder", ""), ("light", "")}
    assert all(one.values.shape == (5,) and one.values[0] == one.values[4] for one in named)
    alpha = next(one.values for one in named if one.name == "alpha")
    assert alpha[1] == finish_numbers(unknowns, unknowns.draw(trials[1]).finish, "plate")["alpha"]
    assert named_numbers(study, unknowns, trials, ("calibration", "pose")) == []
