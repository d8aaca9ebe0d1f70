"""Define the parameters of a sensor file that dots on a sheet determine: access, prior, and the capture required.

The varied quantities are chosen so that each changes one feature:

- the projector's power, and the read noise over the full well;
- the inverse of the full well, the gain, which only noise determines;
- the light of the room over the projector's;
- logarithms of factors;
- squares of blurs and of read noise, since variances add.

The order of a list therefore matters: full well, power, room. ``determined_by`` describes the capture that determines a
parameter if dots alone do not.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from mitsim.sensor.pattern import DiffractionSpots, RandomDots
from mitsim.sensor.preset import Sensor
from mitsim.sensor.sensor_file import RoomTable
from mitsim.twin.sensor.estimate import Scale


@dataclass(frozen=True)
class Parameter:
    """A number of a sensor file.

    - ``key`` as in the file, ``projector.flux_w``; ``unit``.
    - ``read``: returns the number in the file's unit.
    - ``get``: returns the varied quantity; ``put`` inserts it.
    - ``spread`` about the file's value, one sigma; ``step`` for derivatives; ``low`` and ``high``: bounds. All of the
      varied quantity.
    - ``scale`` on which the number in the file is approximately normal.
    - ``determined_by``: the capture that would determine it.
    """

    key: str
    unit: str
    read: Callable[[Sensor], float]
    get: Callable[[Sensor], float]
    put: Callable[[Sensor, float], Sensor]
    spread: float
    step: float
    low: float = -np.inf
    high: float = np.inf
    scale: Scale = "linear"
    determined_by: str = ""


#: full well [e-], and read noise as a share of it, whose varied quantity is 1
_WELL, _READ = 15_000.0, 3e-3


def _log(value: float) -> float:
    return float(np.log(max(value, 1e-9)))


def _with_full_well(sensor: Sensor, x: float) -> Sensor:
    """Set the full well and keep grey levels: power, room and read noise scale with it."""
    chip, ratio = sensor.imager, _WELL / max(x, 1e-3) / sensor.imager.full_well
    projector, room = replace(sensor.projector, flux=sensor.projector.flux * ratio), sensor.room
    if room is not None:
        room = room.model_copy(update={"irradiance_w_mm2": room.irradiance_w_mm2 * ratio})
    chip = replace(chip, full_well=chip.full_well * ratio, read_noise=chip.read_noise * ratio)
    return replace(sensor, imager=chip, projector=projector, room=room)


def _with_flux(sensor: Sensor, x: float) -> Sensor:
    """Set the power and keep the ratio of the room's light to it."""
    projector, room = sensor.projector, sensor.room
    ratio = float(np.exp(x)) * sensor.imager.full_well / projector.flux
    if room is not None:
        room = room.model_copy(update={"irradiance_w_mm2": room.irradiance_w_mm2 * ratio})
    return replace(sensor, projector=replace(projector, flux=projector.flux * ratio), room=room)


def _with_corner(sensor: Sensor, x: float) -> Sensor:
    return replace(sensor, projector=replace(sensor.projector, corner_illumination=float(np.exp(x))))


def _with_black_level(sensor: Sensor, x: float) -> Sensor:
    return replace(sensor, projector=replace(sensor.projector, black_level=float(np.clip(x, 0, 1))))


def _with_read_noise(sensor: Sensor, x: float) -> Sensor:
    chip = sensor.imager
    return replace(sensor, imager=replace(chip, read_noise=_READ * float(np.sqrt(max(x, 0.0))) * chip.full_well))


def _with_smoothing(sensor: Sensor, x: float) -> Sensor:
    return replace(sensor, imager=replace(sensor.imager, smoothing_px=float(np.sqrt(max(x, 0.0)))))


def _with_corner_blur(sensor: Sensor, x: float) -> Sensor:
    chip = sensor.imager
    corner = float(np.sqrt(chip.blur_px**2 + x)) if x > 0 else None
    return replace(sensor, imager=replace(chip, corner_blur_px=corner))


def _corner_blur(sensor: Sensor) -> float:
    chip = sensor.imager
    return chip.blur_px if chip.corner_blur_px is None else chip.corner_blur_px


FULL_WELL = Parameter(
    "imager.full_well_e",
    "e-",
    lambda sensor: sensor.imager.full_well,
    lambda sensor: _WELL / sensor.imager.full_well,
    _with_full_well,
    1.0,
    0.05,
    0.02,
    scale="inverse",
    determined_by="repeats of one pose",
)

READ_NOISE = Parameter(
    "imager.read_noise_e",
    "e-",
    lambda sensor: sensor.imager.read_noise,
    lambda sensor: (sensor.imager.read_noise / sensor.imager.full_well / _READ) ** 2,
    _with_read_noise,
    3.0,
    0.1,
    0.0,
    scale="linear",
    determined_by="a capture in the dark",
)

SMOOTHING = Parameter(
    "imager.smoothing_px",
    "px",
    lambda sensor: sensor.imager.smoothing_px,
    lambda sensor: sensor.imager.smoothing_px**2,
    _with_smoothing,
    0.7,
    0.05,
    0.0,
    4.0,
    determined_by="repeats of one pose",
)

