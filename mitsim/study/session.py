"""Prepare the virtual measurements of a study for all commands: unknowns, measurements, finished trials.

Signal chain: study -> unknowns (:mod:`mitsim.study.virtual.study_unknowns`) -> digest of all that determines a trial
(:func:`mitsim.study.virtual.plan.trial_digest`) -> renderer or map, here or on workers -> trials in a folder,
used again under the same digest -> scores of all views, race, exposures and statement of one view.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import xarray as xr

from characterisation.files.errors import InputError
from characterisation.maps.performance_map import PerformanceMap
from characterisation.statements.statement import Statements
from characterisation.tasks.measurement_model import InputQuantity
from characterisation.words.progress import say
from mitsim.capture.simulated.rendering import Rendering
from mitsim.decoding.cloud import sensor_geometry
from mitsim.maps.prediction import Predictor
from mitsim.running.executor import Executor
from mitsim.running.time_limit import TimeLimit
from mitsim.sensor.exposure import PlannedExposure
from mitsim.study import RaceTable, StatementTable, Study
from mitsim.study.exposures.exposure_plan import PlanRules
from mitsim.study.exposures.planned import kept_plan, rendered, stated_exposures, with_exposure
from mitsim.study.run_files import claim_folder
from mitsim.study.virtual.mapped import MappedMeasurements
from mitsim.study.virtual.plan import (
    measured_by,
    measurements_of,
    race_rendering,
    study_digest,
    trial_digest,
)
from mitsim.study.virtual.race import Raced, run_race
from mitsim.study.virtual.rendered import RenderedMeasurements
from mitsim.study.virtual.screening import screen
from mitsim.study.virtual.spread_out import SpreadMeasurements
from mitsim.study.virtual.stated import StatedView, TrialsOfView, state_view
from mitsim.study.virtual.study_unknowns import study_unknowns
from mitsim.study.virtual.trials import TrialFolder
from mitsim.study.virtual.world import Unknowns
from mitsim.views import View

#: largest share of the time of a statement for the plan of its exposures; chosen
_PLAN_SHARE = 0.5


class Session:
    """A study that is being measured virtually. Everything is prepared on first use.

    Parameters
    ----------
    study
        Part, task, sensor, map and views.
    folder
        Where trials and plans are kept; None for a session that only screens or plans.
    workers
        Processes or cluster that make the trials; by default this process makes them.
    separate_light
        Whether trials share nothing: each renders all of its light at its own pose, with its own finish.
    rendering
        How statements are rendered; by default as :func:`mitsim.study.virtual.plan.rendering_of`.
    """

    def __init__(
        self,
        study: Study,
        folder: str | Path | None = None,
        workers: Executor | None = None,
        separate_light: bool = False,
        rendering: Rendering | None = None,
    ) -> None:
        self.study, self.workers, self.separate_light, self.rendering = study, workers, separate_light, rendering
        self._folder = None if folder is None else Path(folder)
        self._exposures: dict[int, PlannedExposure] = {}

    @property
    def folder(self) -> Path:
        """Return the folder of trials and plans."""
        assert self._folder is not None, "a session without a folder keeps nothing"
        return self._folder

    @property
    def source(self) -> str:
        """Return how trials are made: ``render`` or ``map``."""
        return measured_by(self.study)

    @cached_property
    def unknowns(self) -> Unknowns:
        """Return the unknowns of the study, prepared for drawing: a calibration may take seconds to simulate."""
        return study_unknowns(self.study)

    @cached_property
    def digest(self) -> str:
        """Return the digest of everything that determines a trial."""
        return trial_digest(self.study, self.unknowns, self.source, self.separate_light, self.rendering)

    @cached_property
    def measurements(self) -> RenderedMeasurements | MappedMeasurements:
        """Return the virtual measurements of this process: a sensor prepared on the device, or its map."""
        return measurements_of(self.study, self.unknowns, self.separate_light, self.rendering)

    @property
    def renderer(self) -> RenderedMeasurements | None:
        """Return the measurements if they are rendered, None if they are drawn from a map."""
        return self.measurements if isinstance(self.measurements, RenderedMeasurements) else None

    @cached_property
    def runner(self) -> RenderedMeasurements | MappedMeasurements | SpreadMeasurements:
        """Return the maker of the trials, workers or this process, which is quicker for clouds of a map."""
        if self.workers is None or self.renderer is None:
            return self.measurements
        return SpreadMeasurements(self.workers, self.renderer, self.digest, self._folder)

    @cached_property
    def trials(self) -> TrialFolder:
        """Return the finished trials with the sensor's own exposure."""
        return TrialFolder.of(self.folder / "trials", self.digest, self.study.task)

    @cached_property
    def race_trials(self) -> TrialFolder:
        """Return the finished trials of the race, which have fewer light paths."""
        rendering = race_rendering(self.study)
        digest = trial_digest(self.study, self.unknowns, self.source, self.separate_light, rendering)
        return TrialFolder.of(self.folder / "race_trials", digest, self.study.task)

    @property
    def race_runner(self) -> RenderedMeasurements | MappedMeasurements | SpreadMeasurements:
        """Return the maker of the trials of the race."""
        runner = self.runner
        return runner if isinstance(runner, MappedMeasurements) else runner.rendered_as(race_rendering(self.study))

    @cached_property
    def predictor(self) -> Predictor:
        """Return the predictor of the sensor: that of the measurements, if they are prepared."""
        if "measurements" in vars(self):
            return self.measurements.predictor
        return Predictor.of_sensor(self.study.sensor, sensor_geometry(self.study.sensor))

    def claim(self, command: str) -> None:
        """Reserve the folder for the results of a command, and say where results of another study were moved to."""
        moved = claim_folder(self.folder, command, study_digest(self.study, self.digest))
        if moved is not None:
            say(
                f"{self.folder} contained results of another study, seed, version, map or command; "
                f"they were moved to {moved}"
            )

    def screen(
        self, performance_map: PerformanceMap | None = None, limit: TimeLimit | None = None
    ) -> tuple[xr.Dataset, list[dict[InputQuantity, Any]]]:
        """Score all views with a map, by default that of the study, or those that a limit of time allows.

        The function is :func:`mitsim.study.virtual.screening.screen`.
        """
        performance_map = self.study.performance_map if performance_map is None else performance_map
        assert performance_map is not None
        return screen(self.study, self.predictor, performance_map, self.unknowns, limit)

    def race(
        self,
        scores: xr.Dataset,
        rules: RaceTable | None = None,
        limit: TimeLimit | None = None,
        after_round: Callable[[Raced], None] = lambda _: None,
    ) -> Raced:
        """Race the views.

        ``scores``: of all views. ``rules``: by default those of the study. ``limit``: time of the race; by default its
        rules alone end it. ``after_round``: receives the state before the first trial, and after every round but the
        last.
        """
        rules = self.study.file.race if rules is None else rules
        limit = TimeLimit() if limit is None else limit
        return run_race(self.study.views, scores, self.race_runner, self.race_trials, rules, limit.over, after_round)

    def exposures(self, view: View, limit: TimeLimit | None = None) -> PlannedExposure | None:
        """Return the exposures of a view: those of the study, or planned ones; None for the sensor's own rule.

        Raises InputError if the sensor cannot take or merge the exposures, or measurements are drawn from a map, which
        holds only for the exposure that it was made with.
        """
        table = self.study.file.exposure
        if table is None:
            return None
        renderer = rendered(self.measurements)
        if table.exposures_s is not None:
            return stated_exposures(self.study, table.exposures_s, table.power)
        if view.number not in self._exposures:  # all trials of a session have one plan, finished or not
            rules, folder = PlanRules(table.most, table.within), self.folder / "exposures"
            self._exposures[view.number] = kept_plan(renderer, view, rules, folder, self.digest, limit)
        return self._exposures[view.number]

    def trials_of(self, view: View, limit: TimeLimit | None = None) -> TrialsOfView:
        """Return the maker of a view's trials at its exposures, whose plan takes at most half of a ``limit``."""
        planned = self.exposures(view, None if limit is None else limit.part(_PLAN_SHARE))
        if planned is None:
            return TrialsOfView(self.runner, self.trials, None)
        runner = self.runner
        assert not isinstance(runner, MappedMeasurements)  # exposures() rejects a map
        folder = TrialFolder.of(self.folder / "planned_trials", with_exposure(self.digest, planned), self.study.task)
        return TrialsOfView(runner.exposed_as(planned), folder, planned)

    def state(
        self,
        view: View,
        table: StatementTable | None = None,
        limit: TimeLimit | None = None,
        after_batch: Callable[[StatedView], bool | None] | None = None,
    ) -> StatedView:
        """State every measurement from one view at its exposures.

        Parameters
        ----------
        view
            The view.
        table, limit, after_batch
            As of :func:`mitsim.study.virtual.stated.state_view`.
        """
        return state_view(self.study, self.unknowns, self.trials_of(view, limit), view, table, limit, after_batch)

    def release(self) -> None:
        """Free the memory of the measurements, which are prepared again when they are needed."""
        for name in ("measurements", "runner", "predictor"):
            vars(self).pop(name, None)


