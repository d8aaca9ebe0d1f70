"""Trials that are kept, and races between views whose truth is known; nothing is rendered."""

import json
import math
import tomllib
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr

from characterisation.files.documents import validate
from characterisation.tasks.task_file import Task
from mitsim.maps.campaign.acquire import one_ahead
from mitsim.study import RaceTable
from mitsim.study.scoring import raced_errors, with_race
from mitsim.study.virtual.race import ALL, Job, complete, run_race
from mitsim.study.virtual.risks import shortlist
from mitsim.study.virtual.trials import Outcome, TrialFolder
from mitsim.study.virtual.world import Trial

NAMES = ["radius", "angle"]


@dataclass(frozen=True)
class View:
    number: int


class KnownMaker:
    """Views whose errors are normal with known spreads (measurement, view); worlds in common; may be stopped."""

    source = "render"

    def __init__(self, spreads, stop_after=None, failing=()):
        self.spreads, self.stop_after, self.failing, self.made = np.asarray(spreads), stop_after, failing, 0

    def run(self, jobs):
        for job in jobs:
            if self.stop_after is not None and self.made >= self.stop_after:
                raise KeyboardInterrupt
            self.made += 1
            common = np.random.default_rng([1, job.trial.day]).standard_normal(2)
            own = np.random.default_rng([2, job.trial.day, job.view.number]).standard_normal(2)
            values = self.spreads[:, job.view.number] * (0.5 * common + np.sqrt(0.75) * own)
            if job.view.number in self.failing and job.trial.day % 2:
                values[0] = np.nan
            yield job, Outcome(dict(zip(NAMES, values.tolist(), strict=True)))


def scores_of(u, chance=None, tolerance=(np.nan, np.nan)):
    u = np.asarray(u, float)
    by = ("measurement", "view")
    rank = np.argsort(np.argsort(u, axis=1, kind="stable"), axis=1) + 1
    return xr.Dataset(
        {
            "predicted_uncertainty": (by, u),
            "chance": (by, np.ones(u.shape) if chance is None else chance),
            "uncertainty_rank": (by, rank),
            "tolerance": ("measurement", list(tolerance)),
        },
        {"measurement": NAMES, "view": np.arange(u.shape[1])},
    )


RULES = RaceTable(shortlist=5, trials=200, margin=0.1, loss=0.02, each=True)


def race(maker, scores, folder, rules=RULES, over=lambda: False, after_round=lambda _: None):
    views = [View(number) for number in range(scores.sizes["view"])]
    return run_race(views, scores, maker, TrialFolder(folder, "digest", NAMES), rules, over, after_round)


SPREADS = [[3.0, 1.0, 2.0, 4.0, 2.5, 9.0], [0.2, 0.5, 0.1, 0.3, 0.4, 9.0]]


def test_the_race_finds_the_best_of_each_measurement_against_a_wrong_map(tmp_path):
    wrong = [[1.0, 2.0, 1.5, 1.2, 1.1, 20.0], [0.1, 0.1, 0.3, 0.1, 0.1, 20.0]]
    maker = KnownMaker(SPREADS)
    raced = race(maker, scores_of(wrong), tmp_path)
    assert raced.decided
    assert raced.leaders() == {ALL: 2, "radius": 1, "angle": 2}
    assert 5 not in raced.views  # the map sees that it is hopeless
    assert maker.made == raced.trials < 5 * 200
    # the budget goes where it decides: a view that is bad at everything gets no more than it must
    counts = (~np.isinf(raced.errors[0])).sum(axis=1)
    assert counts[list(raced.views).index(3)] <= counts[list(raced.views).index(2)]


def test_a_race_that_is_stopped_goes_on_and_ends_in_the_same(tmp_path):
    scores = scores_of(np.array(SPREADS) * 1.3)
    whole = race(KnownMaker(SPREADS), scores, tmp_path / "whole")
    for stop in (3, 5, 7):
        with pytest.raises(KeyboardInterrupt):
            race(KnownMaker(SPREADS, stop_after=stop), scores, tmp_path / "parts")
    again = KnownMaker(SPREADS)
    parts = race(again, scores, tmp_path / "parts")
    assert again.made == whole.trials - 15
    np.testing.assert_array_equal(parts.errors, whole.errors)
    for name, standing in whole.standings.items():
        np.testing.assert_array_equal(parts.standings[name].risk, standing.risk)
        assert parts.standings[name].confidence == standing.confidence


