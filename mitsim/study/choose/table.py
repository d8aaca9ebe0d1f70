"""Tabulate the comparison of sensors: for the terminal, and as the document behind the pages.

Signal chain: sensors with screened and stated results, and excluded sensors -> a cell for every measurement of every
sensor -> ``choice.json`` and lines of text, best sensor first.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np

from characterisation.files.atomic_io import json_values
from characterisation.statements.decision import Verdict, decide, mostly_lost, needed
from characterisation.statements.statement import Statement
from characterisation.statements.tolerance import tolerance_of
from characterisation.statements.verdict_words import Reason, in_words, result_reasons
from characterisation.words.numbers import aligned, or_nan, two_digits
from characterisation.words.version import __version__
from mitsim.sensor.exposure import PlannedExposure
from mitsim.sensor.sensor import Sensor
from mitsim.study import Study
from mitsim.study.choice_document import (
    TIME_OVER,
    CaptureEntry,
    CellEntry,
    ChoiceDocument,
    ComparedMeasurement,
    PoseEntry,
    SensorEntry,
    judged,
)
from mitsim.study.choose.candidates import Excluded
from mitsim.study.choose.ranking import LARGEST_DEMAND, relative_to_least
from mitsim.study.choose.sensor_result import SensorResult
from mitsim.study.screened_errors import screened_errors
from mitsim.study.virtual.plan import map_digest
from mitsim.views.no_view import why_no_view
from mitsim.views.scoring_time import not_scored_in_words


def document(
    study: Study, found: Sequence[SensorResult], excluded: Sequence[Excluded], seconds: float, finished: bool
) -> ChoiceDocument:
    """Return all results as a document, best sensor first.

    Parameters
    ----------
    study, found, excluded
        Study of any of the sensors, results of those that are compared, in order, and those that cannot be, which come
        last.
    seconds, finished
        Duration of the comparison so far [s]; whether it is complete, if no sensor lacks views or measurements for want
        of time.
    """
    task = study.task
    named_measurements = {
        name: ComparedMeasurement(
            unit=measurement.unit,
            nominal=measurement.nominal,
            tolerance=measurement.tolerance,
            features=list(measurement.features),
            kind=measurement.kind,
            rule="" if measurement.tolerance is None else task.decision_of(name).in_words,
        )
        for name, measurement in task.measurements.items()
    }
    sensors = [_sensor(result) for result in found]
    if all(named_measurement.tolerance is None for named_measurement in named_measurements.values()):
        sensors = _relative(sensors)
    sensors = [
        sensor.model_copy(update={"words": in_words(reasons_of(sensor, named_measurements))}) for sensor in sensors
    ]
    sensors += [
        SensorEntry(
            name=one.name, given=one.given, status="excluded", why=one.reason, ratio=None, fits=0, words=one.reason
        )
        for one in excluded
    ]
    return ChoiceDocument(
        schema_version=1,
        mitsim=__version__,
        study=str(study.path),
        scene=study.scene.where,
        seed=study.file.seed,
        words=in_words(best_reasons(sensors, named_measurements)),
        finished=finished and not any(sensor.lacks or sensor.why == TIME_OVER for sensor in sensors),
        seconds=round(seconds, 1),
        measurements=named_measurements,
        sensors=sensors,
    )


def best_reasons(sensors: Sequence[SensorEntry], named_measurements: Mapping[str, ComparedMeasurement]) -> list[Reason]:
    """Return the best sensor and its result, as reasons of one line."""
    able = [sensor for sensor in sensors if sensor.status != "excluded"]
    if not able or not able[0].measurements:
        return [Reason("no sensor can measure this")]
    best = able[0]
    if len(best.impossible) == len(best.measurements):
        return [Reason("no sensor can measure this"), *_impossible_ones(best)]
    others = sum(sensor_entry.fits_all and sensor_entry.status == "stated" for sensor_entry in able[1:])
    more = f"so do{'es' if others == 1 else ''} {others} other{'' if others == 1 else 's'}"
    first, *rest = reasons_of(best, named_measurements)
    return [Reason(f"{best.name}: {first.says}"), *rest] + [Reason(more)] * bool(best.fits_all and others)


def reasons_of(sensor_entry: SensorEntry, named_measurements: Mapping[str, ComparedMeasurement]) -> list[Reason]:
    """Return the result of a sensor, as reasons of one line."""
    if len(sensor_entry.impossible) == len(sensor_entry.measurements):
        return [Reason("no measurement is possible"), *_impossible_ones(sensor_entry)]
    verdicts = [replace(each, unit=named_measurements[each.name].unit) for each in judged(sensor_entry)]
    toleranced = {each.name for each in verdicts if each.verdict != "no tolerance"}
    by = "by screening alone: " * (sensor_entry.status == "screened")
    if toleranced and not by:
        reasons = result_reasons(verdicts)
    elif toleranced:
        reasons = [Reason(by + _expected_in_words(sensor_entry, named_measurements))]
    elif sensor_entry.ratio is not None and sensor_entry.ratio > 1:
        reasons = [Reason(f"{by}{two_digits(sensor_entry.ratio)} times the least uncertainty of all sensors at worst")]
    else:
        possible = "possible " * bool(sensor_entry.impossible)
        reasons = [Reason(f"{by}the least uncertainty of all sensors in every {possible}measurement")]
    return [
        *reasons,
        *map(Reason, filter(None, [sensor_entry.possible_in_words])),
        *_impossible_ones(sensor_entry, toleranced),
        *map(Reason, filter(None, [sensor_entry.lacks])),
    ]


def _expected_in_words(sensor_entry: SensorEntry, named_measurements: Mapping[str, ComparedMeasurement]) -> str:
    """Return how many tolerances a sensor is expected to fit by screening, and its largest demand."""
    cells = {name: cell for name, cell in sensor_entry.measurements.items() if cell.verdict != "no tolerance"}
    text = f"{sensor_entry.expected_fits} of {len(cells)} tolerances are expected to fit"
    known = {name: cell for name, cell in cells.items() if cell.demand is not None and cell.uncertainty is not None}
    if not known:
        return text
    name = max(known, key=lambda each: known[each].demand or 0.0)
    unit, needed, u = named_measurements[name].unit, known[name].needed, known[name].uncertainty
    limit = "" if needed is None else f", {two_digits(needed)} {unit} needed"
    return f"{text}; the hardest is {name}: standard uncertainty {two_digits(or_nan(u))} {unit}{limit}"


def _impossible_ones(sensor_entry: SensorEntry, but: Collection[str] = ()) -> list[Reason]:
    """Return the reasons of impossible measurements, measurements of one reason together, ``but`` some."""
    by_reason = dict[str, list[str]]()
    for name, why in sensor_entry.impossible.items():
        if name not in but or sensor_entry.status == "screened":
            by_reason.setdefault(why, []).append(name)
    return [Reason(f" impossible ({why})", tuple(names)) for why, names in by_reason.items()]


def as_text(choice: ChoiceDocument) -> str:
    """Return the table of sensors and measurements, with a legend."""
    names = list(choice.measurements)
    rows: list[tuple[str, ...]] = [("sensor", "fits", "worst", "capture", *names)]
    for sensor in choice.sensors:
        if sensor.status == "excluded":
            continue
        toleranced = choice.toleranced
        rows.append(
            (
                sensor.name + ("" if sensor.status == "stated" else " *"),
                _fits(sensor, toleranced),
                "-" if sensor.ratio is None else two_digits(sensor.ratio),
                "-" if sensor.capture is None else f"{1e3 * sensor.capture.seconds:.0f} ms",
                *(_cell(sensor.measurements[name], choice.measurements[name]) for name in names),
            )
        )
    legend = (
        "cells: standard uncertainty, view, verdict; worst: demand of the decision rule, at most 1 if everything fits\n"
        "order: sensors with virtual measurements, then the most possible measurements, then the smallest worst"
    )
    lines = [*aligned(rows), "", legend, *choice.fit_more]
    lines += [f"{sensor.name}: {sensor.roughness_in_words}" for sensor in choice.sensors if sensor.roughness_in_words]
    if any(sensor.status == "screened" for sensor in choice.sensors):
        least = ", and so many times the best" if choice.toleranced else " times the best"
        reasons = f"fewer measurements are possible there, its demand there is above {LARGEST_DEMAND:g}{least}"
        lines.append(f"* by screening alone, (n of m) expected to fit: {reasons}, or time was over")
    lines += [
        f"{sensor.name}: {sensor.possible_in_words}; {'; '.join(one.in_full for one in _impossible_ones(sensor))}"
        for sensor in choice.sensors
        if sensor.status != "excluded" and sensor.impossible
    ]
    lines += [f"{sensor.name}: {sensor.lacks}" for sensor in choice.sensors if sensor.lacks]
    lines += [f"{sensor.name} is excluded: {sensor.why}" for sensor in choice.sensors if sensor.status == "excluded"]
    return "\n".join(lines)


_SIGNS = {"fits": "fits", "does not fit": "no", "undecidable": "undecidable", "not decided": "?", "no tolerance": ""}


def _fits(sensor_entry: SensorEntry, toleranced: int) -> str:
    if sensor_entry.status == "stated" or not toleranced:
        return sensor_entry.fits_in_cell(toleranced) or "-"
    return f"({sensor_entry.expected_fits} of {toleranced})"


def _cell(cell: CellEntry, measurement: ComparedMeasurement) -> str:
    if cell.uncertainty is None:
        return f"no value in {cell.trials}" if cell.trials else "none by screening"
    return f"{two_digits(cell.uncertainty)} {measurement.unit} ({cell.view}) {_SIGNS[cell.verdict]}".rstrip()


def _sensor(result: SensorResult) -> SensorEntry:
    study = result.candidate.study
    names = list(study.task.measurements)
    rows = result.best() if result.stated else [None] * len(names)
    cells = {name: _cell_of(result, m, name, rows[m]) for m, name in enumerate(names)}
    views = list(dict.fromkeys([*result.stated, *(cell.view for cell in cells.values() if cell.view is not None)]))
    used = {cell.view for cell in cells.values()}
    return SensorEntry(
        name=result.candidate.name,
        given=result.candidate.given,
        status="stated" if result.stated else "screened",
        why="" if result.stated else result.unpromising or TIME_OVER,
        ratio=json_values(result.ratio),
        words="",
        fits=sum(cell.verdict == "fits" and cell.by == "statement" for cell in cells.values()),
        poses=[_pose(study, number) for number in views if number in used or number == next(iter(result.stated), None)],
        capture=capture_entry(study.sensor, next(iter(stated.planned for stated in result.stated.values()), None)),
        measurements=cells,
        map_digest=map_digest(study),
        lacks=not_scored_in_words(result.scores),
    )


def _cell_of(result: SensorResult, m: int, name: str, row: tuple[int, float, Statement] | None) -> CellEntry:
    if not result.stated:
        return _screened(result, m, name)
    return _impossible(result, m, name) if row is None else _stated(row)


def _impossible(result: SensorResult, m: int, name: str) -> CellEntry:
    """Return a cell of virtual measurements that gave too few values, of all stated views together."""
    statements = [stated.statements[m] for stated in result.stated.values()]
    trials = sum(each.trials for each in statements)
    lost = sum(each.trials * each.without_value for each in statements) / trials
    toleranced = tolerance_of(result.candidate.study.task, name) is not None
    reasons = [loss for each in statements for loss in each.losses]
    lost_verdict: Verdict = "undecidable" if mostly_lost(trials) else "not decided"
    return CellEntry(
        verdict=lost_verdict if toleranced else "no tolerance",
        trials=trials,
        without_value=min(lost, 1.0),
        reason=max(reasons, key=lambda loss: loss.count).reason if reasons else "",
    )


def _stated(row: tuple[int, float, Statement]) -> CellEntry:
    view, demand, one = row
    cell = CellEntry(
        by="statement",
        view=view,
        uncertainty=one.standard_uncertainty,
        bias=one.bias,
        share_of_tolerance=one.share_of_tolerance,
        demand=demand,
        verdict=one.verdict,
        trials=one.trials,
        without_value=one.without_value,
    )
    decided = one.decided
    if decided is None:
        return cell
    return cell.model_copy(
        update={
            "demand_interval": tuple(json_values(decided.demand_interval)),
            "fits_corrected": decided.fits_corrected,
            "accepted": None if decided.accepted is None else tuple(json_values(decided.accepted)),
            "needed": json_values(decided.needed),
            "false_accept": decided.false_accept,
            "false_reject": decided.false_reject,
        }
    )


def _screened(found: SensorResult, m: int, name: str) -> CellEntry:
    """Return a cell from screening; its verdict is decided only if the demand exceeds :data:`LARGEST_DEMAND`."""
    u, tolerance = float(found.screened_u[m]), tolerance_of(found.candidate.study.task, name)
    if not math.isfinite(u):
        reason = why_no_view(found.scores, name, found.candidate.study.task.shapes_for(name))
        return CellEntry(verdict="no tolerance" if tolerance is None else "undecidable", reason=reason)
    demand = float(found.screened[m])
    cell = CellEntry(by="screening", view=int(found.screened_view[m]), uncertainty=u, demand=demand, without_value=0.0)
    if tolerance is None:
        return cell.model_copy(update={"verdict": "no tolerance"})
    errors = screened_errors(u)
    return cell.model_copy(
        update={
            "share_of_tolerance": 1.96 * u / tolerance.size,
            "verdict": decide(errors, tolerance).verdict if demand > LARGEST_DEMAND else "not decided",
            "needed": json_values(needed(errors, tolerance)),
        }
    )


def _relative(sensors: Sequence[SensorEntry]) -> list[SensorEntry]:
    """Express demands as multiples of the least demand of all measured sensors, for tasks without tolerances."""
    known = [sensor.status == "stated" for sensor in sensors]
    rows = [
        [math.inf if cell.demand is None else cell.demand for cell in sensor.measurements.values()]
        for sensor in sensors
    ]
    relative = relative_to_least(rows, known if any(known) else [True] * len(known))
    out = list[SensorEntry]()
    for sensor, demands in zip(sensors, relative.tolist(), strict=True):
        cells = {
            name: cell.model_copy(update={"demand": json_values(demand)})
            for (name, cell), demand in zip(sensor.measurements.items(), demands, strict=True)
        }
        worst = max((demand for demand in demands if math.isfinite(demand)), default=math.nan)
        out.append(sensor.model_copy(update={"measurements": cells, "ratio": json_values(worst)}))
    return out


def _pose(study: Study, number: int) -> PoseEntry:
    view = study.view(number)
    return PoseEntry(
        view=number,
        azimuth_deg=view.azimuth_deg,
        elevation_deg=view.elevation_deg,
        roll_deg=view.roll_deg,
        standoff_mm=view.standoff,
        world_from_sensor=view.world_from_sensor.matrix().tolist(),
    )


def capture_entry(sensor: Sensor, planned: PlannedExposure | None = None) -> CaptureEntry:
    """Return images and exposures of one capture; the time is exposure time, without readout and transfer."""
    images = sensor.frames + sensor.ambient_image
    own = sensor.exposure.exposures(None, float(sensor.imager.full_well))
    exposures = own if planned is None else planned.exposures_s
    return CaptureEntry(images=images, exposures_s=list(exposures), seconds=images * float(np.sum(exposures)))
