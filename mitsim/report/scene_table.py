"""Format the output of ``mitsim check``: shapes, materials and findings, as text or as data."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from characterisation.statements.verdict_words import named
from characterisation.words.numbers import aligned, or_none
from mitsim.scene.authoring.finding import SceneFinding
from mitsim.scene.inspect import SceneFacts, ShapeFacts
from mitsim.scene.visible_surfaces import VisibleSurfaces

#: number of rows of the table of shapes, unless more are measured; chosen
MOST_ROWS = 20

_NONE = "-"


def as_text(
    facts: SceneFacts,
    visible: VisibleSurfaces,
    findings: Sequence[SceneFinding],
    measured: Sequence[str] = (),
    every: bool = False,
) -> str:
    """Return tables of features and materials, then one line for each finding.

    Parameters
    ----------
    facts, visible, findings, measured
        Shapes of the scene, the surfaces that the sensor sees, and names of measured shapes, which come first.
    every
        Whether every shape has a row and every finding a line; else other shapes than the measured ones have rows up
        to :data:`MOST_ROWS` in all, and warnings and notes that differ in their shapes only share a line.
    """
    features = [("feature", "material", "Ra um", "area mm2", "size mm", "from mm", "to mm", "triangles", "seen px")]
    materials = [("material", "Ra um", "alpha u, v", "1-sigma", "from")]
    for number, shape in sorted(enumerate(facts.shapes), key=lambda item: item[1].name not in measured):
        material, roughness = _material(shape)
        low, high = shape.bounds
        area = f"{shape.area:.5g}" if math.isfinite(shape.area) else "not known"
        lengths = _lengths(high - low, " x "), _lengths(low, ", "), _lengths(high, ", ")
        triangles = str(len(shape.mesh.triangles)) if shape.mesh else _NONE
        pixels = str(int(((visible.shape == number) & visible.front & visible.seen_by_all).sum()))
        features.append((shape.name, material, roughness, area, *lengths, triangles, pixels))
        row = (material, roughness, _alpha(shape), _number(shape.alpha_factor, "x"), shape.provenance or _NONE)
        if row not in materials:
            materials.append(row)
    kept = len(features) if every else 1 + max(sum(shape.name in measured for shape in facts.shapes), MOST_ROWS)
    more = [f"and {len(features) - kept} more shapes; --all lists them"] if len(features) > kept else []
    told = findings if every else _joined(findings)
    lines = [*aligned(features[:kept]), *more, "", *aligned(materials), "", *map(str, told)]
    return "\n".join(lines if findings else [*lines, "no problems found"])


def _joined(findings: Sequence[SceneFinding]) -> list[SceneFinding]:
    """Merge warnings and notes that differ only in the shapes they are about; each stands where its first stood."""
    about: dict[tuple[Any, ...], list[str]] = {}
    for finding in findings:
        alone = finding.about if finding.severity == "error" else None
        about.setdefault((finding.severity, finding.what, finding.advice, alone), []).append(finding.about)
    return [
        SceneFinding(severity, named(names), words, advice) for (severity, words, advice, _), names in about.items()
    ]


def as_data(facts: SceneFacts, visible: VisibleSurfaces, findings: Sequence[SceneFinding]) -> dict[str, Any]:
    """Return the same as data; lengths in mm, null without a value."""
    shapes = []
    for number, shape in enumerate(facts.shapes):
        mine = (visible.shape == number) & visible.front
        finish = shape.finish
        shapes.append(
            {
                "name": shape.name,
                "type": shape.kind,
                "bsdf": shape.bsdf,
                "finish": finish.name if finish else None,
                "Ra_um": or_none(finish.roughness) if finish else None,
                "alpha_u": or_none(shape.alpha[0]),
                "alpha_v": or_none(shape.alpha[1]),
                "alpha_factor": or_none(shape.alpha_factor),
                "provenance": shape.provenance or None,
                "lay": shape.lay,
                "area_mm2": or_none(shape.area),
                "bounds_mm": shape.bounds.tolist(),
                "triangles": len(shape.mesh.triangles) if shape.mesh else None,
                "closed": shape.mesh.closed if shape.mesh else None,
                "lamp": shape.emitter,
                "pixels": int(mine.sum()),
                "pixels_seen_by_all": int((mine & visible.seen_by_all).sum()),
            }
        )
    return {
        "bounds_mm": facts.bounds.tolist(),
        "features": shapes,
        "emitters": [{"type": kind, "flux_w": or_none(flux)} for kind, flux in facts.emitters],
        "findings": [asdict(finding) for finding in findings],
    }


def _material(shape: ShapeFacts) -> tuple[str, str]:
    if shape.finish is None:
        return ("lamp" if shape.emitter else shape.bsdf), _NONE
    return shape.finish.name, _number(shape.finish.roughness)


def _alpha(shape: ShapeFacts) -> str:
    u, v = shape.alpha
    if not math.isfinite(u):
        return _NONE
    return f"{u:.3g}" if u == v else f"{u:.3g}, {v:.3g}"


def _number(value: float, before: str = "") -> str:
    return f"{before}{value:g}" if math.isfinite(value) else _NONE


def _lengths(values: np.ndarray, between: str) -> str:
    return between.join(f"{round(float(value), 2) + 0.0:g}" for value in values)