FLUX = Parameter(
    "projector.flux_w",
    "W",
    lambda sensor: sensor.projector.flux,
    lambda sensor: _log(sensor.projector.flux / sensor.imager.full_well),
    _with_flux,
    4.0,
    0.1,
    scale="inverse",
    determined_by="a capture with the projector on",
)

PROJECTOR_CORNER = Parameter(
    "projector.corner_illumination",
    "1",
    lambda sensor: sensor.projector.corner_illumination,
    lambda sensor: _log(sensor.projector.corner_illumination),
    _with_corner,
    1.0,
    0.15,
    -4.6,
    0.0,
    scale="logarithm",
    determined_by="a capture of a sheet that fills the field",
)

CORNER_BLUR = Parameter(
    "imager.corner_blur_px",
    "px",
    _corner_blur,
    lambda sensor: _corner_blur(sensor) ** 2 - sensor.imager.blur_px**2,
    _with_corner_blur,
    4.0,
    0.3,
    0.0,
    25.0,
    determined_by="a capture of a sheet that fills the field, projector on",
)

BLACK_LEVEL = Parameter(
    "projector.black_level",
    "1",
    lambda sensor: sensor.projector.black_level,
    lambda sensor: sensor.projector.black_level,
    _with_black_level,
    0.5,
    0.05,
    0.0,
    0.95,
    determined_by="a capture with the projector off",
)


def pattern_parameters(sensor: Sensor) -> list[Parameter]:
    """Return the parameters of a pattern of dots: their size and sharpness."""
    if isinstance(sensor.pattern, RandomDots):
        return [_of_pattern("run_length_px", False, 0.7, 0.05), _of_pattern("blur_px", True, 3.0, 0.2)]
    if isinstance(sensor.pattern, DiffractionSpots):
        return [_of_pattern("cell_px", False, 0.7, 0.05), _of_pattern("spot_px", False, 0.7, 0.05)]
    return []


def _of_pattern(field: str, squared: bool, spread: float, step: float) -> Parameter:
    def read(sensor: Sensor) -> float:
        return float(getattr(sensor.pattern, field))

    def put(sensor: Sensor, x: float) -> Sensor:
        value = float(np.sqrt(max(x, 0.0))) if squared else float(np.exp(x))
        assert isinstance(sensor.pattern, RandomDots | DiffractionSpots)  # see pattern_parameters
        return replace(sensor, pattern=sensor.pattern.model_copy(update={field: value}))

    def get(sensor: Sensor) -> float:
        return read(sensor) ** 2 if squared else _log(read(sensor))

    return Parameter(
        f"pattern.{field}",
        "px",
        read,
        get,
        put,
        spread,
        step,
        0.0 if squared else -np.inf,
        scale="linear" if squared else "logarithm",
        determined_by="a capture with the projector on, of an even sheet",
    )


#: keys of the room's light, in the order of the terms of its irradiance
ROOM_KEYS = ("irradiance_w_mm2", "gradient[0]", "gradient[1]", "curvature[0]", "curvature[1]", "curvature[2]")


def room_parameters(unit: float) -> list[Parameter]:
    """Return the terms of the room's irradiance: 1, x, y, xx, xy, yy; ``unit`` [W/mm^2] is the projector's at 1 W.

    They are varied as irradiances over the projector's, so that they are defined in a dark room too. Assumed one-sigma:
    over half a unit of slope, the edge of a wide view, lamps and windows change the light by half of it.
    """
    spreads, steps = (3.0, 1.0, 1.0, 2.0, 2.0, 2.0), (0.1, 0.2, 0.2, 0.5, 0.5, 0.5)
    return [
        Parameter(
            f"room.{key}",
            "W/mm^2" if index == 0 else "1",
            partial(_read_room, index),
            partial(_room_term, unit, index),
            partial(_with_room_term, unit, index),
            spread,
            step,
            0.02 if index == 0 else -np.inf,
            scale="inverse" if index == 0 else "linear",
            determined_by="a capture with the projector off",
        )
        for index, (key, spread, step) in enumerate(zip(ROOM_KEYS, spreads, steps, strict=True))
    ]


def with_room(sensor: Sensor, terms: list[float]) -> Sensor:
    """Return the sensor with a room of six terms [W/mm^2]."""
    level = max(terms[0], 1e-15)
    gradient = [float(np.clip(term / level, -20, 20)) for term in terms[1:3]]
    curvature = [float(np.clip(term / level, -200, 200)) for term in terms[3:]]
    room = RoomTable.model_validate({"irradiance_w_mm2": level, "gradient": gradient, "curvature": curvature})
    return replace(sensor, room=room)


def _terms(sensor: Sensor) -> list[float]:
    room = sensor.room
    if room is None:
        return [0.0] * len(ROOM_KEYS)
    return [room.irradiance_w_mm2 * share for share in (1.0, *room.gradient, *room.curvature)]


def _read_room(index: int, sensor: Sensor) -> float:
    room = sensor.room
    if room is None:
        return 0.0
    return float((room.irradiance_w_mm2, *room.gradient, *room.curvature)[index])


def _room_term(unit: float, index: int, sensor: Sensor) -> float:
    return _terms(sensor)[index] / (unit * sensor.projector.flux)


def _with_room_term(unit: float, index: int, sensor: Sensor, x: float) -> Sensor:
    terms = _terms(sensor)
    terms[index] = x * unit * sensor.projector.flux
    return with_room(sensor, terms)
