"""One session of a study for all commands: what it prepares, and when."""

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from characterisation.files.errors import InputError
from characterisation.maps.performance_map import PerformanceMap
from characterisation.maps.shipped import shipped_maps
from mitsim.cli.options import keep_finished
from mitsim.maps.prediction.interreflections import TOGETHER, InterreflectionEffect, InterreflectionImage
from mitsim.running.time_limit import TimeLimit
from mitsim.study import RaceTable, StatementTable, StudyFile, open_study, session
from mitsim.study.remedies.change import reopened
from mitsim.study.run import run_study, run_within
from mitsim.study.run_folder import read_run
from mitsim.study.session import Session
from mitsim.study.statement_document import statement_document
from mitsim.study.time_plan import TimePlan
from mitsim.study.virtual import stated as state
from mitsim.study.virtual.screening import effects_of
from mitsim.study.virtual.stated import BATCH, MOST, TrialsOfView, batches
from mitsim.study.virtual.trials import Outcome
from mitsim.views.scoring_time import FEWEST_VIEWS, not_scored_in_words
from tests.smaller_sensors import coarse_sensor

SCENES = Path(__file__).parents[2] / "scenes" / "two_pillars"


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    table = {
        "scene": "matt_white.xml",
        "task": "task.toml",
        "sensor": str(coarse_sensor("ensenso-n10", 2, tmp_path_factory.mktemp("sensor"))),
        "measure": {"by": "map"},
        "score": {"light_path_depth": 1},
        "views": {"subdivisions": 0, "rolls_deg": [0], "lowest_elevation_deg": 20},
    }
    return open_study(SCENES / "study.toml", StudyFile.model_validate(table))


def test_to_screen_needs_neither_a_folder_nor_the_measurements(study, monkeypatch):
    monkeypatch.setattr(session, "measurements_of", lambda *_: pytest.fail("measurements were prepared"))
    scores, inputs = Session(study).screen()
    assert scores.sizes["view"] == len(inputs) == len(study.views)


def test_screening_says_how_many_views_it_has_time_for_once_some_have_told_the_time(study, capsys):
    """The plan said 6 s of the screening of a part of 100 faces, which took 93 s; nothing said so before."""
    views = study.file.views.model_copy(update={"subdivisions": 1, "rolls_deg": [0.0, 90.0]})
    many = open_study(SCENES / "study.toml", study.file.model_copy(update={"views": views}))
    Session(many).screen(limit=TimeLimit(1.0, time.monotonic() - 2.0))
    assert f"about {FEWEST_VIEWS} of {len(many.views)} views are screened" in capsys.readouterr().err
    Session(study).screen(limit=TimeLimit(1e6))
    assert "are screened" not in capsys.readouterr().err


def test_screening_within_a_limit_scores_views_that_lie_far_apart_and_says_how_many(study):
    views = study.file.views.model_copy(update={"subdivisions": 1, "rolls_deg": [0.0, 90.0]})
    many = open_study(SCENES / "study.toml", study.file.model_copy(update={"views": views}))
    whole, _ = Session(many).screen()
    some, inputs = Session(many).screen(limit=TimeLimit(1.0, time.monotonic() - 2.0))
    assert some.attrs["views_scored"] == FEWEST_VIEWS < some.sizes["view"] == len(inputs) == len(many.views)
    assert not_scored_in_words(some) == f"only {FEWEST_VIEWS} of {len(many.views)} views screened, for lack of time"
    assert not_scored_in_words(whole) == ""
    u = some["predicted_uncertainty"].transpose("view", "measurement").values
    scored = np.isfinite(u).any(axis=1)
    assert 0 < scored.sum() <= FEWEST_VIEWS
    np.testing.assert_array_equal(u[scored], whole["predicted_uncertainty"].transpose("view", "measurement")[scored])
    assert not some["uncertainty_possible"].transpose("view", "measurement").values[~scored].any()
    azimuths = np.sort([view.azimuth_deg % 360 for view, known in zip(many.views, scored, strict=True) if known])
    gaps = np.diff([*azimuths, azimuths[0] + 360])
    assert gaps.max() < 120  # from all sides of the part
    assert {view.roll_deg for view, known in zip(many.views, scored, strict=True) if known} == {0.0, 90.0}


