"""Print measurements as tables of text, and as JSON values."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from characterisation.tasks.result import NOT_INCLUDED, Repeatability, Result
from characterisation.words.numbers import aligned, or_none
from characterisation.words.version import __version__

#: significant digits of an uncertainty. A value has as many decimals as its uncertainty, at least 3 and at most 6
_DIGITS = 2


def result_table(results: Sequence[Result]) -> str:
    """Return the table of one cloud's measurements, one line for each."""
    nominal = any(math.isfinite(result.nominal) for result in results)
    corrected = any(result.origin == "statement" for result in results)
    head = ["measurement", "value", "unit", "u", *(["nominal", "error"] if nominal else []), "points"]
    rows = [head + (["bias subtracted"] if corrected else [])]
    for result in results:
        points = f"{result.points}/{result.points_given}" if result.points_given else ""
        row = [
            result.name,
            number_with_decimals(result.value, result.uncertainty),
            result.unit,
            uncertainty_text(result.uncertainty),
        ]
        if nominal:
            row += [_number_text(result.nominal), number_with_decimals(result.error, result.uncertainty)]
        row += [points] + ([_number_text(result.bias)] if corrected else [])
        rows.append(row + ([f"not possible: {result.reason}"] if not result.possible else []))
    return "\n".join(aligned(rows))


def repeatability_table(repeatabilities: Sequence[Repeatability]) -> str:
    """Return the table of the repeatability over several clouds, one line for each measurement."""
    nominal = any(math.isfinite(repeatability.nominal) for repeatability in repeatabilities)
    head = ["measurement", "n", "mean", "standard deviation", "unit", "u (rms of fits)"]
    rows = [head + ["error"] * nominal]
    for repeatability in repeatabilities:
        error = number_with_decimals(repeatability.mean - repeatability.nominal, repeatability.deviation)
        row = [
            repeatability.name,
            f"{repeatability.count}/{repeatability.cloud_count}",
            number_with_decimals(repeatability.mean, repeatability.deviation),
            uncertainty_text(repeatability.deviation),
            repeatability.unit,
            uncertainty_text(repeatability.uncertainty),
        ]
        rows.append(row + [error] * nominal)
    return "\n".join(aligned(rows))


def result_tables(
    paths: Sequence[Path], results: Sequence[Sequence[Result]], repeatability: Sequence[Repeatability]
) -> str:
    """Return the table of each cloud, under its path if there are several, then the table of their repeatability."""
    if len(paths) == 1:
        tables = [result_table(results[0])]
    else:
        tables = [
            f"{path}\n{result_table(cloud_results)}\n" for path, cloud_results in zip(paths, results, strict=True)
        ]
    return "\n".join([*tables, *([repeatability_table(repeatability)] if repeatability else [])])


def summary(clouds: Sequence[Sequence[Result]]) -> str:
    """Return one line: how many measurements have a value, the first without, with its reason, and those of u 0."""
    every = [result for results in clouds for result in results]
    count = sum(result.possible for result in every)
    text = f"{count} of {len(every)} measurements" + (f" in {len(clouds)} clouds" if len(clouds) > 1 else "")
    first_failed = next((result for result in every if not result.possible), None)
    text += f"; {first_failed.name}: {first_failed.reason}" if first_failed else ""
    exact = list(dict.fromkeys(result.name for result in every if result.origin == "fit" and result.uncertainty == 0))
    shown = ", ".join(exact[:3]) + ", ..." * (len(exact) > 3)
    why = "its points have no scatter, as depths of one whole mm have, which hide noise and up to half a step"
    return text + (f"; u is 0 of {shown}: {why}" if exact else "")


def measured_document(
    clouds: Sequence[tuple[Path, str, str]], results: Sequence[Sequence[Result]], repeatability: Sequence[Repeatability]
) -> dict[str, Any]:
    """Return all measurements as JSON values.

    ``clouds`` are path, sensor and source of each cloud. The keys are in docs/reference/formats/printed-json.md.
    """
    return {
        "schema_version": 1,
        "mitsim": __version__,
        "uncertainty": {"of": "standard uncertainty, k = 1", "from_fit_leaves_out": list(NOT_INCLUDED)},
        "clouds": [
            {
                "path": str(path),
                "sensor": sensor,
                "source": source,
                "measurements": [result_values(result) for result in measured],
            }
            for (path, sensor, source), measured in zip(clouds, results, strict=True)
        ],
        "repeatability": [
            {
                "name": quantity.name,
                "unit": quantity.unit,
                "count": quantity.count,
                "asked": quantity.cloud_count,
                "mean": or_none(quantity.mean),
                "standard_deviation": or_none(quantity.deviation),
                "fit_uncertainty": or_none(quantity.uncertainty),
            }
            for quantity in repeatability
        ],
    }


def beside_document(sensor: str, recorded: Sequence[Result], simulated: Sequence[Result]) -> dict[str, Any]:
    """Return the figures of the first cloud and of a simulated sensor before its targets, as JSON values."""
    return {
        "sensor": sensor,
        "recorded": [result_values(result) for result in recorded],
        "simulated": [result_values(result) for result in simulated],
    }


def result_values(result: Result) -> dict[str, Any]:
    """Return a measurement as JSON values; NaN becomes None."""
    return {
        "name": result.name,
        "unit": result.unit,
        "value": or_none(result.value),
        "standard_uncertainty": or_none(result.uncertainty),
        "uncertainty_from": result.origin,
        "points": result.points,
        "points_given": result.points_given,
        "nominal": or_none(result.nominal),
        "bias": result.bias,
        "reason": result.reason,
    }


def uncertainty_text(value: float) -> str:
    """Return an uncertainty with two significant digits; a hyphen without one."""
    return f"{value:.{_DIGITS}g}" if math.isfinite(value) else "-"


def number_with_decimals(value: float, uncertainty: float) -> str:
    """Return a value with the decimals of its uncertainty, at least three and at most six; three without one."""
    if not math.isfinite(value):
        return "-"
    decimals = 3
    if math.isfinite(uncertainty) and uncertainty > 0:
        decimals = min(max(_DIGITS - 1 - math.floor(math.log10(uncertainty)), 3), 6)
    return f"{value:.{decimals}f}"


def _number_text(value: float) -> str:
    return f"{value:g}" if math.isfinite(value) else "-"
