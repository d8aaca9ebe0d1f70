"""Join performance maps: the samples of several campaigns in one map, or the mean of several maps of one sample.

Signal chain: a map, and maps of further samples at some of its distances -> nodes and distances of the first map -> one
map. At distances at which a sample was not characterised, its values are NaN.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr

from characterisation.errors import InputError
from characterisation.maps.light import light_variables
from characterisation.maps.performance_map import PerformanceMap

_NODES = ("sample", "distance", "b", "a")

#: relative difference up to which distances of two maps are equal
_SAME_DISTANCE = 1e-6


def with_samples(performance_map: PerformanceMap, others: Sequence[PerformanceMap]) -> PerformanceMap:
    """Return a map with the samples of other maps appended.

    ``others`` are maps of the same sensor, at some of the distances of the first map. A sample that occurs in several
    of them, each time at another distance, is joined to one. Attributes are those of the first map.

    Raises
    ------
    InputError
        If a distance is not one of the first map's.
    """
    data = performance_map.data
    distances, axis = data["distance"].values.astype(float), data["a"].values.astype(float)
    names = [str(name) for name, values in data.data_vars.items() if values.dims == _NODES]
    samples, lights = list(performance_map.samples), list(performance_map.lights)
    place: dict[str, int] = {}
    fields = {name: [*data[name].values] for name in names}
    for other in others:
        on_nodes = _on_axis(other.data, axis)
        at = [_number_of(distances, float(one)) for one in other.data["distance"].values]
        for number, sample in enumerate(other.samples):
            key = f"{sample} {other.lights[number]}"
            if key not in place:
                place[key] = len(samples)
                samples.append(sample)
                lights.append(other.lights[number])
                for name in names:
                    fields[name].append(np.full(data[name].shape[1:], np.nan, np.float32))
            for name in names:
                if name in on_nodes:
                    fields[name][place[key]][at] = on_nodes[name].values[number]
    joined = xr.Dataset(
        {name: (_NODES, np.stack(fields[name]).astype(data[name].dtype), data[name].attrs) for name in names},
        coords={
            "finish": ("sample", np.array([name for name, _ in samples], dtype=str)),
            "roughness": ("sample", np.array([ra for _, ra in samples], float), data["roughness"].attrs),
            **{name: data[name] for name in ("distance", "a", "b")},
        },
        attrs=data.attrs,
    )
    return PerformanceMap(joined.assign(light_variables(lights)))


def mean_over(maps: Sequence[PerformanceMap]) -> PerformanceMap:
    """Return the mean of maps of one sample that differ in a property that a query does not contain: the lay direction.

    F is the plain mean. Sigma^2 is the mean weighted by recovered points. The standard deviations between the maps are
    the spreads.
    """
    data = maps[0].data.copy(deep=True)
    fraction, sigma, fraction_error, sigma_error = (
        np.stack([one.data[name].values.astype(float) for one in maps])
        for name in ("recovered_fraction", "ray_noise_std", "recovered_fraction_error", "ray_noise_std_error")
    )
    count = len(maps)
    weight = np.where(np.isfinite(sigma), fraction, 0.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        share = weight / weight.sum(axis=0)
        mean = np.sqrt((share * np.nan_to_num(sigma) ** 2).sum(axis=0))
        spread = np.sqrt((share * (np.nan_to_num(sigma) - mean) ** 2).sum(axis=0))
        error = np.sqrt(((share * np.nan_to_num(sigma) * np.nan_to_num(sigma_error)) ** 2).sum(axis=0)) / mean
        known = weight.sum(axis=0) > 0
    fields = {
        "recovered_fraction": fraction.mean(axis=0),
        "ray_noise_std": np.where(known, mean, np.nan),
        "recovered_fraction_error": np.sqrt((fraction_error**2).sum(axis=0)) / count,
        "ray_noise_std_error": np.where(known, error, np.nan),
        "recovered_fraction_spread": fraction.std(axis=0),
        "ray_noise_std_spread": np.where(known, spread, np.nan),
    }
    for name in ("false_fraction", "noise_area", "persistent_share", "bias_share", "patches"):
        if name not in data:
            continue
        values = np.stack([one.data[name].values.astype(float) for one in maps])
        finite = np.isfinite(values)
        with np.errstate(invalid="ignore"):
            fields[name] = np.where(finite, values, 0.0).sum(axis=0) / np.where(
                finite.any(axis=0), finite.sum(axis=0), np.nan
            )
    for name, values in fields.items():
        data[name] = (_NODES, values.astype(np.float32), data[name].attrs)
    return PerformanceMap(data)


def _number_of(distances: np.ndarray, distance: float) -> int:
    number = int(np.abs(np.log(distances / distance)).argmin())
    if abs(distances[number] / distance - 1) > _SAME_DISTANCE:
        known = ", ".join(f"{one:g}" for one in distances)
        raise InputError(
            "maps to be joined", "distance", f"{distance:g} mm", f"a distance of the first map: {known} mm"
        )
    return number


def _on_axis(data: xr.Dataset, axis: np.ndarray) -> xr.Dataset:
    """Return the fields of a map at the nodes of another, bilinear where the nodes differ."""
    own = data["a"].values.astype(float)
    if len(own) == len(axis) and np.allclose(own, axis, atol=1e-9):
        return data
    return data[[name for name, values in data.data_vars.items() if values.dims == _NODES]].interp(a=axis, b=axis)