def test_measurements_that_were_released_are_made_again_the_same_and_unknowns_stay(study, tmp_path):
    here, table = Session(study, tmp_path / "a"), StatementTable(trials=2)
    view, unknowns, first = study.views[0], here.unknowns, here.measurements
    here.release()
    stated = here.state(view, table)
    assert here.unknowns is unknowns and here.measurements is not first
    other = Session(study, tmp_path / "b").state(view, table)
    np.testing.assert_equal(statement_document(here, stated), statement_document(here, other))
    assert (tmp_path / "a/trials/view_0000.jsonl").read_bytes() == (tmp_path / "b/trials/view_0000.jsonl").read_bytes()


def test_a_session_that_shares_nothing_has_trials_of_its_own(study, tmp_path):
    together, apart = Session(study, tmp_path), Session(study, tmp_path, separate_light=True)
    assert together.digest != apart.digest


def test_a_view_that_the_study_lacks_is_one_message(study):
    assert study.view(2) is study.views[2]
    with pytest.raises(InputError, match=f"--view.*99.*0 to {len(study.views) - 1}"):
        study.view(99, "--view")


@pytest.mark.parametrize("limited", [False, True])
def test_interreflections_of_a_view_are_rendered_once(study, limited, monkeypatch):
    """The views of a render follow one another as they are scored, in any order."""
    rendered = []
    limit = TimeLimit(600.0) if limited else None  # it begins when it is made

    def images(_, scene, poses):
        rendered.extend(pose.matrix().tobytes() for pose in poses)
        whole = effect.rays.whole
        values = np.zeros((5, whole.height, whole.width))
        values[4] = 1  # times the noise
        image = InterreflectionImage(effect.coarse, whole, values)
        return [image] * len(poses)

    monkeypatch.setattr(InterreflectionEffect, "render_views", images)
    views = study.file.views.model_copy(update={"subdivisions": 1, "rolls_deg": [0.0, 90.0]})
    score = study.file.score.model_copy(update={"light_path_depth": 2})
    many = open_study(SCENES / "study.toml", study.file.model_copy(update={"views": views, "score": score}))
    here = Session(many)
    effect = next(one for one in effects_of(many, here.unknowns, limit) if isinstance(one, InterreflectionEffect))
    here.screen(limit=limit)
    assert len(rendered) == len(set(rendered)) == len(many.views) > TOGETHER


def test_a_statement_ends_when_time_is_over_and_continues_where_it_ended(study, tmp_path):
    here = Session(study, tmp_path)
    none = here.state(study.views[0], None, TimeLimit(0.0))
    assert none.statements[0].trials == 1 and not none.statements[0].budget  # the trial at hand
    seen = []
    table = StatementTable(trials=BATCH + 5)
    limited = Session(replace(study, file=study.file.model_copy(update={"statement": table})), tmp_path)
    whole = limited.state(study.views[0], None, None, seen.append)
    assert [one.statements[0].trials for one in seen] == [BATCH]
    assert whole.statements[0].trials == BATCH + 5
    assert (tmp_path / "trials/view_0000.jsonl").read_text().count('"day"') == BATCH + 5
    # out of time at its start, it still has all that was made
    assert limited.state(study.views[0], None, TimeLimit(0.0)).statements[0].trials == BATCH + 5


def test_a_settled_statement_needs_no_more_trials():
    table, limit = StatementTable(trials=500), TimeLimit(1.0)
    assert batches(table, True, TimeLimit())[-1] == batches(table, True, limit)[-1] == 500
    assert batches(table, False, limit) == [500]
    assert batches(StatementTable(), True, limit)[-1] > batches(StatementTable(), True, TimeLimit())[-1]


class NormalErrors:
    """Virtual measurements whose errors are normal, or have a long tail."""

    source = "render"

    def __init__(self, names, long_tail):
        self.names, self.long_tail = list(names), long_tail

    def run(self, jobs):
        for job in jobs:
            rng = np.random.default_rng([job.trial.day, job.trial.capture])
            tail = 12.0 if self.long_tail and rng.random() < 0.03 else 1.0
            yield job, Outcome({name: float(rng.normal(0.0, 1.9 * tail)) for name in self.names})


def stated_with(runner, study, folder, monkeypatch):
    monkeypatch.setattr(Session, "trials_of", lambda session, *_: TrialsOfView(runner, session.trials, None))
    monkeypatch.setattr(state, "_settled", lambda _: False)
    return Session(study, folder).state(study.views[4]).statements


