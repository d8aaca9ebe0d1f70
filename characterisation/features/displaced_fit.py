r"""What least squares makes of points that lie off by a known displacement, beyond its linearisation.

Signal chain: displaced points -> Gauss-Newton to where the fit comes to rest -> its change, and how firmly it rests
there: the second derivatives of sum w r^2 / 2 -> by how much what moves the points then moves the fit.

To first order a fit changes by -N^-1 sum w g b, N = sum w g g^T, and noise moves it the same way whatever b is. But
points that no such surface fits leave residuals r, and with them the fit rests less or more firmly (Seber and Wild,
Nonlinear Regression, 2.1.3):

    M = sum w (g g^T + r d^2 r)        instead of        N

Of a pillar whose middle lies too deep, as a matcher finds it, M is softer: the wider the radius, the less of it the
points can tell. A first-order 2 mm is 2.8 mm then and 5 mm are 14, as in fits to rendered clouds of a pillar of 20 mm.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

from characterisation.features.surfaces import Surface

Floats = NDArray[np.float64]

#: steps of Gauss-Newton, and the rms move of the points [mm] by one at which it has come to rest
STEPS, AT_REST_MM = 30, 1e-4

#: a fit that moves the points farther than this [mm], rms, is led away
FARTHEST_MM = 1e3

#: rms move of the points [mm] over which second derivatives are taken
DIFFERENCE_MM = 1e-3

#: M is taken to be no softer than this share of N: beyond, the next order would have to tell
SOFTEST = 0.2


@dataclass(frozen=True)
class DisplacedFit:
    """``change`` (p,) of the parameters, and what the residuals' derivatives (n, p) by them are there, ``g``.

    Of what moves points beside, least squares with ``g`` makes d, and the fit ``gain`` d, (p, p): M^-1 N.
    """

    change: Floats
    g: Floats
    gain: Floats


def displaced_fit(
    surface: Surface, point: Floats, ray: Floats, displaced: Floats, weight: Floats
) -> DisplacedFit | None:  # fmt: skip
    """Fit ``surface`` to points of it (n, 3) [mm] that are ``displaced`` (n,) [mm] along their rays (n, 3).

    ``weight`` (n,) is how many points each stands for. None if the fit comes to no rest: it is led away.
    """
    places = point + displaced[:, None] * ray
    size = np.sqrt(weight.sum())

    def slope(parameters: Floats) -> tuple[Floats, Floats, Floats]:
        """Of sum w r^2 / 2, N there, and g."""
        residual, g, _ = surface.linearised(parameters, places, ray)
        weighted = g * weight[:, None]
        return residual @ weighted, weighted.T @ g, g

    change = np.zeros(surface.parameter_count)
    unit = size / np.sqrt(np.diag(slope(change)[1]))  # moves the points by 1 mm, rms
    for _ in range(STEPS):
        down, normal, _ = slope(change)
        try:
            step = -np.linalg.solve(normal * np.outer(unit, unit), down * unit)
        except np.linalg.LinAlgError:
            return None
        change = change + step * unit
        if not np.abs(change / unit).max() < FARTHEST_MM:
            return None
        if np.abs(step).max() < AT_REST_MM:
            break
    else:
        return None
    _, normal, g = slope(change)
    near = DIFFERENCE_MM * np.diag(unit)
    firm = np.stack([(slope(change + by)[0] - slope(change - by)[0]) * unit for by in near]) / (2 * DIFFERENCE_MM)
    scaled = normal * np.outer(unit, unit)
    try:
        share, modes = eigh((firm + firm.T) / 2, scaled)
    except np.linalg.LinAlgError:
        return None
    # modes are orthonormal by N: M = N modes diag(share) modes^T N
    gain = modes @ np.diag(1 / np.maximum(share, SOFTEST)) @ modes.T @ scaled
    return DisplacedFit(change, g, gain * unit[:, None] / unit)