def test_time_that_is_over_ends_a_race_undecided(tmp_path):
    maker = KnownMaker(np.ones((2, 6)))
    raced = race(maker, scores_of(np.ones((2, 6))), tmp_path, over=lambda: maker.made >= 3)
    assert not raced.decided and raced.trials == 3


def test_time_that_is_over_has_gone_to_the_most_promising_views(tmp_path):
    maker = KnownMaker(np.ones((2, 6)))
    raced = race(maker, scores_of(np.array([[3, 1, 6, 2, 5, 4]] * 2)), tmp_path, over=lambda: maker.made >= 3)
    assert raced.views[np.isfinite(raced.errors[0]).any(axis=1)].tolist() == [1, 3, 0]


class OneAheadMaker(KnownMaker):
    """Takes the next capture while it measures one, as the renderer does."""

    def __init__(self, spreads):
        super().__init__(spreads)
        self.taken = 0

    def run(self, jobs):
        def take(job):
            self.taken += 1
            return job

        return one_ahead(jobs, take, lambda _, job: next(KnownMaker(self.spreads).run([job]))[1])


def test_no_capture_is_begun_when_time_is_over(tmp_path):
    """Of a part of 100 faces, a first capture of a view takes a minute: the next one was made, and thrown away."""
    maker = OneAheadMaker(np.ones((2, 6)))
    raced = race(maker, scores_of(np.ones((2, 6))), tmp_path / "race", over=lambda: maker.taken >= 1)
    assert raced.trials == maker.taken == 1
    folder, other = TrialFolder(tmp_path / "stated", "digest", NAMES), OneAheadMaker(np.ones((2, 6)))
    complete(folder, other, [Job(View(0), Trial(day)) for day in range(5)], "state", lambda: other.taken >= 1)
    assert len(folder.known(0)) == other.taken == 1


def test_the_first_round_tells_its_state_while_it_lasts(tmp_path, monkeypatch):
    monkeypatch.setattr("mitsim.study.virtual.race._SAY_EVERY_S", -1.0)
    scores, states = scores_of(np.array(SPREADS) * 1.3), []
    raced = race(KnownMaker(SPREADS), scores, tmp_path / "told", after_round=states.append)
    assert [one.trials for one in states[:6]] == [0, 1, 2, 3, 4, 5]
    np.testing.assert_array_equal(raced.errors, race(KnownMaker(SPREADS), scores, tmp_path / "quiet").errors)


def test_only_the_view_for_all_measurements_is_asked_for_by_default(tmp_path):
    """Views that are the best of one measurement alone get no trials for it."""
    spreads = [[1.0, 1.0, 3.0, 3.0, 3.0, 3.0], [1.0, 3.0, 3.0, 3.0, 3.0, 3.0]]  # two equals for the first
    trials = {}
    for each in (False, True):
        rules = RaceTable(shortlist=5, trials=60, margin=0.1, loss=0.05, each=each)
        raced = race(KnownMaker(spreads), scores_of(spreads), tmp_path / str(each), rules)
        assert raced.decided and raced.leader(ALL) == 0
        trials[each] = raced.trials
    assert trials[False] < 0.7 * trials[True]


def test_between_equals_the_race_ends_by_expected_loss(tmp_path):
    """No view of equals can be told to be the best, and no trial is worth that."""
    rules = RaceTable(shortlist=2, trials=2000, margin=0.02, loss=0.05)
    raced = race(KnownMaker(np.ones((2, 2))), scores_of(np.ones((2, 2))), tmp_path, rules)
    best = raced.standings[ALL]
    assert raced.decided and best.loss <= 0.05
    assert best.confidence < 0.9 and raced.trials < 2000


def test_a_view_that_often_gives_no_value_falls_behind(tmp_path):
    spreads = np.ones((2, 3))
    spreads[0, 0] = 0.97
    raced = race(KnownMaker(spreads, failing=[0]), scores_of(np.ones((2, 3))), tmp_path)
    risks = dict(zip(raced.views.tolist(), raced.standings["radius"].risk.tolist(), strict=True))
    assert risks[0] > 1.15 * min(risks[1], risks[2])


def test_nothing_to_race(tmp_path):
    scores = scores_of(np.full((2, 4), np.nan))
    raced = race(KnownMaker(np.ones((2, 4))), scores, tmp_path)
    assert raced.leaders() == {} and raced.trials == 0
    assert raced_errors(raced, TASK).sizes["view"] == 0


