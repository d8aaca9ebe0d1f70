"""One random draw of all unknowns of a measurement.

Signal chain: number of a trial -> a stream of random numbers for each group of unknowns -> true geometry of the sensor,
finish, form, light, temperatures, pose of the part, and the seeds of all noise.

There are two kinds of groups. Those in :data:`FRESH` are drawn for every capture. All captures of one day share the
others, which therefore do not average out over repeated captures. A trial states its day and its capture, and these
alone determine its draw, on every machine and in any order. Views are compared with the same draws (common random
numbers).

Some groups draw only a seed. Certain days of a statement keep the seed of the day before, so that the covariance of the
two days tells the variance that the group causes (:mod:`characterisation.statements.budget`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mitsim.sensor.camera import Rig
from mitsim.sensor.rig_covariance import RigCovariance
from mitsim.sensor.rig_parameters import eyes, moved, parameter_names, path_error
from mitsim.sensor.room_light import room_irradiance
from mitsim.sensor.transforms import Transform
from mitsim.sensor.unknowns import TemperatureUnknowns, UnknownsTable

#: effects outside the performance map, for measurements drawn from a map (:mod:`mitsim.study.virtual.beyond_map`); they
#: are the same in all captures of a day
BEYOND = "beyond_map"

#: groups of unknowns that are drawn for every capture
FRESH = ("pose", "noise")

#: all groups; the index of a group in this tuple seeds its stream, so that a new one comes last
GROUPS = ("calibration", "finish", "form", "light", "temperature", "unit", *FRESH, BEYOND, "decoder", "coat")

#: days of a race start at 0; first day of draws that judge the choice of a view
JUDGING_DAYS = 1 << 19

#: first day of the draws of a statement
STATEMENT_DAYS = 1 << 20

#: first day of the draws of a set of views
SET_DAYS = 1 << 21

#: Groups that draw only a seed, and the day among every four of a statement that keeps the seed of the day before.
KEEPS_SEED = {"unit": 1, "form": 3, BEYOND: 1}


@dataclass(frozen=True)
class Trial:
    """Identifies a draw: day, and capture within the day."""

    day: int
    capture: int = 0


@dataclass(frozen=True)
class DrawnValues:
    """All values that were drawn for one trial.

    ``rig`` is the sensor's true geometry. ``path`` is offset [mm] and scale [1] of a time-of-flight distance.
    ``finish`` numbers the deviation of the finishes (:mod:`mitsim.study.virtual.drawn_finish`), -1 for the best
    estimate. ``form``, ``unit``, ``decoder`` and ``coat`` are seeds, 0 for none: the unit's patterns,
    :func:`mitsim.study.virtual.drawn_decoder.drawn_decoder` and :func:`mitsim.study.virtual.coat.drawn_coat`.
    ``room`` is irradiance [W/mm^2]. ``power`` and ``exposure`` are relative to nominal [1]. ``expansion`` of the part
    is relative [1]. ``placed`` and ``assumed`` (world to world) are the true and the assumed motion of the part from
    its nominal pose. ``seed`` is that of the capture, ``beyond`` that of effects outside the map, 0 for none.
    """

    rig: Rig
    path: tuple[float, float]
    finish: int
    form: int
    room: float
    power: float
    exposure: float
    expansion: float
    placed: Transform
    assumed: Transform
    unit: int
    seed: int
    beyond: int = 0
    decoder: int = 0
    coat: int = 0


@dataclass(frozen=True)
class Unknowns:
    """Groups of unknowns of one sensor and one part, prepared for drawing.

    ``table`` holds their sizes. ``rig`` is nominal. ``calibration`` is the covariance of the calibration, with the
    drift since then. ``expansion`` of the part is in 1/K. ``centre`` (3,) [mm] is the point about which the part
    rotates. Groups that are not in ``varied`` keep their best estimate.
    """

    table: UnknownsTable
    rig: Rig
    calibration: RigCovariance
    wavelength_nm: float
    expansion: float
    centre: NDArray[np.float64]
    seed: int
    varied: tuple[str, ...] = GROUPS

    def draw(self, trial: Trial) -> DrawnValues:
        """Draw the values of a trial."""
        table, streams = self.table, {group: self.stream(group, trial) for group in GROUPS}
        sensor_kelvin, part_kelvin = (
            streams["temperature"].standard_normal(2) * [table.temperature.sensor_kelvin, table.temperature.part_kelvin]
            if "temperature" in self.varied
            else np.zeros(2)
        )
        names, values = self._geometry(streams["calibration"], float(sensor_kelvin))
        room, power, exposure = self._light(streams["light"])
        placed, assumed = self._poses(streams["pose"])
        return DrawnValues(
            rig=moved(self.rig, names, values),
            path=path_error(names, values),
            finish=_seed(streams["finish"]) if "finish" in self.varied else -1,
            form=_seed(streams["form"]) if "form" in self.varied else 0,
            room=room,
            power=power,
            exposure=exposure,
            expansion=self.expansion * float(part_kelvin),
            placed=placed,
            assumed=assumed,
            unit=_seed(streams["unit"]) if "unit" in self.varied else 0,
            seed=_seed(streams["noise"]),
            beyond=_seed(streams[BEYOND]) if BEYOND in self.varied else 0,
            decoder=_seed(streams["decoder"]) if "decoder" in self.varied else 0,
            coat=_seed(streams["coat"]) if "coat" in self.varied else 0,
        )

    def stream(self, group: str, trial: Trial) -> np.random.Generator:
        """Return the stream of random numbers from which a group is drawn in a trial."""
        day = seed_day(group, trial.day)
        key = [day, trial.capture] if group in FRESH else [day]
        if group not in self.varied:
            key = [0]
        return np.random.default_rng(np.random.SeedSequence([self.seed, GROUPS.index(group), *key]))

    def _geometry(self, rng: np.random.Generator, sensor_kelvin: float) -> tuple[tuple[str, ...], NDArray[np.float64]]:
        """Return names and errors of the rig's parameters, due to calibration and temperature."""
        error: dict[str, float] = {}

        def add(names: tuple[str, ...], values: NDArray[np.float64]) -> None:
            for name, value in zip(names, values.tolist(), strict=True):
                error[name] = error.get(name, 0.0) + value

        if "calibration" in self.varied:
            add(self.calibration.names, self.calibration.draw(rng))
        if sensor_kelvin:
            add(*warmed(self.rig, self.table.temperature, sensor_kelvin))
        return tuple(error), np.array(list(error.values()))

    def _light(self, rng: np.random.Generator) -> tuple[float, float, float]:
        """Return irradiance of the room [W/mm^2], and projector power and exposure relative to nominal [1]."""
        light = self.table.light
        level = room_irradiance(light.illuminance, light.daylight, self.wavelength_nm, light.filter_nm)
        if "light" not in self.varied:
            return level, 1.0, 1.0
        room = level * light.room_factor ** float(rng.standard_normal())
        power = max(0.1, 1 + light.power_relative * float(rng.standard_normal()))
        return room, power, 1 + light.exposure_relative * float(rng.uniform(-1, 1))

    def _poses(self, rng: np.random.Generator) -> tuple[Transform, Transform]:
        if "pose" not in self.varied:
            return Transform.identity(), Transform.identity()
        pose = self.table.pose
        placed = self._nudge(rng, pose.placement_mm, pose.placement_deg)
        return placed, self._nudge(rng, pose.told_mm, pose.told_deg) @ placed

    def _nudge(self, rng: np.random.Generator, shift_mm: float, turn_deg: float) -> Transform:
        """Return a small rotation about the part's middle, with a shift."""
        turn = Rotation.from_rotvec(rng.normal(0.0, np.radians(turn_deg), 3)).as_matrix()
        return Transform(turn, self.centre + rng.normal(0.0, shift_mm, 3) - turn @ self.centre)


