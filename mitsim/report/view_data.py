"""Collect the data for the page's script: the numbers of the views and the solids, as JSON and data blocks.

Signal chain: scores, checks and sets of views -> numbers of every view, in the order of the scores; ``part.ply`` and
predicted clouds -> :mod:`mitsim.report.view_clouds` -> data blocks. The JSON escapes ``<``, so that names given by a
user cannot end the script.
"""

from __future__ import annotations

import json
import math
from typing import Any

import matplotlib
import numpy as np
import xarray as xr
from markupsafe import Markup
from matplotlib.colors import to_hex
from numpy.typing import ArrayLike, NDArray

from characterisation.plots.style import NOISE, SEQUENTIAL
from characterisation.words.numbers import count, percent
from mitsim.report.agreement import agreement
from mitsim.report.view_clouds import (
    MOST_POINTS,
    MOST_POINTS_IN_ALL,
    box_around,
    choose_clouds,
    noise_ends,
    packed_cloud,
    packed_part,
    shown_cloud,
)
from mitsim.study.run_folder import Run

#: Okabe and Ito's palette, for the features
COLOURS = ("#e69f00", "#56b4e9", "#009e73", "#d55e00", "#0072b2", "#cc79a7", "#f0e442")

#: the limit of a view in words, and how to improve it
LIMITS = {
    "noise": ("the noise of its points", "move nearer, reduce the incidence angle, or give the sensor more light"),
    "few points": ("too few points", "move nearer, reduce the incidence angle, or lengthen the exposure"),
    "short arc": ("only a short arc of it is visible", "choose another direction, or add a second view"),
    "small extent": (
        "only a small part of it is visible",
        "choose a direction from which more of it is visible, or add a second view",
    ),
    "occlusion": ("the rest of the part hides it", "choose a direction that sees it freely, or roll the sensor"),
}

#: number of colours of a scale, between which the script interpolates
_STOPS = 17


def view_data(run: Run) -> dict[str, Any]:
    """Return the numbers of all views for the script: lists in the order of the scores, None for NaN."""
    scores = run.scores
    by_feature = {name: scores[name].transpose("feature", "view").values for name in _BY_FEATURE}
    poses = scores["world_from_sensor"].values
    return {
        "views": {
            "number": scores["view"].values.tolist(),
            "direction": _numbers(scores["direction"].values),
            "site": sites(scores["direction"].values).tolist(),
            "position": _numbers(poses[:, :3, 3], 6),
            "turn": _numbers(poses[:, :3, :3]),
            **{name: _numbers(scores[name].values) for name in _BY_VIEW},
        },
        "features": [
            {"name": str(name), "colour": COLOURS[k % len(COLOURS)]}
            | {short: _numbers(by_feature[long][k]) for long, short in _BY_FEATURE.items()}
            for k, name in enumerate(scores["feature"].values)
        ],
        "measurements": [_measurement(run, name) for name in run.measurements],
        "limits": {name: {"words": words, "remedy": remedy} for name, (words, remedy) in LIMITS.items()},
        "minimum_points": float(scores.attrs.get("minimum_points", 100)),
        "checked": run.checked,
        "sets": [entry.model_dump() for entry in run.about.view_sets],
        "palette": {"views": _colours(SEQUENTIAL), "noise": _colours(NOISE)},
    }


_BY_VIEW = ("azimuth_deg", "elevation_deg", "roll_deg", "standoff_mm")
_BY_FEATURE = {"n": "points", "mean_sigma": "sigma", "R_f": "in_sight", "n_only_white": "alone"}
_BY_MEASUREMENT = {
    "predicted_uncertainty": "uncertainty",
    "chance": "chance",
    "V_m": "score",
    "rank": "score_rank",
    "uncertainty_rank": "rank",
}


