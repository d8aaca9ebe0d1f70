"""Print measurements as tables of text, and as JSON values."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from characterisation.tasks.result import NOT_INCLUDED, Repeatability, Result
from mitsim.running.numbers import or_none
from mitsim.running.text_table import aligned
from mitsim.running.version import __version__

#: significant digits of an uncertainty. A value has as many decimals as its uncertainty, at least 3 and at most 6
_DIGITS = 2


def result_table(results: Sequence[Result]) -> str:
    """Return the table of one cloud's measurements, one line for each."""
    nominal = any(math.isfinite(one.nominal) for one in results)
    corrected = any(one.origin == "statement" for one in results)
    head = ["measurement", "value", "unit", "u", *(["nominal", "error"] if nominal else []), "points"]
    rows = [head + (["bias subtracted"] if corrected else [])]
    for one in results:
        points = f"{one.points}/{one.points_given}" if one.points_given else ""
        row = [one.name, number_with_decimals(one.value, one.uncertainty), one.unit, uncertainty_text(one.uncertainty)]
        if nominal:
            row += [_number_text(one.nominal), number_with_decimals(one.error, one.uncertainty)]
        row += [points] + ([_number_text(one.bias)] if corrected else [])
        rows.append(row + ([f"not possible: {one.reason}"] if not one.possible else []))
    return "\n".join(aligned(rows))


def repeatability_table(found: Sequence[Repeatability]) -> str:
    """Return the table of the repeatability over several clouds, one line for each measurement."""
    nominal = any(math.isfinite(one.nominal) for one in found)
    rows = [
        ["measurement", "n", "mean", "standard deviation", "unit", "u (rms of fits)", *(["error"] if nominal else [])]
    ]
    for one in found:
        rows.append(
            [
                one.name,
                f"{one.count}/{one.cloud_count}",
                number_with_decimals(one.mean, one.deviation),
                uncertainty_text(one.deviation),
                one.unit,
                uncertainty_text(one.uncertainty),
                *([number_with_decimals(one.mean - one.nominal, one.deviation)] if nominal else []),
            ]
        )
    return "\n".join(aligned(rows))


def result_tables(
    paths: Sequence[Path], results: Sequence[Sequence[Result]], repeatability: Sequence[Repeatability]
) -> str:
    """Return the table of each cloud, under its path if there are several, then the table of their repeatability."""
    if len(paths) == 1:
        tables = [result_table(results[0])]
    else:
        tables = [f"{path}\n{result_table(found)}\n" for path, found in zip(paths, results, strict=True)]
    return "\n".join([*tables, *([repeatability_table(repeatability)] if repeatability else [])])


def summary(clouds: Sequence[Sequence[Result]]) -> str:
    """Return one line: the number of measurements with a value, and the first without, with its reason."""
    every = [one for results in clouds for one in results]
    count = sum(one.possible for one in every)
    text = f"{count} of {len(every)} measurements" + (f" in {len(clouds)} clouds" if len(clouds) > 1 else "")
    first_failed = next((one for one in every if not one.possible), None)
    return text + (f"; {first_failed.name}: {first_failed.reason}" if first_failed else "")


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
                "name": one.name,
                "unit": one.unit,
                "count": one.count,
                "asked": one.cloud_count,
                "mean": or_none(one.mean),
                "standard_deviation": or_none(one.deviation),
                "fit_uncertainty": or_none(one.uncertainty),
            }
            for one in repeatability
        ],
    }


def beside_document(sensor: str, recorded: Sequence[Result], simulated: Sequence[Result]) -> dict[str, Any]:
    """Return the figures of the first cloud and of a simulated sensor before its targets, as JSON values."""
    return {
        "sensor": sensor,
        "recorded": [result_values(one) for one in recorded],
        "simulated": [result_values(one) for one in simulated],
    }


def result_values(one: Result) -> dict[str, Any]:
    """Return a measurement as JSON values; NaN becomes None."""
    return {
        "name": one.name,
        "unit": one.unit,
        "value": or_none(one.value),
        "standard_uncertainty": or_none(one.uncertainty),
        "uncertainty_from": one.origin,
        "points": one.points,
        "points_given": one.points_given,
        "nominal": or_none(one.nominal),
        "bias": one.bias,
        "reason": one.reason,
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
