"""Write ``report.html``, one self-contained page, from the folder of a run.

Signal chain: run folder -> results (:mod:`mitsim.report.findings`, :mod:`mitsim.report.agreement`) and pictures
(:mod:`mitsim.report.page_pictures`) -> the template ``page.html.j2``, which escapes all names given by a user -> one
HTML file. It opens without a network. Views are sorted by their predicted standard uncertainty u, with the talk's view
score V_m beside it.
"""

from __future__ import annotations

import html
import math
from pathlib import Path
from typing import Any

import numpy as np

from characterisation.point_cloud import Status
from characterisation.scores.coverage import NORMAL_COVERAGE
from characterisation.tasks.covariance import LEAST_CHANCE, PERSISTENT_REACH_PX, PERSISTENT_TURN
from characterisation.words.numbers import NONE, count, listed, percent, quantity, rounded, two_digits
from mitsim.report import findings
from mitsim.report.agreement import Agreement, agreement, chance_level
from mitsim.report.cloud_figures import REASONS
from mitsim.report.first_rows import exact
from mitsim.report.first_screen import of_run
from mitsim.report.page_pictures import camera_view, cloud_picture, map_pictures, measurement_pictures
from mitsim.report.pose_texts import TOP, best_rows, expected_texts, pose_of_view, pose_texts
from mitsim.report.statement_section import rules_in_words, stated_rules, statement_section
from mitsim.report.templates import write_page
from mitsim.report.view_sphere import view_sphere
from mitsim.study.run_document import RunnerUp
from mitsim.study.run_folder import Run, read_run
from mitsim.study.scene_geometry import read_scene_geometry
from mitsim.study.virtual.race import ALL

#: largest number of rolls that are listed individually
MOST_LISTED = 8

#: how a user can recover missing points, by their status
REMEDIES: dict[Status, str] = {
    Status.VALID: "",
    Status.NO_SURFACE: "outside a rectified image: aim again, or move farther away",
    Status.OUT_OF_RANGE: "change the standoff; if only predicted: characterise more distances or incidence angles",
    Status.SATURATED: "shorten the exposure, or turn the highlight away from the cameras",
    Status.LOW_MODULATION: "lengthen the exposure, move nearer, or reduce the incidence angle",
    Status.SHADOWED: "choose a view from which the projector reaches the feature",
    Status.HIDDEN: "roll the sensor until the baseline lies along the feature, not across it",
    Status.AMBIGUOUS: "use a finer pattern, or a larger matching block",
    Status.PHASE_INCONSISTENT: "keep the part still, or use more images",
    Status.INTERREFLECTION: "choose a view in which shiny faces do not reflect light onto one another",
    Status.DROPPED: "the map predicts this loss for the finish: choose another view, or a duller finish",
    Status.UNCALIBRATED: "calibrate with boards that reach the corners, and with fewer distortion coefficients",
}


def write_report(folder: str | Path) -> Path:
    """Write ``report.html`` atomically into the folder of a finished run, and return its path.

    Raises InputError if a file of the run is missing or damaged; the message names the file.
    """
    run = read_run(folder)
    return write_page(run.folder / "report.html", "page.html.j2", page_content(run))


def page_content(run: Run) -> dict[str, Any]:
    """Return everything that the template shows, in its order."""
    scores, about, map_data = run.scores, run.about, run.performance_map.data
    agreements = {name: agreement(scores, run.checks, name) for name in run.measurements}
    best = about.leader if run.statement is None else run.statement.view
    return {
        "part": Path(about.scene).stem,
        "about": about,
        "features": _by_finish(about.features),
        "draws_lay": run.statement is not None and run.statement.draws_lay,
        "rules": "" if run.statement is None else rules_in_words(stated_rules(run.statement)),
        "standoff": _standoffs(run),
        "views": count(scores.sizes["view"]),
        "rolls": _rolls(run),
        "least_chance": percent(LEAST_CHANCE),
        "minimum_points": count(int(scores.attrs.get("minimum_points", 100))),
        "first": of_run(run, read_scene_geometry(run.folder)),
        "statement": None if run.statement is None else statement_section(run.statement),
        "stated_pose": None if best is None else pose_texts(pose_of_view(run, best)),
        "race_confidence": percent(about.confidence.get(ALL, 0.0)),
        "race_margin": percent(about.race_margin),
        "race_loss": percent(about.losses[ALL]) if ALL in about.losses else "",
        "runners_up": [_runner_up(run, up) for up in about.runners_up],
        "answers": [_answer(run, name) for name in run.measurements],
        "tolerances": bool(np.isfinite(scores["tolerance"].values).any()),
        "coverage": percent(NORMAL_COVERAGE),
        "agreements": [_agreement_row(name, comparison) for name, comparison in agreements.items()],
        "sphere": view_sphere(run),
        "map_pictures": list(map_pictures(run)),
        "measurement_pictures": [
            (name, list(measurement_pictures(run, name, comparison))) for name, comparison in agreements.items()
        ],
        "camera_views": [camera_view(run, view) for view in _spread(run.checked, 3)],
        "cloud_pictures": [cloud_picture(run, view) for view in _spread(run.checked, 2)],
        "reasons": _reason_rows(run),
        "tables": [_table(run, name) for name in run.measurements],
        "top": TOP,
        "map": map_data.attrs,
        "knows_area": bool("noise_area" in map_data and np.isfinite(map_data["noise_area"].values).any()),
        "bias_reach": f"{rounded(PERSISTENT_REACH_PX)} pixels, {rounded(math.degrees(PERSISTENT_TURN))}°",
        "faces_in_sight": [f"{name} ({percent(share)})" for name, share in about.faces_in_sight.items()],
        "residual": _residual(run),
        "total_seconds": rounded(sum(about.seconds.values())),
        "rounded": rounded,
    }


