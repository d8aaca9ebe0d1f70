"""One self-contained page, ``report.html``, from the folder of a run.

Signal chain: run folder -> what it says (:mod:`mitsim.report.findings`) and shows (the figures) -> the template
``page.html.j2`` -> one HTML file without scripts, fonts or images of its own anywhere else: it opens from a disk
without a network, in light and dark. The sphere of views (:mod:`mitsim.report.view_sphere`) is the one part of it that
needs a script, and brings it along. Whatever a user named is text to the template, never markup.
"""

from __future__ import annotations

import html
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from characterisation.point_cloud import Status
from characterisation.whole_files import written_whole
from mitsim.report import figures, findings
from mitsim.report.cloud_figures import REASONS, camera_images, cloud_figure
from mitsim.report.numbers import count, finish_name, listed, percent, quantity, rounded, two_digits, unit_symbol
from mitsim.report.run_folder import Run, read_run
from mitsim.report.style import Picture, as_svg
from mitsim.report.view_figures import agreement_figure, score_figure
from mitsim.report.view_sphere import view_sphere

#: rows of the ranked table that are printed; scores.csv has them all
TOP = 10

#: rolls that are told one by one
MOST_LISTED = 8

#: said where the checked views confirm the order that the score gives
CONFIRMED = "higher score, smaller error"

#: what a user can do about a missing point
REMEDIES: dict[Status, str] = {
    Status.VALID: "",
    Status.NO_SURFACE: "outside an image after rectification: aim again, or stand farther away",
    Status.OUT_OF_RANGE: "change the standoff; in a prediction also: characterise steeper or farther than the map does",
    Status.SATURATED: "shorten the exposure, or turn the highlight away from the cameras",
    Status.LOW_MODULATION: "lengthen the exposure, come nearer, or look less steeply",
    Status.SHADOWED: "choose a view from which the projector reaches the feature",
    Status.HIDDEN: "roll the sensor, so that the baseline lies along the feature and not across it",
    Status.AMBIGUOUS: "a finer pattern, or a larger matching block",
    Status.PHASE_INCONSISTENT: "keep the part still, or use more images",
    Status.INTERREFLECTION: "choose a view in which shiny faces do not light one another",
    Status.DROPPED: "foreseen by the map for this finish: another view, or a duller finish",
}


