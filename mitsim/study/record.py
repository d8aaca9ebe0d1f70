"""Make the record of a run, ``run.json``: what was run, the outcome, and the digests of the files of a report."""

from __future__ import annotations

import os
import platform
from dataclasses import asdict, dataclass
from typing import Any

from characterisation.maps.performance_map import PerformanceMap
from characterisation.scores.view_sets import ViewSet
from mitsim.capture.simulated.render_residual import RenderResidual
from mitsim.running.version import __version__
from mitsim.scene.surface.lay import lay_left_out
from mitsim.study import Study, finishes_of_features
from mitsim.study.view_sets.confirmed_set import TriedSet, confirmed_entry, joining_in_words, tried_entries
from mitsim.study.virtual.race import Raced


def own_files(study: Study, drawn: list[int], shown: list[int], stated: bool) -> list[str]:
    """Return the paths of the files that a report of the run reads.

    The index of a capture has the digests of its other files.
    """
    names = ["map.nc", "scores.csv", "scores.nc", "checks.nc", "part.ply", "stand.npz"]
    names += ["samples.nc"] if study.campaign is not None else []
    names += ["statement.json"] if stated else []
    names += [f"clouds/predicted_{view:04d}.ply" for view in drawn]
    names += [f"clouds/rendered_{view:04d}.ply" for view in shown]
    return names + [f"captures/view_{view:04d}/capture.json" for view in shown]


@dataclass(frozen=True)
class Outcome:
    """Outcome of a run: the race, views whose pictures were ``checked``, the set and those ``tried``.

    ``residual`` is the worst of the renderings, ``seconds`` the wall time of each step [s].
    """

    raced: Raced
    checked: list[int]
    chosen: ViewSet | None
    tried: list[TriedSet]
    residual: RenderResidual | None
    seconds: dict[str, float]


def run_record(study: Study, performance_map: PerformanceMap, outcome: Outcome) -> dict[str, Any]:
    """Return the record of a run without the digests of its files."""
    raced, chosen, residual = outcome.raced, outcome.chosen, outcome.residual
    finishes = finishes_of_features(study)
    lays = {name: lay_left_out(one.name, one.scatter) for name, one in finishes.items() if one is not None}
    return {
        "schema_version": 1,
        "mitsim": __version__,
        "study": str(study.path),
        "scene": study.scene.where,
        "sensor": study.sensor.name,
        "source": "simulated",
        "map_source": performance_map.data.attrs.get("source", ""),
        "exposure_rule": study.sensor.exposure.rule,
        "seed": study.file.seed,
        "views": len(study.views),
        "view_sets": [] if chosen is None else [_set_in_words(study, chosen, outcome.tried)],
        "checked_views": outcome.checked,
        "raced_views": len(raced.views),
        "race_trials": raced.trials,
        "race_decided": raced.decided,
        "leaders": raced.leaders(),
        "confidence": {name: one.confidence for name, one in raced.standings.items()},
        "light_path_depth": study.file.measure.light_path_depth,
        "score_light_path_depth": study.file.score.light_path_depth,
        "render_residual": None if residual is None else asdict(residual),
        "features": {name: str(one) for name, one in finishes.items()},
        "lay": {name: left_out for name, left_out in lays.items() if left_out is not None},
        "measurements": {
            name: {
                "kind": m.kind,
                "nominal": m.nominal,
                "unit": m.unit,
                "features": list(m.features),
                "tolerance": m.tolerance,
            }
            for name, m in study.task.measurements.items()
        },
        "seconds": outcome.seconds,
        "python": platform.python_version(),
        "machine": platform.machine(),
        "cores": os.cpu_count(),
    }


def _set_in_words(study: Study, chosen: ViewSet, tried: list[TriedSet]) -> dict[str, Any]:
    table = study.file.set
    assert table is not None
    limits, known = table.limits, table.pose_known
    return {
        "limits": limits,
        "views": list(chosen.views),
        "exact": chosen.exact,
        "uncertainty": dict(zip(limits, chosen.uncertainty.tolist(), strict=True)),
        "feasible": dict(zip(limits, chosen.feasible.tolist(), strict=True)),
        "joining": {"kind": table.joining, "position_mm": known[0], "angle_deg": known[1]},
        "joined": joining_in_words(table),
        "confirmed": confirmed_entry(tried[-1].stated if tried else ()),
        "tried": tried_entries(tried, limits),
    }
