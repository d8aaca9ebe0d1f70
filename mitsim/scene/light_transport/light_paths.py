"""Number and kind of the light paths of one rendering."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

#: default number of photons for each sample of the whole image
PHOTONS_PER_SAMPLE = 0.25


@dataclass(frozen=True)
class LightPaths:
    """The light paths that :func:`trace` follows."""

    samples: int  # per pixel, rounded up to a square number, because they form a raster
    seed: int  # of the directions of later bounces, and of the jitter; use another for each camera and pose
    depth: int = 1  # largest number of surfaces on a path: 1 is direct light, 3 adds two interreflections
    jitter: bool = False  # whether the positions are random within their cells and lenses, instead of fixed
    #: for light of two and more surfaces, rounded up to a square number. By default their number is proportional to the
    #: samples of the *whole* image, whatever the region. 0 leaves all light to camera paths
    photons: int | None = None
    indirect_only: bool = False  # render only light that has met two surfaces or more, on the same paths
    with_ambient: bool = False  # add a last image, the light of the scene's own emitters alone, with the projector off

    @property
    def side(self) -> int:
        """Number of samples along one side of a pixel's raster."""
        return int(np.ceil(np.sqrt(self.samples)))

    def photon_count(self, pixels: int) -> int:
        """Return the number of photons for an image of ``pixels`` pixels, a square number."""
        if self.depth == 1:
            return 0
        photons = int(PHOTONS_PER_SAMPLE * self.side**2 * pixels) if self.photons is None else self.photons
        return int(np.ceil(np.sqrt(photons))) ** 2
