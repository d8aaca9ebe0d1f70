"""Measurements as text and as JSON values."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mitsim.measuring.result import LEAVES_OUT, Repeated, Result
from mitsim.version import __version__

#: significant digits of an uncertainty; a value has as many decimals as its uncertainty
_DIGITS = 2


def result_table(results: Sequence[Result]) -> str:
    """One cloud's measurements, a line each."""
    nominal = any(math.isfinite(one.nominal) for one in results)
    biased = any(one.origin == "statement" for one in results)
    head = ["measurement", "value", "unit", "u", *(["nominal", "error"] if nominal else []), "points"]
    rows = [head + (["bias taken off"] if biased else [])]
    for one in results:
        points = f"{one.points}/{one.points_given}" if one.points_given else ""
        row = [one.name, _shown(one.value, one.uncertainty), one.unit, _uncertain(one.uncertainty)]
        if nominal:
            row += [_plain(one.nominal), _shown(one.error, one.uncertainty)]
        row += [points] + ([_plain(one.bias)] if biased else [])
        rows.append(row + ([f"not possible: {one.reason}"] if not one.possible else []))
    return _laid_out(rows)


def repeatability_table(found: Sequence[Repeated]) -> str:
    """Measurements over several clouds, a line each."""
    nominal = any(math.isfinite(one.nominal) for one in found)
    rows = [
        ["measurement", "n", "mean", "standard deviation", "unit", "u (mean of fits)", *(["error"] if nominal else [])]
    ]
    for one in found:
        rows.append(
            [
                one.name,
                f"{one.count}/{one.asked}",
                _shown(one.mean, one.deviation),
                _uncertain(one.deviation),
                one.unit,
                _uncertain(one.uncertainty),
                *([_shown(one.mean - one.nominal, one.deviation)] if nominal else []),
            ]
        )
    return _laid_out(rows)


def result_tables(paths: Sequence[Path], results: Sequence[Sequence[Result]], repeated: Sequence[Repeated]) -> str:
    """Return the table of each cloud, under its path if there are several, and that of their repeatability."""
    if len(paths) == 1:
        tables = [result_table(results[0])]
    else:
        tables = [f"{path}\n{result_table(found)}\n" for path, found in zip(paths, results, strict=True)]
    return "\n".join([*tables, *([repeatability_table(repeated)] if repeated else [])])


def summary(clouds: Sequence[Sequence[Result]]) -> str:
    """One line that says the result."""
    every = [one for results in clouds for one in results]
    done = sum(one.possible for one in every)
    text = f"{done} of {len(every)} measurements" + (f" in {len(clouds)} clouds" if len(clouds) > 1 else "")
    lost = next((one for one in every if not one.possible), None)
    return text + (f"; {lost.name}: {lost.reason}" if lost else "")


def measured_document(
    clouds: Sequence[tuple[Path, str, str]], results: Sequence[Sequence[Result]], repeated: Sequence[Repeated]
) -> dict[str, Any]:
    """All measurements as JSON values, of clouds by path, sensor and source.

    See docs/reference/formats/printed-json.md.
    """
    return {
        "schema_version": 1,
        "mitsim": __version__,
        "uncertainty": {"of": "standard uncertainty, k = 1", "from_fit_leaves_out": list(LEAVES_OUT)},
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
                "asked": one.asked,
                "mean": _number(one.mean),
                "standard_deviation": _number(one.deviation),
                "fit_uncertainty": _number(one.uncertainty),
            }
            for one in repeated
        ],
    }


def result_values(one: Result) -> dict[str, Any]:
    """Return a measurement as JSON values."""
    return {
        "name": one.name,
        "unit": one.unit,
        "value": _number(one.value),
        "standard_uncertainty": _number(one.uncertainty),
        "uncertainty_from": one.origin,
        "points": one.points,
        "points_given": one.points_given,
        "nominal": _number(one.nominal),
        "bias": one.bias,
        "reason": one.reason,
    }


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _uncertain(value: float) -> str:
    return f"{value:.{_DIGITS}g}" if math.isfinite(value) else "-"


def _shown(value: float, uncertainty: float) -> str:
    """Value to the decimals of its uncertainty, at least three and at most six."""
    if not math.isfinite(value):
        return "-"
    decimals = 3
    if math.isfinite(uncertainty) and uncertainty > 0:
        decimals = min(max(_DIGITS - 1 - math.floor(math.log10(uncertainty)), 3), 6)
    return f"{value:.{decimals}f}"


def _plain(value: float) -> str:
    return f"{value:g}" if math.isfinite(value) else "-"


def _laid_out(rows: list[list[str]]) -> str:
    wide = max(len(row) for row in rows)
    widths = [
        max((len(row[k]) for row in rows if k < len(row) - (len(row) > len(rows[0]))), default=0) for k in range(wide)
    ]
    return "\n".join(
        "  ".join(text.ljust(width) for text, width in zip(row, widths, strict=False)).rstrip() for row in rows
    )
