"""A scene whose faces have F and sigma of a map, on the device."""

from __future__ import annotations

from characterisation.files.errors import InputError
from characterisation.maps.performance_map import PerformanceMap
from characterisation.maps.tables import Surface
from mitsim.scene.load import Scene
from mitsim.scene.materials import Finish
from mitsim.scene.ray_casting.mapped_scene import MappedScene


class CharacterisedScene:
    """A scene and the map of a sensor: F and sigma of its faces, copied to the device once.

    ``finish`` replaces the finishes of the scene: matt white, to normalise the view score.
    """

    def __init__(self, scene: Scene, performance_map: PerformanceMap, finish: Finish | None = None) -> None:
        self.scene, self.performance_map, self.finish = scene, performance_map, finish
        self.unknown: dict[int, InputError] = {}
        surfaces = [self._surface(index) for index in range(len(scene.names))]
        self.mapped = MappedScene(scene, surfaces)

    def _surface(self, index: int) -> Surface | None:
        finish = self.finish or self.scene.finishes[index]
        if finish is None:
            return None
        try:
            return self.performance_map.surface(finish.name, finish.roughness, finish.light)
        except InputError as error:  # raised only if a view shows the face
            self.unknown[index] = error
            return None
