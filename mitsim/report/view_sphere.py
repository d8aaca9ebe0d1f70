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
from characterisation.words.numbers import SPACE, count, percent, quantity, two_digits
from mitsim.report.first_rows import bias_words
from mitsim.report.pose_texts import best_rows
from mitsim.report.set_words import views_in_words
from mitsim.report.templates import joined_script, script_content
from mitsim.report.view_data import as_json, solids, view_data
from mitsim.study.run_document import TriedEntry, ViewSetEntry
from mitsim.study.run_folder import Run

#: in the order in which they are joined to one script
SCRIPTS = ("view_scene.js", "view_panel.js", "view_sphere.js", "view_controls.js")


def view_sphere(run: Run) -> dict[str, Any]:
    """Return the content of the sphere's section for the template."""
    about, (clouds, bodies) = view_data(run), solids(run)
    first = run.measurements[0] if run.measurements else ""
    rows = best_rows(run, first) if first else []
    return {
        "data": as_json(about | bodies),
        "clouds": clouds,
        "measurements": run.measurements,
        "first": first,
        "rows": [row | {"standoff": row["standoff"].removesuffix(f"{SPACE}mm")} for row in rows],
        "least_chance": percent(LEAST_CHANCE),
        "directions": count(max(about["views"]["site"], default=-1) + 1),
        "checked": run.checked,
        "sets": [_set_words(run, entry) for entry in run.about.view_sets],
        "shown": bodies["shown"],
        "part": bodies["part"],
    } | script_content(joined_script(SCRIPTS))


def _set_words(run: Run, entry: ViewSetEntry) -> dict[str, Any]:
    lines = []
    for name, limit in entry.limits.items():
        unit = run.about.measurements[name].unit if name in run.about.measurements else ""
        reach = "" if entry.feasible.get(name, True) else ": not reached, even with all views together"
        line = f"{name}: {quantity(entry.uncertainty.get(name), unit)}, limit {quantity(limit, unit)}{reach}"
        lines.append(line + _confirmed_words(entry, name))
    return {
        "views": entry.views,
        "limits": lines,
        "exact": "proven" if entry.exact else "not proven: a smaller set may exist",
        "joined": entry.joined,
        "tried": [_tried_words(tried) for tried in entry.tried if set(tried.views) != set(entry.views)],
    }


def _tried_words(tried: TriedEntry) -> str:
    excess = "a measurement without a value" if tried.excess is None else f"{two_digits(tried.excess)} times a limit"
    return f"also measured: {views_in_words(tried.views)}, {excess}"


def _confirmed_words(entry: ViewSetEntry, name: str) -> str:
    confirmed = entry.confirmed.get(name)
    if confirmed is None:
        return ""
    if confirmed.bias is None or confirmed.standard_uncertainty is None:
        return "; measured together it has no value"
    uncertainty = quantity(confirmed.standard_uncertainty, confirmed.unit)
    lost = f", no value in {percent(confirmed.without_value)}" if confirmed.without_value > 0 else ""
    bias = bias_words(confirmed.bias, confirmed.standard_uncertainty, confirmed.unit)
    return f"; measured together {confirmed.trials} times: {uncertainty}, bias {bias}{lost}"
