"""Format numbers for readers, with a unit and with significant digits only, and tables; convert missing numbers."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

#: sign of negative numbers
MINUS = "\N{MINUS SIGN}"

#: stands for a number that is missing
NONE = "\N{EN DASH}"

#: space between a number and its unit
SPACE = "\N{NO-BREAK SPACE}"


def two_digits(value: float) -> str:
    """Round to two significant digits, which suffice for a standard uncertainty (GUM 7.2.6)."""
    if not math.isfinite(value):
        return NONE
    if value == 0:
        return "0"
    decimals = 1 - math.floor(math.log10(abs(value)))
    rounded = round(value, decimals)
    if rounded:  # rounding up can add a digit: 0.0996 became 0.100
        decimals = 1 - math.floor(math.log10(abs(rounded)))
    return signed(f"{rounded:.{max(decimals, 0)}f}")


def rounded(value: float, decimals: int = 0) -> str:
    """Round to a number of decimal places, without a negative zero."""
    return signed(f"{round(value, decimals) + 0.0:.{decimals}f}") if math.isfinite(value) else NONE


def beside(value: float, uncertainty: float | None) -> str:
    """Round an estimate to the decimal places of its standard uncertainty (GUM 7.2.6), or to two digits without one."""
    if not uncertainty or not math.isfinite(uncertainty):
        return two_digits(value)
    return rounded(value, len(two_digits(uncertainty).partition(".")[2]))


def interval_text(low: float, high: float) -> str:
    """Write the ends of an interval with the decimal places that two digits of half its width need."""
    half = (high - low) / 2 or max(abs(low), abs(high)) or 1.0
    decimals = max(0, 1 - math.floor(math.log10(half)))
    return f"{rounded(low, decimals)} to {rounded(high, decimals)}"


def accepted_text(low: float, high: float, tolerance: float) -> str:
    """Write accepted readings to a hundredth of the tolerance or finer, and none beyond: ``19.82 to 20.18``.

    ``low`` is -inf for ``up to 0.13``.
    """
    finest = min(tolerance, high - low) if high > low else tolerance
    decimals = max(0, 2 - math.floor(math.log10(tolerance)), 1 - math.floor(math.log10(finest)))
    unit, near = 10.0**decimals, 1e-6  # a number that is written with these decimals stays
    most = rounded(math.floor(high * unit + near) / unit, decimals)
    return f"up to {most}" if math.isinf(low) else f"{rounded(math.ceil(low * unit - near) / unit, decimals)} to {most}"


def signed(text: str) -> str:
    """Replace hyphens by minus signs."""
    return text.replace("-", MINUS)


def unit_symbol(unit: str) -> str:
    """Write ``deg`` as °; return other units unchanged."""
    return "°" if unit == "deg" else unit


def with_degree_signs(text: str) -> str:
    """Write ``°`` for ``deg`` after a number."""
    return re.sub(r"(?<=\d) deg\b", "°", text)


def quantity(value: float | None, unit: str) -> str:
    """Write a quantity with two significant digits and its unit; a dash without a value."""
    if value is None or not math.isfinite(value):
        return NONE
    return f"{two_digits(value)}°" if unit == "deg" else f"{two_digits(value)}{SPACE}{unit}"


def percent(share: float | None) -> str:
    """Write a share as a percentage, with one decimal below ten; 100 % is all of it; a dash without a value."""
    if share is None or not math.isfinite(share):
        return NONE
    if share == 0:
        return f"0{SPACE}%"
    if 0 < share < 0.0005:
        return f"<{SPACE}0.1{SPACE}%"
    if 0.995 <= share < 1:
        return f">{SPACE}99{SPACE}%"
    return f"{100 * share:.{1 if share < 0.0995 else 0}f}{SPACE}%"


def count(number: int) -> str:
    """Write a whole number with thin spaces between the thousands."""
    return f"{number:,}".replace(",", "\N{NARROW NO-BREAK SPACE}")


def how_many(number: int, noun: str) -> str:
    """Return a number with its noun, in the plural except of one: ``1 view``, ``2 views``."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


def finish_name(finish: str, roughness: float) -> str:
    """Return the name of a finish: ``matt white``, ``aluminium/ground, Ra 0.37 µm``."""
    name = finish.replace("_", " ")
    return name if math.isnan(roughness) else f"{name}, Ra {roughness:g} µm"


def time_in_words(seconds: float) -> str:
    """Write a time in seconds, or in minutes from 100 s on."""
    return f"{seconds:.0f} s" if seconds < 100 else f"{seconds / 60:.0f} min"


def listed(parts: list[str]) -> str:
    """Join words to a list: ``a``, ``a and b``, ``a, b and c``."""
    return " and ".join(filter(None, [", ".join(parts[:-1]), parts[-1]])) if parts else ""


def or_none(value: float) -> float | None:
    """Return a finite number as it is, and None for others, which JSON cannot hold."""
    return value if math.isfinite(value) else None


def or_nan(value: float | None) -> float:
    """Return a number as it is, and NaN for None."""
    return math.nan if value is None else value


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the lines of a table with columns as wide as their widest cell and two spaces between columns.

    The first row is the header. A cell beyond its columns, such as a reason, widens no column.
    """
    widths = [max(len(row[k]) for row in rows if len(row) > k) for k in range(len(rows[0]))]
    return [
        "  ".join(cell.ljust(width) for cell, width in zip(row, [*widths, 0], strict=False)).rstrip() for row in rows
    ]
