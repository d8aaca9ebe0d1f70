"""Settings of a capture's rendering."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mitsim.sensor.roi import Roi
from mitsim.simulation.indirect_light import IndirectLight


@dataclass(frozen=True)
class LaterLight:
    """Light by way of other surfaces, rendered before by ``SimulatedSensor.later_light`` for every camera.

    ``images`` (P, h, w) [W / (mm^2 sr)] of the ``rois`` of the images, before the lens; ``how`` they were rendered,
    and over how many surfaces, ``depth``.
    """

    images: dict[str, NDArray[np.float32]]
    rois: dict[str, Roi]
    how: IndirectLight
    depth: int


@dataclass(frozen=True)
class Rendering:
    """Light paths of a capture: ``samples`` per pixel, at most ``depth`` surfaces on a path, and ``indirect`` light.

    Without ``indirect``, light by way of other surfaces is rendered as direct light is. :class:`LaterLight` is that
    light of the same scene, rendered before from a pose near by; its regions and its depth hold.
    """

    samples: int = 16
    depth: int = 1
    indirect: IndirectLight | LaterLight | None = None

    @property
    def before(self) -> LaterLight | None:
        """The light by way of other surfaces that was rendered before."""
        return self.indirect if isinstance(self.indirect, LaterLight) else None

    @property
    def surfaces(self) -> int:
        """Most surfaces on a light path."""
        return self.depth if self.before is None else self.before.depth

    @property
    def indirectly(self) -> IndirectLight | None:
        """How light by way of other surfaces is rendered; None as direct light is."""
        return self.indirect.how if isinstance(self.indirect, LaterLight) else self.indirect
