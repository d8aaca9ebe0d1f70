"""Define the parameters of a sensor file that dots on a sheet determine: access, prior, and the capture required.

The varied quantities are chosen so that each changes one feature:

- the projector's power, and the read noise over the full well;
- the inverse of the full well, the gain, which only noise determines;
- the light of the room over the projector's;
- logarithms of factors;
- squares of blurs and of read noise, since variances add.

The order of a list therefore matters: full well, power, room.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from mitsim.sensor.pattern import DiffractionSpots, RandomDots
from mitsim.sensor.sensor import Sensor
from mitsim.sensor.sensor_file import RoomTable
from mitsim.twin.sensor.estimate import Scale


@dataclass(frozen=True)
class Parameter:
    """A number of a sensor file."""

    key: str  # as in the file, ``projector.flux_w``; ``unit``
    unit: str
    read: Callable[[Sensor], float]  # returns the number in the file's unit
    get: Callable[[Sensor], float]  # returns the varied quantity; ``put`` inserts it
    put: Callable[[Sensor, float], Sensor]
    #: ``spread`` about the file's value, one sigma; ``step`` for derivatives; ``low`` and ``high``: bounds. All of the
    #: varied quantity
    spread: float
    step: float
    low: float = -np.inf
    high: float = np.inf
    scale: Scale = "linear"  # on which the number in the file is approximately normal
    determined_by: str = ""  # the capture that would determine it
    held: bool = False  # stays at the sensor's value, with the uncertainty ``spread``

    def held_within(self, uncertainty: float) -> Parameter:
        """Return the parameter, held with an uncertainty of the varied quantity."""
        return replace(self, held=True, spread=max(uncertainty, _LEAST_HELD))


#: least uncertainty of a held quantity, which keeps the normal matrix regular; chosen
_LEAST_HELD = 1e-4

#: full well whose varied quantity is 1 [e-]
_WELL = 15_000.0

#: read noise, as a share of the full well, whose varied quantity is 1
_READ = 3e-3


def _log(value: float) -> float:
    return float(np.log(max(value, 1e-9)))


#: varied quantity of a number in the file, and its inverse
_TRANSFORMS: dict[str, tuple[Callable[[float], float], Callable[[float], float]]] = {
    "square": (lambda value: value**2, lambda x: float(np.sqrt(max(x, 0.0)))),
    "logarithm": (_log, lambda x: float(np.exp(x))),
    "share": (lambda value: value, lambda x: float(np.clip(x, 0, 1))),
}


def _number(key: str, unit: str, transform: str, **about: Any) -> Parameter:
    """Return the parameter of a number that is varied alone; ``key`` is its place in :class:`Sensor` too."""
    table, _, name = key.partition(".")
    varied, inverse = _TRANSFORMS[transform]

    def read(sensor: Sensor) -> float:
        return float(getattr(getattr(sensor, table), name))

    def put(sensor: Sensor, x: float) -> Sensor:
        owner, change = getattr(sensor, table), {name: inverse(x)}
        changed = owner.model_copy(update=change) if table == "pattern" else replace(owner, **change)
        return replace(sensor, **{table: changed})

    return Parameter(key, unit, read, lambda sensor: varied(read(sensor)), put, **about)


def _with_room_share(sensor: Sensor, x: float) -> Sensor:
    assert sensor.room is not None
    level = float(np.exp(x)) * sensor.imager.full_well
    return replace(sensor, room=sensor.room.model_copy(update={"irradiance_w_mm2": level}))


def _with_full_well(sensor: Sensor, x: float) -> Sensor:
    """Set the full well and keep grey levels: power, room and read noise scale with it."""
    chip, ratio = sensor.imager, _WELL / max(x, 1e-3) / sensor.imager.full_well
    projector = replace(sensor.projector, flux=sensor.projector.flux * ratio)
    chip = replace(chip, full_well=chip.full_well * ratio, read_noise=chip.read_noise * ratio)
    room = sensor.room
    if room is not None:
        room = room.model_copy(update={"irradiance_w_mm2": room.irradiance_w_mm2 * ratio})
    return replace(sensor, imager=chip, projector=projector, room=room)


def _with_flux(sensor: Sensor, x: float) -> Sensor:
    """Set the power; the light of a known room stays, and that of a fitted one is set after it, as a ratio to it."""
    return replace(sensor, projector=replace(sensor.projector, flux=float(np.exp(x)) * sensor.imager.full_well))


def _with_read_noise(sensor: Sensor, x: float) -> Sensor:
    chip = sensor.imager
    return replace(sensor, imager=replace(chip, read_noise=_READ * float(np.sqrt(max(x, 0.0))) * chip.full_well))


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
    spread=1.0,
    step=0.05,
    low=0.02,
    scale="inverse",
    determined_by="repeats of one pose",
)

READ_NOISE = Parameter(
    "imager.read_noise_e",
    "e-",
    lambda sensor: sensor.imager.read_noise,
    lambda sensor: (sensor.imager.read_noise / sensor.imager.full_well / _READ) ** 2,
    _with_read_noise,
    spread=3.0,
    step=0.1,
    low=0.0,
    determined_by="repeats of one pose",
)

FLUX = Parameter(
    "projector.flux_w",
    "W",
    lambda sensor: sensor.projector.flux,
    lambda sensor: _log(sensor.projector.flux / sensor.imager.full_well),
    _with_flux,
    spread=4.0,
    step=0.1,
    scale="inverse",
    determined_by="a capture with the projector on, of an even sheet",
)

CORNER_BLUR = Parameter(
    "imager.corner_blur_px",
    "px",
    _corner_blur,
    lambda sensor: _corner_blur(sensor) ** 2 - sensor.imager.blur_px**2,
    _with_corner_blur,
    spread=4.0,
    step=0.3,
    low=0.0,
    high=25.0,
    determined_by="a capture of a sheet that fills the field, projector on",
)

SMOOTHING = _number(
    "imager.smoothing_px",
    "px",
    "square",
    spread=0.7,
    step=0.05,
    low=0.0,
    high=4.0,
    determined_by="one capture with the projector off",
)

PROJECTOR_CORNER = _number(
    "projector.corner_illumination",
    "1",
    "logarithm",
    spread=1.0,
    step=0.15,
    low=-4.6,
    high=0.0,
    scale="logarithm",
    determined_by="a capture of a sheet that fills the field",
)

_OFF = "a capture with the projector off"

BLACK_LEVEL = _number(
    "projector.black_level", "1", "share", spread=0.5, step=0.05, low=0.0, high=0.95, determined_by=_OFF
)


#: light of a room that another capture determines, in grey levels; its terms over the field stay
ROOM_LEVEL = Parameter(
    "room.irradiance_w_mm2",
    "W/mm^2",
    lambda sensor: _read_room(0, sensor),
    lambda sensor: float(np.log(_read_room(0, sensor) / sensor.imager.full_well)),
    _with_room_share,
    spread=1.0,
    step=0.05,
    scale="inverse",
    determined_by=_OFF,
)


def pattern_parameters(sensor: Sensor) -> list[Parameter]:
    """Return the parameters of a pattern of dots: their size and sharpness."""
    determined_by = "a capture with the projector on, of an even sheet"
    sizes: dict[type, list[str]] = {RandomDots: ["run_length_px"], DiffractionSpots: ["cell_px", "spot_px"]}
    size: dict[str, Any] = {"spread": 0.7, "step": 0.05, "scale": "logarithm", "determined_by": determined_by}
    out = [_number(f"pattern.{name}", "px", "logarithm", **size) for name in sizes.get(type(sensor.pattern), ())]
    if isinstance(sensor.pattern, RandomDots):
        blur: dict[str, Any] = {"spread": 3.0, "step": 0.2, "low": 0.0, "determined_by": determined_by}
        out.append(_number("pattern.blur_px", "px", "square", **blur))
    return out


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
            determined_by=_OFF,
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


def _read_room(index: int, sensor: Sensor) -> float:
    room = sensor.room
    return 0.0 if room is None else float((room.irradiance_w_mm2, *room.gradient, *room.curvature)[index])


def _terms(sensor: Sensor) -> list[float]:
    level, *shares = (_read_room(index, sensor) for index in range(len(ROOM_KEYS)))
    return [level, *(level * share for share in shares)]


def _room_term(unit: float, index: int, sensor: Sensor) -> float:
    return _terms(sensor)[index] / (unit * sensor.projector.flux)


def _with_room_term(unit: float, index: int, sensor: Sensor, x: float) -> Sensor:
    terms = _terms(sensor)
    terms[index] = x * unit * sensor.projector.flux
    return with_room(sensor, terms)
