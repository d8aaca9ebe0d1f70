"""Keep the trials of a case in one small file.

Signal chain: trial folders of a run -> ``CASE.nc``: a row for each trial -> trial folders of a later run, which makes
only missing trials. Judging the same trials by another rule then takes seconds.

For each kind of trials, the file has a digest of everything that determines them. It is used only with the same digest.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from characterisation.files.arrays import Floats
from characterisation.files.datasets import Schema, Variable, read_dataset
from characterisation.files.errors import InputError
from characterisation.statements.one_sided import stated_errors
from mitsim.maps.campaign.run import write_netcdf
from mitsim.study.virtual.trials import Outcome, TrialFolder
from mitsim.study.virtual.world import Trial

_TRIAL = ("trial",)
_SCHEMA = Schema(
    "a file that `python -m tests.proofs statements` wrote",
    {
        "error": Variable(("trial", "measurement"), gaps=True),
        "deviation": Variable(("trial", "place"), gaps=True, needed=False),
        "measurement": Variable(("measurement",), "text"),
        "kind": Variable(_TRIAL, "whole", 0, 100),
        "view": Variable(_TRIAL, "whole", 0, 1e9),
        "day": Variable(_TRIAL, "whole", 0, 2**62),
        "capture": Variable(_TRIAL, "whole", 0, 2**15),
    },
    hint="remove `measured` from the cases file to measure everything again",
)


def errors_of(folder: TrialFolder, view: int, trials: Sequence[Trial]) -> Floats:
    """Return the errors (measurements, n) of finished trials that a statement is about, NaN without a value.

    Those of a value that folds are at the limit of its tolerance.
    """
    errors = folder.errors_of_parts(view, trials)
    return np.array([stated_errors(error) for error in errors], float).reshape(len(errors), len(trials))


def write_trials(path: Path, folders: Mapping[str, TrialFolder], views: list[int]) -> None:
    """Write all finished trials of some views, by kind, completely or not at all."""
    rows = [
        (kind, view, trial, [one.errors[name] for name in folder.measurements], _deviations(folder, one))
        for kind, folder in folders.items()
        for view in views
        for trial, one in sorted(folder.known(view).items(), key=lambda item: _place(item[0]))
    ]
    if not rows:
        return
    kinds = list(folders)
    names = next(iter(folders.values())).measurements
    errors = np.array([row[3] for row in rows], np.float32)
    columns = {
        "kind": np.array([kinds.index(row[0]) for row in rows], np.int8),
        "view": np.array([row[1] for row in rows], np.int32),
        "day": np.array([row[2].day for row in rows], np.int64),
        "capture": np.array([row[2].capture for row in rows], np.int16),
    }
    data = xr.Dataset(
        {
            "error": (("trial", "measurement"), errors, {"units": "mm or deg"}),
            **{name: ("trial", values, {"units": "1"}) for name, values in columns.items()},
        },
        {"measurement": list(names)},
        {
            "title": "virtual measurements",
            "schema_version": 1,
            "kinds": kinds,
            "digests": [folders[kind].digest for kind in kinds],
        },
    )
    if rows[0][4]:
        values = np.array([row[4] for row in rows], np.float32)
        data["deviation"] = (("trial", "place"), values, {"units": "mm or deg"})
    for name in data.data_vars:
        data[name].encoding = {"zlib": True, "complevel": 6}
    path.parent.mkdir(parents=True, exist_ok=True)
    write_netcdf(data, path)


def take_up_trials(path: Path, folders: Mapping[str, TrialFolder]) -> dict[str, int]:
    """Add the trials in a file of :func:`write_trials` to trial folders of the same kind and digest.

    Returns the number of added trials of each kind; zero if there is no such file.

    Raises
    ------
    InputError
        If the file has another format.
    """
    taken = dict.fromkeys(folders, 0)
    if not path.exists():
        return taken
    data = read_dataset(path, _SCHEMA)
    try:
        kinds, digests = (np.atleast_1d(data.attrs[name]).tolist() for name in ("kinds", "digests"))
        known = dict(zip(kinds, digests, strict=True))
        for kind, folder in folders.items():
            if known.get(kind) != folder.digest or tuple(data["measurement"].values) != folder.measurements:
                continue
            mine = data.isel(trial=np.flatnonzero(data["kind"].values == kinds.index(kind)))
            values = mine["error"].values.astype(float)
            behind = mine["deviation"].values.astype(float) if "deviation" in mine else np.empty((len(values), 0))
            for view in np.unique(mine["view"].values).tolist():
                rows = np.flatnonzero(mine["view"].values == view)
                trials = {
                    Trial(int(mine["day"][i]), int(mine["capture"][i])): _outcome(folder, values[i], behind[i])
                    for i in rows
                }
                whole = {trial: outcome for trial, outcome in trials.items() if folder.is_whole(outcome)}
                for trial, outcome in whole.items():
                    folder.known(int(view)).setdefault(trial, outcome)
                taken[kind] += len(whole)
    except (KeyError, ValueError, IndexError, TypeError) as problem:
        raise InputError(
            path,
            "",
            str(problem).splitlines()[0],
            "a file that `python -m tests.proofs statements` wrote",
            "remove `measured` from the cases file to measure everything again",
        ) from problem
    return taken


def _deviations(folder: TrialFolder, outcome: Outcome) -> list[float]:
    """Return the deviations behind all values that fold, in one row."""
    return [
        value for name, count in folder.folded.items() for value in outcome.deviations.get(name, [math.nan] * count)
    ]


def _outcome(folder: TrialFolder, errors: NDArray[np.float64], row: NDArray[np.float64]) -> Outcome:
    """Return a trial from its errors, and the deviations of its row; without those if the row has another length."""
    ends = np.cumsum([0, *folder.folded.values()])
    whole = len(row) == ends[-1]
    deviations = {
        name: row[first:end].tolist()
        for name, first, end in zip(folder.folded, ends[:-1], ends[1:], strict=True)
        if whole and math.isfinite(errors[folder.measurements.index(name)])
    }
    return Outcome(dict(zip(folder.measurements, errors.tolist(), strict=True)), {}, deviations)


def _place(trial: Trial) -> tuple[int, int]:
    return trial.day, trial.capture
