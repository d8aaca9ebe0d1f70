"""At which distances a study's views stand, and whether that is where the sensor measures and was characterised."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from mitsim.errors import InputError
from mitsim.sensor.preset import Sensor
from mitsim.sensor.working_volume import nearest_standoff
from mitsim.views.table import ViewsTable


def chosen_standoffs(where: str | Path, table: ViewsTable, sensor: Sensor, radius_mm: float) -> list[float]:
    """|V| of the views [mm], nearest first: the table's own, or as near as a ball about the part can be measured.

    Raises
    ------
    InputError
        For a standoff outside the sensor's working range.
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
    """Between which |V| [mm] a view may stand: in the sensor's working range, and where it is characterised.

    Raises
    ------
    InputError
        For a standoff beyond the ``distances`` that are characterised [mm].
    """
    for standoff in standoffs:
        if not min(distances) <= standoff <= max(distances):
            allowed = f"{min(distances):g} to {max(distances):g} mm, the distances that are characterised"
            raise InputError(where, _key(table), f"{standoff:g} mm", allowed)
    near, far = sensor.working_range_mm
    return max(near, min(distances)), min(far, max(distances))


def _key(table: ViewsTable) -> str:
    return "views.standoff_mm" if table.standoffs_mm is None else "views.standoffs_mm"
