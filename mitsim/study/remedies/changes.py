"""Propose changes of a study that could make a measurement fit its tolerance, the least effort first.

Signal chain: statement of a view, scores and race of all views -> candidates: the bias subtracted, another view, nearer
to the features, a matt white spray, planned exposures, repeated captures, no room light, a fresh calibration, several
views, steady temperatures, a better calibration, a known decoder -> bound of each (:mod:`mitsim.study.remedies.bounds`)
-> those with which some measurement can fit. Other sensors: :mod:`mitsim.study.remedies.sensors`.

Apart from views and repeated captures, a change consists of ``keys`` of the study's TOML file. A user who adds them
gets the study that was measured.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from characterisation.files.errors import InputError
from characterisation.statements.statement import Statement
from mitsim.running.time_limit import TimeLimit
from mitsim.scene.load import bounds_of
from mitsim.sensor.unknowns import FLIGHT_DRIFT, TRIANGULATION_DRIFT
from mitsim.sensor.working_volume import nearest_standoff
from mitsim.study import ExposureTable, SetTable, StatementTable, finishes_of_features
from mitsim.study.remedies.bounds import EXPOSURE, Effect, can_fit, least_shares, least_uncertainty
from mitsim.study.remedies.change import (
    SCREENING_FACTOR,
    Change,
    ChangedStudy,
    Shortfall,
    changed_file,
    possible,
    reopened,
    same_direction,
    session_of_views,
)
from mitsim.study.remedies.repeats import state_mean
from mitsim.study.screened_errors import needed_by_tolerance
from mitsim.study.session import Session
from mitsim.study.view_sets.confirmed_set import state_set
from mitsim.views.view_scores import MATT_WHITE, screening_risk

#: numbers of captures whose mean is proposed: they divide repeatability by 2 and 4; chosen
_CAPTURES = (4, 16)

#: shares of the errors of calibration and temperature that are proposed; chosen
_SHARES = (1 / 2, 1 / 4, 1 / 8)

#: number of other views that are tried
_MOST_OTHER_VIEWS = 2

#: largest ratio of standoffs at which a nearer one is worth a try
_NEARER = 0.9

#: largest number of views that may measure together: a box is seen from all sides by eight; chosen
_MOST_VIEWS = 8

#: time to search for them [s]; chosen
_SEARCH_S = 5.0


def changes(now: Shortfall, short: bool = False) -> Iterator[Change]:
    """Yield the changes with which some measurement that is missed can fit, the least effort first.

    If time is ``short``, the spray comes before all that need virtual measurements: it acts on all errors of the light,
    which are most of those of a bare part, and other views share them.
    """
    first = (_spray, _views, _nearer) if short else (_views, _nearer, _spray)
    proposals: Sequence[Callable[[Shortfall], Iterator[Change]]] = (
        _bias,
        *first,
        _exposure,
        _repeats,
        _room,
        _fresh_calibration,
        _several_views,
        _temperature,
        _better_calibration,
        _decoder,
    )
    for propose in proposals:
        yield from (change for change in propose(now) if change.expected)


def _of_study(
    now: Shortfall, kind: str, words: str, keys: Mapping[str, Any], expected: Mapping[str, float], name: str = ""
) -> Change:
    """Return a change of the unknowns or of the exposure, with the same part and views."""
    study, number = now.study, now.stated.view.number
    changed = ChangedStudy(
        now,
        name or kind,
        lambda: replace(study, file=changed_file(study.file, keys)),
        lambda opened: opened.view(number),
    )
    return Change(kind, words, keys, (number,), expected, changed.state, release=changed.release)


def _bias(now: Shortfall) -> Iterator[Change]:
    able = {
        name: statement
        for name, statement in now.missed.items()
        if statement.decided is not None and statement.decided.fits_corrected
    }
    if not able:
        return
    task = now.study.task
    key = {"subtract_bias": True}
    decision, measurements = task.decision.model_copy(update=key), dict(task.measurements)
    keys: dict[str, Any] = {"decision": key}
    for name, measurement in task.measurements.items():
        if measurement.decision is not None:
            own = measurement.decision.model_copy(update=key)
            measurements[name] = measurement.model_copy(update={"decision": own})
            keys.setdefault("measurements", {})[name] = {"decision": key}
    corrected = task.model_copy(update={"decision": decision, "measurements": measurements})
    session, number = now.session, now.stated.view.number
    most = max(statement.trials for statement in now.stated.statements)

    def state(_: int, limit: TimeLimit) -> list[Statement]:
        # the trials of the statement itself
        again = copy.copy(session)
        again.study = replace(now.study, task=corrected)
        return again.state(again.study.view(number), StatementTable(trials=most), limit).statements

    words = "with its bias subtracted"
    expected = {name: statement.standard_uncertainty for name, statement in able.items()}
    yield Change("bias", words, keys, (number,), expected, state, needs_trials=False)


def _views(now: Shortfall) -> Iterator[Change]:
    """Yield best other views of single measurements, by the race or by the map, those of most measurements first."""
    stated, by_view = now.stated.view.number, dict[int, dict[str, float]]()
    risk = screening_risk(now.scores)
    numbers = now.scores["view"].values.tolist()
    names = [str(name) for name in now.scores["measurement"].values]
    for name, statement in now.missed.items():
        ratios: dict[int, float] = {}
        screened = np.exp(risk[names.index(name)])
        if np.isfinite(screened).any():
            best = int(np.argmin(screened))
            ratios[numbers[best]] = float(screened[best] / screened[numbers.index(stated)])
        if name in now.raced.standings and stated in now.raced.views:
            risks = dict(zip(now.raced.views.tolist(), now.raced.standings[name].risk.tolist(), strict=True))
            # the trials of the race tell more of a view than the map
            ratios = {view: risks.get(view, risks[stated] * ratio) / risks[stated] for view, ratio in ratios.items()}
            leader = now.raced.leader(name)
            ratios[leader] = risks[leader] / risks[stated]
        for number, ratio in ratios.items():
            u = ratio * statement.standard_uncertainty / SCREENING_FACTOR
            if number != stated and ratio < 1 and can_fit(statement, u, unbiased=True):
                by_view.setdefault(number, {})[name] = u
    session = session_of_views(now.session, now.folder / "view")
    for number, expected in sorted(by_view.items(), key=lambda row: -len(row[1]))[:_MOST_OTHER_VIEWS]:

        def state(count: int, limit: TimeLimit, view: int = number) -> list[Statement]:
            return session.state(now.study.view(view), StatementTable(trials=count), limit).statements

        yield Change("view", f"from view {number}", {}, (number,), expected, state)


def _nearer(now: Shortfall) -> Iterator[Change]:
    """Yield a standoff for the features of the missed measurements alone, if that is much nearer."""
    study, view, table = now.study, now.stated.view, now.study.file.views
    if table.stage is not None or table.standoffs_mm is not None:
        return
    names = {shape for name in now.missed for shape in study.task.shapes_for(name)}
    boxes = [
        bounds_of(shape) for shape, name in zip(study.scene.shapes, study.scene.names, strict=True) if name in names
    ]
    low, high = np.min([box[0] for box in boxes], axis=0), np.max([box[1] for box in boxes], axis=0)
    standoff = nearest_standoff(study.sensor, float(np.linalg.norm(high - low)) / 2)
    if standoff > _NEARER * view.standoff:
        return
    ratio = (standoff / view.standoff) ** 2 / SCREENING_FACTOR
    expected = {
        name: ratio * statement.standard_uncertainty
        for name, statement in now.missed.items()
        if can_fit(statement, ratio * statement.standard_uncertainty, unbiased=True)
    }
    target = [round(float(value), 3) for value in (low + high) / 2]
    keys = {"views": {"target_mm": target, "standoff_mm": standoff}}
    changed = ChangedStudy(now, "nearer", lambda: reopened(study, keys), partial(same_direction, view=view))
    words = f"from {standoff:.0f} mm to its features, in place of {view.standoff:.0f} mm to the part"
    yield Change("nearer", words, keys, (view.number,), expected, changed.state, release=changed.release)


def _exposure(now: Shortfall) -> Iterator[Change]:
    if now.study.file.exposure is not None or now.session.source == "map":
        return
    expected = possible(now, EXPOSURE)
    keys = {"exposure": ExposureTable().model_dump(exclude={"exposures_s", "power"})}
    yield _of_study(now, "exposure", "with up to three exposures planned for the view", keys, expected)


def _repeats(now: Shortfall) -> Iterator[Change]:
    left = dict(now.missed)
    for captures in _CAPTURES:
        expected = {
            name: statement.after_repeats(captures)
            for name, statement in left.items()
            if math.isfinite(statement.repeatability)
            and can_fit(statement, statement.after_repeats(captures), unbiased=False)
        }
        left = {name: statement for name, statement in left.items() if name not in expected}
        state = partial(state_mean, now.session, now.stated.view, captures)
        words, view = f"as the mean of {captures} captures", now.stated.view.number
        yield Change("repeats", words, {}, (view,), expected, state, captures=captures)


def _room(now: Shortfall) -> Iterator[Change]:
    if now.study.unknowns.light.illuminance > 0:
        keys = {"unknowns": {"light": {"room": "dark cell"}}}
        expected = possible(now, Effect({"light": 0.0, "interaction": 0.0, "noise": 0.0}))
        yield _of_study(now, "light", "without light of the room", keys, expected)


def _fresh_calibration(now: Shortfall) -> Iterator[Change]:
    if now.study.unknowns.calibration.drifting(now.study.sensor.technology == "time_of_flight"):
        keys = {"unknowns": {"calibration": dict.fromkeys(TRIANGULATION_DRIFT | FLIGHT_DRIFT, 0.0)}}
        expected = possible(now, Effect({"calibration": 0.0}))
        yield _of_study(now, "calibration", "calibrated just before, without drift", keys, expected, "fresh")


def _better_calibration(now: Shortfall) -> Iterator[Change]:
    scale = now.study.unknowns.calibration.scale
    for share, expected in _by_share(now, "calibration").items():
        keys = {"unknowns": {"calibration": {"scale": scale * share}}}
        words = f"with a calibration {1 / share:.0f} times as accurate"
        yield _of_study(now, "calibration", words, keys, expected, f"calibration_{1 / share:.0f}")


def _temperature(now: Shortfall) -> Iterator[Change]:
    temperature = now.study.unknowns.temperature
    for share, expected in _by_share(now, "temperature").items():
        part, sensor = temperature.part_kelvin * share, temperature.sensor_kelvin * share
        keys = {"unknowns": {"temperature": {"part_kelvin": part, "sensor_kelvin": sensor}}}
        words = f"with the part steady within {part:g} K and the sensor within {sensor:g} K"
        yield _of_study(now, "temperature", words, keys, expected, f"temperature_{1 / share:.0f}")


def _by_share(now: Shortfall, group: str) -> dict[float, dict[str, float]]:
    """Return the measurements that can fit, by the largest share of the errors of a group that suffices."""
    out: dict[float, dict[str, float]] = {}
    for name, statement in now.missed.items():
        share = least_shares(statement, group, _SHARES)
        if share is not None and statement.budget:
            out.setdefault(share, {})[name] = least_uncertainty(statement, Effect({group: share}))
    return dict(sorted(out.items(), reverse=True))


def _several_views(now: Shortfall) -> Iterator[Change]:
    """Yield the fewest views that together reach the tolerances, by the map corrected by the statement."""
    study, names = now.study, [str(name) for name in now.scores["measurement"].values]
    if now.session.source == "map" or study.file.set is not None:
        return
    here = now.scores["predicted_uncertainty"].sel(view=now.stated.view.number)
    of_tolerance = needed_by_tolerance(study.task)
    limits, needed = dict[str, float](), dict[str, float]()
    for name, statement in now.missed.items():
        predicted, decided = float(here.values[names.index(name)]), statement.decided
        if decided is not None and math.isfinite(decided.needed) and statement.root_mean_square > 0:
            optimism = min(1.0, predicted / statement.root_mean_square) if math.isfinite(predicted) else 1.0
            needed[name], limits[name] = decided.needed, decided.needed * optimism
        elif math.isfinite(of_tolerance.get(name, math.nan)):  # no value from this view
            needed[name] = limits[name] = of_tolerance[name]
    table, chosen = SetTable(seconds=_SEARCH_S), None
    while limits and chosen is None:
        try:
            chosen = now.search(limits, table=table)
        except InputError as error:
            if error.field not in limits:
                return
            limits.pop(error.field)  # joined views cannot make it
    if chosen is None:
        return
    able = [name for name, reached in zip(limits, chosen.feasible, strict=True) if reached]
    if not able or not 2 <= len(chosen.views) <= _MOST_VIEWS:
        return
    listed = f"{', '.join(map(str, chosen.views[:-1]))} and {chosen.views[-1]}"
    keys = {"set": {"joining": table.joining, "limits": {name: needed[name] for name in able}}}
    table = table.model_copy(update={"limits": limits})

    def state(count: int, limit: TimeLimit) -> list[Statement]:
        joined = changed_file(study.file, {"set": table.model_copy(update={"trials": count}).model_dump()})
        base = now.session
        session = Session(replace(base.study, file=joined), base.folder, base.workers, base.separate_light)
        session.measurements = base.measurements
        return state_set(session, chosen, limit.over)

    expected = {name: limits[name] for name in able}
    words = f"from views {listed} together, joined by a robot"
    yield Change("views", words, keys, chosen.views, expected, state)


def _spray(now: Shortfall) -> Iterator[Change]:
    study, view = now.study, now.stated.view
    white = all(
        finish is not None and finish.name == MATT_WHITE.name for finish in finishes_of_features(study).values()
    )
    if white or study.file.sprayed:
        return
    keys = {"sprayed": True}
    changed = ChangedStudy(now, "spray", lambda: reopened(study, keys), partial(same_direction, view=view))
    expected = possible(now, EXPOSURE)
    yield Change("spray", "sprayed matt white", keys, (view.number,), expected, changed.state, release=changed.release)


def _decoder(now: Shortfall) -> Iterator[Change]:
    if now.study.unknowns.decoder.known or now.session.source == "map":
        return
    keys = {"unknowns": {"decoder": {"known": True}}}
    expected = possible(now, Effect({"decoder": 0.0}))
    yield _of_study(now, "decoder", "with the settings of the decoder known", keys, expected)
