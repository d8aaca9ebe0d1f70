"""Open studies, score the views of a part with a map, and state the uncertainty of one view by virtual measurements."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import xarray as xr

from characterisation.files.errors import InputError
from characterisation.statements.statement import Statement, Statements
from mitsim.decode.cloud import sensor_geometry
from mitsim.maps.prediction import Predictor
from mitsim.running.executor import Executor
from mitsim.study import StatementTable, Study, read_study
from mitsim.study.exposures.planned import exposed_for
from mitsim.study.run import claim
from mitsim.study.virtual.plan import measurements_of, trial_digest
from mitsim.study.virtual.screening import screen
from mitsim.study.virtual.spread_out import spread_over
from mitsim.study.virtual.stated import state_view, statement_document
from mitsim.study.virtual.study_digest import study_digest, with_scene_files
from mitsim.study.virtual.study_unknowns import study_unknowns
from mitsim.study.virtual.trials import TrialFolder
from mitsim.views import View


@dataclass(frozen=True)
class StatedView:
    """Statements of every measurement from one view, and the ``document`` of ``statement.json``."""

    statements: list[Statement]
    document: dict[str, Any]


def open_study(
    path: str | Path, *, performance_map: str | Path | None = None, ask: Callable[[str], bool] | None = None
) -> Study:
    """Open a study TOML file with everything it names: part, task, sensor, map and candidate views.

    Parameters
    ----------
    path
        The file; the reference of file formats lists its keys.
    performance_map
        A ``map.nc``, or a sensor whose map is shipped with mitsim, instead of the study's own. ``""`` selects the
        study's own map, or that of its sensor if the study names a campaign.
    ask
        Called with a question if the map lacks a finish of the part; if it returns True, the finish is characterised
        immediately.

    Returns
    -------
    Study
        ``views``, each with its ``number``, ``world_from_sensor`` and ``standoff`` [mm]; ``scene``, ``task``,
        ``sensor`` and ``performance_map``.

    Raises
    ------
    InputError
        For anything that would stop the study later.

    Examples
    --------
    >>> import mitsim as ms
    >>> study = ms.open_study("study.toml")
    >>> study.sensor.name, list(study.task.measurements)[:2]
    ('ensenso-n10', ['point1_point2_distance', 'plane_pillar1_angle'])
    >>> study.views[0].number
    0
    """
    return read_study(path, None if performance_map is None else str(performance_map), ask)


def score(study: Study) -> xr.Dataset:
    """Score all views of a study by the uncertainty that the map predicts for them; nothing is rendered.

    Parameters
    ----------
    study
        From :func:`open_study`.

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
        raise InputError(
            study.path,
            "characterisation.campaign",
            "a campaign that was not run",
            "a performance map",
            "open the study with performance_map=''",
        )
    predictor = Predictor.of_sensor(study.sensor, sensor_geometry(study.sensor))
    return screen(study, predictor, study.performance_map)[0]


def statement(
    study: Study, view: int, *, trials: int | None = None, pairs: int | None = None, folder: str | Path | None = None
) -> Statements:
    """State the uncertainty of every measurement from one view, by virtual measurements of it.

    Each trial draws calibration, finish, room light, temperature, pose and noise anew, renders, decodes and measures
    (JCGM 101:2008).

    Parameters
    ----------
    study
        From :func:`open_study`.
    view
        Number of the view.
    trials
        Number of virtual measurements, at least 2; by default that of the study (200). A trial takes 0.2 to 1 s. With
        fewer than 39, the 95 % interval assumes normal errors. Rare large errors then make u, interval and budget
        wrong by a factor of two or more: see ``settled``.
    pairs
        Trials of which each line of the budget needs another one; by default those of the study (16). The budget has
        eight lines at most, so the total is ``trials`` + 8 ``pairs``. 0: no budget.
    folder
        Where finished trials are kept for reuse by the next call; by default they are not kept.

    Returns
    -------
    list of Statement
        One for each measurement, in a list whose ``plot()`` draws them: ``bias``, ``standard_uncertainty`` and the 95 %
        ``interval`` of the error, in
        ``unit`` (mm or deg); ``settled``, whether one significant digit of u is certain; ``budget`` by group of
        unknowns, each a :class:`BudgetLine`; ``verdict``, ``no tolerance`` if the task has none.

    Raises
    ------
    InputError
        If there is no such view, or a number is out of its range.

    Examples
    --------
    >>> import mitsim as ms
    >>> study = ms.open_study("study.toml")
    >>> stated = {one.measurement: one for one in ms.statement(study, 4, trials=4, pairs=0)}
    >>> stated["pillar1_radius"].trials, stated["pillar1_radius"].unit
    (4, 'mm')
    """
    own = study.file.statement
    most = own.trials if trials is None else trials
    table = StatementTable(
        trials=_checked("trials", most, 2), pairs=_checked("pairs", own.pairs if pairs is None else pairs, 0)
    )
    chosen = study_view(study, view, "statement: view")
    if folder is not None:
        return Statements(stated_view(study, chosen, Path(folder), table=table).statements)
    with TemporaryDirectory() as place:
        return Statements(stated_view(study, chosen, Path(place), table=table).statements)


def stated_view(
    study: Study, view: View, folder: Path, workers: Executor | None = None, table: StatementTable | None = None
) -> StatedView:
    """State one view, with its trials kept in ``folder``, as ``mitsim budget`` does.

    ``workers`` run the trials; without them, this process does. ``table`` replaces the study's own numbers.
    """
    unknowns = study_unknowns(study)
    virtual_measurements = measurements_of(study, unknowns)
    digest = with_scene_files(trial_digest(study, unknowns, virtual_measurements.source), study)
    runner = spread_over(workers, study, unknowns, virtual_measurements)
    claim(folder, f"budget of view {view.number}", study_digest(study, digest))
    exposed = exposed_for(study, view, virtual_measurements, runner, digest, folder)
    trials = TrialFolder(folder / "trials", exposed.digest, list(study.task.measurements))
    stated = state_view(study, view, exposed.runner, trials, unknowns, table or study.file.statement)
    return StatedView(
        stated, statement_document(study, view, stated, unknowns, virtual_measurements.source, exposed.planned)
    )


def study_view(study: Study, number: int, where: str) -> View:
    """Return the candidate view with a number.

    Raises
    ------
    InputError
        If the study has no such view.
    """
    known = {one.number: one for one in study.views}
    if number not in known:
        raise InputError(where, "", number, f"{min(known)} to {max(known)}, the views of this study")
    return known[number]


def _checked(name: str, value: int, least: int) -> int:
    if not least <= value <= 1_000_000:
        raise InputError("statement", name, value, f"{least} to 1000000")
    return value