def _standoffs(run: Run) -> str:
    standoffs = run.scores["standoff_mm"].values
    ends = rounded(float(standoffs.min())), rounded(float(standoffs.max()))
    return " to ".join(dict.fromkeys(ends))


def _by_finish(features: dict[str, str]) -> dict[str, str]:
    """Group the names of the features by finish, since a part of sixteen faces has one or two finishes."""
    out = dict[str, list[str]]()
    for name, finish in features.items():
        out.setdefault(finish.replace(" um", "\N{NO-BREAK SPACE}µm"), []).append(name)
    return {finish: listed(names) for finish, names in out.items()}


def _rolls(run: Run) -> str:
    rolls = np.unique(run.scores["roll_deg"].values)
    if len(rolls) <= MOST_LISTED:
        return listed([f"{rounded(roll)}°" for roll in rolls])
    return f"{rounded(rolls[0])}° to {rounded(rolls[-1])}°"


def _residual(run: Run) -> dict[str, str] | None:
    residual = run.about.render_residual
    if residual is None:
        return None
    return {
        "noise": two_digits(residual.noise),
        "quadrature": two_digits(residual.quadrature),
        "outliers": percent(residual.outliers),
    }


def _spread(views: list[int], number: int) -> list[int]:
    """Return up to ``number`` items of a list, evenly from its first to its last."""
    last, number = len(views) - 1, min(number, len(views))
    return [views[round(last * i / max(number - 1, 1))] for i in range(number)]


def _answer(run: Run, name: str) -> dict[str, Any]:
    """Return the best view of one measurement from the race, or from the screening if none was raced."""
    entry, scores = run.about.measurements[name], run.scores.sel(measurement=name)
    nominal = exact(entry.nominal, entry.unit)
    best = run.about.leaders.get(name, findings.best_view(run.scores, name))
    row: dict[str, Any] = {"name": name, "features": ", ".join(entry.features), "nominal": nominal, "best": best}
    if best is None:
        return row
    risk = float(scores["measured_risk"].sel(view=best)) if "measured_risk" in scores else math.nan
    trials = int(scores["trials"].sel(view=best)) if "trials" in scores else 0
    measured = {
        "risk": quantity(risk, entry.unit) if math.isfinite(risk) else "not measured",
        "trials": count(trials),
        "confidence": percent(run.about.confidence.get(name, 0.0)),
    }
    return row | pose_texts(pose_of_view(run, best)) | expected_texts(run, name, best) | measured


def _runner_up(run: Run, up: RunnerUp) -> dict[str, Any]:
    stated = NONE if up.stated_ratio is None else rounded(up.stated_ratio, 2)
    texts = {"ratio": rounded(up.ratio, 2), "near": percent(up.near), "trials": count(up.trials), "stated": stated}
    return pose_texts(pose_of_view(run, up.view)) | texts


def _agreement_row(name: str, comparison: Agreement) -> dict[str, str]:
    size = "u too small" if comparison.optimistic else "u holds" if comparison.trials else ""
    interval = f"{percent(comparison.low)} to {percent(comparison.high)}, n = {comparison.trials}"
    return {
        "name": name,
        "count": f"{comparison.count} of {len(comparison.views)}",
        "spearman": rounded(comparison.spearman, 2),
        "score_spearman": rounded(comparison.score_spearman, 2),
        "chance": rounded(chance_level(comparison.count), 2),
        "coverage": percent(comparison.coverage),
        "interval": interval if comparison.trials else "",
        "ratio": two_digits(comparison.ratio),
        "order": comparison.order,
        "size": size,
    }


def _reason_rows(run: Run) -> list[dict[str, str]]:
    shares = findings.reason_shares((run.predicted(view), run.decoded(view)) for view in run.checked)
    return [
        {
            "colour": html.escape(REASONS[status][1]),
            "name": REASONS[status][0],
            "remedy": REMEDIES[status],
            "predicted": percent(predicted),
            "decoded": percent(decoded),
        }
        for status, (predicted, decoded) in shares.items()
    ]


def _table(run: Run, name: str) -> dict[str, Any]:
    entry, rows = run.about.measurements[name], best_rows(run, name)
    for row in rows:
        points = run.scores["n"].sel(view=int(row["view"]))
        row["points"] = [count(round(float(points.sel(feature=feature)))) for feature in entry.shapes]
        row["checked"] = int(row["view"]) in run.checked
    tolerance = math.isfinite(float(run.scores["tolerance"].sel(measurement=name)))
    return {"name": name, "features": entry.shapes, "tolerance": tolerance, "rows": rows}
