"""Check a task against the scene: its features, their nominal geometry, and the nominal values of its measurements.

Signal chain: facts about the shapes (:mod:`mitsim.scene.inspect`), features and measurements of a task -> findings.
A study refuses errors among those about geometry, because errors of measurements are counted from there.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from pydantic import Field

from characterisation.features.surfaces import Cone, Cylinder, Plane
from characterisation.features.vectors import tangents
from characterisation.files.arrays import Floats
from characterisation.files.documents import Document, read_toml
from characterisation.files.errors import nearest
from characterisation.tasks.decision_table import Decision
from characterisation.tasks.task_file import Feature, Measurement, Task
from characterisation.tasks.task_reading import misstated, read_task
from characterisation.words.progress import say
from mitsim.scene.authoring.face import surface_distance
from mitsim.scene.authoring.finding import SceneFinding, Severity
from mitsim.scene.authoring.naming import ROUND, round_angle
from mitsim.scene.inspect import SceneFacts, ShapeFacts, shape_facts
from mitsim.scene.load import Scene

#: distance of nominal geometry from the shape's surface above which it is reported [mm]; chosen
NOMINAL_MM = 0.05

#: distance above which it is an error [mm]; chosen
MISTAKE_MM = 1.0

#: share of a circle that lies on the edge of its face; the end of a slot is half a circle
_ON_EDGE = 0.25

#: least width of an outline over that of its feature; chosen
_SHORTER = 0.5

#: largest width of an outline over that of its feature: the corners of a disc's lie on its rim; chosen
_LONGER = 1.1


class TaskFeatures(Document):
    """A task TOML that may have no measurements yet."""

    features: dict[str, Feature]
    measurements: dict[str, Measurement] = Field(default_factory=dict)
    decision: Decision = Decision()

    def measured_shapes(self) -> tuple[str, ...]:
        """Return the names of the shapes of the scene that measurements depend on, each once."""
        named = [self.features[name] for measurement in self.measurements.values() for name in measurement.features]
        of = (parent for feature in named for parent in feature.of or ())
        all_names = [*(name for measurement in self.measurements.values() for name in measurement.features), *of]
        return tuple(dict.fromkeys(name for name in all_names if self.features[name].shaped))


def read_features(path: str | Path) -> TaskFeatures:
    """Read a task, with or without measurements.

    Raises InputError if the file cannot be used, or a measurement does not fit its features.
    """
    task = read_toml(path, TaskFeatures)
    if task.measurements:
        read_task(path)
    return task


def task_findings(facts: SceneFacts, task: TaskFeatures) -> Iterator[SceneFinding]:
    """Yield findings about features and measurements of a task, against the shapes of the scene."""
    shapes = {shape.name: shape for shape in facts.shapes}
    if not task.measurements:
        yield SceneFinding("note", "task", "it has no measurements yet", "Add a measurement before a study")
    for name, feature in task.features.items():
        yield from _geometry(shapes, name, feature)
        if name in shapes and feature.shaped:
            yield from _bore(shapes[name], feature, task)
        elif feature.shaped:
            hint = nearest(name, list(shapes))
            advice = f"D{hint[1:]}" if hint else f"The shapes are: {', '.join(shapes)}"
            yield SceneFinding("error", name, "a feature of the task without a shape in the scene", advice)
    if task.measurements:
        whole = Task(features=task.features, measurements=task.measurements, decision=task.decision)
        for name in whole.measurements:
            if fault := misstated(whole, name):
                value, allowed, hint = fault
                yield SceneFinding(
                    "error", name, f"the nominal value is {value}; allowed: {allowed}", hint[0].upper() + hint[1:]
                )


def report_geometry(task: Task, scene: Scene) -> None:
    """Report nominal geometry that does not lie on the shapes of the scene: errors are counted from there."""
    shapes = {shape_fact.name: shape_fact for shape_fact in shape_facts(scene, set(task.shapes))}
    for name, feature in task.features.items():
        for finding in _geometry(shapes, name, feature):
            say(f"warning: {name}: {finding.what}. {finding.advice}")


def _geometry(shapes: dict[str, ShapeFacts], name: str, feature: Feature) -> Iterator[SceneFinding]:
    """Yield findings about a feature whose geometry does not lie on its shape, if the scene has that."""
    if not feature.shaped and feature.of and feature.of[0] in shapes:
        yield from _figure(shapes[feature.of[0]], name, feature)
    elif feature.shaped and name in shapes:
        yield from _nominal(shapes[name], feature)
        yield from _outline(shapes[name], feature)


def _figure(face: ShapeFacts, name: str, feature: Feature) -> Iterator[SceneFinding]:
    """Yield a finding if a circle or a point of an edge does not lie on the edge of its face."""
    if feature.kind not in ("circle", "edge_point") or face.mesh is None or not face.mesh.open_edges:
        return
    points, share = np.array([feature.point_mm], float), 1.0
    if feature.kind == "circle":
        normal = face.normals.mean(axis=0)
        angle = np.linspace(0, 2 * np.pi, 64, endpoint=False)[:, None]
        along, across = tangents(normal / np.linalg.norm(normal))
        points = points + float(feature.radius_mm or 0.0) * (np.cos(angle) * along + np.sin(angle) * across)
        share = _ON_EDGE
    start, end = np.moveaxis(face.mesh.open_edge_ends, 1, 0)
    way = end - start
    local = points[:, None] - start
    at = np.clip(np.einsum("ijk,jk->ij", local, way) / np.maximum((way**2).sum(axis=1), 1e-30), 0, 1)
    off = np.linalg.norm(local - at[..., None] * way, axis=-1).min(axis=1)
    worst = float(np.quantile(off, share))
    if worst > NOMINAL_MM:
        severity: Severity = "error" if worst > MISTAKE_MM else "warning"
        problem = f"the {feature.kind.replace('_', ' ')} is {worst:.3g} mm off the edge of {face.name}"
        advice = "Correct its point" + (" or radius_mm, half the diameter" if feature.kind == "circle" else "")
        yield SceneFinding(severity, name, problem, advice)


def _outline(shape: ShapeFacts, feature: Feature) -> Iterator[SceneFinding]:
    """Yield a finding if the outline of a plane or an axis is much smaller or larger than the shape."""
    if feature.outline_mm is None:
        return
    surface, corners = feature.nominal(), _corners(shape)
    if isinstance(surface, Plane):
        angle = np.pi * np.arange(4)[:, None] / 4
        along, across = tangents(surface.normal)
        ways = np.cos(angle) * along + np.sin(angle) * across
    else:
        assert isinstance(surface, Cylinder | Cone)
        ways = surface.axis[None]
    spans = np.ptp(np.array(feature.outline_mm) @ ways.T, axis=0), np.ptp(corners @ ways.T, axis=0)
    ratio = spans[0] / np.maximum(spans[1], 1e-9)
    worst = int(np.abs(np.log(np.maximum(ratio, 1e-9))).argmax())
    if ratio.min() < _SHORTER or ratio.max() > _LONGER:
        problem = (
            f"outline_mm spans {spans[0][worst]:.4g} mm in a direction in which the shape has {spans[1][worst]:.4g} mm"
        )
        yield SceneFinding(
            "warning", shape.name, problem, "Zones are evaluated over the outline: give the corners or ends"
        )


def _corners(shape: ShapeFacts) -> Floats:
    """Return points (n, 3) [mm] on a shape: the vertices of a mesh."""
    return shape.points if shape.mesh is None else shape.mesh.vertices


def _nominal(shape: ShapeFacts, feature: Feature) -> Iterator[SceneFinding]:
    """Yield a finding if the nominal geometry of a task does not lie on the shape of that name."""
    surface = feature.nominal()
    worst = float(np.abs(surface_distance(surface, _corners(shape))).max(initial=0.0))
    if worst > NOMINAL_MM:
        severity: Severity = "error" if worst > MISTAKE_MM else "warning"
        problem = f"the shape is up to {worst:.3g} mm off the nominal {feature.kind} of the task"
        advice = "All errors would be measured from there: correct its position, direction or radius"
        yield SceneFinding(severity, shape.name, problem, advice)
    elif shape.mesh is not None:
        middles = shape.mesh.vertices[shape.mesh.triangles].mean(axis=1)
        sag = float(np.abs(surface_distance(surface, middles)).max(initial=0.0))
        if sag > NOMINAL_MM:
            problem = f"facets deviate by up to {sag:.2g} mm from the nominal {feature.kind}"
            advice = "Mesh the part more finely: this is an error of the part, not of the sensor"
            yield SceneFinding("warning", shape.name, problem, advice)


def _bore(shape: ShapeFacts, feature: Feature, task: TaskFeatures) -> Iterator[SceneFinding]:
    """Yield a note if a measurement uses the wall of a bore whose rim is no feature: a camera sees little of it."""
    if feature.kind != "cylinder" or not len(shape.points):
        return
    if shape.name not in {name for measurement in task.measurements.values() for name in measurement.features}:
        return
    surface = feature.nominal()
    assert isinstance(surface, Cylinder)
    if round_angle(shape.points, surface.axis, surface.point) <= ROUND:
        return  # a fillet, or the end of a slot
    across = shape.points - surface.point
    across -= np.outer(across @ surface.axis, surface.axis)
    if np.einsum("ij,ij->i", shape.normals, across).mean() >= 0 or any(
        _rim(candidate, surface) for candidate in task.features.values()
    ):
        return
    problem = "a measurement uses the wall of this bore, of which a camera sees little"
    advice = 'If it has too few points, measure its rim, a feature of the kind "circle" in the face around it'
    yield SceneFinding("note", shape.name, problem, advice)


def _rim(feature: Feature, bore: Cylinder) -> bool:
    """Return whether a feature is a circle about the axis of a bore."""
    if feature.kind != "circle":
        return False
    offset = np.array(feature.point_mm) - bore.point
    return float(np.linalg.norm(offset - (offset @ bore.axis) * bore.axis)) < NOMINAL_MM