def test_the_shortlist_weighs_the_chance():
    chance = np.ones((2, 4))
    chance[:, 0] = 0.3
    u = [[1.0, 1.5, 9.0, 9.0], [1.0, 1.5, 9.0, 9.0]]
    assert shortlist(scores_of(u, chance), 1) == [1]
    assert shortlist(scores_of(u), 1) == [0]


@dataclass(frozen=True)
class Asked:
    nominal: float = 1.0


class TASK:
    measurements = {name: Asked() for name in NAMES}  # noqa: RUF012


def test_scores_follow_the_race(tmp_path):
    scores = scores_of(np.array(SPREADS)[:, ::-1])
    raced = race(KnownMaker(SPREADS), scores, tmp_path)
    table = with_race(scores, raced)
    best = int(table["view"].values[table["final_rank"].sel(measurement="radius").values.argmin()])
    assert best == raced.leader("radius")
    measured = set(raced.views.tolist())
    ranks = table["final_rank"].sel(measurement="radius")
    assert max(int(ranks.sel(view=v)) for v in measured) == len(measured)
    assert sorted(ranks.values.tolist()) == list(range(1, 7))
    errors = raced_errors(raced, TASK)
    assert int(errors["tried"].sum()) == 2 * raced.trials
    np.testing.assert_allclose(errors["value"] - errors["error"], np.where(np.isnan(errors["error"]), np.nan, 1.0))


# --- trials that are kept


def filled(folder, digest="d", count=6):
    trials = TrialFolder(folder, digest, NAMES)
    for day in range(count):
        trials.add(3, Trial(day), Outcome({"radius": day / 7, "angle": float("nan") if day == 2 else -0.1 * day}))
    return trials


def test_trials_come_back_to_the_last_bit(tmp_path):
    known = filled(tmp_path).known(3)
    again = TrialFolder(tmp_path, "d", NAMES).known(3)
    assert list(again) == list(known)
    for trial in known:
        np.testing.assert_array_equal(list(again[trial].errors.values()), list(known[trial].errors.values()))


@pytest.mark.parametrize("cut", [1, 20, 60])
def test_a_line_that_was_cut_off_is_dropped_and_written_again(tmp_path, cut):
    filled(tmp_path)
    path = tmp_path / "view_0003.jsonl"
    text = path.read_bytes()
    path.write_bytes(text[:-cut])
    trials = TrialFolder(tmp_path, "d", NAMES)
    assert list(trials.known(3)) == [Trial(day) for day in range(5)]
    trials.add(3, Trial(5), Outcome({"radius": 5 / 7, "angle": -0.5}))
    assert path.read_bytes() == text


def test_reasons_are_kept_with_their_trials_and_old_lines_have_none(tmp_path):
    trials = TrialFolder(tmp_path, "d", NAMES)
    trials.add(3, Trial(0), Outcome({"radius": 0.1, "angle": -0.1}))
    trials.add(3, Trial(1), Outcome({"radius": 0.1, "angle": np.nan}, {"angle": "plane: 3 points"}))
    again = TrialFolder(tmp_path, "d", NAMES)
    assert again.reasons(3, [Trial(0), Trial(1), Trial(2)], "angle") == ["plane: 3 points"]
    assert again.reasons(3, [Trial(0), Trial(1)], "radius") == []


FOLDED = {"angle": SimpleNamespace(shape=(3,))}


def test_deviations_are_kept_to_the_last_bit_with_their_gaps(tmp_path):
    trials = TrialFolder(tmp_path, "d", NAMES, FOLDED)
    behind = [0.1 + 1e-17, math.nan, -1 / 3]
    trials.add(3, Trial(0), Outcome({"radius": 0.1, "angle": 0.2}, {}, {"angle": behind}))
    trials.add(3, Trial(1), Outcome({"radius": 0.1, "angle": math.nan}, {"angle": "plane: 3 points"}))
    again = TrialFolder(tmp_path, "d", NAMES, FOLDED).deviations(3, [Trial(0), Trial(1)], "angle")
    np.testing.assert_array_equal(again, [behind, [math.nan] * 3])