def score(study: Study) -> xr.Dataset:
    """Score all views of a study by the uncertainty that the map predicts for them; nothing is rendered.

    Parameters
    ----------
    study
        From :func:`mitsim.open_study`.

    Returns
    -------
    xarray.Dataset
        The coordinate ``view`` holds the numbers of the views.

        Over ``measurement`` and ``view``: ``predicted_uncertainty``, standard, in the ``unit`` (mm or deg) of the
        measurement, infinite or NaN if a view cannot measure; ``chance`` that it can, 0 to 1; ``uncertainty_rank`` by
        u / sqrt(chance), 1 for the best, chances under 1/2 last; ``V_m``, the score of Kinnell and Justham (2018), and
        ``rank`` by it.

        Over ``view``: ``overall_rank``, by the mean of log(u / sqrt(chance)) over the measurements; ``azimuth_deg``
        about the z axis of the world, from x; ``elevation_deg`` above the plane z = 0, 90 from above; ``roll_deg``
        about the line of sight, clockwise as the sensor sees; ``standoff_mm``; and ``world_from_sensor`` (view, 4, 4).

        Select variables of equal dimensions before ``to_dataframe()`` makes a pandas table of them. Other variables of
        the dataset are not part of the interface.

    Raises
    ------
    InputError
        If the study has a campaign instead of a map.

    Examples
    --------
    >>> import mitsim as ms
    >>> scores = ms.score(ms.open_study("study.toml"))
    >>> table = scores[["predicted_uncertainty", "uncertainty_rank"]].to_dataframe()
    >>> list(table.index.names)
    ['measurement', 'view']
    >>> one = scores.sel(measurement="pillar1_radius")
    >>> best = int(one["view"][one["uncertainty_rank"].argmin("view")])
    >>> best in scores["view"].values, int(one["uncertainty_rank"].sel(view=best))
    (True, 1)
    """
    if study.performance_map is None:
        campaign, hint = "a campaign that was not run", "open the study with performance_map=''"
        raise InputError(study.path, "characterisation.campaign", campaign, "a performance map", hint)
    return Session(study).screen()[0]