@pytest.mark.parametrize("long_tail", [False, True])
def test_a_statement_goes_on_until_its_uncertainties_are_known(study, tmp_path, monkeypatch, long_tail):
    """Trials beyond the default are made where tails are long, and no more than the standard error needs."""
    monkeypatch.setattr(state, "least_trials", lambda *_: 2)
    stated = stated_with(NormalErrors(study.task.measurements, long_tail), study, tmp_path, monkeypatch)
    known_to = max(one.moved[1] / one.standard_uncertainty for one in stated)
    default = StatementTable()
    assert stated[0].trials > default.trials if long_tail else stated[0].trials == default.trials
    assert known_to <= default.known_to or stated[0].trials == MOST


@pytest.mark.parametrize("sprayed", [False, True])
def test_few_errors_of_bare_metal_are_not_believed_to_be_normal(study, tmp_path, monkeypatch, sprayed):
    """A relative standard error of a tenth takes 50 normal errors, and 700 of the kurtosis of errors of metal."""
    metal = {"scene": "two_pillars.xml", "sprayed": sprayed}
    bare = open_study(SCENES / "study.toml", study.file.model_copy(update=metal))
    runner = NormalErrors(study.task.measurements, long_tail=False)
    stated = stated_with(runner, bare, tmp_path, monkeypatch)
    assert stated[0].trials == (StatementTable().trials if sprayed else 720)
    assert state.least_trials(bare, 0.1) == (50 if sprayed else 700)


def test_a_run_within_a_limit_says_what_it_lacks_and_goes_on_without_one(study, tmp_path):
    """A run that is out of time at its start writes a whole folder, which the same command completes."""
    out_of_time = TimeLimit(1.0, time.monotonic() - 2.0)
    run_within(study, tmp_path, out_of_time)
    about = read_run(tmp_path).about
    assert not about.finished and about.raced_views and any("statement" in one for one in about.lacks)
    views = study.file.views.model_copy(update={"subdivisions": 1, "rolls_deg": [0.0, 90.0]})
    many = open_study(SCENES / "study.toml", study.file.model_copy(update={"views": views}))
    run_within(many, tmp_path / "many", TimeLimit(1.0, time.monotonic() - 2.0))
    lacks = f"only {FEWEST_VIEWS} of {len(many.views)} views screened, for lack of time"
    assert lacks in read_run(tmp_path / "many").about.lacks
    rules = {"race": RaceTable(shortlist=1, trials=4), "statement": StatementTable(trials=2)}
    keep_finished(tmp_path, False, "run.json")  # no error
    assert read_run(tmp_path).about == about  # still there, so that a run of another study moves it away with the rest
    whole = run_study(replace(study, file=study.file.model_copy(update=rules)), tmp_path / "other")
    about = read_run(tmp_path / "other").about
    assert whole[0].trials == 2 and about.finished and not about.lacks
    with pytest.raises(InputError, match="finished run"):
        keep_finished(tmp_path / "other", False, "run.json")


def test_a_run_that_kept_its_time_for_the_page_goes_on_with_the_same_command(study, tmp_path, monkeypatch):
    """It ends before its limit, without a statement. Before, it said "The same command goes on", and was refused."""
    monkeypatch.setattr(TimePlan, "closing", lambda *_: True)
    rules = {"race": RaceTable(shortlist=1, trials=4), "statement": StatementTable(trials=2)}
    limited = TimeLimit(3600.0)
    run_within(replace(study, file=study.file.model_copy(update=rules)), tmp_path, limited)
    assert not limited.over()
    about = read_run(tmp_path).about
    assert "no statement of uncertainty" in about.lacks and not about.finished
    keep_finished(tmp_path, False, "run.json")  # no error


def test_a_map_of_ones_own_is_still_there_when_workers_and_changes_open_the_study_again(tmp_path):
    sensor = coarse_sensor("ensenso-n10", 2, tmp_path)
    sensor.write_text(sensor.read_text().replace('"ensenso-n10"', '"mine"'))
    shipped = PerformanceMap.load(shipped_maps()["ensenso-n10"])
    shipped.data.attrs["sensor"] = "mine"
    shipped.save(tmp_path / "map.nc")
    table = {"scene": "matt_white.xml", "task": "task.toml", "sensor": str(sensor), "views": {"subdivisions": 0}}
    opened = open_study(SCENES / "study.toml", StudyFile.model_validate(table), performance_map=tmp_path / "map.nc")
    again = reopened(opened, {"measure": {"by": "render"}})
    assert again.performance_map.data.identical(opened.performance_map.data)
    assert open_study(opened.path, opened.file, mapped=False).performance_map.data.attrs["sensor"] == "mine"
