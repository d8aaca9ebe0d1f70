"""Make the pictures of the page, each with a caption and an alternative text.

Signal chain: run folder and its results (:mod:`mitsim.report.findings`, :mod:`mitsim.report.agreement`) -> figures ->
inline SVG or PNG, and captions.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from markupsafe import Markup
from numpy.typing import ArrayLike

from characterisation.plots.discs import NOISE_PERCENTILES, noise_limits
from characterisation.point_cloud import Status
from characterisation.words.numbers import count, finish_name, listed, percent, quantity, rounded, two_digits
from mitsim.report import figures, findings
from mitsim.report.agreement import CHANCE, CONFIRMED, TOO_FEW, Agreement, chance_level
from mitsim.report.cloud_figures import REASONS, camera_images, cloud_figure
from mitsim.report.placement_figure import placement_figure
from mitsim.report.pose_texts import angles_in_words, pose_of_view
from mitsim.report.style import Picture, as_svg
from mitsim.report.view_data import LIMITS
from mitsim.report.view_figures import agreement_figure, uncertainty_figure
from mitsim.study.run_folder import Run
from mitsim.study.scene_geometry import SceneGeometry


def _picture(figure: Any, alt: str, caption: str) -> Picture:
    return Picture(Markup(as_svg(figure, alt)), caption)


def map_pictures(run: Run) -> Iterator[tuple[str, Picture]]:
    """Yield titles and pictures of the performance map, and of the patches behind it if the run made it."""
    performance_map = run.performance_map
    distances = performance_map.data["distance"].values
    # use the standoff, since the views were scored at it
    target = float(np.median(run.scores["standoff_mm"].values))
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
        f"Bright means that the sensor returns nearly every point. At {distances[middle]:g} mm, averaged over the tilt "
        f"direction, F {', '.join(parts)} as the surface tilts away."
    )
    alt = f"Discs of recovered fraction over surface orientation for {listed(names)} at several distances"
    yield "Fraction of points recovered", _picture(figures.fraction_figure(performance_map), alt, caption)

    low, high = noise_limits(performance_map.data["ray_noise_std"].values)
    medians = [findings.median_noise(performance_map, i, middle) for i in order]
    noises = [f"{two_digits(s)} mm on {name}" for s, name in zip(medians, names, strict=True) if math.isfinite(s)]
    caption = (
        f"Dark means little noise. At {distances[middle]:g} mm and up to {findings.NOISE_UP_TO_DEG:g}° of incidence "
        f"the median of σ is "
        f"{listed(noises) or 'not known'} (logarithmic colours from the {NOISE_PERCENTILES[0]}nd to the "
        f"{NOISE_PERCENTILES[1]}th percentile, {two_digits(low)} to {two_digits(high)} mm)."
    )
    alt = f"Discs of noise along the view ray over surface orientation for {listed(names)} at several distances"
    yield "Noise along the view ray", _picture(figures.noise_figure(performance_map), alt, caption)

    if run.patches is not None:
        caption = (
            "Each coloured cell is an orientation at which patches of a coupon were measured. Between them, neighbours "
            "give the map its values; beyond them the map has none."
        )
        alt = "Discs of the number of measured patches over surface orientation for each sample"
        yield "Where coupons were measured", _picture(figures.patches_figure(run.patches), alt, caption)


def measurement_pictures(run: Run, name: str, agreement: Agreement) -> Iterator[Picture]:
    """Yield the predicted uncertainty of a measurement from every view, and the errors in the checked views."""
    best, unit = findings.best_view(run.scores, name), run.about.measurements[name].unit
    if best is None:
        caption = f"No view can make this measurement; the most frequent reason: {_commonest_limit(run, name)}."
    else:
        here = run.scores.sel(measurement=name)
        able, total = int(here["uncertainty_possible"].values.sum()), run.scores.sizes["view"]
        u = quantity(float(here["predicted_uncertainty"].sel(view=best)), unit)
        caption = (
            f"{count(able)} of {count(total)} views can make this measurement, and view {best} "
            f"({angles_in_words(pose_of_view(run, best))}) is the best, with u = {u}. Bright means a small u."
        )
    alt = f"Predicted standard uncertainty of {name} over the sphere of views, seen from above. {caption}"
    yield _picture(uncertainty_figure(run.scores, name, unit, run.checked, best), alt, caption)
    if not run.checked:
        return
    level = rounded(chance_level(agreement.count), 2)
    words = {
        TOO_FEW: "too few views gave a value to test whether u orders them correctly",
        CHANCE: f"the order of the {agreement.count} views with a value proves nothing, since a rank correlation "
        f"within ±{level} could be chance",
        CONFIRMED: "u orders the views correctly: smaller u, smaller error",
    }.get(agreement.order, "u orders the views in reverse: smaller u, larger error")
    tail = ""
    if agreement.trials:
        inside = f"{round(agreement.coverage * agreement.trials)} of {agreement.trials} errors"
        beyond = ", significantly fewer than 95 %" if agreement.optimistic else ""
        tail = f"; {inside} lie within 2 u{beyond}"
    caption = f"In the rendered views {words}{tail}."
    alt = f"True error of {name} against predicted standard uncertainty and against view score. {caption}"
    yield _picture(agreement_figure(agreement, unit), alt, caption)


def _commonest_limit(run: Run, name: str) -> str:
    here = run.scores.sel(measurement=name)
    limits = list(zip(here["limit"].values.tolist(), here["limiting_feature"].values.tolist(), strict=True))
    limit, feature = max(dict.fromkeys(limits), key=limits.count)
    words = LIMITS[limit][0] if limit in LIMITS else limit
    return f"{words} ({feature})" if feature else words


def camera_view(run: Run, view: int) -> dict[str, Any]:
    """Return the images of a checked view as (name, data URI, text), and their caption."""
    capture = run.capture(view)
    part, pose = run.part(), run.scores["world_from_sensor"].sel(view=view).values
    seen = None if part is None else (np.asarray(part.vertices) - pose[:3, 3]) @ pose[:3, :3]
    images, stretch = camera_images(capture, seen)
    rank = float(run.scores["uncertainty_rank"].sel(view=view).values.mean())
    able = int(run.scores["uncertainty_possible"].sel(view=view).values.sum())
    angles = angles_in_words(pose_of_view(run, view))
    caption = f"View {view}: {angles}; mean rank {rounded(rank, 1)} of {run.scores.sizes['view']}, "
    caption += f"{able} of {len(run.measurements)} measurements possible ({capture.source}; {stretch})."
    return {
        "images": [(name, uri, f"{name} camera, view {view}, {angles}") for name, uri in images.items()],
        "caption": caption,
    }


def cloud_picture(run: Run, view: int) -> Picture:
    """Return the picture of the predicted and the decoded cloud of a checked view."""
    predicted, decoded = run.predicted(view), run.decoded(view)
    shares = findings.reason_shares([(predicted, decoded)])
    predicted_share, decoded_share = shares.get(Status.VALID, (0.0, 0.0))
    lost = [status for status in shares if status != Status.VALID]
    why = ""
    if lost:
        reason = max(lost, key=lambda status: shares[status][1])
        why = f"; the most frequent reason for a missing point is “{REASONS[reason][0]}” ({percent(shares[reason][1])})"
    caption = (
        f"View {view}: of the pixels that could show the part, {percent(predicted_share)} give a point in the "
        f"prediction and {percent(decoded_share)} in the decoded images{why}."
    )
    alt = f"Depth and status of the predicted and the decoded cloud. {caption}"
    return _picture(cloud_figure(predicted, decoded), alt, caption)


def placement_picture(
    geometry: SceneGeometry | None, poses: Sequence[tuple[str, ArrayLike]], verdicts: Mapping[str, str], caption: str
) -> Picture | None:
    """Return the picture of :func:`draw_placement`, wide and narrow, with a caption; None without a part or a pose."""
    if geometry is None or not len(geometry.corners) or not poses:
        return None
    by_verdict: dict[str, Any] = {}
    for name, verdict in verdicts.items():
        by_verdict.setdefault(verdict, []).append(name)
    faces = (f"{verdict}: {', '.join(names)}" for verdict, names in by_verdict.items())
    alt = "The part and the sensor. " + "; ".join(faces)
    drawn = f"{caption}. Drawn to scale; beside it or below, the part enlarged, from the same viewpoint."
    # a narrow window shows the second: text would shrink to 4 px in the first
    both = [as_svg(placement_figure(geometry, poses, verdicts, stacked), alt) for stacked in (False, True)]
    return Picture(Markup('<div class="wide">{}</div><div class="narrow">{}</div>').format(*map(Markup, both)), drawn)