def statement(study: Study, view: int, *, trials: int | None = None, folder: str | Path | None = None) -> Statements:
    """State the uncertainty of every measurement from one view, by virtual measurements of it.

    Each trial draws calibration, finish, room light, temperature, pose and noise anew, renders, decodes and measures
    (JCGM 101:2008).

    Parameters
    ----------
    study
        From :func:`mitsim.open_study`.
    view
        Number of the view.
    trials
        Number of virtual measurements, at least 2; by default that of the study (200). A trial takes 0.2 to 1 s. With
        fewer than 39, the 95 % interval assumes normal errors. Rare large errors then make u, interval and budget
        wrong by a factor of two or more: see ``settled``. With fewer than 30 there is no budget.
    folder
        Where finished trials are kept for reuse by the next call; by default they are not kept.

    Returns
    -------
    list of Statement
        One for each measurement, in a list whose ``plot()`` draws them: ``bias``, ``standard_uncertainty`` and the 95 %
        ``interval`` of the error, in ``unit`` (mm or deg); ``settled``, whether one significant digit of u is certain;
        ``budget`` by group of unknowns, each a :class:`BudgetLine`; ``verdict``, ``no tolerance`` if the task has none.

    Raises
    ------
    InputError
        If there is no such view, or a number is out of its range.

    See Also
    --------
    score : all views, by prediction

    Examples
    --------
    >>> import mitsim as ms
    >>> study = ms.open_study("study.toml")
    >>> stated = {one.measurement: one for one in ms.statement(study, 4, trials=4)}
    >>> stated["pillar1_radius"].trials, stated["pillar1_radius"].unit
    (4, 'mm')
    """
    count = study.file.statement.trials if trials is None else trials
    if not 2 <= count <= 1_000_000:
        raise InputError("statement", "trials", count, "2 to 1000000")
    chosen = study.view(view, "statement: view")
    with nullcontext(folder) if folder is not None else TemporaryDirectory() as kept:
        session = Session(study, kept)
        return Statements(session.state(chosen, StatementTable(trials=count)).statements)
