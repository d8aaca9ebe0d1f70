"""Hold view scores against measurements from rendered views: all of a validation file, and its page.

Signal chain: checks (:mod:`mitsim.validation.score_plan`) -> scored views, and what simpler scores say of them -> views
measured (:mod:`mitsim.validation.checked_views`) -> ``views.nc`` of each sensor and sample, ``SENSOR.nc`` of all
measurements -> true errors beside every score, :class:`characterisation.scores.score_validation.CheckedViews`.
"""

from __future__ import annotations

from itertools import groupby
from pathlib import Path

import numpy as np
import xarray as xr

from characterisation.scores.score_validation import UNCERTAINTY, CheckedViews
from mitsim.campaign.run import write_netcdf
from mitsim.capture.cloud import sensor_geometry
from mitsim.capture.simulate import SimulatedSensor
from mitsim.predict import Predictor
from mitsim.predict.interreflection import Interreflections
from mitsim.score import score_candidates
from mitsim.study import MINIMUM_POINTS
from mitsim.validation.baselines import COSINE, DIRECT_ONLY, by_uncertainty, said_of_views
from mitsim.validation.checked_views import check_views
from mitsim.validation.measured_views import write_measured
from mitsim.validation.score_plan import ScoreCheck


def run_score_validation(checks: list[ScoreCheck], folder: str | Path) -> dict[str, list[CheckedViews]]:
    """Score and measure all views of all checks; what the folder holds of them is not measured again.

    Returns, by sensor, every measurement of every sample.
    """
    found: dict[str, list[CheckedViews]] = {}
    for name, mine in groupby(checks, key=lambda check: check.study.sensor.name):
        of_sensor = list(mine)
        sensor = of_sensor[0].study.sensor
        geometry = sensor_geometry(sensor)
        predictor, simulated = Predictor.of_sensor(sensor, geometry), SimulatedSensor(sensor)
        for check in of_sensor:
            said = _said(check, predictor)
            truth = check_views(check, simulated, geometry, predictor, folder)
            write_measured(of_sensor, folder)
            write_netcdf(xr.merge([said, truth], join="exact"), Path(folder) / check.folder / "views.nc")
            found.setdefault(name, []).extend(_checked(check, said, truth))
    return found


def _said(check: ScoreCheck, predictor: Predictor) -> xr.Dataset:
    """``score`` (name, measurement, view) of every score, and ``predicted_uncertainty`` where a view is possible."""
    study = check.study
    performance_map, depth = study.performance_map, check.file.light_path_depth
    assert performance_map is not None

    def scored(interreflections: Interreflections | None) -> xr.Dataset:
        return score_candidates(
            study.scene, study.task, study.views, predictor, performance_map, MINIMUM_POINTS, interreflections
        )[0]

    direct = scored(None)
    said = said_of_views(direct, study.scene, study.task, study.views, predictor, check.file.seed)
    scores = direct
    if depth > 1:
        scores = scored(Interreflections(study.sensor, depth))
        said = said | {DIRECT_ONLY: said[UNCERTAINTY], UNCERTAINTY: by_uncertainty(scores, said[COSINE])}
    possible = scores["uncertainty_possible"].values
    u = np.where(possible, scores["predicted_uncertainty"].values, np.nan)
    by = ("measurement", "view")
    return xr.Dataset(
        {
            "score": (("name", *by), np.stack(list(said.values())), {"long_name": "higher is better", "units": "1"}),
            "predicted_uncertainty": (by, u, {"long_name": "predicted standard uncertainty", "units": "mm or deg"}),
            "world_from_sensor": scores["world_from_sensor"],
        },
        {"name": list(said), "measurement": list(study.task.measurements), "view": [v.number for v in study.views]},
    )


def _checked(check: ScoreCheck, said: xr.Dataset, truth: xr.Dataset) -> list[CheckedViews]:
    names = said["name"].values.tolist()
    assert UNCERTAINTY in names  # or its own would be put beside, which knows no order among the unlikely
    return [
        CheckedViews(
            name, check.sample.name, asked.unit, {one: said["score"].values[k, m] for k, one in enumerate(names)},
            truth["error"].values[m], said["predicted_uncertainty"].values[m],
            np.nan if asked.tolerance is None else asked.tolerance,
        )
        for m, (name, asked) in enumerate(check.study.task.measurements.items())
    ]  # fmt: skip
