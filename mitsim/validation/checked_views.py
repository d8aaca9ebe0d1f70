"""Views of a part, rendered, decoded and measured several times: the truth that a view score is held against.

Signal chain: view -> the part put down anew -> capture, with interreflections -> cloud -> features of the part's
geometry -> measurements -> error of each; the repeats of a view are kept in one small file.

A run that was stopped goes on where it was, and more repeats may be asked for later. While one capture is decoded and
measured, the next is being rendered.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from characterisation.point_cloud import PointCloud
from characterisation.tasks.measuring import Measured, measure
from characterisation.whole_files import write_json
from mitsim.campaign.take import one_ahead
from mitsim.capture.capture import Capture
from mitsim.capture.cloud import Geometry, capture_cloud
from mitsim.capture.indirect_light import IndirectLight
from mitsim.capture.simulate import SimulatedSensor
from mitsim.predict import Predictor
from mitsim.progress import track
from mitsim.run_study import MINIMUM_POINTS
from mitsim.scene.triangles import triangles
from mitsim.sensor.frames import Transform
from mitsim.validation.score_plan import ScoreCheck
from mitsim.views import View

Floats = NDArray[np.float64]

#: what is kept of every measurement, in its unit
FIELDS = ("error", "standard_uncertainty")

#: measurement -> field -> number, None where there is none
Repeat = dict[str, dict[str, float | None]]


@dataclass(frozen=True)
class _Shot:
    """One repeat of one view, and where the sensor stands in it."""

    view: View
    repeat: int
    pose: Transform


@dataclass(frozen=True)
class _Taken:
    """A capture, and which feature each pixel of its cloud shows, (H, W)."""

    capture: Capture
    labels: NDArray[np.int16]


def check_views(
    check: ScoreCheck, simulated: SimulatedSensor, geometry: Geometry, predictor: Predictor, folder: str | Path
) -> xr.Dataset:  # fmt: skip
    """Measure from all views; repeats that the folder holds already are left as they are.

    Returns ``error`` and ``standard_uncertainty`` (measurement, view, repeat), NaN where a measurement could not be
    made; the uncertainty is what the fit told of itself.
    """
    study, folder = check.study, Path(folder) / check.folder
    folder.mkdir(parents=True, exist_ok=True)
    corners = triangles(study.scene).reshape(-1, 3)
    repeats = check.file.repeats
    indirect = IndirectLight(**check.file.indirect_light.model_dump())
    known = {view.number: _kept(folder, view, check) for view in study.views}
    shots = [
        _Shot(view, k, check.pose(view, k)) for view in study.views for k in range(len(known[view.number]), repeats)
    ]

    def take(shot: _Shot) -> _Taken:
        capture = simulated.capture(
            study.scene, shot.pose, seed=check.seed(shot.view, shot.repeat), samples=check.file.samples_per_pixel,
            depth=check.file.light_path_depth, around=shot.pose.inverse().points(corners), indirect=indirect,
        )  # fmt: skip
        return _Taken(capture, predictor.labels(predictor.surfaces(study.scene, shot.pose)))

    def finish(taken: _Taken, shot: _Shot) -> dict[str, Measured]:
        cloud = capture_cloud(taken.capture, study.sensor.settings, geometry, imager=study.sensor.imager)
        labelled = PointCloud(
            cloud.points, cloud.status, cloud.grid, cloud.sensor, cloud.source, cloud.baseline, taken.labels,
            study.scene.names,
        )  # fmt: skip
        return measure(labelled, study.task, shot.pose.inverse().matrix(), MINIMUM_POINTS)

    what = f"{study.sensor.name}, {check.sample.name}"
    for shot, measured in track(one_ahead(shots, take, finish), what, len(shots)):
        every = known[shot.view.number]
        every.append(_values(measured))
        if shot.repeat == repeats - 1:
            write_json(_place(folder, shot.view), _identity(shot.view, check) | {"repeats": every})
    return _gathered(check, [known[view.number][:repeats] for view in study.views])


def _values(measured: dict[str, Measured]) -> Repeat:
    """What is kept of a repeat, None where there is no number."""

    def number(value: float) -> float | None:
        return float(value) if math.isfinite(value) else None

    return {name: {field: number(getattr(one, field)) for field in FIELDS} for name, one in measured.items()}


def _place(folder: Path, view: View) -> Path:
    return folder / f"view_{view.number:04d}.json"


def _identity(view: View, check: ScoreCheck) -> dict[str, Any]:
    """What a kept view must say of itself to be the one that is asked for."""
    pose = np.round(view.world_from_sensor.matrix(), 9).tolist()
    return {"schema_version": 1, "digest": check.digest, "world_from_sensor": pose}


def _kept(folder: Path, view: View, check: ScoreCheck) -> list[Repeat]:
    """Repeats of a view that were measured before, if it is the same.

    Files are written whole, so one that does not parse is not ours and is measured again.
    """
    try:
        known: dict[str, Any] = json.loads(_place(folder, view).read_text())
    except (FileNotFoundError, ValueError):
        return []
    same = all(known.get(key) == value for key, value in _identity(view, check).items())
    return list(known["repeats"]) if same and "repeats" in known else []


def _gathered(check: ScoreCheck, views: list[list[Repeat]]) -> xr.Dataset:
    names, dims = list(check.study.task.measurements), ("measurement", "view", "repeat")
    arrays = {
        field: np.array([[[one[name][field] for one in repeats] for repeats in views] for name in names], float)
        for field in FIELDS
    }  # fmt: skip
    variables = {field: (dims, values, {"units": "mm or deg"}) for field, values in arrays.items()}
    return xr.Dataset(variables, {"measurement": names, "view": [view.number for view in check.study.views]})
