"""Make the interactive sphere of views, and the tables that replace it without scripts.

Signal chain: numbers and solids (:mod:`mitsim.report.view_data`), the script with its checksum, and a table of the best
views for readers without scripts -> ``view_sphere.html.j2``.

The script draws on 2D canvases with its own depth buffer. It uses no WebGL and no library, and loads nothing. The
page's security policy allows this one script only, by its SHA-256.

The page explains why a view is worse than the best one by factors whose product is the ratio of the two uncertainties
u. The feature that limits the view has n = n_alone R_f g points with mean noise sigma. Here n_alone is the number
expected in matt white without the rest of the part, R_f the share that the part does not hide, and g the share that the
finish returns:

    u / u_best = sqrt(n_best / n) (sigma / sigma_best) (remainder: geometry, other features, correlated noise)
"""

from __future__ import annotations

from typing import Any

from characterisation.tasks.covariance import LEAST_CHANCE
from characterisation.words.numbers import count, percent, quantity, rounded, two_digits
from mitsim.report import findings
from mitsim.report.first_rows import bias_words
from mitsim.report.pose_texts import expected_texts, pose_of_view, pose_texts
from mitsim.report.templates import joined_script, script_content
from mitsim.report.view_data import as_json, solids, view_data
from mitsim.study.run_document import TriedEntry, ViewSetEntry
from mitsim.study.run_folder import Run

#: views in the table that replaces the sphere
TOP = 10

#: in the order in which they are joined to one script
SCRIPTS = ("view_scene.js", "view_panel.js", "view_sphere.js", "view_controls.js")


def view_sphere(run: Run) -> dict[str, Any]:
    """Return the content of the sphere's section for the template."""
    about = view_data(run)
    clouds, bodies = solids(run)
    first = run.measurements[0] if run.measurements else ""
    return {
        "data": as_json(about | bodies),
        "clouds": clouds,
        "measurements": run.measurements,
        "first": first,
        "rows": _rows(run, first),
        "least_chance": percent(LEAST_CHANCE),
        "directions": count(max(about["views"]["site"], default=-1) + 1),
        "checked": run.checked,
        "sets": [_set_words(run, entry) for entry in run.about.view_sets],
        "shown": bodies["shown"],
        "part": bodies["part"],
    } | script_content(page_script())


def page_script() -> str:
    """Return the one script of the page."""
    return joined_script(SCRIPTS)


def _rows(run: Run, name: str) -> list[dict[str, str]]:
    """Return the best views of a measurement, for readers without scripts; the script writes all others."""
    if not name:
        return []
    numbers = run.scores["view"].values
    rows = list[dict[str, str]]()
    for rank, i in enumerate(findings.ranked_views(run.scores, name)[:TOP], 1):
        pose = pose_of_view(run, int(numbers[i]))
        texts = {"rank": str(rank), "standoff": rounded(pose.standoff_mm)}
        rows.append(pose_texts(pose) | expected_texts(run, name, pose.view) | texts)
    return rows


def _set_words(run: Run, entry: ViewSetEntry) -> dict[str, Any]:
    lines = []
    for name, limit in entry.limits.items():
        unit = run.about.measurements[name].unit if name in run.about.measurements else ""
        u = entry.uncertainty.get(name)
        reach = "" if entry.feasible.get(name, True) else ": not reached, even with all views together"
        lines.append(
            f"{name}: {quantity(u, unit)}, limit {quantity(limit, unit)}{reach}" + _confirmed_words(entry, name)
        )
    minimal = "proven" if entry.exact else "not proven: a smaller set may exist"
    return {
        "views": entry.views,
        "limits": lines,
        "exact": minimal,
        "joined": entry.joined,
        "tried": [_tried_words(tried) for tried in entry.tried if set(tried.views) != set(entry.views)],
    }


def _tried_words(tried: TriedEntry) -> str:
    """Describe a set that was measured and not chosen."""
    excess = "a measurement without a value" if tried.excess is None else f"{two_digits(tried.excess)} times a limit"
    views = f"{len(tried.views)} view{'s' if len(tried.views) > 1 else ''} ({', '.join(map(str, tried.views))})"
    return f"also measured: {views}, {excess}"


def _confirmed_words(entry: ViewSetEntry, name: str) -> str:
    """Describe the result of the virtual measurements of the set."""
    confirmed = entry.confirmed.get(name)
    if confirmed is None:
        return ""
    if confirmed.bias is None or confirmed.standard_uncertainty is None:
        return "; measured together it has no value"
    uncertainty = quantity(confirmed.standard_uncertainty, confirmed.unit)
    lost = f", no value in {percent(confirmed.without_value)}" if confirmed.without_value > 0 else ""
    bias = bias_words(confirmed.bias, confirmed.standard_uncertainty, confirmed.unit)
    return f"; measured together {confirmed.trials} times: {uncertainty}, bias {bias}{lost}"
