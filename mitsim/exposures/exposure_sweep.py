"""How well one view measures each feature at any exposure: one tracing of the light, many exposures of it.

Signal chain: view with every unknown at its best guess -> light on the imagers, traced once
(:meth:`mitsim.virtual.rendered.RenderedMeasurements.lit`) -> exposed anew for every set of exposures and draw of noise,
and decoded -> of each feature the points that belong to it, their share F of those that are possible, and the standard
uncertainty u of its fitted surface.

Images are linear in the projector's power and in the exposure, so nothing of the light is traced twice. u is that of
the place of the surface along the view rays, as the root mean square over all places of the feature that the view can
see. With g the derivatives of the distance along the ray by the surface's parameters,

    u^2 = mean over possible points of g C g^T,      C = s^2 (sum over points that came back of g^T g)^-1

and s the robust standard deviation of their residuals from the best surface. A loss of one end of a face so costs more
than its share of points. Noise that neighbours share is left out of C: it is much the same at all exposures of a view.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from characterisation.features.fits import belonging
from characterisation.features.robust_fit import CLIP, robust_std
from characterisation.features.surfaces import GRAZING_COSINE, Surface
from characterisation.point_cloud import PointCloud, Status
from characterisation.tasks.task_file import Task
from mitsim.scene.light_transport.ambient import has_emitters
from mitsim.sensor.exposure import PlannedExposure
from mitsim.study import MINIMUM_POINTS
from mitsim.views import View
from mitsim.virtual.rendered import RenderedMeasurements
from mitsim.virtual.world import Trial

Floats = NDArray[np.float64]

#: first number of the stream of noise of a sweep, apart from all that trials draw
_STREAM = 77


@dataclass(frozen=True)
class FeatureLook:
    """One feature at one set of exposures: mean number of ``points``, share ``fraction`` of the possible ones, ``u``.

    ``u`` [mm] is infinite where the points do not determine the surface, or are too few to be measured; ``scatter``
    [mm] of the points; ``error`` relative standard error of u from the finite number of draws.
    """

    points: float
    fraction: float
    u: float
    scatter: float
    error: float = 0.0


@dataclass(frozen=True)
class Look:
    """All needed features at one set of exposures; ``seen`` masks (possible points,) of one draw, by feature."""

    exposure: PlannedExposure
    features: dict[str, FeatureLook]
    seen: dict[str, NDArray[np.bool_]]


@dataclass(frozen=True)
class _Possible:
    """Points of a feature that a perfect sensor would see: ``pixel`` (n,), derivatives (n, p) ``slope``, surface."""

    pixel: NDArray[np.int64]
    slope: Floats
    surface: Surface


class ExposureSweep:
    """Light of one view on the imagers, to be exposed as often as one likes.

    ``dimmable``: whether the power can be lowered here.
    """

    def __init__(self, maker: RenderedMeasurements, view: View) -> None:
        world = replace(maker.unknowns, varied=()).draw(Trial(0))
        self.maker, self.view = maker, view
        self.lit = maker.lit(view, world)
        self.possible = _possible(maker, view)
        sensor = maker.study.sensor
        # light that is not the projector's does not follow its power
        self.dimmable = not has_emitters(maker.study.scene) and sensor.room is None and not sensor.ambient_image

    def look(self, exposure: PlannedExposure, noise: int, draws: int) -> Look:
        """What a set of exposures gives in the mean of some draws; every ``noise`` has draws of its own."""
        rows: dict[str, list[FeatureLook]] = {name: [] for name in self.possible}
        seen: dict[str, NDArray[np.bool_]] = {}
        for k in range(draws):
            seed = _seed(self.maker.unknowns.seed, self.view.number, noise, k)
            capture = self.maker.exposed(self.lit, exposure, seed, keep=True)
            cloud = self.maker.unlabelled_cloud(capture)
            for name, possible in self.possible.items():
                one, mask = feature_look(cloud, possible.pixel, possible.slope, possible.surface)
                rows[name].append(one)
                seen[name] = mask
        return Look(exposure, {name: _mean(some) for name, some in rows.items()}, seen)


def feature_look(
    cloud: PointCloud, pixel: NDArray[np.int64], slope: Floats, surface: Surface
) -> tuple[FeatureLook, NDArray[np.bool_]]:
    """One feature of a cloud, and which of its possible points (n,) came back.

    ``pixel`` (n,) flat and ``slope`` (n, p), the derivatives, of the possible points; ``surface`` in the cloud's frame.
    """
    points = cloud.points.reshape(-1, 3)[pixel].astype(float)
    known = np.isfinite(points).all(axis=1)
    back = np.zeros(len(pixel), bool)
    back[known] = belonging(points[known], surface, cloud.grid.origin)
    count = int(back.sum())
    nothing = FeatureLook(float(count), count / max(len(pixel), 1), math.inf, math.nan)
    if count < max(MINIMUM_POINTS, 2 * slope.shape[1]):
        return nothing, back
    away = points[back] - cloud.grid.origin
    rays = away / np.linalg.norm(away, axis=1, keepdims=True)
    meeting = surface.meet(points[back], rays)
    usable = np.abs(meeting.cosine) > GRAZING_COSINE
    residual, g = meeting.residual[usable], slope[back][usable]
    if len(residual) < max(MINIMUM_POINTS, 2 * slope.shape[1]):
        return nothing, back
    near = np.ones(len(residual), bool)
    for _ in range(3):
        change = np.linalg.lstsq(g[near], residual[near], rcond=None)[0]
        left = residual - g @ change
        near = np.abs(left) <= CLIP * robust_std(left)
    scatter = robust_std(left)
    try:
        covariance = scatter**2 * np.linalg.inv(g[near].T @ g[near])
    except np.linalg.LinAlgError:
        return nothing, back
    square = float(np.einsum("ni,ij,nj->n", slope, covariance, slope).mean())
    u = math.sqrt(square) if square > 0 else math.inf
    return FeatureLook(float(count), count / len(pixel), u, scatter), back


def needed_shapes(task: Task) -> list[str]:
    """Shapes that any measurement of a task rests on, each once."""
    return list(dict.fromkeys(name for one in task.measurements for name in task.shapes_for(one)))


def _possible(maker: RenderedMeasurements, view: View) -> dict[str, _Possible]:
    """Of every needed feature the points that every eye can see."""
    scene, pose = maker.study.scene, view.world_from_sensor
    whole = maker.predictor.surfaces(scene, pose)
    ideal, labels = maker.predictor.ideal(whole), maker.predictor.labels(scene, pose, whole)
    label = labels.reshape(-1)[ideal.pixel]
    out = {}
    for name in needed_shapes(maker.study.task):
        mask = (label == scene.names.index(name)) & (ideal.status == Status.VALID)
        surface = maker.study.task.features[name].nominal(pose.inverse().matrix())
        point, ray = ideal.point[mask], ideal.ray[mask]
        slope = surface.linearised(np.zeros(surface.parameter_count), point, ray)[1]
        facing = np.abs(surface.meet(point, ray).cosine) > GRAZING_COSINE
        out[name] = _Possible(ideal.pixel[mask][facing], slope[facing], surface)
    return out


def _seed(*numbers: int) -> int:
    return int(np.random.SeedSequence([_STREAM, *numbers]).generate_state(1)[0] >> 1)


def _mean(some: Sequence[FeatureLook]) -> FeatureLook:
    scatter = [one.scatter for one in some if math.isfinite(one.scatter)]
    u = np.array([one.u for one in some])
    error = float(u.std(ddof=1) / u.mean() / math.sqrt(len(u))) if len(u) > 1 and np.isfinite(u).all() else 0.0
    return FeatureLook(
        float(np.mean([one.points for one in some])),
        float(np.mean([one.fraction for one in some])),
        float(np.sqrt(np.mean(u**2))),
        float(np.mean(scatter)) if scatter else math.nan,
        error,
    )
