"""Check a task against the scene: its features, their nominal geometry, and the nominal values of its measurements.

Signal chain: facts about the shapes (:mod:`mitsim.scene.inspect`), features and measurements of a task -> findings.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from pydantic import Field

from characterisation.features.surfaces import Cylinder
from characterisation.files.documents import Document, read_toml
from characterisation.files.errors import nearest
from characterisation.tasks.decision_table import Decision
from characterisation.tasks.task_file import Feature, Measurement, Task
from characterisation.tasks.task_reading import misstated, read_task
from mitsim.scene.authoring.face import surface_distance
from mitsim.scene.authoring.finding import SceneFinding, Severity
from mitsim.scene.inspect import SceneFacts, ShapeFacts

#: largest distance of nominal geometry from the shape's surface [mm]; beyond the second it is an error
NOMINAL_MM, MISTAKE_MM = 0.05, 1.0


class TaskFeatures(Document):
    """A task TOML that may have no measurements yet."""

    features: dict[str, Feature]
    measurements: dict[str, Measurement] = Field(default_factory=dict)
    decision: Decision = Decision()

    def measured_shapes(self) -> tuple[str, ...]:
        """Return the names of the shapes of the scene that measurements depend on, each once."""
        named = [self.features[name] for one in self.measurements.values() for name in one.features]
        of = (parent for feature in named for parent in feature.of or ())
        all_names = [*(name for one in self.measurements.values() for name in one.features), *of]
        return tuple(dict.fromkeys(name for name in all_names if self.features[name].shaped))


def read_features(path: str | Path) -> TaskFeatures:
    """Read a task, with or without measurements.

    Raises
    ------
    InputError
        If the file cannot be used, or a measurement does not fit its features.
    """
    task = read_toml(path, TaskFeatures)
    if task.measurements:
        read_task(path)
    return task


def task_findings(facts: SceneFacts, task: TaskFeatures) -> Iterator[SceneFinding]:
    """Yield findings about features and measurements of a task, against the shapes of the scene."""
    names = [shape.name for shape in facts.shapes]
    if not task.measurements:
        yield SceneFinding("note", "task", "it has no measurements yet", "Add a measurement before a study")
    for name, feature in task.features.items():
        if not feature.shaped:
            continue  # it is derived from others
        if name not in names:
            hint = nearest(name, names)
            advice = f"D{hint[1:]}" if hint else f"The shapes are: {', '.join(names)}"
            yield SceneFinding("error", name, "a feature of the task without a shape in the scene", advice)
        else:
            yield from _nominal(facts.shapes[names.index(name)], feature)
            yield from _bore(facts.shapes[names.index(name)], feature, task)
    if task.measurements:
        whole = Task(features=task.features, measurements=task.measurements, decision=task.decision)
        for name in whole.measurements:
            if fault := misstated(whole, name):
                value, allowed, hint = fault
                yield SceneFinding(
                    "error", name, f"the nominal value is {value}; allowed: {allowed}", hint[0].upper() + hint[1:]
                )


def _nominal(shape: ShapeFacts, feature: Feature) -> Iterator[SceneFinding]:
    """Yield a finding if the nominal geometry of a task does not lie on the shape of that name."""
    surface = feature.nominal()
    corners = shape.points if shape.mesh is None else shape.mesh.vertices
    worst = float(np.abs(surface_distance(surface, corners)).max(initial=0.0))
    if worst > NOMINAL_MM:
        severity: Severity = "error" if worst > MISTAKE_MM else "warning"
        what = f"the shape is up to {worst:.3g} mm off the nominal {feature.kind} of the task"
        advice = "All errors would be measured from there: correct its position, direction or radius"
        yield SceneFinding(severity, shape.name, what, advice)
    elif shape.mesh is not None:
        middles = shape.mesh.vertices[shape.mesh.triangles].mean(axis=1)
        sag = float(np.abs(surface_distance(surface, middles)).max(initial=0.0))
        if sag > NOMINAL_MM:
            what = f"facets deviate by up to {sag:.2g} mm from the nominal {feature.kind}"
            advice = "Mesh the part more finely: this is an error of the part, not of the sensor"
            yield SceneFinding("warning", shape.name, what, advice)


def _bore(shape: ShapeFacts, feature: Feature, task: TaskFeatures) -> Iterator[SceneFinding]:
    """Yield a note if a measurement uses the wall of a bore whose rim is no feature: a camera sees little of it."""
    if feature.kind != "cylinder" or not len(shape.points):
        return
    if shape.name not in {name for one in task.measurements.values() for name in one.features}:
        return
    surface = feature.nominal()
    assert isinstance(surface, Cylinder)
    across = shape.points - surface.point
    across -= np.outer(across @ surface.axis, surface.axis)
    if np.einsum("ij,ij->i", shape.normals, across).mean() >= 0 or any(
        _rim(one, surface) for one in task.features.values()
    ):
        return
    what = "a measurement uses the wall of this bore, of which a camera sees little"
    advice = 'If it has too few points, measure its rim, a feature of the kind "circle" in the face around it'
    yield SceneFinding("note", shape.name, what, advice)


def _rim(feature: Feature, bore: Cylinder) -> bool:
    """Return whether a feature is a circle about the axis of a bore."""
    if feature.kind != "circle":
        return False
    offset = np.array(feature.point_mm) - bore.point
    return float(np.linalg.norm(offset - (offset @ bore.axis) * bore.axis)) < NOMINAL_MM
