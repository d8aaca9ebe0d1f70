"""Store and query the performance map of a sensor: F and sigma over distance |V|, normal N and sample.

Signal chain: map (:mod:`characterisation.maps.building`) or netCDF file -> fields of one surface, by ln Ra between
samples of its finish -> bilinear over the normal -> by ln |V| between distances.

Normals N in the view frame are mapped by Lambert's azimuthal equal-area projection, (a, b) = (N_x, N_y) sqrt(2 / (1 +
N_z)). It covers the hemisphere toward the sensor. Cells are then equal for equal solid angles, and a look-up needs no
search. The radius is 2 sin(incidence / 2). The gradient space (N_x/N_z, N_y/N_z) of the talk (Kinnell and Justham,
2018) is the same picture with another radial scale.

Between nodes, distances and Ra, the probit of F and ln sigma are linear (:mod:`characterisation.maps.tables`). Sigma
therefore follows a power of |V|. Nothing is extrapolated: outside the characterised normals, distances and Ra a query
returns NaN.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from characterisation.files.arrays import Floats
from characterisation.files.checked_files import dataset_digest
from characterisation.files.errors import InputError
from characterisation.lambert_projection import inverse_lambert_projection
from characterisation.maps.lay import between_directions, directions_of
from characterisation.maps.light import Light, lights_of
from characterisation.maps.map_file import read_map, write_map
from characterisation.maps.samples import Samples
from characterisation.maps.tables import FIELDS, Surface, between_samples

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: largest difference from 1 of the length of a normal; chosen: rounding to four digits stays below
UNIT_TOLERANCE = 1e-3


@dataclass(frozen=True)
class Performance:
    """Answer of a map, one array element per query, NaN where the map has no value.

    - ``fraction`` F [1] and ``sigma`` [mm] along the view ray, without outliers.
    - ``fraction_error`` and ``sigma_error``: one standard error of the map itself. NaN between distances or Ra where no
      third one shows the error of linear interpolation.
    - ``fraction_spread`` and ``sigma_spread``: standard uncertainty due to unknown properties of the sample, NaN where
      the campaign had no variants.
    """

    fraction: Floats
    sigma: Floats
    fraction_error: Floats
    sigma_error: Floats
    fraction_spread: Floats
    sigma_spread: Floats


class PerformanceMap:
    """Performance map, an ``xarray.Dataset`` with dimensions (sample, distance, b, a)."""

    def __init__(self, data: xr.Dataset) -> None:
        self.data = data
        self._distances = data["distance"].values.astype(float)
        self._axis = data["a"].values.astype(float)
        names, roughness = data["finish"].values.astype(str).tolist(), data["roughness"].values.astype(float)
        self.known = Samples(names, roughness, lights_of(data), str(data.attrs.get("name", "performance map")))
        # all views of a part query the same few surfaces
        self._surface = lru_cache(maxsize=16)(self._make_surface)

    @cached_property
    def digest(self) -> str:
        """Return the SHA-256 of the content."""
        return dataset_digest(self.data)

    @property
    def finishes(self) -> list[str]:
        """Return the names of the characterised finishes."""
        return self.known.finishes

    @property
    def samples(self) -> list[tuple[str, float]]:
        """Return (finish, Ra [um] or NaN) of every sample."""
        return list(zip(self.known.names, self.known.roughness.tolist(), strict=True))

    @property
    def lights(self) -> list[Light | None]:
        """Return the optical properties of every sample; None where the map does not contain them."""
        return list(self.known.lights)

    def query(
        self,
        finish: str,
        roughness: float,
        distance: ArrayLike,
        normals: NDArray[np.floating],
        light: Light | None = None,
        tangents: NDArray[np.floating] | None = None,
    ) -> Performance:
        """Look up F and sigma.

        Parameters
        ----------
        finish
            Name of the finish of the surface.
        roughness
            Its Ra [um]; ignored for a finish without Ra.
        distance
            |V| (n,) [mm], from the reference camera to the point; one for all normals, or one for each.
        normals
            Unit N (n, 3) in the view frame: z from the point to the camera, x along the baseline; or one (3,) for all.
        light
            Optical properties of the surface, see :meth:`~characterisation.maps.samples.Samples.representing`.
        tangents
            Direction of the surface's parameter u in the view frame (n, 3), for a surface with a lay. Without it, or
            where it is NaN, the answer is the mean over directions. A surface without a lay ignores it.

        Raises
        ------
        InputError
            If the surface was not characterised, or normals are no unit vectors, or not as many as distances.

        See Also
        --------
        plot : a picture of F and sigma
        """
        distance, normals = _matched(np.asarray(distance, float), np.asarray(normals))
        surface, flat = self.surface(finish, roughness, light), normals.reshape(-1, 3)
        if tangents is None or not surface.directions:
            answer = surface.look_up(distance.ravel(), flat)
        else:
            along = np.broadcast_to(np.asarray(tangents, float), normals.shape).reshape(-1, 3)
            answer = between_directions(surface, distance.ravel(), flat, along)
        return Performance(*(values.reshape(distance.shape) for values in answer))

    def plot(
        self,
        ax: NDArray[np.object_] | Sequence[Axes] | None = None,
        *,
        finish: str | None = None,
        roughness: float | None = None,
        distance: float | None = None,
    ) -> NDArray[np.object_]:
        """Draw F and sigma of a finish at a distance, over the orientation of the surface.

        At the centre of each disc the surface faces the sensor. To the right its normal leans along the baseline toward
        the second eye. The projection is equal-area, and the rings are angles of incidence. The colours of sigma are
        those of the whole map, so that pictures of one map can be compared.

        Parameters
        ----------
        ax
            Two axes to draw F and sigma into; by default those of a new figure.
        finish, roughness
            Finish, and Ra [um]; by default those of the first sample, or of the first sample of the finish.
        distance
            Distance |V| [mm]; by default the characterised distance nearest to mid range, in ratio.

        Returns
        -------
        numpy.ndarray of matplotlib.axes.Axes
            (2,), of F and of sigma.

        Raises
        ------
        InputError
            If the finish or the distance was not characterised, or ``ax`` is not two axes.

        See Also
        --------
        query : the numbers

        Examples
        --------
        >>> import mitsim as ms
        >>> of_f, of_sigma = ms.performance_map("ensenso-n10").plot(finish="aluminium/ground", roughness=0.37)
        >>> of_f.get_title()
        'aluminium/ground, Ra 0.37 µm at 504 mm'
        """
        # imported here because a map alone does not need matplotlib
        from characterisation.plots.discs import draw_performance, noise_limits
        from characterisation.plots.style import axes_for

        name, rough = next((sample for sample in self.samples if finish in (None, sample[0])), (str(finish), math.nan))
        if roughness is not None or name not in self.finishes:
            rough = self.require(name, math.nan if roughness is None else roughness)
        nearest, farthest = float(self._distances[0]), float(self._distances[-1])
        if distance is None:
            middle = math.sqrt(nearest * farthest)
            distance = float(self._distances[np.abs(np.log(self._distances / middle)).argmin()])
        if not nearest <= distance <= farthest:
            allowed = f"{nearest:g} to {farthest:g} mm, as characterised"
            raise InputError("plot", "distance", f"{distance:g} mm", allowed)
        b, a = np.meshgrid(self._axis, self._axis, indexing="ij")
        inside = np.hypot(a, b) <= math.sqrt(2.0)
        normals = inverse_lambert_projection(np.stack([a, b], axis=-1)[inside])
        answer = self.query(name, rough, distance, normals)
        fraction, sigma = np.full((2, *a.shape), np.nan)
        fraction[inside], sigma[inside] = answer.fraction, answer.sigma
        mapped = np.isfinite(self.data["recovered_fraction"].values).any(axis=(0, 1))[inside]
        largest = float(np.arccos(np.clip(normals[mapped, 2], -1, 1)).max()) if mapped.any() else math.radians(75)
        with axes_for(ax, (1, 2), (7.0, 4.4)) as grid:
            pair = grid.ravel()
            limits = noise_limits(self.data["ray_noise_std"].values)
            draw_performance(pair, fraction, sigma, self._axis, largest, limits)
            words = name.replace("_", " ") if math.isnan(rough) else f"{name}, Ra {rough:g} µm"
            for axes in pair:
                axes.set_title(f"{words} at {distance:g} mm")
        return pair

    def surface(self, finish: str, roughness: float, light: Light | None = None) -> Surface:
        """Return the fields of one surface for look-up; arguments and errors are those of :meth:`query`."""
        members, rough = self.known.representing(finish, roughness, light)
        return self._surface(tuple(members), "" if math.isnan(rough) else rough)

    def require(self, finish: str, roughness: float, light: Light | None = None) -> float:
        """Return the Ra [um] at which a surface is looked up, NaN for one that equals a sample; InputError if none."""
        return self.known.representing(finish, roughness, light)[1]

    def _make_surface(self, numbers: tuple[int, ...], roughness: float | str) -> Surface:
        members = list(numbers)
        unknown = np.full(self.data["recovered_fraction"].shape[1:], np.nan)

        def surface_fields(stacks: dict[str, Floats], rough: float) -> list[Floats]:
            whole = {name: stacks.get(name, unknown[None].repeat(len(members), 0)) for name in FIELDS}
            return between_samples(whole, self.known.roughness[members], rough)

        stacks = {name: self.data[name].values[members].astype(float) for name in FIELDS if name in self.data}
        fields = surface_fields(stacks, float(roughness) if roughness != "" else math.nan)
        directions = [
            Surface(
                surface_fields({name: values[None] for name, values in of_direction.items()}, math.nan),
                self._distances,
                self._axis,
            )
            for of_direction in (directions_of(self.data, members[0]) if len(members) == 1 else ())
        ]
        x, y = (float(self.data[name]) if directions else 0.0 for name in ("lay_mirror_x", "lay_mirror_y"))
        return Surface(fields, self._distances, self._axis, directions, (x, y))

    def save(self, path: str | Path, compact: bool = False) -> None:
        """Write netCDF, atomically; ``compact`` compresses it, after rounding errors and values."""
        write_map(self.data, path, compact)

    @staticmethod
    def load(path: str | Path) -> PerformanceMap:
        """Read a map; raise InputError if the file is missing, damaged, no performance map, or of another schema."""
        return PerformanceMap(read_map(path))


def _matched(distance: Floats, normals: NDArray[np.floating]) -> tuple[Floats, NDArray[np.floating]]:
    """Return checked distances and normals of a query, one of each for every element."""
    if normals.shape[-1:] != (3,):
        raise InputError("query", "normals", f"an array {normals.shape}", "(n, 3), or one (3,)")
    try:
        shape = np.broadcast_shapes(distance.shape, normals.shape[:-1])
    except ValueError:
        found, allowed = f"{normals.shape[:-1]} normals and {distance.shape} distances", "one of each, or as many"
        raise InputError("query", "distance", found, allowed) from None
    off = np.abs(np.einsum("...k,...k->...", normals, normals) - 1) > 2 * UNIT_TOLERANCE
    if off.any():
        found, allowed = f"{normals[off][0].tolist()}, and {off.sum() - 1} more", "vectors of length 1"
        raise InputError("query", "normals", found, allowed, "divide them by their length")
    return np.broadcast_to(distance, shape), np.broadcast_to(normals, (*shape, 3))
