"""Describe a finish as a function of its lobe's width alpha, and find the Ra with this lobe.

Signal chain: metal, process, wavelength -> alpha(Ra) by :func:`mitsim.scene.surface.machined.machined` -> range in
which alpha increases with Ra -> its inverse: alpha -> Ra-equivalent -> height, and from it the coherent shares -> a
:class:`~mitsim.scene.surface.scatter.Scatter` for any alpha.

The Ra-equivalent is the Ra with which ``machined_metal`` renders the fitted lobe; it is not a measurement of Ra. The
relation has a one-sigma factor of 1.6 for most processes. The Ra-equivalent is NaN below a least alpha and beyond
``ALPHA_LARGEST``, where no Ra has the lobe. It is also NaN where alpha does not increase with Ra: with a large coherent
share A, a smoother face may have a wider lobe.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from characterisation.files.errors import InputError
from mitsim.scene.materials import Finish
from mitsim.scene.surface.diffraction import phase_variance
from mitsim.scene.surface.energy import energy_factors
from mitsim.scene.surface.machined import machined
from mitsim.scene.surface.machined_face import MachinedFace
from mitsim.scene.surface.metals import CONSTANTS, normal_reflectance, refractive_index
from mitsim.scene.surface.processes import PROCESSES
from mitsim.scene.surface.roughness import ALPHA_LARGEST
from mitsim.scene.surface.scatter import Scatter

#: range of alpha in a fit [1]
ALPHA_RANGE = (0.01, 0.6)
LOG_ALPHA_RANGE = (math.log(ALPHA_RANGE[0]), math.log(ALPHA_RANGE[1]))

#: number of values in the table of alpha(Ra)
_TABLE_SIZE = 64


@dataclass(frozen=True)
class MetalFinish:
    """A machined metal with an unknown width of its lobe."""

    #: ``metal``, ``process``, ``wavelength_nm``
    metal: str
    process: str
    wavelength_nm: float
    index: tuple[float, float]  # (n, k) refractive index
    normal_reflectance: float  # F0 [1], which is also the albedo of the wide-angle share
    #: ``log_alpha``, ``log_ra`` (n,): table of alpha(Ra) where it increases, as natural logarithms; Ra is in um
    log_alpha: NDArray[np.float64] = field(repr=False)
    log_ra: NDArray[np.float64] = field(repr=False)
    _along: dict[str, NDArray[np.float64]] = field(repr=False)
    _energy: tuple[CubicSpline, CubicSpline] = field(repr=False)
    _template: Scatter = field(repr=False)

    def scatter(self, x: float) -> Scatter:
        """Return the scattering of a face whose lobe has the width alpha = exp(x).

        Outside the table, height, coherent width and share of Beckmann's distribution keep their values at its end.
        """
        alpha = math.exp(x)
        height, beckmann, mirror = (
            float(np.interp(x, self.log_alpha, self._along[name])) for name in ("log_height", "beckmann", "log_mirror")
        )
        return replace(
            self._template,
            alpha_u=alpha,
            alpha_v=alpha,
            beckmann=beckmann,
            height_um=math.exp(height),
            phase_variance=phase_variance(math.exp(height), self.wavelength_nm),
            coherent_alpha=(math.exp(mirror), math.exp(mirror)),
            energy_factor=(float(self._energy[0](x)), float(self._energy[1](x))),
        )

    def with_beckmann(self, share: float) -> MetalFinish:
        """Return the same metal and process with this Beckmann share of the lobe [1] at every alpha."""
        return replace(self, _along=self._along | {"beckmann": np.full(len(self.log_alpha), share)})

    @property
    def alpha_range(self) -> tuple[float, float]:
        """Least and largest alpha [1] with a Ra-equivalent."""
        return float(np.exp(self.log_alpha[0])), float(np.exp(self.log_alpha[-1]))

    @property
    def roughness_range(self) -> tuple[float, float]:
        """Least and largest Ra-equivalent [um]."""
        return float(np.exp(self.log_ra[0])), float(np.exp(self.log_ra[-1]))

    def roughness(self, alpha: float, relative_uncertainty: float) -> tuple[float, float]:
        """Return the Ra-equivalent [um] of an alpha, and its standard uncertainty; both NaN if no Ra has this lobe.

        The uncertainty follows from that of alpha alone, and does not include that of the relation.
        """
        x = math.log(alpha)
        if not self.log_alpha[0] <= x <= self.log_alpha[-1]:
            return math.nan, math.nan
        ra = float(np.exp(np.interp(x, self.log_alpha, self.log_ra)))
        slope = float(np.interp(x, self.log_alpha, np.gradient(self.log_ra, self.log_alpha)))
        return ra, ra * slope * relative_uncertainty


def metal_finish(finish: Finish, wavelength_nm: float, where: str) -> MetalFinish:
    """Return the finishes of all alphas of a coupon's metal and process; InputError if none, or with a lay."""
    metal, _, process = finish.name.partition("/")
    if metal not in CONSTANTS or process not in PROCESSES or finish.scatter is None:
        raise InputError(where, "bsdf", finish.name, "machined_metal, or matt_white for a diffuse sheet")
    if finish.scatter.alpha_u != finish.scatter.alpha_v:
        found = f"alpha {finish.scatter.alpha_u:.3g} along u and {finish.scatter.alpha_v:.3g} along v"
        raise InputError(where, "lay", found, "a round lobe", "only one width is fitted: omit the lay")
    return _family(metal, process, wavelength_nm)


@lru_cache(maxsize=16)
def _family(metal: str, process: str, wavelength_nm: float) -> MetalFinish:
    """Return the finishes of a metal and process at all alphas, from a table over the usual Ra of the process."""
    low, high = PROCESSES[process].usual
    heights = np.geomspace(low, high, _TABLE_SIZE)
    faces = [machined(MachinedFace(metal=metal, process=process, Ra=float(ra)), wavelength_nm) for ra in heights]
    widths = np.array([face.alpha_u for face in faces])
    last = int(np.argmax(widths >= ALPHA_LARGEST)) if (widths >= ALPHA_LARGEST).any() else len(widths)
    # the part of the table above the last Ra at which alpha decreases with Ra
    falling = np.flatnonzero(np.diff(widths[:last]) <= 0)
    rising = slice(int(falling[-1]) + 1 if len(falling) else 0, last)
    branch = faces[rising]
    along = {
        "log_height": np.log([face.height_um for face in branch]),
        "beckmann": np.array([face.beckmann for face in branch]),
        "log_mirror": np.log([face.coherent_alpha[0] for face in branch]),
    }
    bright = normal_reflectance(metal, wavelength_nm)
    scan = np.linspace(*LOG_ALPHA_RANGE, _TABLE_SIZE)
    factors = np.array([energy_factors(alpha, alpha, bright) for alpha in np.exp(scan).tolist()])
    energy = CubicSpline(scan, factors[:, 0]), CubicSpline(scan, factors[:, 1])
    return MetalFinish(
        metal,
        process,
        wavelength_nm,
        refractive_index(metal, wavelength_nm),
        bright,
        np.log(widths[rising]),
        np.log(heights[rising]),
        along,
        energy,
        branch[0],
    )
