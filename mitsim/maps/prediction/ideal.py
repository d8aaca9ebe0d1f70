"""Points of a view that a perfect sensor would measure: :meth:`mitsim.maps.prediction.predictor.Predictor.ideal`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Ideal:
    """Measured pixels of a perfect sensor; flat arrays over the n pixels that meet a surface.

    ``pixel`` (n,) flat index into the grid; ``point`` (n, 3) and ``ray`` (n, 3) in the sensor frame [mm]; ``distance``
    (n,) |V| [mm]; ``normal`` (n, 3) in the view frame; ``shape`` (n,) index into the scene's names; ``status`` (n,)
    VALID where every eye sees the point; ``along`` (n, 3) the direction of the surface's parameter u in the view frame,
    None in a scene without a lay.
    """

    pixel: NDArray[np.int64]
    point: NDArray[np.float64]
    ray: NDArray[np.float64]
    distance: NDArray[np.float64]
    normal: NDArray[np.float64]
    shape: NDArray[np.int16]
    status: NDArray[np.uint8]
    along: NDArray[np.float64] | None = None
