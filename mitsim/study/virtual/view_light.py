"""What all trials of a view share: regions of the images, surfaces that are seen, paths of interreflections.

Signal chain: view at its nominal pose and calibration -> regions of the part in each image -> surfaces that the pixels
see, and the paths of light between surfaces (:mod:`mitsim.capture.simulated.kept_light`), for any finish -> kept while
memory allows.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from characterisation.files.arrays import Floats
from characterisation.region_of_interest import Roi
from mitsim.capture.simulated.kept_light import KeptLight
from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.running.executor import available_memory
from mitsim.scene.light_transport.room_light import SeenSurfaces
from mitsim.scene.load import Scene
from mitsim.sensor.transforms import Transform
from mitsim.sensor.working_volume import roi_around

#: pixels traced around the part, for the blur of the lens and the blocks of the matcher
_MARGIN_PX = 12

#: least memory of the paths of views that are kept for later trials [bytes], however little is available; chosen
_LEAST_KEPT = 1 << 29

#: largest such memory [bytes], however much is available; chosen
_MOST_KEPT = 1 << 32

#: share of the available memory that they may take beyond the least
_KEPT_SHARE = 0.25


@dataclass(frozen=True)
class ViewLight:
    """What all draws of a view share, by camera: regions, surfaces that are seen, paths of interreflections."""

    rois: dict[str, Roi]
    seen: dict[str, SeenSurfaces]
    kept: dict[str, KeptLight]

    @property
    def bytes(self) -> int:
        """Memory that it needs."""
        return sum(light.bytes for light in self.kept.values()) + sum(
            surfaces.shape.nbytes + surfaces.cosine.nbytes for surfaces in self.seen.values()
        )


def regions(
    simulated: SimulatedSensor, sensor_from_world: Transform, corners: Floats, turned: Floats
) -> dict[str, Roi]:
    """Return the region of each camera's image around a part.

    Parameters
    ----------
    simulated, sensor_from_world
        Sensor and its pose.
    corners
        (n, 3) [mm] of the part at all positions, world frame; a margin is added.
    turned
        (m, 3) [mm] the same if it also rotates; without the margin, within which small parts turn.

    See Also
    --------
    seen_surfaces : what the regions show
    """
    out = {}
    for name, camera in simulated.sensor.rig.cameras.items():
        around, wider = (
            roi_around(camera, sensor_from_world.points(points), margin)
            for points, margin in ((corners, _MARGIN_PX), (turned, 0))
        )
        out[name] = around.joined(wider) if around is not None and wider is not None else simulated.rays[name].whole
    return out


def seen_surfaces(
    simulated: SimulatedSensor, scene: Scene, pose: Transform, rois: dict[str, Roi]
) -> dict[str, SeenSurfaces]:
    """Return the surfaces that the pixels of each camera's region see, from a pose ``world_from_sensor``."""
    return {name: SeenSurfaces.of(scene, simulated.pixel_rays(name), pose, roi) for name, roi in rois.items()}


class LightOfViews:
    """The shared light of views by their numbers; that which was not used for the longest time goes first."""

    def __init__(self) -> None:
        self._views: dict[int, ViewLight] = {}

    def of(self, number: int, make: Callable[[], ViewLight]) -> ViewLight:
        """Return the light of a view, made on first use."""
        if number not in self._views:
            made = make()
            kept = sum(view.bytes for view in self._views.values())
            allowed = min(max(_LEAST_KEPT, kept + int(_KEPT_SHARE * available_memory())), _MOST_KEPT)
            while self._views and made.bytes + sum(view.bytes for view in self._views.values()) > allowed:
                self._views.pop(next(iter(self._views)))
            self._views[number] = made
        used = self._views.pop(number)
        self._views[number] = used
        return used