def seed_day(group: str, day: int) -> int:
    """Return the day whose seed of a group a day has: some days of a statement keep that of the day before."""
    keeps = STATEMENT_DAYS <= day < SET_DAYS and day % 4 == KEEPS_SEED.get(group)
    return day - 1 if keeps else day


Scaled = tuple[tuple[str, ...], NDArray[np.float64]]


def scaled_focal(rig: Rig, share: float) -> Scaled:
    """Return the parameters of all focal lengths, and their changes if all grow by a relative ``share``."""
    names = tuple(name for name in parameter_names(rig) if name.endswith(("focal_x_px", "focal_y_px")))
    optics = eyes(rig)
    lengths = [
        optics[name.rpartition(".")[0]].matrix[0 if "_x_" in name else 1, 0 if "_x_" in name else 1] for name in names
    ]
    return names, share * np.array(lengths)


def scaled_baseline(rig: Rig, share: float) -> Scaled:
    """Return the position parameters of all eyes, and their changes if the baselines grow by a relative ``share``."""
    names = tuple(name for name in parameter_names(rig) if "position_" in name)
    optics = eyes(rig)
    reference = rig.reference.centre
    values = [(optics[name.rpartition(".")[0]].centre - reference)["xyz".index(name[-4])] for name in names]
    return names, share * np.array(values)


def warmed(rig: Rig, table: TemperatureUnknowns, kelvin: float) -> Scaled:
    """Return the parameters that the temperature of a sensor changes, and their changes by a deviation [K]."""
    places, lengths = (
        scaled_baseline(rig, table.body_per_kelvin * kelvin),
        scaled_focal(rig, table.focal_per_kelvin * kelvin),
    )
    return places[0] + lengths[0], np.concatenate([places[1], lengths[1]])


def _seed(rng: np.random.Generator) -> int:
    return int(rng.integers(1, 1 << 31))
