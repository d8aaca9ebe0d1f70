"""Form deviation of a real part: a smooth random deviation of its faces from their nominal geometry.

Signal chain: position on a face -> smooth random height with a given standard deviation -> displacement of the point
along its ray, by the distance that matches the height along the normal.

The field is a sum of plane waves with random directions and phases. Their wavelengths are between half and twice the
extent of the face, since form, as opposed to waviness, is the deviation over the whole extent (ISO 1101, ISO 12781-1).
Each face has its own field.

A face whose flatness or cylindricity has a tolerance deviates by a quarter of it, one sigma, unless the study says
otherwise: the zone of the drawing then holds 95 % of the deviations. The form itself is measured without that
deviation, since its statement is about a part at the limit of the tolerance
(:mod:`characterisation.statements.one_sided`).
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Collection, Mapping

import numpy as np
from numpy.typing import NDArray

from characterisation.point_cloud import ViewGrid
from characterisation.tasks.definitions import DEFINITIONS
from characterisation.tasks.result import Result
from characterisation.tasks.task_file import Task
from mitsim.scene.load import Scene, bounds_of
from mitsim.scene.ray_casting.raycast import Surfaces
from mitsim.sensor.transforms import Transform

#: number of plane waves of a field; chosen
_WAVES = 24

#: smallest cosine between normal and view ray, which bounds the displacement along the ray; chosen
_GRAZING = 0.1

#: width of the zone of a form tolerance, in standard deviations of the form. Assumed
_ZONE_SIGMAS = 4.0


def drawn_form(task: Task, stated_sizes: Mapping[str, float]) -> dict[str, float]:
    """Return the form deviation [mm], one sigma, by face: as stated, else a quarter of the tolerance of its form."""
    sizes = dict[str, float]()
    for name in form_measurements(task):
        asked = task.measurements[name]
        if asked.tolerance_size is not None:
            face = asked.features[0]
            sizes[face] = min(asked.tolerance_size / _ZONE_SIGMAS, sizes.get(face, np.inf))
    return sizes | dict(stated_sizes)


def form_measurements(task: Task) -> list[str]:
    """Return the names of the measurements of form: flatness and cylindricity."""
    return [name for name, measurement in task.measurements.items() if DEFINITIONS[measurement.kind].of == "form"]


def measured_with_form(
    task: Task, evaluate: Callable[[Task, bool], dict[str, Result]], deviates: bool
) -> dict[str, Result]:
    """Return all measurements of a cloud; those of form from the cloud without form deviation.

    Parameters
    ----------
    task
        The task.
    evaluate
        Measures a task in the cloud with or without form deviation.
    deviates
        Whether the cloud has a form deviation at all.
    """
    names = form_measurements(task) if deviates else []
    if not names:
        return evaluate(task, True)

    def part(wanted: Collection[str]) -> Task:
        return task.model_copy(update={"measurements": {name: task.measurements[name] for name in wanted}})

    other_names = [name for name in task.measurements if name not in names]
    results = evaluate(part(names), False) | (evaluate(part(other_names), True) if other_names else {})
    return {name: results[name] for name in task.measurements}


def form_deviation(
    points: NDArray[np.float32],
    surfaces: Surfaces,
    scene: Scene,
    sizes: Mapping[str, float],
    world_from_sensor: Transform,
    grid: ViewGrid,
    seed: int,
) -> NDArray[np.float32]:
    """Return points (H, W, 3) [mm], sensor frame, displaced along their rays by the form deviation of their faces.

    Parameters
    ----------
    points
        (H, W, 3) points [mm], sensor frame, NaN where there is none. They are not changed.
    surfaces
        Shape and normal that each pixel of the grid meets, sensor frame.
    scene
        Scene with the shapes.
    sizes
        Standard deviation of the form [mm] by name of a shape.
    world_from_sensor
        Pose of the sensor.
    grid
        View rays of the pixels.
    seed
        Selects the form; each face has its own field.
    """
    out = points
    for name, size in sizes.items():
        index = scene.names.index(name)
        here = (surfaces.shape == index) & np.isfinite(points[..., 2])
        if not here.any():
            continue
        positions = world_from_sensor.points(points[here].astype(float))
        extent = float(np.linalg.norm(np.ptp(bounds_of(scene.shapes[index]), axis=0)))
        height = size * random_field(positions, extent, np.random.default_rng([seed, zlib.crc32(name.encode())]))
        out = along_rays(out, here, height, surfaces, grid)
    return out


def along_rays(
    points: NDArray[np.float32],
    here: NDArray[np.bool_],
    height: NDArray[np.floating],
    surfaces: Surfaces,
    grid: ViewGrid,
) -> NDArray[np.float32]:
    """Return points of which some lie farther out along the normal of their face; they move along their rays.

    Parameters
    ----------
    points
        (H, W, 3) points [mm], sensor frame. They are not changed.
    here
        (H, W) pixels whose points move.
    height
        (n,) heights of these points [mm], toward the sensor.
    surfaces, grid
        Normal that each pixel meets, sensor frame, and the view rays of the pixels.
    """
    out = points.copy()
    rows, columns = np.nonzero(here)
    rays = grid.rays_at(columns, rows)
    cosine = np.maximum(np.abs((surfaces.normal[here] * rays).sum(axis=-1)), _GRAZING)
    out[here] -= (rays * (height / cosine)[:, None]).astype(np.float32)
    return out


def random_field(positions: NDArray[np.floating], extent: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return a smooth field of variance 1 at positions (n, 3) [mm]; wavelengths are 0.5 to 2 times ``extent`` [mm]."""
    waves = random_waves(_WAVES, extent, rng)
    phases = rng.uniform(0, 2 * np.pi, _WAVES)
    return np.asarray(np.sqrt(2 / _WAVES) * np.cos(positions @ waves.T + phases).sum(axis=1))


def random_waves(count: int, extent: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return wave vectors (count, 3) [rad/mm] of random directions; wavelengths are 0.5 to 2 times ``extent`` [mm]."""
    directions = rng.standard_normal((count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return np.asarray(directions * (2 * np.pi / (extent * rng.uniform(0.5, 2.0, (count, 1)))))
