"""Properties of a BSDF in a scene file, checked: known names, choices, numbers within limits."""

from __future__ import annotations

from typing import Any

from mitsim.errors import InputError, nearest


def only_known(props: Any, where: str, known: tuple[str, ...]) -> None:
    """Raise an error for a property whose name is not known."""
    for key in props.keys():  # noqa: SIM118 - not a dict
        if key not in known:
            raise InputError(where, str(key), "an unknown property", ", ".join(known), nearest(str(key), list(known)))


def choice(props: Any, where: str, key: str, default: str, known: list[str]) -> str:
    """Return the text of a property, one of those known."""
    value = props.get(key, default)
    if value not in known:
        raise InputError(where, key, repr(value), ", ".join(known), nearest(str(value), known))
    return str(value)


def number_within(props: Any, where: str, key: str, default: float | None, low: float, high: float, unit: str) -> float:
    """Return the number of a property, its default if the author wrote none."""
    allowed = f"a number from {low:g} to {high:g} {unit}".rstrip()
    value = props.get(key, default)
    if value is None:
        raise InputError(where, key, "nothing", allowed)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(where, key, repr(value), allowed, f'write <float name="{key}" value="..."/>')
    if not low <= value <= high:
        raise InputError(where, key, f"{value:g}", allowed)
    return float(value)
