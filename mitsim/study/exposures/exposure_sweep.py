"""Predict how well one view measures each feature at any exposure, from a single simulation of the light.

Signal chain: view with every unknown at its best estimate -> light on the imagers, traced once
(:meth:`mitsim.study.virtual.rendered.RenderedMeasurements.lit`) -> images for each set of exposures and noise sample ->
cloud -> recovered points of each feature, their share F of the possible points, and the standard uncertainty u of its
fitted surface.

Images are linear in the projector's power and in the exposure, so the light is traced only once. The uncertainty u is
that of the surface's position along the view rays, as the root mean square over the visible part of the feature. Let g
(1, p) be the derivatives of the distance along the ray with respect to the p parameters of the surface. Then

    u^2 = mean over possible points of g C g^T,      C = s^2 (sum over recovered points of g^T g)^-1

C is the covariance of linear least squares, and g C g^T follows from the law of propagation of uncertainty (JCGM 100,
5.2). The robust standard deviation s is that of the residuals from the fitted surface. If one end of a face is lost, u
increases more than the number of points alone suggests. C does not contain noise that neighbours share: it hardly
differs between the exposures of a view.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from characterisation.features.fits import belonging
from characterisation.features.robust_fit import CLIP, robust_std, scatter_of
from characterisation.features.starts import rounding_scale
from characterisation.features.surfaces import GRAZING_COSINE, Surface
from characterisation.files.arrays import Floats
from characterisation.point_cloud import PointCloud, Status
from characterisation.tasks.task_file import Task
from mitsim.scene.light_transport.plain_scene import has_emitters
from mitsim.sensor.exposure import PlannedExposure
from mitsim.study import MINIMUM_POINTS
from mitsim.study.virtual.rendered import RenderedMeasurements
from mitsim.study.virtual.world import Trial
from mitsim.views import View

#: first number of the seeds of a sweep, which keeps its noise independent of that of the trials
_STREAM = 77


@dataclass(frozen=True)
class FeatureResult:
    """Result for one feature at one set of exposures."""

    points: float  # mean number of recovered points
    fraction: float  # their share F of the possible points [1]
    #: [mm]: standard uncertainty of the surface's position, root mean square over the noise samples. It is infinite if
    #: the points are too few or do not determine the surface
    u: float
    #: [mm]: robust standard deviation of the points along the rays, NaN if unknown; of rounded depths, of which most
    #: are the same, the standard deviation
    scatter: float
    error: float = 0.0  # relative standard error of u from the finite number of noise samples [1], 0 if unknown


@dataclass(frozen=True)
class ExposureResult:
    """Result for all needed features at one set of exposures; ``recovered`` (n,) masks of the last noise sample."""

    exposure: PlannedExposure
    features: dict[str, FeatureResult]
    recovered: dict[str, NDArray[np.bool_]]


@dataclass(frozen=True)
class _PossiblePoints:
    """Points of a feature that an ideal sensor would return."""

    pixel: NDArray[np.int64]  # (n,) flat indices in the grid
    derivatives: Floats  # (n, p) of the distance along the ray with respect to the surface's parameters
    surface: Surface  # in the sensor frame [mm]


class ExposureSweep:
    """Light of one view, exposed any number of times; ``dimmable``: all of it is the projector's."""

    def __init__(self, renderer: RenderedMeasurements, view: View) -> None:
        drawn = replace(renderer.unknowns, varied=()).draw(Trial(0))
        self.renderer, self.view = renderer, view
        self.lit = renderer.lit(view, drawn)
        self.possible = _possible_points(renderer, view)
        sensor = renderer.study.sensor
        # only the light of the projector is proportional to its power
        self.dimmable = not has_emitters(renderer.study.scene) and sensor.room is None and not sensor.ambient_image

    def evaluate(self, exposure: PlannedExposure, noise: int, draws: int) -> ExposureResult:
        """Return the mean result of a set of exposures over ``draws`` noise samples.

        Each number ``noise`` has its own, independent samples.
        """
        results: dict[str, list[FeatureResult]] = {name: [] for name in self.possible}
        recovered: dict[str, NDArray[np.bool_]] = {}
        for k in range(draws):
            numbers = [_STREAM, self.renderer.unknowns.seed, self.view.number, noise, k]
            seed = int(np.random.SeedSequence(numbers).generate_state(1)[0] >> 1)
            capture = self.renderer.exposed(self.lit, exposure, seed, keep=True)
            cloud = self.renderer.unlabelled_cloud(capture)
            for name, possible in self.possible.items():
                result, mask = feature_result(cloud, possible.pixel, possible.derivatives, possible.surface)
                results[name].append(result)
                recovered[name] = mask
        return ExposureResult(exposure, {name: _mean_result(samples) for name, samples in results.items()}, recovered)


