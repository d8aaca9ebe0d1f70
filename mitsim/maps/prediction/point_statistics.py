"""Look up F and sigma of the ideal points of a view in a map, and derive the statistics of a feature.

Signal chain: ideal points -> F and sigma by distance, normal in the view frame and material of their face -> number and
mean sigma of a feature's points, or the input of :mod:`characterisation.tasks.covariance`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from characterisation.files.arrays import Floats
from characterisation.maps.noise_structure import noise_structure
from characterisation.maps.performance_map import PerformanceMap
from characterisation.point_cloud import Status
from characterisation.tasks.covariance import ExpectedPoints
from mitsim.maps.prediction.perturbation import Ideal, Perturbation
from mitsim.scene.load import Scene
from mitsim.scene.materials import Finish
from mitsim.sensor.transforms import Transform


def performance(ideal: Ideal, scene: Scene, performance_map: PerformanceMap) -> tuple[Floats, Floats]:
    """Return F and sigma (n,) of every ideal point; 0 and NaN if an eye does not see it, NaN without an answer."""
    answers = map_answers(ideal, scene, performance_map)
    return answers.fraction, answers.sigma


@dataclass(frozen=True)
class MapAnswers:
    """Answers of a map for the n ideal points of a view: F, sigma [mm] and the error of F, as :func:`performance`."""

    fraction: Floats
    sigma: Floats
    fraction_error: Floats


def map_answers(
    ideal: Ideal,
    scene: Scene,
    performance_map: PerformanceMap,
    finish: Finish | None = None,
    of_scene: MapAnswers | None = None,
) -> MapAnswers:
    """Return F, sigma and the error of F of every ideal point.

    Parameters
    ----------
    ideal, scene, performance_map
        As for :func:`performance`.
    finish, of_scene
        Replaces the finishes of the scene: matt white, to normalise the view score; answers for the finishes of the
        scene, if they are known: a shape with the surface of ``finish`` keeps them.
    """
    out = MapAnswers(*np.full((3, len(ideal.pixel)), np.nan))
    for index, scene_finish in enumerate(scene.finishes):
        used = finish or scene_finish
        mask = (ideal.shape == index) & (ideal.status == Status.VALID)
        if used is None or not mask.any():
            continue
        if of_scene is not None and scene_finish is not None and _same_surface(performance_map, used, scene_finish):
            answers = [values[mask] for values in vars(of_scene).values()]
        else:
            along = None if ideal.along is None else ideal.along[mask]
            distance, normal = ideal.distance[mask], ideal.normal[mask]
            answer = performance_map.query(used.name, used.roughness, distance, normal, used.light, along)
            answers = [answer.fraction, answer.sigma, answer.fraction_error]
        for all_values, values in zip(vars(out).values(), answers, strict=True):
            all_values[mask] = values
    out.fraction[ideal.status != Status.VALID] = 0.0
    return out


def _same_surface(performance_map: PerformanceMap, first: Finish, second: Finish) -> bool:
    """Return whether two finishes have the same surface in a map, which keeps its surfaces."""
    one, other = (performance_map.surface(finish.name, finish.roughness, finish.light) for finish in (first, second))
    return one is other


@dataclass(frozen=True)
class ViewPoints:
    """Ideal points of a view from a pose, and the ``labels`` (H, W) of the shapes that its rays show.

    Each ray stands for ``thinning`` pixels of the sensor, ``angular_pitch`` [rad] apart.
    """

    ideal: Ideal
    labels: NDArray[np.int16]
    world_from_sensor: Transform
    thinning: float = 1.0
    angular_pitch: float = np.nan


def expected_points(
    view: ViewPoints,
    scene: Scene,
    shape: int,
    performance_map: PerformanceMap,
    perturbation: Perturbation | None = None,
    answers: MapAnswers | None = None,
) -> ExpectedPoints:
    """Return the predicted points of one shape in the world frame, which is the part frame; one row per possible point.

    Where the map has no noise area, the area is that of independent points, 1/F, and there is no persistent noise.

    Parameters
    ----------
    view, scene, shape, performance_map
        Ideal points of the view, the scene, the index of the shape into its names, and the map.
    perturbation, answers
        Effects that flat coupons cannot show; what the map answers for all points of the view, if that is known.
    """
    ideal, labels, world_from_sensor = view.ideal, view.labels, view.world_from_sensor
    finish = scene.finishes[shape]
    mask = (labels.reshape(-1)[ideal.pixel] == shape) & (ideal.status == Status.VALID)
    if finish is None:
        mask[:] = False
    distance, normal = ideal.distance[mask], ideal.normal[mask]
    pixel = np.stack(np.divmod(ideal.pixel[mask], labels.shape[1]), axis=-1)
    unknown = np.full(len(distance), np.nan)
    fraction = fraction_error = sigma = area = persistent = unknown
    displaced = np.zeros(len(distance))
    if finish is not None and mask.any():
        if answers is None:
            answers = map_answers(replace(ideal, shape=np.where(mask, ideal.shape, -1)), scene, performance_map)
        structure = noise_structure(performance_map, finish.name, finish.roughness, distance, normal, finish.light)
        fraction, sigma, fraction_error = (values[mask] for values in vars(answers).values())
        area, persistent = structure.area, structure.persistent_share * sigma
        displaced = np.nan_to_num(structure.bias_share * sigma)
        if perturbation is not None:
            with np.errstate(divide="ignore", invalid="ignore"):  # further losses are random: more noise of means
                area = area + (1 / perturbation.kept[mask] - 1) / fraction
            fraction, fraction_error = (value * perturbation.kept[mask] for value in (fraction, fraction_error))
            sigma = np.hypot(sigma * perturbation.noisier[mask], perturbation.scattered[mask])
            displaced = displaced + perturbation.displaced[mask]
    possible = np.isfinite(fraction) & (fraction > 0) & np.isfinite(sigma)
    fraction, sigma = fraction[possible], sigma[possible]
    return ExpectedPoints(
        world_from_sensor.points(ideal.point[mask][possible]),
        ideal.ray[mask][possible] @ world_from_sensor.rotation.T,
        np.rint(pixel[possible] * np.sqrt(view.thinning)).astype(np.int64),
        normal[possible],
        fraction,
        # an unknown error is the largest that a mean F allows: all of the points, or none
        np.where(np.isfinite(fraction_error[possible]), fraction_error[possible], np.sqrt(fraction * (1 - fraction))),
        sigma,
        np.where(np.isfinite(area[possible]), area[possible], 1 / fraction),
        np.nan_to_num(persistent[possible]),
        displaced[possible],
        distance[possible],
        view.thinning,
        view.angular_pitch,
        shared=None if perturbation is None else perturbation.shared[mask][possible],
        shown=world_from_sensor.points(ideal.point[(ideal.shape == shape) & (ideal.status == Status.VALID)]),
    )


def feature_statistics(
    ideal: Ideal, labels: NDArray[np.int16], fraction: Floats, sigma: Floats, shapes: list[int]
) -> tuple[Floats, Floats]:
    """Return the expected number of points n and the mean sigma [mm] of each shape, (features,) each; NaN if n is 0.

    The mean of sigma is over the expected points, so each pixel is weighted by its F.

    Parameters
    ----------
    ideal, labels, shapes
        Points of the view, the shapes (H, W) that its rays show, and indices into the scene's names.
    fraction, sigma
        F and sigma [mm] (n,) of the points, from :func:`performance`.
    """
    label = labels.reshape(-1)[ideal.pixel]
    weight = np.where(np.isfinite(sigma), np.nan_to_num(fraction), 0.0)
    n = np.array([weight[label == shape].sum() for shape in shapes])
    total = np.array([(weight * np.nan_to_num(sigma))[label == shape].sum() for shape in shapes])
    with np.errstate(invalid="ignore", divide="ignore"):
        return n, np.where(n > 0, total / n, np.nan)
