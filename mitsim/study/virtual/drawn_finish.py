"""Draw the finishes of a trial, the size and the shape of the light that each reflects, and show the part in them.

Signal chain: number of the finishes of a trial, id of a finish -> independent standard normals, one for each unknown
property -> sizes and centres of ``[unknowns.finish]`` -> a :class:`~mitsim.scene.surface.scatter.Deviation` -> the
scene of the part with these finishes, and the directional albedos of its shapes.

One finish is one draw: faces of the same BSDF have the same alpha, shares and direction of the lay, each in its own
frame. All directions of a lay are equally likely.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.special import ndtr

from characterisation.files.arrays import Floats
from mitsim.scene.light_transport.room_light import directional_albedos
from mitsim.scene.load import Scene, load_scene
from mitsim.scene.surface.scatter import LARGEST_DEVIATION, Deviation
from mitsim.study import Study
from mitsim.study.virtual.world import Unknowns

#: seed of the stream of finishes, different from those of the groups
_FINISH_STREAM = 8

#: drawn properties, in the order of their random numbers
DRAWN = ("alpha", "wide_angle", "reflectance", "tail", "lay", "lay_direction")


def finish_numbers(unknowns: Unknowns, number: int, finish: str) -> dict[str, float]:
    """Return the standard normals behind a finish, given by its BSDF's id, by the names of :data:`DRAWN`.

    Properties that are not drawn are left out: those of size 0, and the direction of a lay that is not drawn. The
    number -1 is the best estimate, with zeros.
    """
    prior = unknowns.table.finish.centres_and_sizes(finish)
    drawn = [name for name in DRAWN if prior[name.removesuffix("_direction")][1] > 0]
    numbers = _normals(number, finish)
    return {name: numbers[name] for name in drawn}


def _normals(number: int, finish: str) -> dict[str, float]:
    """Return a standard normal for each of :data:`DRAWN`, from a stream that the number seeds."""
    if number < 0:
        return dict.fromkeys(DRAWN, 0.0)
    rng = np.random.default_rng(np.random.SeedSequence([number, _FINISH_STREAM, zlib.crc32(finish.encode())]))
    values = np.clip(rng.standard_normal(len(DRAWN)), -LARGEST_DEVIATION, LARGEST_DEVIATION)
    return dict(zip(DRAWN, values.tolist(), strict=True))


def finish_deviation(unknowns: Unknowns, number: int, finish: str) -> Deviation:
    """Return the deviation of a finish, given by its BSDF's id, from the scene's finish in the finishes of a number.

    The lay of a finish is drawn unless ``lay`` of its table is 0. The number -1 is the best estimate: the centres of a
    measured finish, and no drawn lay.
    """
    table = unknowns.table.finish
    deviation = deviation_of(table.centres_and_sizes(finish), _normals(number, finish))
    return replace(deviation, lay_deg=None) if number < 0 else deviation


def deviation_of(prior: Mapping[str, tuple[float, float]], numbers: Mapping[str, float]) -> Deviation:
    """Return the deviation of standard normals under a prior, which is a centre and a size for each property."""

    def drawn(name: str) -> float:
        centre, size = prior[name]
        return float(np.clip(centre + size * numbers[name], -LARGEST_DEVIATION, LARGEST_DEVIATION))

    lay_deg = 180.0 * float(ndtr(numbers["lay_direction"])) if prior["lay"][1] > 0 else None
    alpha, wide_angle, reflectance, tail, lay = (drawn(name) for name in DRAWN[:5])
    return Deviation(alpha, wide_angle, reflectance, tail, lay, lay_deg)


class DrawnPart:
    """The part of a study in finishes that are drawn. There is one scene: a call changes the scene of the call before.

    Dr.Jit compiles a material call for the materials of every scene in memory, therefore there is no second.
    """

    def __init__(self, study: Study, unknowns: Unknowns) -> None:
        self._study, self._unknowns = study, unknowns
        self._finished: tuple[int, Scene, list[Floats]] | None = None
        self._scene: Scene | None = None

    def in_finish(self, number: int) -> tuple[Scene, list[Floats]]:
        """Return the part in the finishes of a number, and the directional albedos of its shapes."""
        if self._finished is None or self._finished[0] != number:
            scene = self.scene_in(number)
            self._finished = number, scene, directional_albedos(scene)
        return self._finished[1:]

    def scene_in(self, number: int) -> Scene:
        """Return the part in the finishes of a number."""
        return self.deviated(partial(finish_deviation, self._unknowns, number))

    def deviated(self, deviation: Callable[[str], Deviation]) -> Scene:
        """Return the part with finishes that deviate, each by its BSDF's id."""
        self._finished = None
        if self._scene is None or not self._scene.changeable:
            file, scene = self._study.file, self._study.scene
            parameters = {name: str(value) for name, value in file.parameters.items()}
            wavelength_nm = self._study.sensor.wavelength_nm
            self._scene = load_scene(scene.where, wavelength_nm, parameters, deviation, file.sprayed)
        return self._scene.deviated(deviation) if self._scene.changeable else self._scene
