"""Make the section of the page with the statement of a run: uncertainties, budget as table and bars, influences.

Signal chain: ``statement.json`` -> checked document -> texts and one bar for each measurement, divided into the groups
of unknowns. All bars are as long: the lines of a budget add up to the variance.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from characterisation.plots.statements import GROUPS
from characterisation.statements.losses import Loss, lost_features
from characterisation.statements.statement import AT_THE_LIMIT, FAR_FROM_NOMINAL
from characterisation.words.numbers import NONE, SPACE, interval_text, listed, or_nan, percent, quantity
from mitsim.report.first_rows import bias_words, exact, share_words
from mitsim.report.unknowns_words import unknowns_in_words
from mitsim.study.dependence_words import dependences_in_words, remedies_in_words
from mitsim.study.statement_file import BudgetEntry, ExposureEntry, StatedMeasurement, StatementDocument


def statement_section(document: StatementDocument) -> dict[str, Any]:
    """Return everything that the section of the page shows, as texts."""
    measured = document.measurements
    lines = [line for one in measured.values() for line in one.budget]
    shown = [group for group in GROUPS if any(line.group == group for line in lines)]
    return {
        "view": document.view,
        "rendered": document.measured_by == "render",
        "trials": max((one.trials for one in measured.values()), default=0),
        "calibration": calibration_in_words(document),
        "exposure": exposed_in_words(document.exposure),
        "rows": [_row(name, one) for name, one in measured.items()],
        "tolerances": any(one.tolerance is not None for one in measured.values()),
        "legend": [{"colour": GROUPS[group][0], "name": GROUPS[group][1]} for group in shown],
        "bars": [_bar(name, one) for name, one in measured.items() if one.budget],
        "without_bar": [name for name, one in measured.items() if not one.budget],
        "budget_groups": [GROUPS[group][1] for group in shown],
        "budget_rows": [_budget_row(name, one, shown) for name, one in measured.items() if one.budget],
        "included": [influence.model_dump() for influence in document.influences if influence.included],
        "open_lines": any(not line.settled for line in lines),
        "depends": dependences_in_words(
            (name, one.unit, one.size_depends_on, None if one.decision is None else one.decision.needed)
            for name, one in measured.items()
        ),
        "find_out": remedies_in_words(one.size_depends_on for one in measured.values()),
        "missing": [influence.model_dump() for influence in document.influences if not influence.included],
        "losses": lost_features(
            (name, one.trials, [Loss(lost.reason, lost.count) for lost in one.losses]) for name, one in measured.items()
        ),
        "at_limit": [name for name, one in measured.items() if one.errors_of == AT_THE_LIMIT],
        "far": [name for name, one in measured.items() if one.errors_of == FAR_FROM_NOMINAL],
        "unsettled": [name for name, one in measured.items() if not one.settled],
    }


def rules_in_words(rules: Mapping[str, str]) -> str:
    """Return the decision rules of measurements, each with the names that it is for where there are several."""
    by_rule = dict[str, list[str]]()
    for name, rule in rules.items():
        by_rule.setdefault(rule, []).append(name)
    by_rule.pop("", None)
    if len(by_rule) == 1:
        return next(iter(by_rule))
    return "; ".join(f"{listed(names)}: {rule}" for rule, names in by_rule.items())


def stated_rules(document: StatementDocument) -> dict[str, str]:
    """Return the decision rule of each measurement of a statement; empty without a tolerance."""
    return {name: "" if one.decision is None else one.decision.rule for name, one in document.measurements.items()}


def calibration_in_words(document: StatementDocument, sizes: bool = True) -> str:
    """Return the calibration and, with ``sizes``, its drift; the file has the drift by the keys of the unknowns."""
    calibration, _, _ = document.calibration.partition("; drift:")
    if any(one.name.startswith("drift") and not one.included for one in document.influences):
        return f"{calibration}; used where and just after it was calibrated: no drift"
    drift = unknowns_in_words({"drift": document.unknowns.get("calibration", {})}) if sizes else ""
    return "; ".join(filter(None, [calibration, drift]))


def exposed_in_words(exposure_entry: ExposureEntry | None) -> str:
    """Describe the exposure of the captures, unless it follows the sensor's own rule."""
    if exposure_entry is None:
        return ""
    times = listed([f"{1e3 * seconds:.3g}" for seconds in exposure_entry.exposures_s])
    merged = ", merged" if len(exposure_entry.exposures_s) > 1 else ""
    return f"{times} ms{merged}, at {percent(exposure_entry.power)} of the projector's power"


def _row(name: str, measurement: StatedMeasurement) -> dict[str, str]:
    uncorrected = math.hypot(or_nan(measurement.bias), or_nan(measurement.standard_uncertainty))
    return {
        "name": name,
        "bias": bias_words(measurement.bias, measurement.bias_uncertainty, measurement.unit),
        "bias_uncertainty": quantity(measurement.bias_uncertainty, measurement.unit),
        "uncertainty": quantity(measurement.standard_uncertainty, measurement.unit),
        "uncorrected": quantity(uncorrected, measurement.unit),
        "interval": interval_words(measurement.interval, measurement.unit),
        "corrected": interval_words(measurement.interval_corrected, measurement.unit),
        "without": percent(measurement.without_value),
        "share": NONE if measurement.share_of_tolerance is None else share_words(measurement.share_of_tolerance),
        "tolerance": NONE if measurement.tolerance is None else exact(measurement.tolerance, measurement.unit),
        "verdict": measurement.verdict,
        "repeatability": quantity(measurement.repeatability, measurement.unit),
        "after_four": quantity(measurement.after_repeats.get("4"), measurement.unit),
    }


def _bar(name: str, measurement: StatedMeasurement) -> dict[str, Any]:
    """Return the parts of a bar in per cent of its width, in the order of :data:`GROUPS`, so that colours line up."""
    left, parts = 0.0, []
    by_group = {line.group: line for line in measurement.budget}
    for group, (colour, words) in GROUPS.items():
        if group in by_group:
            line = by_group[group]
            width = 100 * line.share
            label = f"{words}: {percent(line.share)} of the variance ({_share_interval(line)})"
            part = {"left": f"{left:.2f}", "width": f"{width:.2f}", "colour": colour, "title": label}
            parts.append(part | {"open": not line.settled})
            left += width
    return {"name": name, "parts": parts}


def _budget_row(name: str, measurement: StatedMeasurement, groups: list[str]) -> dict[str, Any]:
    by_group = {line.group: line for line in measurement.budget}
    cells = [_budget_cell(by_group.get(group), measurement.unit) for group in groups]
    return {"name": name, "cells": cells, "whole": quantity(measurement.standard_uncertainty, measurement.unit)}


def _budget_cell(line: BudgetEntry | None, unit: str) -> dict[str, str]:
    if line is None:
        return {"u": NONE, "share": ""}
    if not line.settled:
        return {"u": "too few trials", "share": _share_interval(line)}
    return {
        "u": quantity(math.sqrt(line.variance), unit),
        "share": f"{percent(line.share)}; {_share_interval(line)}",
    }


def _share_interval(line: BudgetEntry) -> str:
    low, high = line.share_interval
    return f"{100 * low:.0f} to {100 * high:.0f}{SPACE}%"


def interval_words(ends: tuple[float | None, float | None], unit: str) -> str:
    """Write both ends of an interval with their unit; a dash without one."""
    low, high = ends
    return NONE if low is None or high is None else f"{interval_text(low, high)}{'°' if unit == 'deg' else ' mm'}"