@pytest.mark.parametrize(
    "kept", [{}, {"angle": [1.0, 2.0]}, {"angle": "abc"}, {"angle": 3.0}, {"angle": [1, 2, 1e999]}]
)
def test_a_kept_trial_without_its_deviations_is_measured_again(tmp_path, kept):
    trials = TrialFolder(tmp_path, "d", NAMES, FOLDED)
    trials.add(3, Trial(0), Outcome({"radius": 0.1, "angle": 0.2}, {}, {"angle": [1.0, 2.0, 3.0]}))
    path = tmp_path / "view_0003.jsonl"
    good = path.read_text()
    line = {"day": 1, "capture": 0, "errors": [0.1, 0.2], "deviations": kept}
    path.write_text(good + json.dumps(line) + "\n")
    assert list(TrialFolder(tmp_path, "d", NAMES, FOLDED).known(3)) == [Trial(0)]
    assert not trials.is_whole(Outcome({"radius": 0.1, "angle": 0.2}))
    assert trials.is_whole(Outcome({"radius": 0.1, "angle": math.nan}))


ZONES = """
[features]
ball = { kind = "sphere", point_mm = [0, 0, 0], radius_mm = 5 }
[measurements.place]
kind = "position"
features = ["ball"]
nominal = 0
unit = "mm"
tolerance = 20
[measurements.size]
kind = "radius"
features = ["ball"]
nominal = 5
unit = "mm"
tolerance = 20
"""


def test_captures_of_a_day_are_about_the_same_part(tmp_path):
    """On every day the part deviates in one direction: an equal error of another capture is read alike."""
    task = validate("task.toml", tomllib.loads(ZONES), Task)
    trials, rng = TrialFolder.of(tmp_path, "d", task), np.random.default_rng(1)
    assert trials.folded == {"place": 3}
    days = [Trial(day) for day in range(400)]
    for day in days:
        error = rng.standard_normal(3)
        outcome = Outcome({"place": 2 * float(np.linalg.norm(error)), "size": 0.5}, {}, {"place": error.tolist()})
        trials.add(3, day, outcome)
        trials.add(3, Trial(day.day, 1), outcome)
    place, size = trials.errors_of_parts(3, days)
    assert place.stated.mean() == pytest.approx(0.2, abs=4 * 2 / 20)  # 2 sigma^2 / r for r = 10
    assert place.stated.std() == pytest.approx(2, rel=0.15)
    np.testing.assert_array_equal(size, np.full(400, 0.5))
    again = [Trial(day.day, 1) for day in days]
    np.testing.assert_array_equal(trials.errors_of_parts(3, again)[0].stated, place.stated)


def test_trials_of_another_study_are_moved_aside_and_not_used(tmp_path):
    filled(tmp_path)
    other = TrialFolder(tmp_path, "another", NAMES)
    assert other.known(3) == {}
    other.add(3, Trial(0), Outcome({"radius": 1.0, "angle": 2.0}))
    assert len(list(tmp_path.glob("*.other"))) == 1
    assert list(TrialFolder(tmp_path, "another", NAMES).known(3)) == [Trial(0)]


@pytest.mark.parametrize(
    "line",
    [
        "[]",
        "null",
        '{"day": 1}',
        '{"day": "x", "capture": 0, "errors": [1, 2]}',
        '{"day": 1, "capture": -1, "errors": [1, 2]}',
        '{"day": 1, "capture": 0, "errors": [1]}',
        "\ufffd" * 40,
        "[" * 3000,
    ],
)
def test_a_line_that_is_no_trial_ends_what_is_trusted(tmp_path, line):
    filled(tmp_path, count=2)
    path = tmp_path / "view_0003.jsonl"
    good = path.read_text()
    path.write_text(good + line + "\n" + good.splitlines()[-1] + "\n")
    assert list(TrialFolder(tmp_path, "d", NAMES).known(3)) == [Trial(0), Trial(1)]
    assert path.read_text() == good


def test_a_full_disk_names_the_file(tmp_path, monkeypatch):
    trials = filled(tmp_path, count=1)
    monkeypatch.setattr(
        "mitsim.study.virtual.trials.os.fsync", lambda handle: (_ for _ in ()).throw(OSError(28, "full"))
    )
    with pytest.raises(OSError, match="full") as caught:
        trials.add(3, Trial(1), Outcome({"radius": 1.0, "angle": 2.0}))
    assert caught.value.filename.endswith("view_0003.jsonl")
    assert Trial(1) not in trials.known(3)


def test_the_head_says_what_the_lines_are(tmp_path):
    filled(tmp_path)
    head = json.loads((tmp_path / "view_0003.jsonl").read_text().splitlines()[0])
    assert head == {"schema_version": 1, "digest": "d", "measurements": NAMES}


def test_jobs_are_values():
    assert Job(View(1), Trial(2)) == Job(View(1), Trial(2))