def write_report(folder: str | Path) -> Path:
    """Write ``report.html`` into the folder of a finished run, whole or not at all; returns its path.

    Raises
    ------
    InputError
        If a file of the run is missing or damaged; the file is named.
    """
    run = read_run(folder)
    loader = FileSystemLoader(Path(__file__).parent)
    environment = Environment(
        loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    text = environment.get_template("page.html.j2").render(page_content(run))
    path = run.folder / "report.html"
    with written_whole(path) as file:
        file.write_text(text, encoding="utf-8")
    return path


def page_content(run: Run) -> dict[str, Any]:
    """Everything that the template shows, in its order."""
    scores, about = run.scores, run.about
    agreements = {name: findings.agreement(scores, run.checks, name) for name in run.measurements}
    ratios = [found.ratio for found in agreements.values() if math.isfinite(found.ratio)]
    rows = [_agreement_row(run, name, found) for name, found in agreements.items()]
    shown = _spread(run.checked, 3)
    return {
        "part": Path(about.scene).stem,
        "about": about,
        "features": {name: finish.replace(" um", "\N{NO-BREAK SPACE}µm") for name, finish in about.features.items()},
        "standoff": _standoffs(run),
        "views": count(scores.sizes["view"]),
        "rolls": _rolls(run),
        "minimum_points": count(int(scores.attrs.get("minimum_points", 100))),
        "answers": [_answer(run, name, agreements[name]) for name in run.measurements],
        "for_all": _for_all(run),
        "ratio": two_digits(float(np.median(ratios))) if ratios else "",
        "optimistic": bool(ratios) and float(np.median(ratios)) > 2,
        "agreements": rows,
        "sphere": view_sphere(run),
        "confirmed": sum(row["verdict"] == CONFIRMED for row in rows),
        "map_pictures": list(_map_pictures(run)),
        "measurement_pictures": [
            (name, list(_measurement_pictures(run, name, found))) for name, found in agreements.items()
        ],
        "camera_views": [_camera_view(run, view) for view in shown],
        "cloud_pictures": [_cloud_picture(run, view) for view in _spread(run.checked, 2)],
        "reasons": _reason_rows(run),
        "tables": [_table(run, name) for name in run.measurements],
        "top": TOP,
        "map": run.performance_map.data.attrs,
        "residual": _residual(run),
        "total_seconds": rounded(sum(about.seconds.values())),
        "rounded": rounded,
    }


def _standoffs(run: Run) -> str:
    if math.isfinite(run.standoff) or "standoff_mm" not in run.scores:
        return rounded(run.standoff)
    known = run.scores["standoff_mm"].values
    return f"{rounded(float(known.min()))} to {rounded(float(known.max()))}"


def _rolls(run: Run) -> str:
    known = np.unique(run.scores["roll_deg"].values)
    if len(known) <= MOST_LISTED:
        return listed([f"{rounded(roll)}°" for roll in known])
    return f"{rounded(known[0])}° to {rounded(known[-1])}°"


def _residual(run: Run) -> dict[str, str] | None:
    known = run.about.render_residual
    if known is None:
        return None
    return {
        "noise": two_digits(known.noise), "quadrature": two_digits(known.quadrature),
        "outliers": percent(known.outliers),
    }  # fmt: skip


def _spread(views: list[int], number: int) -> list[int]:
    """Some of a list, evenly from its first to its last."""
    last, number = len(views) - 1, min(number, len(views))
    return [views[round(last * i / max(number - 1, 1))] for i in range(number)]


def _pose(run: Run, view: int) -> dict[str, str]:
    """Pose of a view as texts: angles in deg, position in mm, both in the part's frame."""
    here = run.scores.sel(view=view)
    position = here["world_from_sensor"].values[:3, 3]
    return {
        "view": str(view),
        "azimuth": f"{rounded(float(here['azimuth_deg']))}°",
        "elevation": f"{rounded(float(here['elevation_deg']))}°",
        "roll": f"{rounded(float(here['roll_deg']))}°",
        "position": ", ".join(rounded(float(x)) for x in position),
    }


def _pose_words(run: Run, view: int) -> str:
    pose = _pose(run, view)
    return f"azimuth {pose['azimuth']}, elevation {pose['elevation']}, roll {pose['roll']}"


def _answer(run: Run, name: str, found: findings.Agreement) -> dict[str, Any]:
    entry = run.about.measurements[name]
    nominal = f"{entry.nominal:g}{'°' if entry.unit == 'deg' else ' ' + entry.unit}"
    best = findings.best_view(run.scores, name)
    row: dict[str, Any] = {"name": name, "features": ", ".join(entry.features), "nominal": nominal, "best": best}
    if best is None:
        return row
    here = run.scores.sel(measurement=name, view=best)
    rendered = "not rendered"
    if best in found.views:
        error = float(found.error[list(found.views).index(best)])
        rendered = quantity(error, entry.unit) if math.isfinite(error) else "not measurable"
    u = float(here["predicted_standard_uncertainty"])
    return row | _pose(run, best) | {
        "score": rounded(float(here["V_m"]), 2), "uncertainty": quantity(u, entry.unit), "rendered": rendered,
    }  # fmt: skip


def _for_all(run: Run) -> dict[str, str] | None:
    found = findings.view_for_all(run.scores)
    return None if found is None else _pose(run, found[0]) | {"mean_rank": rounded(found[1], 1)}


def _agreement_row(run: Run, name: str, found: findings.Agreement) -> dict[str, str]:
    level = findings.chance_level(found.count)
    return {
        "name": name,
        "spearman": rounded(found.spearman, 2),
        "chance": rounded(level, 2),
        "count": f"{found.count} of {len(found.views)}",
        "ratio": two_digits(found.ratio),
        "verdict": _verdict(found, level),
    }


def _verdict(found: findings.Agreement, level: float) -> str:
    if not math.isfinite(found.spearman):
        return "too few views to tell"
    if abs(found.spearman) < level:
        return "could be chance"
    return CONFIRMED if found.spearman < 0 else "higher score, larger error: do not trust it"


def _picture(figure: Any, alt: str, caption: str) -> Picture:
    return Picture(Markup(as_svg(figure, alt)), caption)


def _map_pictures(run: Run) -> Iterator[tuple[str, Picture]]:
    performance_map = run.performance_map
    distances = performance_map.data["distance"].values
    # of the standoff, if it is known: that is what the views were scored with
    target = run.standoff if math.isfinite(run.standoff) else float(np.median(distances))
    middle = int(np.abs(distances - target).argmin())
    order = figures.matt_to_shiny(performance_map.samples)
    names = [finish_name(*performance_map.samples[i]).replace(", ", " ") for i in order]
    half = [math.degrees(findings.half_recovery_incidence(performance_map, i, middle)) for i in order]
    falls = [f"{rounded(angle)}° on {name}" for angle, name in zip(half, names, strict=True) if angle > 0]
    holds = [name for angle, name in zip(half, names, strict=True) if math.isnan(angle)]
    lost = [name for angle, name in zip(half, names, strict=True) if angle == 0]
    parts = [f"falls below one half beyond {listed(falls)}"] if falls else []
    parts += [f"stays above it on {listed(holds)}"] if holds else []
    parts += [f"never reaches it on {listed(lost)}"] if lost else []
    caption = (
        f"Bright means that nearly every point comes back: at {distances[middle]:g} mm, averaged over the tilt "
        f"direction, F {', '.join(parts)} as the surface tilts away."
    )
    alt = f"Discs of recovered fraction over surface orientation for {listed(names)} at several distances"
    yield "Fraction of points recovered", _picture(figures.fraction_figure(performance_map), alt, caption)

    low, high = figures.noise_limits(performance_map)
    medians = [findings.median_noise(performance_map, i, middle, math.radians(45)) for i in order]
    told = [f"{two_digits(s)} mm on {name}" for s, name in zip(medians, names, strict=True) if math.isfinite(s)]
    caption = (
        f"Dark means little noise: at {distances[middle]:g} mm and up to 45° of incidence the median of σ is "
        f"{listed(told) or 'not known'} (colours are logarithmic and end at the {figures.NOISE_PERCENTILES[0]}nd and "
        f"{figures.NOISE_PERCENTILES[1]}th percentile, {two_digits(low)} and {two_digits(high)} mm)."
    )
    alt = f"Discs of noise along the view ray over surface orientation for {listed(names)} at several distances"
    yield "Noise along the view ray", _picture(figures.noise_figure(performance_map), alt, caption)

    if run.patches is not None:
        caption = (
            "Each coloured cell is an orientation at which pieces of a coupon were measured: between them the map is "
            "pooled from the neighbours, beyond them it gives no answer."
        )
        alt = "Discs of the number of measured patches over surface orientation for each sample"
        yield "Where coupons were measured", _picture(figures.patches_figure(run.patches), alt, caption)


def _measurement_pictures(run: Run, name: str, found: findings.Agreement) -> Iterator[Picture]:
    best = findings.best_view(run.scores, name)
    possible = int(run.scores["possible"].sel(measurement=name).values.sum())
    total = run.scores.sizes["view"]
    if best is None:
        limits = run.scores["limited_by"].sel(measurement=name).values.astype(str)
        worst, times = np.unique(limits, return_counts=True)
        caption = f"No view can make this measurement; most often for want of points on {worst[times.argmax()]}."
    else:
        caption = (
            f"{count(possible)} of {count(total)} views can make this measurement, and view {best} "
            f"({_pose_words(run, best)}) scores highest."
        )
    alt = f"View score of {name} on the sphere of views, seen from above. {caption}"
    yield _picture(score_figure(run.scores, name, run.checked, best), alt, caption)
    if not run.checked:
        return
    level = findings.chance_level(found.count)
    words = {
        "too few views to tell": "too few views were measurable to say whether the score orders them",
        "could be chance": f"the order of the {found.count} that were measurable proves nothing, since a rank "
        f"correlation within ±{rounded(level, 2)} could be chance",
        CONFIRMED: "the score orders the views as it should: higher score, smaller error",
    }.get(_verdict(found, level), "the score orders the views the wrong way round: higher score, larger error")
    tail = ""
    if math.isfinite(found.ratio):
        beyond = "more than noise alone explains" if found.ratio > 2 else "what its own noise explains"
        tail = f"; the typical error is {two_digits(found.ratio)} times the predicted standard uncertainty, {beyond}"
    caption = f"In the rendered views {words}{tail}."
    unit = run.about.measurements[name].unit
    alt = f"True error of {name} against view score and against predicted standard uncertainty. {caption}"
    yield _picture(agreement_figure(found, unit), alt, caption)


def _camera_view(run: Run, view: int) -> dict[str, Any]:
    capture = run.capture(view)
    images, stretch = camera_images(capture)
    rank = float(run.scores["rank"].sel(view=view).values.mean())
    able = int(run.scores["possible"].sel(view=view).values.sum())
    caption = f"View {view}: {_pose_words(run, view)}; mean rank {rounded(rank, 1)} of {run.scores.sizes['view']}, "
    caption += f"{able} of {len(run.measurements)} measurements possible ({capture.source}; {stretch})."
    return {
        "images": [
            (name, uri, f"{name} camera, view {view}, {_pose_words(run, view)}") for name, uri in images.items()
        ],
        "caption": caption,
    }


def _cloud_picture(run: Run, view: int) -> Picture:
    predicted, decoded = run.predicted(view), run.decoded(view)
    shares = findings.reason_shares([(predicted, decoded)])
    one, other = shares.get(Status.VALID, (0.0, 0.0))
    lost = [status for status in shares if status != Status.VALID]
    why = ""
    if lost:
        reason = max(lost, key=lambda status: shares[status][1])
        why = f", and where none does it is mostly “{REASONS[reason][0]}” ({percent(shares[reason][1])})"
    caption = (
        f"View {view}: of the pixels in which the part could be seen, {percent(one)} give a point in the prediction "
        f"and {percent(other)} in the decoded images{why}."
    )
    alt = f"Depth and reasons of the predicted and the decoded cloud. {caption}"
    return _picture(cloud_figure(predicted, decoded), alt, caption)


def _reason_rows(run: Run) -> list[dict[str, str]]:
    shares = findings.reason_shares((run.predicted(view), run.decoded(view)) for view in run.checked)
    return [
        {
            "colour": html.escape(REASONS[status][1]), "name": REASONS[status][0], "remedy": REMEDIES[status],
            "predicted": percent(one), "decoded": percent(other),
        }
        for status, (one, other) in shares.items()
    ]  # fmt: skip


def _table(run: Run, name: str) -> dict[str, Any]:
    here = run.scores.sel(measurement=name)
    features = run.about.measurements[name].features
    unit = run.about.measurements[name].unit
    first = np.argsort(here["rank"].values)[:TOP]
    rows = []
    for i in first[here["possible"].values[first]]:
        one = here.isel(view=int(i))
        u = float(one["predicted_standard_uncertainty"])
        rows.append(
            _pose(run, int(one["view"]))
            | {
                "rank": int(one["rank"]),
                "score": rounded(float(one["V_m"]), 2),
                "uncertainty": two_digits(u),
                "points": [count(round(float(one["n"].sel(feature=feature)))) for feature in features],
                "checked": int(one["view"]) in run.checked,
            }
        )
    return {"name": name, "features": features, "unit": unit_symbol(unit), "rows": rows}
