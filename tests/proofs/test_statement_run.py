"""Statements and choices judged in worlds that they have not seen: errors of known distributions, nothing rendered."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr
from scipy.stats import norm

import tests.proofs.case_trials as case_trials
from characterisation.files.errors import InputError
from mitsim.study import session
from mitsim.study.virtual.race import ALL
from mitsim.study.virtual.trials import Outcome, TrialFolder
from mitsim.study.virtual.world import Trial
from tests.proofs.judged_statements import choices_of
from tests.proofs.kept_trials import take_up_trials, write_trials
from tests.proofs.known_trials import NAMES, KnownMaker, rows
from tests.proofs.part_cases import described, read_part_cases
from tests.proofs.statement_page import write_statement_page
from tests.proofs.statement_run import run_cases


def scores(study, *_):
    """The map has the order of the views the wrong way round."""
    u = np.tile(np.linspace(6, 1, len(study.views)), (len(NAMES), 1))
    by = ("measurement", "view")
    return xr.Dataset(
        {
            "predicted_uncertainty": (by, u),
            "chance": (by, np.ones(u.shape)),
            "V_m": (by, 1 / u),
            "tolerance": ("measurement", np.full(len(NAMES), np.nan)),
        },
        {"measurement": NAMES, "view": np.arange(len(study.views))},
    )


@pytest.fixture(autouse=True)
def _known_scores(monkeypatch):
    monkeypatch.setattr(session, "screen", lambda *given: (scores(*given), []))


def test_right_statements_cover_and_the_race_finds_the_view_that_the_map_thinks_worst(cases, tmp_path):
    chosen = read_part_cases(cases)
    found = run_cases(chosen, tmp_path / "run")
    page, table = write_statement_page(found, tmp_path / "run", described(cases, chosen))
    shares = [float(row["share"]) for row in rows(tmp_path / "run/coverage.csv")]
    assert len(shares) == 2 * len(NAMES) and np.mean(shares) == pytest.approx(0.95, abs=0.015)
    # errors are 1 + s z: less the bias, each edge has 2.5 %; as they are, U = 1 + 1.96 s, and one edge has almost none
    judged = rows(tmp_path / "run/coverage.csv")
    corrected, plain = (
        np.mean([int(row[key]) / int(row["worlds"]) for row in judged])
        for key in ("false_accepts_corrected", "false_accepts")
    )
    spreads = 1 + np.array([int(row["view"]) for row in judged])
    one_sided = 0.025 + norm.cdf(-(2 + 1.96 * spreads) / spreads)
    assert corrected == pytest.approx(0.05, abs=0.015) and plain == pytest.approx(one_sided.mean(), abs=0.01)
    regrets = {row["by"]: [] for row in rows(tmp_path / "run/regret.csv")}
    for row in rows(tmp_path / "run/regret.csv"):
        regrets[row["by"]].append((int(row["view"]), float(row["unbiased"])))
    # the race chooses for all measurements together; its views of each alone rest on the same trials
    assert found[0].raced.leader(ALL) == 0
    assert [view for view, _ in regrets["race"]].count(0) >= 3
    assert {view for view, _ in regrets["predicted u"]} == {3}
    # risks: sqrt(1 + 1) of view 0, sqrt(1 + 16) of view 3
    assert np.mean([value for _, value in regrets["predicted u"]]) == pytest.approx(np.sqrt(17 / 2), rel=0.12)
    assert "ensenso-n10" in table and page.read_text().startswith("# How right the statements are")
    assert (tmp_path / "run/coverage.png").stat().st_size > 1000


def test_statements_that_are_too_narrow_are_found_out(cases, tmp_path, monkeypatch):
    monkeypatch.setattr(session, "measurements_of", lambda *given: KnownMaker(*given, wider=2.0))
    found = run_cases(read_part_cases(cases), tmp_path / "run")
    _, table = write_statement_page(found, tmp_path / "run", "")
    shares = [float(row["share"]) for row in rows(tmp_path / "run/coverage.csv")]
    assert max(shares) < 0.85
    assert "0 of 8" in table


def test_kept_trials_are_not_made_again_and_judge_alike(cases, tmp_path):
    first = run_cases(read_part_cases(cases), tmp_path / "run")
    made = KnownMaker.made
    (tmp_path / "measured").mkdir()
    name = f"{first[0].case.name}.nc"
    (tmp_path / "run" / name).rename(tmp_path / "measured" / name)
    again = run_cases(read_part_cases(cases), tmp_path / "other")
    assert KnownMaker.made == made > 1000
    assert np.array_equal(again[0].choice, first[0].choice.astype(np.float32).astype(float))
    assert [one.view for one in again[0].stated] == [one.view for one in first[0].stated]


def test_only_picks_cases_and_says_which_there_are(cases):
    assert len(read_part_cases(cases, ["n10"])) == 1
    with pytest.raises(InputError, match=r"balls_on_plate__ensenso-n10__Ra0\.46"):
        read_part_cases(cases, ["zivid"])


def test_a_file_of_other_trials_is_not_taken_up(tmp_path):
    mine = TrialFolder(tmp_path / "mine", "a" * 16, ["one"])
    mine.add(3, Trial(5, 1), Outcome({"one": 0.25}))
    mine.add(3, Trial(1 << 20), Outcome({"one": float("nan")}))
    write_trials(tmp_path / "case.nc", {"tool": mine}, [3])
    same, other = (TrialFolder(tmp_path / digest, digest * 16, ["one"]) for digest in ("a", "b"))
    assert take_up_trials(tmp_path / "case.nc", {"tool": same, "apart": other}) == {"tool": 2, "apart": 0}
    assert take_up_trials(tmp_path / "case.nc", {"tool": other}) == {"tool": 0}
    assert same.known(3)[Trial(5, 1)].errors == {"one": 0.25}
    assert np.isnan(same.known(3)[Trial(1 << 20)].errors["one"])


def test_deviations_are_kept_with_their_trials(tmp_path):
    names, sizes = ["size", "place", "flat"], {"place": 2, "flat": 3}
    folded = {name: SimpleNamespace(shape=(size,)) for name, size in sizes.items()}
    mine = TrialFolder(tmp_path / "mine", "a" * 16, names, folded)
    deviations = {"place": [0.25, -1.5], "flat": [0.5, np.nan, 2.0]}
    mine.add(3, Trial(0), Outcome(dict.fromkeys(names, 0.25), {}, deviations))
    mine.add(3, Trial(1), Outcome({"size": 0.25, "place": np.nan, "flat": 0.5}, {}, {"flat": [1.0, 2.0, 3.0]}))
    write_trials(tmp_path / "case.nc", {"tool": mine}, [3])
    same = TrialFolder(tmp_path / "same", "a" * 16, names, folded)
    assert take_up_trials(tmp_path / "case.nc", {"tool": same}) == {"tool": 2}
    for name in folded:
        kept, first = (one.deviations(3, [Trial(0), Trial(1)], name) for one in (same, mine))
        np.testing.assert_array_equal(kept, first)
    # trials that were kept without them are measured again
    bare = TrialFolder(tmp_path / "bare", "a" * 16, names)
    bare.add(3, Trial(0), Outcome(dict.fromkeys(names, 0.25)))
    write_trials(tmp_path / "bare.nc", {"tool": bare}, [3])
    assert take_up_trials(tmp_path / "bare.nc", {"tool": TrialFolder(tmp_path, "a" * 16, names, folded)})["tool"] == 0


@pytest.mark.parametrize("content", [b"", b"no netCDF", b"CDF\x01" + bytes(200)])
def test_a_file_that_is_none_is_refused(tmp_path, content):
    (tmp_path / "case.nc").write_bytes(content)
    with pytest.raises(InputError, match="proofs statements"):
        take_up_trials(tmp_path / "case.nc", {"tool": TrialFolder(tmp_path, "a", ["one"])})


def test_the_truth_may_have_light_that_the_tool_leaves_out(cases, tmp_path):
    cases.write_text(cases.read_text() + "surfaces = 5\n")
    (case,) = read_part_cases(cases)
    found = case_trials.trials_by_kind(case, case.open(), tmp_path / "run")
    depth = {kind: bench.study.file.measure.light_path_depth for kind, bench in found.items()}
    assert depth == {"tool": 4, "truth": 5, "apart": 5, "choice": 5}
    assert found["truth"].trials.digest != found["tool"].trials.digest


def test_a_measurement_that_hardly_any_world_makes_is_in_no_mean_of_regrets(cases, tmp_path, monkeypatch):
    class Rarely(KnownMaker):
        """The first measurement has a value on one day in four."""

        def run(self, jobs):
            for job, outcome in super().run(jobs):
                lost = {} if job.trial.day % 4 == 0 else {NAMES[0]: np.nan}
                yield job, Outcome(dict(outcome.errors) | lost)

    monkeypatch.setattr(session, "measurements_of", Rarely)
    chosen = read_part_cases(cases)
    found = run_cases(chosen, tmp_path / "run")
    page, _ = write_statement_page(found, tmp_path / "run", described(cases, chosen))
    judged = {one.measurement: one.judged for one in choices_of(found[0])}
    assert judged == {NAMES[0]: False} | dict.fromkeys(NAMES[1:], True)
    assert page.read_text().count(f"{NAMES[0]} (not judged)") == 1


def test_the_trials_that_come_with_the_cases_are_as_they_were_written():
    files = sorted((Path(__file__).parents[2] / "scenes" / "parts" / "measured").glob("*.nc"))
    assert len(files) >= 29
    for path in files:
        assert take_up_trials(path, {}) == {}  # refuses a file that was changed since