def feature_result(
    cloud: PointCloud, pixel: NDArray[np.int64], derivatives: Floats, surface: Surface
) -> tuple[FeatureResult, NDArray[np.bool_]]:
    """Return the result for one feature of a cloud, and a mask (n,) of its recovered points.

    Formulas and source: :mod:`mitsim.study.exposures.exposure_sweep`.

    ``cloud``, ``surface``: organised cloud, and nominal surface, in the sensor frame [mm]. ``pixel``: (n,) flat indices
    of the possible points in the grid. ``derivatives``: (n, p) derivatives at the possible points of the distance along
    the ray with respect to the parameters.
    """
    points = cloud.points.reshape(-1, 3)[pixel].astype(float)
    finite = np.isfinite(points).all(axis=1)
    recovered = np.zeros(len(pixel), bool)
    recovered[finite] = belonging(points[finite], surface, cloud.grid.origin)
    count = int(recovered.sum())
    no_result = FeatureResult(float(count), count / max(len(pixel), 1), math.inf, math.nan)
    if count < max(MINIMUM_POINTS, 2 * derivatives.shape[1]):
        return no_result, recovered
    offsets = points[recovered] - cloud.grid.origin
    rays = offsets / np.linalg.norm(offsets, axis=1, keepdims=True)
    meeting = surface.meet(points[recovered], rays)
    usable = np.abs(meeting.cosine) > GRAZING_COSINE
    residual, g = meeting.residual[usable], derivatives[recovered][usable]
    if len(residual) < max(MINIMUM_POINTS, 2 * derivatives.shape[1]):
        return no_result, recovered
    near, least_scale = np.ones(len(residual), bool), rounding_scale(points[recovered][usable], surface)
    for _ in range(3):
        change = np.linalg.lstsq(g[near], residual[near], rcond=None)[0]
        remaining = residual - g @ change
        near = np.abs(remaining) <= CLIP * max(robust_std(remaining), least_scale)
    scatter = scatter_of(remaining, least_scale)
    try:
        covariance = scatter**2 * np.linalg.inv(g[near].T @ g[near])
    except np.linalg.LinAlgError:
        return no_result, recovered
    square = float(np.einsum("ni,ij,nj->n", derivatives, covariance, derivatives).mean())
    u = math.sqrt(square) if square > 0 else math.inf
    return FeatureResult(float(count), count / len(pixel), u, scatter), recovered


def needed_shapes(task: Task) -> list[str]:
    """Return the names of all shapes that the measurements of a task need, each once."""
    return list(dict.fromkeys(name for measurement in task.measurements for name in task.shapes_for(measurement)))


def _possible_points(renderer: RenderedMeasurements, view: View) -> dict[str, _PossiblePoints]:
    """Return the points of every needed feature that all cameras and the projector can see."""
    scene, pose = renderer.study.scene, view.world_from_sensor
    surfaces = renderer.predictor.surfaces(scene, pose)
    ideal, labels = (renderer.predictor.ideal(surfaces), renderer.predictor.labels(scene, pose, surfaces))
    label = labels.reshape(-1)[ideal.pixel]
    out = {}
    for name in needed_shapes(renderer.study.task):
        mask = (label == scene.names.index(name)) & (ideal.status == Status.VALID)
        surface = renderer.study.task.features[name].nominal(pose.inverse().matrix())
        point, ray = ideal.point[mask], ideal.ray[mask]
        derivatives = surface.linearised(np.zeros(surface.parameter_count), point, ray)[1]
        facing = np.abs(surface.meet(point, ray).cosine) > GRAZING_COSINE
        out[name] = _PossiblePoints(ideal.pixel[mask][facing], derivatives[facing], surface)
    return out


def _mean_result(samples: Sequence[FeatureResult]) -> FeatureResult:
    """Return the mean result of one feature over noise samples: means, and for u the root mean square."""
    scatter = [sample.scatter for sample in samples if math.isfinite(sample.scatter)]
    u = np.array([sample.u for sample in samples])
    error = float(u.std(ddof=1) / u.mean() / math.sqrt(len(u))) if len(u) > 1 and np.isfinite(u).all() else 0.0
    return FeatureResult(
        float(np.mean([sample.points for sample in samples])),
        float(np.mean([sample.fraction for sample in samples])),
        float(np.sqrt(np.mean(u**2))),
        float(np.mean(scatter)) if scatter else math.nan,
        error,
    )
