"""Standoffs of a study's views, checked against working range and characterised range of the sensor."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from characterisation.files.errors import InputError
from mitsim.sensor.sensor import Sensor
from mitsim.sensor.working_volume import nearest_standoff
from mitsim.views.table import ViewsTable


def chosen_standoffs(where: str | Path, table: ViewsTable, sensor: Sensor, radius_mm: float) -> list[float]:
    """Return |V| of the views [mm], nearest first.

    They are those of the table, or else the nearest at which the sensor can measure a ball around the part. Raises
    InputError for a standoff outside the sensor's working range.

    Parameters
    ----------
    where, table, sensor, radius_mm
        File of the table ``[views]``, for the error, and the table; sensor; radius of a ball around the part.
    """
    near, far = sensor.working_range_mm
    for standoff in table.standoffs:
        if not near <= standoff <= far:
            allowed = f"{near:g} to {far:g} mm, the working range of {sensor.name}"
            raise InputError(where, _key(table), f"{standoff:g} mm", allowed)
    return table.standoffs or [nearest_standoff(sensor, radius_mm)]


def characterised_range(
    where: str | Path, table: ViewsTable, sensor: Sensor, standoffs: Sequence[float], distances: Sequence[float]
) -> tuple[float, float]:
    """Return the range of |V| [mm] that a view may have: the part of the sensor's working range that is characterised.

    Raises InputError for a standoff outside the characterised ``distances`` [mm].

    Parameters
    ----------
    where, table, sensor, standoffs, distances
        As in :func:`chosen_standoffs`; |V| of the views, and characterised ones [mm].
    """
    for standoff in standoffs:
        if not min(distances) <= standoff <= max(distances):
            allowed = f"{min(distances):g} to {max(distances):g} mm, the characterised distances"
            raise InputError(where, _key(table), f"{standoff:g} mm", allowed)
    near, far = sensor.working_range_mm
    return max(near, min(distances)), min(far, max(distances))


def _key(table: ViewsTable) -> str:
    return "views.standoff_mm" if table.standoffs_mm is None else "views.standoffs_mm"
