"""The numbers of a sensor file that dots on a sheet can tell: where each stands, how it is varied, what shows it.

A number is varied as a logarithm where it is a factor, and as a square where it blurs: variances of blurs add.
``without`` says which capture would tell it where one image with the projector on does not.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from mitsim.sensor.pattern import DiffractionSpots, RandomDots
from mitsim.sensor.preset import Sensor
from mitsim.sensor.sensor_file import RoomTable


@dataclass(frozen=True)
class Parameter:
    """A number of a sensor file.

    ``key`` as in the file, ``projector.flux_w``; ``unit``; ``get`` the varied number of a sensor and ``set`` it;
    ``value`` of the varied number as it stands in the file; ``spread`` about the file's value, one sigma, ``step`` for
    derivatives, ``low`` and ``high``, all of the varied number; ``without`` the capture that would tell it.
    """

    key: str
    unit: str
    get: Callable[[Sensor], float]
    set: Callable[[Sensor, float], Sensor]
    value: Callable[[float], float]
    spread: float
    step: float
    low: float = -np.inf
    high: float = np.inf
    without: str = ""


def _of_imager(key: str, field: str, unit: str, without: str) -> Parameter:
    def put(sensor: Sensor, x: float) -> Sensor:
        changed: dict[str, Any] = {field: float(np.exp(x))}
        return replace(sensor, imager=replace(sensor.imager, **changed))

    return Parameter(
        key, unit, lambda sensor: float(np.log(max(getattr(sensor.imager, field), 1e-3))), put,
        lambda x: float(np.exp(x)), 1.5, 0.1, without=without,
    )  # fmt: skip


def _root(x: float) -> float:
    return float(np.sqrt(max(x, 0.0)))


def _of_pattern(key: str, field: str, unit: str, squared: bool, spread: float, step: float) -> Parameter:
    def get(sensor: Sensor) -> float:
        value = float(getattr(sensor.pattern, field))
        return value**2 if squared else float(np.log(value))

    def put(sensor: Sensor, x: float) -> Sensor:
        value = _root(x) if squared else float(np.exp(x))
        return replace(sensor, pattern=sensor.pattern.model_copy(update={field: value}))  # type: ignore[union-attr]

    return Parameter(
        key, unit, get, put, _root if squared else lambda x: float(np.exp(x)), spread, step,
        0.0 if squared else -np.inf, without="one with the projector on, of an even sheet",
    )  # fmt: skip


FLUX = Parameter(
    "projector.flux_w", "W", lambda sensor: float(np.log(sensor.projector.flux)),
    lambda sensor, x: replace(sensor, projector=replace(sensor.projector, flux=float(np.exp(x)))),
    lambda x: float(np.exp(x)), 4.0, 0.1, without="one with the projector on",
)  # fmt: skip

PROJECTOR_CORNER = Parameter(
    "projector.corner_illumination", "1", lambda sensor: float(np.log(sensor.projector.corner_illumination)),
    lambda sensor, x: replace(sensor, projector=replace(sensor.projector, corner_illumination=float(np.exp(x)))),
    lambda x: float(np.exp(x)), 1.0, 0.15, -4.6, 0.0, without="one of a sheet that fills the field",
)  # fmt: skip

BLACK_LEVEL = Parameter(
    "projector.black_level", "1", lambda sensor: sensor.projector.black_level,
    lambda sensor, x: replace(sensor, projector=replace(sensor.projector, black_level=float(np.clip(x, 0, 1)))),
    lambda x: x, 0.5, 0.05, 0.0, 0.95, without="one with the projector off",
)  # fmt: skip

FULL_WELL = _of_imager("imager.full_well_e", "full_well", "e-", "repeats of one pose")
READ_NOISE = _of_imager("imager.read_noise_e", "read_noise", "e-", "one in the dark")

SMOOTHING = Parameter(
    "imager.smoothing_px", "px", lambda sensor: sensor.imager.smoothing_px**2,
    lambda sensor, x: replace(sensor, imager=replace(sensor.imager, smoothing_px=_root(x))), _root, 0.7, 0.05, 0.0, 4.0,
    without="repeats of one pose",
)  # fmt: skip


#: keys of the light of the room, in the order of the terms of its irradiance
ROOM_KEYS = ("irradiance_w_mm2", "gradient[0]", "gradient[1]", "curvature[0]", "curvature[1]", "curvature[2]")

_ROOM_OFF = "one with the projector off"


def room_parameters(unit: float) -> list[Parameter]:
    """Terms of the irradiance of the room: 1, x, y, xx, xy, yy; ``unit`` [W/mm^2], as much as the projector's own.

    They are varied as irradiances, so that all of them mean something while the room is still dark. Over half a unit of
    slope, the edge of a wide view, lamps and windows are taken to change the light by half of it, one sigma.
    """
    spreads, steps = (3.0, 1.0, 1.0, 2.0, 2.0, 2.0), (0.1, 0.2, 0.2, 0.5, 0.5, 0.5)
    return [
        Parameter(
            f"room.{key}", "W/mm^2" if index == 0 else "1", partial(_room_term, unit, index),
            partial(_with_room_term, unit, index), (lambda x: unit * x) if index == 0 else (lambda x: x),
            spread, step, 0.02 if index == 0 else -np.inf, without=_ROOM_OFF,
        )
        for index, (key, spread, step) in enumerate(zip(ROOM_KEYS, spreads, steps, strict=True))
    ]  # fmt: skip


def room_terms(unit: float, sensor: Sensor) -> list[float]:
    """The six terms of a sensor's room, over ``unit``."""
    room = sensor.room
    if room is None:
        return [0.0] * len(ROOM_KEYS)
    share = room.irradiance_w_mm2 / unit
    return [share, *(share * term for term in (*room.gradient, *room.curvature))]


def with_room_terms(unit: float, sensor: Sensor, terms: list[float]) -> Sensor:
    """The sensor with a room of six terms."""
    share = max(terms[0], 1e-6)
    gradient = [float(np.clip(term / share, -20, 20)) for term in terms[1:3]]
    curvature = [float(np.clip(term / share, -200, 200)) for term in terms[3:]]
    room = RoomTable.model_validate({"irradiance_w_mm2": unit * share, "gradient": gradient, "curvature": curvature})
    return replace(sensor, room=room)


def _room_term(unit: float, index: int, sensor: Sensor) -> float:
    return room_terms(unit, sensor)[index]


def _with_room_term(unit: float, index: int, sensor: Sensor, x: float) -> Sensor:
    terms = room_terms(unit, sensor)
    terms[index] = x
    return with_room_terms(unit, sensor, terms)


def pattern_parameters(sensor: Sensor) -> list[Parameter]:
    """What a pattern of dots can be told of itself: how large its dots are, and how sharp."""
    if isinstance(sensor.pattern, RandomDots):
        return [
            _of_pattern("pattern.run_length_px", "run_length_px", "px", False, 0.7, 0.05),
            _of_pattern("pattern.blur_px", "blur_px", "px", True, 3.0, 0.2),
        ]
    if isinstance(sensor.pattern, DiffractionSpots):
        return [
            _of_pattern("pattern.cell_px", "cell_px", "px", False, 0.7, 0.05),
            _of_pattern("pattern.spot_px", "spot_px", "px", False, 0.7, 0.05),
        ]
    return []
