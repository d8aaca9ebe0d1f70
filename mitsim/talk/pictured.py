"""Capture the artefact in one view: image, cloud, and the share of possible points on every feature.

Slide *Measuring Challenging Surfaces*, and the comparison of direct light with all light on slide *Simulation
Validation*.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from characterisation.maps.performance_map import PerformanceMap
from characterisation.point_cloud import Status
from characterisation.region_of_interest import Roi
from mitsim.maps.prediction import performance
from mitsim.report.sheet_figures import image_on_grid
from mitsim.study import StudyFile, open_study
from mitsim.study.virtual.plan import rendering_of
from mitsim.study.virtual.rendered import RenderedMeasurements
from mitsim.study.virtual.study_unknowns import study_unknowns
from mitsim.views import View

#: pixels around the part in a picture
_MARGIN_PX = 12


def picture_of_finish(folder: str, file: StudyFile, number: int) -> xr.Dataset:
    """Return image, status and depth (row, column) of the part in one view, and its points of each feature.

    ``possible`` points are the pixels that a perfect sensor would fill; both eyes see them. Unknowns are at their best
    estimates.
    """
    study = open_study(Path(folder) / "talk.toml", file, mapped=False)
    view = study.view(number)
    renderer = RenderedMeasurements(study, study_unknowns(study), rendering_of(study))
    capture, cloud = renderer.at_best_estimates(view)
    part = Roi.around(renderer.predictor.surfaces(study.scene, view.world_from_sensor).shape >= 0, _MARGIN_PX)
    window = (part or Roi.whole(cloud.grid.width, cloud.grid.height)).slices
    image = np.nan_to_num(image_on_grid(capture, cloud))
    low, high = np.percentile(image, (0.5, 99.7))
    shown = np.asarray(255 * np.clip((image - low) / max(high - low, 1), 0, 1) ** 0.6, np.uint8)
    depth = np.where(cloud.valid, cloud.points[..., 2], np.nan)
    pixel = ("row", "column")
    data = _counts(renderer, study.task.shapes, view, cloud.valid)
    data["image"] = (pixel, shown[window])
    data["status"] = (pixel, cloud.status[window])
    data["depth"] = (pixel, depth[window].astype(np.float32), {"units": "mm"})
    return data


def features_in_light(folder: str, file: StudyFile, numbers: tuple[int, ...]) -> xr.Dataset:
    """Return captured, possible and expected points (view, feature) of the part in some views.

    ``expected`` is the sum of F of the map, which knows no light from other faces.
    """
    study = open_study(Path(folder) / "talk.toml", file)
    renderer = RenderedMeasurements(study, study_unknowns(study), rendering_of(study))
    counts = []
    for number in numbers:
        view = study.view(number)
        _, cloud = renderer.at_best_estimates(view)
        counts.append(_counts(renderer, study.task.shapes, view, cloud.valid, study.performance_map))
    return xr.concat(counts, xr.Variable("view", list(numbers)))


def _counts(
    renderer: RenderedMeasurements,
    shapes: Iterable[str],
    view: View,
    valid: NDArray[np.bool_],
    performance_map: PerformanceMap | None = None,
) -> xr.Dataset:
    """Return possible, captured and expected points (feature,) of a view; NaN for expected ones without a map."""
    scene, pose = renderer.study.scene, view.world_from_sensor
    surfaces = renderer.predictor.surfaces(scene, pose)
    ideal, labels = renderer.predictor.ideal(surfaces), renderer.predictor.labels(scene, pose, surfaces)
    seen = ideal.status == Status.VALID
    label = labels.ravel()[ideal.pixel]
    fraction = None if performance_map is None else performance(ideal, scene, performance_map)[0]
    rows = []
    names = list(shapes)
    for name in names:
        here = seen & (label == scene.names.index(name))
        expected = np.nan if fraction is None else float(np.nan_to_num(fraction[here]).sum())
        rows.append((int(here.sum()), int(valid.ravel()[ideal.pixel[here]].sum()), expected))
    possible, points, expected = np.array(rows).T
    return xr.Dataset(
        {"possible": ("feature", possible), "points": ("feature", points), "expected": ("feature", expected)},
        {"feature": names},
    )