def _measurement(run: Run, name: str) -> dict[str, Any]:
    here, entry = run.scores.sel(measurement=name), run.about.measurements[name]
    features, comparison = _features(run), agreement(run.scores, run.checks, name)
    errors = zip(comparison.views.tolist(), _numbers(comparison.error), strict=True)
    return {
        "name": name,
        "unit": entry.unit,
        "nominal": entry.nominal,
        "tolerance": _numbers(here["tolerance"].values),
        "features": [features.index(feature) for feature in entry.shapes if feature in features],
        "able": here["uncertainty_possible"].values.astype(int).tolist(),
        "possible": here["possible"].values.astype(int).tolist(),
        "limit": here["limit"].values.astype(str).tolist(),
        "limiting": here["limiting_feature"].values.astype(str).tolist(),
        "error": {str(view): error for view, error in errors},
    } | {short: _numbers(here[long].values) for long, short in _BY_MEASUREMENT.items()}


def sites(directions: NDArray[np.floating]) -> NDArray[np.int64]:
    """Return for each view the index (view,) of its direction (view, 3), in order of appearance."""
    _, first, of_view = np.unique(np.round(directions, 5) + 0.0, axis=0, return_index=True, return_inverse=True)
    order = np.empty(len(first), np.int64)
    order[np.argsort(first)] = np.arange(len(first))
    return np.asarray(order[of_view.ravel()])


def target(scores: xr.Dataset) -> NDArray[np.float64]:
    """Return the target of the views, (3,) [mm], part frame: the mean of the end points of their axes."""
    away = scores["standoff_mm"].values[:, None] * scores["direction"].values
    return np.asarray((scores["world_from_sensor"].values[:, :3, 3] - away).mean(axis=0), float)


def solids(run: Run) -> tuple[list[tuple[int, Markup]], dict[str, Any]]:
    """Return the data blocks of the clouds by view, and the script's description of the clouds and of the part."""
    features, poses, part = _features(run), run.scores["world_from_sensor"], run.part()
    first = [*run.checked, *(view for entry in run.about.view_sets for view in entry.views)]
    chosen = choose_clouds(run.scores, run.clouds, first)
    most = min(MOST_POINTS, MOST_POINTS_IN_ALL // max(len(chosen), 1))
    clouds = {view: shown_cloud(run.predicted(view), poses.sel(view=view).values, features, most) for view in chosen}
    box = box_around([*(cloud.points for cloud in clouds.values()), *([] if part is None else [part.vertices])])
    ends = noise_ends(clouds)
    shares = [len(cloud.points) / cloud.count for cloud in clouds.values() if cloud.count]
    about = {
        "box": {"origin": box.origin.tolist(), "step": box.step},
        "target": _numbers(target(run.scores), 6),
        "part": None if part is None else packed_part(part, box),
        "noise": None if ends is None else _numbers(np.array(ends)),
        "clouds": {
            str(view): {"count": cloud.count, "shown": len(cloud.points), "spacing": _numbers(np.array(cloud.spacing))}
            for view, cloud in clouds.items()
        },
        "shown": {
            "clouds": count(len(chosen)),
            "of": count(len(run.scores["view"])),
            "share": percent(min(shares, default=1.0)),
            "thinned": bool(shares) and min(shares) < 1,
        },
    }
    return [(view, Markup(packed_cloud(cloud, box, ends))) for view, cloud in clouds.items()], about


def _features(run: Run) -> list[str]:
    return [str(name) for name in run.scores["feature"].values]


def _colours(name: str) -> list[str]:
    """Return a colour scale from bad to good; good is bright."""
    return [to_hex(matplotlib.colormaps[name](float(level))) for level in np.linspace(0, 1, _STOPS)]


def _numbers(values: ArrayLike, digits: int = 5) -> Any:
    """Return nested lists of numbers with ``digits`` significant digits; None for numbers that are not finite."""
    array = np.asarray(values, float)
    if array.ndim:
        return [_numbers(item, digits) for item in array]
    value = float(array)
    if not math.isfinite(value):
        return None
    short = float(f"{value:.{digits}g}")
    return int(short) if short.is_integer() and abs(short) < 1e15 else short


def as_json(data: Any) -> Markup:
    """Return JSON that is safe in a script element, whatever names it holds."""
    text = json.dumps(data, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    for character in "<>&\u2028\u2029":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return Markup(text)
