"""Views of a part, rendered, decoded and measured several times: the truth that a view score is held against.

Signal chain: view -> the part put down anew -> capture, with interreflections -> cloud -> features of the part's
geometry -> measurements -> error of each; the repeats of a view are kept in one small file.

A run that was stopped goes on where it was, and more repeats may be asked for later. While one capture is decoded and
measured, the next is being rendered.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from characterisation.point_cloud import PointCloud
from characterisation.tasks.measuring import Measured, measure
from mitsim.campaign.take import one_ahead
from mitsim.capture.capture import Capture
from mitsim.capture.cloud import Geometry, capture_cloud
from mitsim.capture.simulate import SimulatedSensor
from mitsim.predict import Predictor
from mitsim.progress import track
from mitsim.scene.triangles import outermost
from mitsim.sensor.frames import Transform
from mitsim.study import MINIMUM_POINTS
from mitsim.validation.measured_views import gathered, keep, known_repeats, repeat_of
from mitsim.validation.score_plan import ScoreCheck
from mitsim.views import View

Floats = NDArray[np.float64]


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
    """Measure from all views; repeats that the folder, or the check's own file, holds already are left as they are.

    Returns ``error`` and ``standard_uncertainty`` (measurement, view, repeat), NaN where a measurement could not be
    made; the uncertainty is what the fit told of itself.
    """
    study, place = check.study, Path(folder) / check.folder
    place.mkdir(parents=True, exist_ok=True)
    corners = outermost(study.scene)
    repeats = check.file.repeats
    indirect = check.file.indirect_light.of(study.sensor)
    known = known_repeats(check, folder)
    shots = [
        _Shot(view, k, check.pose(view, k)) for view in study.views for k in range(len(known[view.number]), repeats)
    ]

    def take(shot: _Shot) -> _Taken:
        capture = simulated.capture(
            study.scene, shot.pose, seed=check.seed(shot.view, shot.repeat), samples=check.file.samples_per_pixel,
            depth=check.file.light_path_depth, around=shot.pose.inverse().points(corners), indirect=indirect,
        )  # fmt: skip
        return _Taken(capture, predictor.labels(study.scene, shot.pose, predictor.surfaces(study.scene, shot.pose)))

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
        every.append(repeat_of(measured))
        if shot.repeat == repeats - 1:
            keep(place, shot.view, check, every)
    return gathered(check, [known[view.number][:repeats] for view in study.views])
