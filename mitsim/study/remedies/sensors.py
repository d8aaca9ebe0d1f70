"""Propose other sensors with which a measurement could fit its tolerance.

Signal chain: presets with a map -> the study with each -> screening of the directions that were best for the first
sensor -> uncertainty of each missed measurement relative to the first sensor's -> the sensors with which most can fit.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import xarray as xr

from characterisation.files.arrays import Floats
from characterisation.files.errors import InputError
from characterisation.maps.shipped import shipped_maps
from characterisation.words.progress import say
from mitsim.running.time_limit import TimeLimit
from mitsim.sensor.preset import named_sensor, presets
from mitsim.study import Study
from mitsim.study.choose.candidates import Excluded, open_candidate
from mitsim.study.remedies.bounds import can_fit
from mitsim.study.remedies.change import SCREENING_FACTOR, Change, ChangedStudy, Shortfall
from mitsim.study.session import Session
from mitsim.views import View
from mitsim.views.view_scores import screening_risk

#: number of directions in which another sensor is screened; chosen
_DIRECTIONS = 6

#: largest number of sensors that are proposed; chosen
_MOST = 2

#: share of the time that is left, for the screening of a sensor
_SCREENING_SHARE = 0.5


def other_sensors(now: Shortfall, limit: TimeLimit) -> Iterator[Change]:
    """Yield the most promising other sensors, the one with which most measurements can fit first."""
    if now.session.source == "map":
        return
    names, stated = list(now.missed), now.stated.view.number
    stated_risks = _risks(now.scores, names)[:, now.scores["view"].values.tolist().index(stated)]
    proposals = list[tuple[int, float, Change]]()
    # fringes first: time may not suffice for all
    for name in sorted(presets(), key=lambda preset: named_sensor(preset)[1] != "structured_light"):
        if name == now.study.sensor.name or name not in shipped_maps():
            continue
        if limit.over():
            break
        study = _opened(now, name)
        if study is None or not (screened_study := _in_best_directions(now, study)).views:
            continue
        say(f"remedies: screening {name}, {len(screened_study.views)} views")
        scores, _ = Session(screened_study).screen(limit=limit.part(_SCREENING_SHARE))
        risks = _risks(scores, names)
        least = risks.min(axis=1)
        expected = {}
        for statement, risk, before in zip(now.missed.values(), least, stated_risks, strict=True):
            ratio = float(risk / before)  # 0 where the map sees no way for the first sensor
            u = ratio * statement.standard_uncertainty / SCREENING_FACTOR
            if math.isfinite(risk) and can_fit(statement, u, unbiased=True):
                expected[statement.measurement] = u
        if expected:
            able = np.isfinite(least)
            best = int(np.argmin((risks[able] / least[able, None]).max(axis=0)))
            view = study.view(int(scores["view"].values[best]))
            proposals.append((-len(expected), float(least[able].sum()), _with_sensor(now, name, study, view, expected)))
    for _, _, change in sorted(proposals, key=lambda proposal: proposal[:2])[:_MOST]:
        yield change


def _opened(now: Shortfall, name: str) -> Study | None:
    """Return the study with another sensor; None if that is impossible, such as without its finishes in the map."""
    try:
        opened = open_candidate(now.study.path, now.study.file, name, None)
    except InputError:
        return None
    return None if isinstance(opened, Excluded) else opened.study


def _with_sensor(now: Shortfall, name: str, study: Study, view: View, expected: dict[str, float]) -> Change:
    changed = ChangedStudy(now, f"sensor_{name}", lambda: study, lambda opened: opened.view(view.number))
    words = f"with {name}, from its view {view.number}"
    before, after = now.study.file, study.file
    keys: dict[str, Any] = {"sensor": name}
    for table, names in (("characterisation", ("campaign", "map")), ("views", ("standoff_mm", "standoffs_mm"))):
        old, new = getattr(before, table), getattr(after, table)
        if gone := [key for key in names if getattr(old, key) is not None and getattr(new, key) is None]:
            keys[table] = dict.fromkeys(gone)
    return Change("sensor", words, keys, (view.number,), expected, changed.state, release=changed.release)


def _in_best_directions(now: Shortfall, study: Study) -> Study:
    """Return the study with the views in the stated direction and in those that screening ranks first."""
    risks = _risks(now.scores, list(now.missed))
    risks = risks[np.isfinite(risks).any(axis=1)]
    worst = (risks / risks.min(axis=1, keepdims=True)).max(axis=0) if len(risks) else np.zeros(now.scores.sizes["view"])
    order = now.scores["view"].values[np.argsort(worst, kind="stable")].tolist()
    directions = list[Floats]()
    for number in (now.stated.view.number, *order):
        direction = now.study.view(int(number)).direction
        if len(directions) < _DIRECTIONS and all(other @ direction < 1 - 1e-9 for other in directions):
            directions.append(direction)
    views = [view for view in study.views if any(other @ view.direction > 1 - 1e-9 for other in directions)]
    return replace(study, candidates=replace(study.candidates, views=views))


def _risks(scores: xr.Dataset, names: list[str]) -> Floats:
    """Return the screened risk (measurement, view) of measurements, in their units; infinite if the map excludes it."""
    all_names = [str(name) for name in scores["measurement"].values]
    return np.asarray(np.exp(screening_risk(scores)[[all_names.index(name) for name in names]]))
