"""Write the statement of a view as JSON values: ``statement.json``."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import Any

from characterisation.files.atomic_io import json_values
from characterisation.statements.statement import Statement
from characterisation.words.version import __version__
from mitsim.sensor.pattern import DotPattern
from mitsim.study.maker_accuracy import maker_sigma
from mitsim.study.session import Session
from mitsim.study.virtual.influences import influences
from mitsim.study.virtual.stated import StatedView
from mitsim.study.virtual.world import FRESH


def statement_document(session: Session, stated: StatedView) -> dict[str, Any]:
    """Return the statement as JSON values; see docs/reference/formats/statement.md."""
    study, unknowns, view = session.study, session.unknowns, stated.view
    flight = study.sensor.technology == "time_of_flight"
    table = unknowns.table.model_copy(
        update={
            "temperature": unknowns.table.temperature.model_copy(update={"expansion_per_kelvin": unknowns.expansion}),
            "calibration": unknowns.table.calibration.of_kind(flight),
            "finish": unknowns.table.finish.of_finishes(finish.name for finish in study.scene.finishes if finish),
        }
    )
    declared = influences(
        table,
        session.source,
        study.file.measure.light_path_depth,
        "coat" in unknowns.varied,
        flight,
        isinstance(study.sensor.pattern, DotPattern),
    )
    exposed = {} if stated.planned is None else {"exposure": asdict(stated.planned)}
    return exposed | {
        "schema_version": 1,
        "mitsim": __version__,
        "study": str(study.path),
        "sensor": study.sensor.name,
        "measured_by": session.source,
        "map_source": "" if study.performance_map is None else study.performance_map.data.attrs.get("source", ""),
        "seed": study.file.seed,
        "view": view.number,
        "world_from_sensor": view.world_from_sensor.matrix().tolist(),
        "coverage_probability": 0.95,
        "calibration": unknowns.calibration.source,
        "unknowns": table.model_dump(mode="json"),
        "measurements": {
            statement.measurement: _measurement(statement)
            | {"maker_sigma": maker_sigma(study.sensor, study.task.measurements[statement.measurement], view.standoff)}
            for statement in stated.statements
        },
        "influences": [asdict(influence) for influence in declared],
    }


def _measurement(statement: Statement) -> dict[str, Any]:
    lines = statement.budget
    table = {key: value for key, value in asdict(statement).items() if key not in ("measurement", "budget", "decided")}
    table["decision"] = None if statement.decided is None else asdict(statement.decided)
    table["budget"] = [asdict(line) | {"fresh": line.group in FRESH} for line in lines]
    finite = math.isfinite(statement.repeatability) and math.isfinite(statement.standard_uncertainty)
    table["after_repeats"] = {str(n): statement.after_repeats(n) for n in (1, 4, 16)} if finite else {}
    return {key: json_values(value) for key, value in table.items()}
