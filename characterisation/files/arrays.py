"""Name the types of arrays, and a number, that most modules share."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]

#: standard deviation of a normal distribution over its median absolute deviation: 1 / the 75 % quantile of a unit one
MEDIAN_TO_STD = 1.482602218505602
