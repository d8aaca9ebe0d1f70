"""Open a study for virtual measurements, in one place for all commands: what is unknown, who measures, what is kept.

Signal chain: study -> unknowns (:mod:`mitsim.study.virtual.study_unknowns`) -> digest of all that determines a trial
(:func:`mitsim.study.virtual.plan.trial_digest`) -> renderer or map, here or on workers -> trials in a folder,
used again under the same digest -> scores of all views, race, exposures and statement of one view.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import xarray as xr

from characterisation.maps.performance_map import PerformanceMap
from characterisation.statements.statement import Statement
from characterisation.tasks.evaluation import InputQuantity
from mitsim.decode.cloud import sensor_geometry
from mitsim.maps.prediction import Predictor
from mitsim.running.executor import Executor
from mitsim.running.progress import say
from mitsim.sensor.exposure import PlannedExposure
from mitsim.study import StatementTable, Study
from mitsim.study.exposures.planned import planned_for, rendered, with_exposure
from mitsim.study.run_files import claim_folder
from mitsim.study.virtual.mapped import MappedMeasurements
from mitsim.study.virtual.plan import measured_by, measurements_of, race_rules, trial_digest
from mitsim.study.virtual.race import Raced, RaceRules, run_race
from mitsim.study.virtual.rendered import RenderedMeasurements
from mitsim.study.virtual.screening import screen
from mitsim.study.virtual.spread_out import SpreadMeasurements, spread_over
from mitsim.study.virtual.stated import state_view, statement_document
from mitsim.study.virtual.study_digest import study_digest
from mitsim.study.virtual.study_unknowns import study_unknowns
from mitsim.study.virtual.trials import TrialFolder
from mitsim.study.virtual.world import Unknowns
from mitsim.views import View


@dataclass(frozen=True)
class StatedView:
    """Statements of every measurement from one view, and the ``document`` of ``statement.json``.

    ``planned`` are the exposures that they hold for, None for the sensor's own rule.
    """

    statements: list[Statement]
    document: dict[str, Any]
    planned: PlannedExposure | None


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
    """

    def __init__(
        self,
        study: Study,
        folder: str | Path | None = None,
        workers: Executor | None = None,
        separate_light: bool = False,
    ) -> None:
        self.study, self.workers, self.separate_light = study, workers, separate_light
        self._folder = None if folder is None else Path(folder)

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
        return replace(study_unknowns(self.study), pooled=not self.separate_light)

    @cached_property
    def digest(self) -> str:
        """Return the digest of everything that determines a trial."""
        return trial_digest(self.study, self.unknowns, self.source, self.separate_light)

    @cached_property
    def measurements(self) -> RenderedMeasurements | MappedMeasurements:
        """Return the virtual measurements of this process: a sensor prepared on the device, or its map."""
        return measurements_of(self.study, self.unknowns, self.separate_light)

    @property
    def renderer(self) -> RenderedMeasurements | None:
        """Return the measurements if they are rendered, None if they are drawn from a map."""
        return self.measurements if isinstance(self.measurements, RenderedMeasurements) else None

    @cached_property
    def runner(self) -> RenderedMeasurements | MappedMeasurements | SpreadMeasurements:
        """Return the maker of the trials: the measurements of this process, or workers that make the same."""
        return spread_over(self.workers, self.measurements, self.digest)

    @cached_property
    def trials(self) -> TrialFolder:
        """Return the finished trials with the sensor's own exposure."""
        return TrialFolder.of(self.folder / "trials", self.digest, self.study.task)

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
        self, performance_map: PerformanceMap | None = None
    ) -> tuple[xr.Dataset, list[dict[InputQuantity, Any]]]:
        """Score all views with a map, by default that of the study: :func:`mitsim.study.virtual.screening.screen`."""
        performance_map = self.study.performance_map if performance_map is None else performance_map
        assert performance_map is not None
        return screen(self.study, self.predictor, performance_map, self.unknowns)

    def race(self, scores: xr.Dataset, rules: RaceRules | None = None) -> Raced:
        """Race the views with scores, by default by the rules of the study."""
        rules = race_rules(self.study.file.race) if rules is None else rules
        return run_race(self.study.views, scores, self.runner, self.trials, rules)

    def exposures(self, view: View) -> PlannedExposure | None:
        """Return the exposures of a view: those of the study, or planned ones; None for the sensor's own rule.

        Raises
        ------
        InputError
            If the sensor cannot take or merge the exposures, or measurements are drawn from a map, which holds only for
            the exposure that it was made with.
        """
        if self.study.file.exposure is None:
            return None
        return planned_for(rendered(self.measurements), view, self.digest, self.folder)

    def state(self, view: View, table: StatementTable | None = None) -> StatedView:
        """State every measurement from one view at its exposures; ``table`` replaces the study's numbers of trials."""
        study, runner, trials, planned = self.study, self.runner, self.trials, self.exposures(view)
        if planned is not None:
            assert not isinstance(runner, MappedMeasurements)  # exposures() rejects a map
            runner = runner.exposed_as(planned)
            trials = TrialFolder.of(self.folder / "planned_trials", with_exposure(self.digest, planned), study.task)
        stated = state_view(study, view, runner, trials, self.unknowns, table or study.file.statement)
        document = statement_document(study, view, stated, self.unknowns, self.source, planned)
        return StatedView(stated, document, planned)

    def release(self) -> None:
        """Free the memory of the measurements, which are prepared again when they are needed."""
        for name in ("measurements", "runner", "predictor"):
            vars(self).pop(name, None)
