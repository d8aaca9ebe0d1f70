"""Score the views of a part with a map, and state the uncertainty of one view by virtual measurements."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from tempfile import TemporaryDirectory

import xarray as xr

from characterisation.files.errors import InputError
from characterisation.statements.statement import Statements
from mitsim.study import StatementTable, Study
from mitsim.study.session import Session


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
        raise InputError(
            study.path,
            "characterisation.campaign",
            "a campaign that was not run",
            "a performance map",
            "open the study with performance_map=''",
        )
    return Session(study).screen()[0]


def statement(
    study: Study, view: int, *, trials: int | None = None, pairs: int | None = None, folder: str | Path | None = None
) -> Statements:
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
    chosen = study.view(view, "statement: view")
    with nullcontext(folder) if folder is not None else TemporaryDirectory() as place:
        session = Session(study, place)
        session.claim(f"budget of view {view}")
        return Statements(session.state(chosen, table).statements)


def _checked(name: str, value: int, least: int) -> int:
    if not least <= value <= 1_000_000:
        raise InputError("statement", name, value, f"{least} to 1000000")
    return value
