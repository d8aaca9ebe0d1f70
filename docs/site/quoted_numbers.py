"""When two printed numbers are the same figure.

Two whole numbers are equal; of 1000 or more they count pixels or points and may differ by 0.1 %, because other
processors round differently. Other numbers are the same if both can be roundings of one value: they differ by at most
half a unit in the last digit of the one plus half a unit in the last digit of the other, and no digit is quoted that
the command does not print.
"""

from __future__ import annotations

NUMBER = r"(?<![A-Za-z_\d.])[-+−]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?(?![A-Za-z_\d])"


def same(quoted: str, found: str) -> bool:
    """Return whether two printed numbers are the same figure."""
    first, second = (float(one.replace("−", "-")) for one in (quoted, found))
    if unit(quoted) >= 1 and unit(found) >= 1:
        return first == second or abs(first - second) <= 1e-3 * abs(first) >= 1
    rounded = (unit(quoted) + unit(found)) / 2 if unit(found) <= unit(quoted) else 0.0
    return abs(first - second) <= rounded * (1 + 1e-9)


def unit(number: str) -> float:
    """Return the unit of the last digit of a printed number."""
    digits, _, power = number.lower().partition("e")
    return float(10.0 ** (int(power or 0) - len(digits.partition(".")[2])))
