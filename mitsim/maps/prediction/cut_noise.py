"""Cut normal deviates at the error beyond which a point is false.

Signal chain: standard normal deviates, |V| and sigma of points -> deviates of the same standard deviation and order,
whose errors are at most the limit of false points.

F and sigma of a map are those of the points within 1 % of |V| of the surface
(:data:`~characterisation.point_cloud.FALSE_SHARE_OF_DISTANCE`). Normal errors of that sigma exceed the limit where
sigma is a third of it or more, as of a Kinect far from metal. Fits leave such points out, so F and sigma of a drawn
cloud would be too small. With a normal variable of standard deviation s that is cut at +-l,

    sigma^2 = s^2 [1 - 2 t phi(t) / (2 Phi(t) - 1)],    t = l / s

(Johnson, Kotz and Balakrishnan, Continuous Univariate Distributions 1, 1994, sec. 13.10.1). The largest sigma is that
of a uniform distribution, l / sqrt(3).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from characterisation.point_cloud import FALSE_SHARE_OF_DISTANCE

#: limits t in standard deviations before the cut; between them t is interpolated. Below the first the distribution is
#: uniform to 1e-3, beyond the last nothing is cut
_LIMITS = np.linspace(0.05, 6.0, 240)

#: the same limits in standard deviations after the cut
_LIMITS_AFTER = _LIMITS / np.sqrt(
    1 - 2 * _LIMITS * np.exp(-(_LIMITS**2) / 2) / np.sqrt(2 * np.pi) / (2 * ndtr(_LIMITS) - 1)
)


def cut_deviates(
    deviates: NDArray[np.floating], sigma: NDArray[np.floating], distance: NDArray[np.floating]
) -> NDArray[np.floating]:
    """Return deviates of unit variance, times sigma within the limit of false points.

    The largest error is the limit, also where sigma is larger than a distribution within the limit can have.

    Parameters
    ----------
    deviates
        Standard normal deviates, of any shape.
    sigma, distance
        Sigma and |V| of the points, of that shape [mm]; the deviates of NaN are returned unchanged.

    Examples
    --------
    >>> cut = cut_deviates(np.array([-3.0, 0.0, 3.0]), np.full(3, 4.0), np.full(3, 1000.0))
    >>> np.abs(4.0 * cut).max() < 10.0
    True
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = FALSE_SHARE_OF_DISTANCE * distance / sigma
    cut = reach < _LIMITS_AFTER[-1]
    if not cut.any():
        return deviates
    limit = np.interp(reach[cut], _LIMITS_AFTER, _LIMITS)
    inside = 2 * ndtr(limit) - 1
    normal = ndtri(0.5 + (ndtr(deviates[cut]) - 0.5) * inside)
    out = np.array(deviates)
    out[cut] = normal * np.minimum(np.interp(limit, _LIMITS, _LIMITS_AFTER), reach[cut]) / limit
    return out
