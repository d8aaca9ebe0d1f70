"""What was measured from rendered views, kept: a small file for each view while a run goes on, then one for a sensor.

Signal chain: repeats of a view -> ``view_0001.json`` of a sensor and sample -> all samples of a sensor ->
``SENSOR.nc``, with which another map or another score is held against the same views in minutes.

A view that is kept says what decided its measurement, as a digest, and where the sensor stood; it is used for the same
and for nothing else.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from characterisation.errors import InputError
from characterisation.tasks.measuring import Measured
from characterisation.whole_files import write_json
from mitsim.campaign.run import write_netcdf
from mitsim.validation.score_plan import ScoreCheck
from mitsim.views import View

#: what is kept of every measurement, in its unit
FIELDS = ("error", "standard_uncertainty")

#: measurement -> field -> number, None where there is none
Repeat = dict[str, dict[str, float | None]]


def repeat_of(measured: dict[str, Measured]) -> Repeat:
    """What is kept of a repeat, None where there is no number."""
    return {name: {field: _number(getattr(one, field)) for field in FIELDS} for name, one in measured.items()}


def keep(folder: Path, view: View, check: ScoreCheck, repeats: list[Repeat]) -> None:
    """Keep all repeats of a view in a folder."""
    write_json(_place(folder, view), _identity(view, check) | {"repeats": repeats})


def kept(folder: Path, view: View, check: ScoreCheck) -> list[Repeat]:
    """Repeats of a view that a folder holds, if it is the same.

    Files are written whole, so one that does not parse is not ours and is measured again.
    """
    try:
        known: dict[str, Any] = json.loads(_place(folder, view).read_text())
    except (FileNotFoundError, ValueError):
        return []
    same = all(known.get(key) == value for key, value in _identity(view, check).items())
    return list(known["repeats"]) if same and "repeats" in known else []


def known_repeats(check: ScoreCheck, folder: str | Path) -> dict[int, list[Repeat]]:
    """By number of the view what is known of each: of a run's folder or of the check's own file, what has more.

    Raises
    ------
    InputError
        If that file is not one of :func:`write_measured`.
    """
    place = Path(folder) / check.folder
    before = {} if check.measured is None else read_measured(check.measured / check.sensor_file, check)
    return {
        view.number: max(kept(place, view, check), before.get(view.number, []), key=len) for view in check.study.views
    }


def gathered(check: ScoreCheck, views: Sequence[list[Repeat]]) -> xr.Dataset:
    """:data:`FIELDS` (measurement, view, repeat) of as many repeats of each view, NaN where there is no number."""
    names = list(check.study.task.measurements)
    return xr.Dataset(
        {name: (("measurement", "view", "repeat"), values, {"units": "mm or deg"})
         for name, values in _arrays(names, views).items()},
        {"measurement": names, "view": [view.number for view in check.study.views]},
    )  # fmt: skip


def write_measured(checks: Sequence[ScoreCheck], folder: str | Path) -> None:
    """Write what is known of the checks of one sensor as one file into a run's folder.

    ``error`` and ``standard_uncertainty`` (sample, measurement, view, repeat), ``repeats`` (sample, view) that were
    measured, ``digest`` (sample) and ``world_from_sensor`` (view, i, j).
    """
    study = checks[0].study
    names, views = list(study.task.measurements), study.views
    known = [list(known_repeats(check, folder).values()) for check in checks]
    most = max(len(repeats) for sample in known for repeats in sample)
    nothing: Repeat = {name: dict.fromkeys(FIELDS) for name in names}
    filled = [_arrays(names, [one + [nothing] * (most - len(one)) for one in sample]) for sample in known]
    by = ("sample", "measurement", "view", "repeat")
    data = {field: (by, np.stack([one[field] for one in filled]).astype(np.float32), {"units": "mm or deg"})
            for field in FIELDS}  # fmt: skip
    poses = np.stack([view.world_from_sensor.matrix() for view in views])
    write_netcdf(
        xr.Dataset(
            {
                **data, "repeats": (("sample", "view"), np.array([[len(one) for one in sample] for sample in known])),
                "digest": ("sample", [check.digest for check in checks]),
                "world_from_sensor": (("view", "i", "j"), poses, {"units": "mm"}),
            },
            {"sample": [check.sample.name for check in checks], "measurement": names,
             "view": [view.number for view in views]},
            {"title": "measurements from rendered views", "sensor": study.sensor.name, "schema_version": 1},
        ),
        Path(folder) / checks[0].sensor_file,
    )  # fmt: skip


def read_measured(path: Path, check: ScoreCheck) -> dict[int, list[Repeat]]:
    """By number of the view the repeats that a file of :func:`write_measured` holds of the same views; none if none.

    Raises
    ------
    InputError
        If the file is not one of these.
    """
    if not path.exists():
        return {}
    try:
        data = xr.load_dataset(path)
        same = np.flatnonzero((data["sample"].values == check.sample.name) & (data["digest"].values == check.digest))
        if not len(same):
            return {}
        mine = data.isel(sample=int(same[0])).sel(measurement=list(check.study.task.measurements))
        poses = {int(n): pose for n, pose in zip(mine["view"].values, mine["world_from_sensor"].values, strict=True)}
        counts = {int(n): int(count) for n, count in zip(mine["view"].values, mine["repeats"].values, strict=True)}
        values = {field: mine[field].values.astype(float) for field in FIELDS}
    except (OSError, KeyError, ValueError) as problem:
        raise InputError(path, "", str(problem).splitlines()[0], "a file that `mitsim validate scores` wrote",
                         "take `measured` out of the validation to measure all views") from problem  # fmt: skip
    names, places = list(check.study.task.measurements), {number: i for i, number in enumerate(poses)}
    out = {}
    for view in check.study.views:
        if view.number not in poses or np.abs(poses[view.number] - view.world_from_sensor.matrix()).max() > 1e-8:
            continue
        v = places[view.number]
        out[view.number] = [
            {name: {field: _number(values[field][m, v, k]) for field in FIELDS} for m, name in enumerate(names)}
            for k in range(counts[view.number])
        ]
    return out


def _arrays(names: list[str], views: Sequence[list[Repeat]]) -> dict[str, np.ndarray[Any, np.dtype[np.float64]]]:
    return {
        field: np.array([[[one[name][field] for one in repeats] for repeats in views] for name in names], float)
        for field in FIELDS
    }


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _place(folder: Path, view: View) -> Path:
    return folder / f"view_{view.number:04d}.json"


def _identity(view: View, check: ScoreCheck) -> dict[str, Any]:
    """What a kept view must say of itself to be the one that is asked for."""
    pose = np.round(view.world_from_sensor.matrix(), 9).tolist()
    return {"schema_version": 1, "digest": check.digest, "world_from_sensor": pose}
