"""Form deviation of a real part: a smooth random deviation of its faces from their nominal geometry.

Signal chain: position on a face -> smooth random height -> less its least-squares plane, cylinder, sphere or cone over
the whole face -> scaled to a zone of a given width -> displacement of the point along its ray, by the distance that
matches the height along the normal.

The field is a sum of plane waves with random directions and phases. Their wavelengths are between half and twice the
extent of the face, since form, as opposed to waviness, is the deviation over the whole extent (ISO 1101, ISO 12781-1).
Each face has its own field.

Distances, angles and radii are those of the least-squares features of the real faces (ISO 17450-1). A height with a
mean or a tilt over a face would move its feature: the part would have another true value, and a sensor that measures
that value would be charged with the difference. The true value of every trial is the nominal one, because the heights
have no such part. A sensor that sees only a part of a face does not find the feature of the whole, and has an error.

The zone of a form tolerance, unless the study says otherwise, is filled by every trial: its width is the tolerance of
flatness or cylindricity. The form itself is measured without that deviation, since its statement is about a part at
the limit of the tolerance (:mod:`characterisation.statements.one_sided`).
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from characterisation.features.fits import LEAST_GATE_MM
from characterisation.features.surfaces import Surface, distances
from characterisation.features.vectors import dots
from characterisation.files.arrays import Floats
from characterisation.point_cloud import ViewGrid
from characterisation.tasks.definitions import DEFINITIONS
from characterisation.tasks.result import Result
from characterisation.tasks.task_file import Task
from mitsim.scene.load import Scene, bounds_of
from mitsim.scene.ray_casting.raycast import Surfaces
from mitsim.scene.ray_casting.triangles import places_over, triangles_by_shape
from mitsim.sensor.transforms import Transform

#: number of plane waves of a field; chosen
_WAVES = 24

#: smallest cosine between normal and view ray, which bounds the displacement along the ray; chosen
_GRAZING = 0.1

#: width of the zone of a form in units of its size: that of 95 % of normal heights, in standard deviations
_ZONE_SIZES = 4.0

#: longest edge, in extents of a face, of the triangles on which its feature and zone are found: an eighth of the
#: shortest wave; chosen
_LONGEST_EDGE = 1 / 16


def drawn_form(task: Task, stated_sizes: Mapping[str, float]) -> dict[str, float]:
    """Return a quarter of the zone of the form [mm], by face: as stated, else that of the tolerance of its form."""
    sizes = dict[str, float]()
    for name in form_measurements(task):
        asked = task.measurements[name]
        if asked.tolerance_size is not None:
            face = asked.features[0]
            sizes[face] = min(asked.tolerance_size / _ZONE_SIZES, sizes.get(face, np.inf))
    return sizes | dict(stated_sizes)


def form_measurements(task: Task) -> list[str]:
    """Return the names of the measurements of form: flatness and cylindricity."""
    return [name for name, measurement in task.measurements.items() if DEFINITIONS[measurement.kind].of == "form"]


def measured_with_form(
    task: Task, evaluate: Callable[[Task, bool], dict[str, Result]], deviates: bool
) -> dict[str, Result]:
    """Return all measurements of a cloud; those of form from ``evaluate`` without form, if the cloud ``deviates``."""
    names = form_measurements(task) if deviates else []
    if not names:
        return evaluate(task, True)

    def part(wanted: Collection[str]) -> Task:
        return task.model_copy(update={"measurements": {name: task.measurements[name] for name in wanted}})

    other_names = [name for name in task.measurements if name not in names]
    results = evaluate(part(names), False) | (evaluate(part(other_names), True) if other_names else {})
    return {name: results[name] for name in task.measurements}


@dataclass(frozen=True)
class FaceForm:
    """Form deviation of a face of any draw: a zone about its least-squares feature."""

    name: str  # of the face, and its nominal ``surface``, part frame
    surface: Surface
    zone: float  # width [mm], from the lowest to the highest place of the face
    extent: float  # of the face [mm]
    places: Floats  # (n, 3) [mm] all over the face, part frame, and the ``areas`` (n,) that they stand for
    areas: Floats

    def heights(self, positions: NDArray[np.floating], seed: int) -> Floats:
        """Return heights (n,) [mm] along the normals of the nominal surface at positions (n, 3) [mm], part frame."""
        everywhere = np.concatenate([self.places, positions])
        rng = np.random.default_rng([seed, zlib.crc32(self.name.encode())])
        field = random_field(everywhere, self.extent, rng)
        _, changes, _ = self.surface.linearised(np.zeros(self.surface.parameter_count), everywhere, None)
        count, weights = len(self.places), np.sqrt(self.areas)
        feature = np.linalg.lstsq(weights[:, None] * changes[:count], weights * field[:count], rcond=None)[0]
        field -= changes @ feature
        return np.asarray(field[count:] * (self.zone / np.ptp(field[:count])))


def forms_of_faces(scene: Scene, task: Task, sizes: Mapping[str, float]) -> list[FaceForm]:
    """Return the forms of the faces of a task that deviate, by their quarters of a zone [mm]; no other is measured."""
    sizes = {name: size for name, size in sizes.items() if size > 0 and name in task.shapes}
    corners = triangles_by_shape(scene) if sizes else {}
    forms = []
    for name, size in sizes.items():
        if name not in corners:  # it reflects no light
            continue
        surface = task.features[name].nominal()
        extent = float(np.linalg.norm(np.ptp(bounds_of(scene.shapes[scene.names.index(name)]), axis=0)))
        places, areas = places_over(corners[name], extent * _LONGEST_EDGE)
        near = np.abs(distances(surface, places, None)[0]) <= LEAST_GATE_MM
        if near.any():  # a shape may have other faces, too
            places, areas = places[near], areas[near]
        forms.append(FaceForm(name, surface, _ZONE_SIZES * size, extent, places, areas))
    return forms


@dataclass(frozen=True)
class SeenFaces:
    """Faces of a ``scene`` that the pixels of a ``grid`` meet: ``surfaces``, in the frame of the sensor."""

    scene: Scene
    surfaces: Surfaces
    world_from_sensor: Transform
    grid: ViewGrid

    def raised(
        self, points: NDArray[np.float32], here: NDArray[np.bool_], height: NDArray[np.floating]
    ) -> NDArray[np.float32]:
        """Return points (H, W, 3) [mm], sensor frame, raised along rays ``here`` (H, W) by ``height`` (n,) normally."""
        out = points.copy()
        rows, columns = np.nonzero(here)
        rays = self.grid.rays_at(columns, rows)
        cosine = np.maximum(np.abs((self.surfaces.normal[here] * rays).sum(axis=-1)), _GRAZING)
        out[here] -= (rays * (height / cosine)[:, None]).astype(np.float32)
        return out


def form_deviation(
    points: NDArray[np.float32], seen: SeenFaces, forms: Iterable[FaceForm], seed: int
) -> NDArray[np.float32]:
    """Return points (H, W, 3) [mm], sensor frame, displaced along their rays by the form deviation of their faces.

    - ``points``: (H, W, 3) points [mm], sensor frame, NaN where there is none. They are not changed.
    - ``seen``: faces that the pixels meet.
    - ``forms``: forms of the faces that deviate.
    - ``seed``: selects the form; each face has its own field.
    """
    out, pose = points, seen.world_from_sensor
    for form in forms:
        here = (seen.surfaces.shape == seen.scene.names.index(form.name)) & np.isfinite(points[..., 2])
        if not here.any():
            continue
        positions = pose.points(points[here].astype(float))
        toward_sensor = pose.directions(seen.surfaces.normal[here].astype(float))
        # a sheet that rises on one side falls on the other
        side = np.where(dots(form.surface.meet(positions, None).normal, toward_sensor) < 0, -1.0, 1.0)
        out = seen.raised(out, here, side * form.heights(positions, seed))
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
