"""Settings of the rendering of a capture."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from characterisation.region_of_interest import Roi
from mitsim.capture.simulated.indirect_light import IndirectLight, KeptSettings


@dataclass(frozen=True)
class IndirectImages:
    """Interreflections that ``SimulatedSensor.indirect_radiance`` rendered before, for each camera.

    ``images`` are (P, h, w) in the region ``rois`` of each camera's image, before the lens [W / (mm^2 sr)]. ``depth``
    is the largest number of surfaces on a light path.
    """

    images: dict[str, NDArray[np.float32]]
    rois: dict[str, Roi]
    settings: IndirectLight
    depth: int


@dataclass(frozen=True)
class Rendering:
    """Light paths of a capture.

    - ``samples``: number per pixel.
    - ``depth``: largest number of surfaces on a path.
    - ``indirect``: none: interreflections are rendered together with direct light. :class:`IndirectLight`: they are
      rendered separately and smoothed. :class:`IndirectImages`: they were rendered before, of the same scene from a
      near pose; their regions and depth apply.
    - ``kept``: numbers of paths of interreflections that are traced once and serve any finish; None for none.
    """

    samples: int = 16
    depth: int = 1
    indirect: IndirectLight | IndirectImages | None = None
    kept: KeptSettings | None = None

    @classmethod
    def smoothed(cls, samples: int, depth: int, smoothing_px: float) -> Rendering:
        """Return settings with as many paths for direct light as for interreflections.

        ``smoothing_px`` is the standard deviation of the filter over the interreflections on each shape; 0 for none.
        """
        return cls(samples, depth, IndirectLight(samples, smoothing_px) if smoothing_px > 0 and depth > 1 else None)

    def finer(self, factor: int) -> Rendering:
        """Return settings with a ``factor`` times as many paths."""
        indirect, kept = self.indirect, self.kept
        if isinstance(indirect, IndirectLight):
            indirect = replace(indirect, samples=factor * indirect.samples)
        if kept is not None:
            kept = replace(kept, samples=factor * kept.samples, kept=factor * kept.kept)
        return replace(self, samples=factor * self.samples, indirect=indirect, kept=kept)

    @property
    def prerendered(self) -> IndirectImages | None:
        """Interreflections that were rendered before, or None."""
        return self.indirect if isinstance(self.indirect, IndirectImages) else None

    @property
    def surfaces(self) -> int:
        """Largest number of surfaces on a light path."""
        return self.depth if self.prerendered is None else self.prerendered.depth

    @property
    def indirect_settings(self) -> IndirectLight | None:
        """Settings for interreflections that are rendered separately; None if they are not."""
        return self.indirect.settings if isinstance(self.indirect, IndirectImages) else self.indirect

    def records(self, scene: str, parameters: dict[str, str]) -> dict[str, Any]:
        """Return what a capture's settings say of the rendering of a scene with parameters, as JSON values."""
        given = {"scene_parameters": dict(sorted(parameters.items()))} if parameters else {}
        paths = {"samples_per_pixel": self.samples, "light_path_depth": self.surfaces}
        out: dict[str, Any] = {"scene": scene, **given, **paths}
        indirect = self.indirect_settings
        return out if indirect is None else out | {"indirect_light": asdict(indirect)}
