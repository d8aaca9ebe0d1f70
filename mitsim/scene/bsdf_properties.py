"""Read and check the properties of a BSDF in a scene file: names, choices and limits of numbers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from characterisation.files.errors import InputError, nearest


def only_known(props: Any, where: str, names: Sequence[str]) -> None:
    """Raise :class:`InputError` if a BSDF has a property that is not ``names``."""
    for key in props.keys():  # noqa: SIM118 - not a dict
        if key not in names:
            raise InputError(where, str(key), "an unknown property", ", ".join(names), nearest(str(key), list(names)))


def choice(props: Any, where: str, key: str, default: str, choices: list[str]) -> str:
    """Return a text property of a BSDF.

    Parameters
    ----------
    props, where
        Mitsuba's properties of the BSDF, and its name for messages.
    key, default
        Of the property; the default is for a BSDF without it.
    choices
        Allowed values.

    Raises
    ------
    InputError
        If the value is not one of ``choices``.

    See Also
    --------
    number_within : a number
    """
    value = props.get(key, default)
    if value not in choices:
        raise InputError(where, key, repr(value), ", ".join(choices), nearest(str(value), choices))
    return str(value)


def number_within(props: Any, where: str, key: str, default: float | None, low: float, high: float, unit: str) -> float:
    """Return a numeric property of a BSDF.

    Parameters
    ----------
    props, where
        Mitsuba's properties of the BSDF, and its name for messages.
    key, default
        Of the property; the default is for a BSDF without it, None if it is required.
    low, high, unit
        Allowed values, and their unit for messages.

    Raises
    ------
    InputError
        If there is neither a value nor a default, or the value is no number or outside the limits.

    See Also
    --------
    choice : a text
    """
    allowed = f"a number from {low:g} to {high:g} {unit}".rstrip()
    value = props.get(key, default)
    if value is None:
        raise InputError(where, key, "nothing", allowed)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(where, key, repr(value), allowed, f'write <float name="{key}" value="..."/>')
    if not low <= value <= high:
        raise InputError(where, key, f"{value:g}", allowed)
    return float(value)
