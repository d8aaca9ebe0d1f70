"""The part in drawn finishes: one scene, whose finishes change from trial to trial.

Signal chain: number of the finishes of a trial -> deviation of each finish (:mod:`mitsim.study.virtual.drawn_finish`)
-> the scene with these finishes, and the directional albedos of its shapes.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from characterisation.files.arrays import Floats
from mitsim.scene.light_transport.plain_scene import distinct_bsdfs
from mitsim.scene.light_transport.room_light import directional_albedos
from mitsim.scene.load import Scene, load_scene
from mitsim.scene.surface.scatter import Deviation
from mitsim.study import Study
from mitsim.study.virtual.drawn_finish import finish_deviation
from mitsim.study.virtual.world import Unknowns


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
            scene = self.deviated(partial(finish_deviation, self._unknowns, number))
            self._finished = number, scene, directional_albedos(scene)
        return self._finished[1:]

    def bsdfs(self, number: int) -> list[Any]:
        """Return the distinct BSDFs of the part in the finishes of a number; none if it has BSDFs inside others."""
        return distinct_bsdfs(self.deviated(partial(finish_deviation, self._unknowns, number))) or []

    def deviated(self, deviation: Callable[[str], Deviation]) -> Scene:
        """Return the part with finishes that deviate, each by its BSDF's id."""
        self._finished = None
        if self._scene is None or not self._scene.changeable:
            file, scene = self._study.file, self._study.scene
            parameters = {name: str(value) for name, value in file.parameters.items()}
            wavelength_nm = self._study.sensor.wavelength_nm
            self._scene = load_scene(scene.where, wavelength_nm, parameters, deviation, file.sprayed)
        return self._scene.deviated(deviation) if self._scene.changeable else self._scene
