"""Join performance maps: the samples of several campaigns in one map, or the mean of several maps of one sample.

Signal chain: a map, and maps of further samples at some of its distances -> nodes and distances of the first map -> one
map. At distances at which a sample was not characterised, its values are NaN.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr

from characterisation.files.errors import InputError
from characterisation.maps.lay import LAY_FIELDS, LAY_NODES
from characterisation.maps.light import light_variables
from characterisation.maps.performance_map import PerformanceMap

_NODES = ("sample", "distance", "b", "a")

#: relative difference up to which distances of two maps are equal
_SAME_DISTANCE = 1e-6


def with_samples(performance_map: PerformanceMap, other_maps: Sequence[PerformanceMap]) -> PerformanceMap:
    """Return a map with the samples of other maps appended.

    ``other_maps`` are of the same sensor, at some of the distances of the first map. A sample that occurs in several of
    them, each time at another distance, is joined to one. Attributes are those of the first map. Raises InputError if a
    distance is not one of the first map's.
    """
    data = performance_map.data
    distances, axis = data["distance"].values.astype(float), data["a"].values.astype(float)
    kinds = {str(name): values for name, values in data.data_vars.items() if values.dims == _NODES}
    with_lay = next((one.data for one in (performance_map, *other_maps) if "lay" in one.data.dims), None)
    if with_lay is not None:
        kinds |= {name: with_lay[name] for name in LAY_FIELDS.values()}
    samples, lights = list(performance_map.samples), list(performance_map.lights)
    index_of: dict[str, int] = {}
    missing = {
        name: np.full((*kind.shape[1:-3], len(distances), len(axis), len(axis)), np.nan, kind.dtype)
        for name, kind in kinds.items()
    }
    fields = {name: [*data[name].values] if name in data else [empty] * len(samples) for name, empty in missing.items()}
    for other in other_maps:
        on_nodes = _on_axis(other.data, axis)
        at = [_number_of(distances, float(distance)) for distance in other.data["distance"].values]
        for number, sample in enumerate(other.samples):
            key = f"{sample} {other.lights[number]}"
            if key not in index_of:
                index_of[key] = len(samples)
                samples.append(sample)
                lights.append(other.lights[number])
                for name, empty in missing.items():
                    fields[name].append(empty.copy())
            for name in kinds:
                if name in on_nodes:
                    fields[name][index_of[key]][..., at, :, :] = on_nodes[name].values[number]
    joined = xr.Dataset(
        {name: (kind.dims, np.stack(fields[name]).astype(kind.dtype), kind.attrs) for name, kind in kinds.items()},
        coords={
            "finish": ("sample", np.array([name for name, _ in samples], dtype=str)),
            "roughness": ("sample", np.array([ra for _, ra in samples], float), data["roughness"].attrs),
            **{name: data[name] for name in ("distance", "a", "b")},
            **({} if with_lay is None else {name: with_lay[name] for name in ("lay", "lay_mirror_x", "lay_mirror_y")}),
        },
        attrs=data.attrs,
    )
    return PerformanceMap(joined.assign(light_variables(lights)))


def mean_over(maps: Sequence[PerformanceMap]) -> PerformanceMap:
    """Return the mean of maps of one sample that differ in a property that a query does not contain: the lay direction.

    F is the plain mean. Sigma^2, the bias and the second moment of what persists, p^2 + beta^2 [mm^2], are means
    weighted by recovered points: a bias that differs between the maps persists. The standard deviations between the
    maps are the spreads.
    """
    data = maps[0].data.copy(deep=True)
    fraction, sigma, fraction_error, sigma_error = (
        np.stack([performance_map.data[name].values.astype(float) for performance_map in maps])
        for name in ("recovered_fraction", "ray_noise_std", "recovered_fraction_error", "ray_noise_std_error")
    )
    count = len(maps)
    weight = np.where(np.isfinite(sigma), fraction, 0.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        share = weight / weight.sum(axis=0)
        mean = np.sqrt((share * np.nan_to_num(sigma) ** 2).sum(axis=0))
        spread = np.sqrt((share * (np.nan_to_num(sigma) - mean) ** 2).sum(axis=0))
        error = np.sqrt(((share * np.nan_to_num(sigma) * np.nan_to_num(sigma_error)) ** 2).sum(axis=0)) / mean
        weighted = weight.sum(axis=0) > 0
    fields = {
        "recovered_fraction": fraction.mean(axis=0),
        "ray_noise_std": np.where(weighted, mean, np.nan),
        "recovered_fraction_error": np.sqrt((fraction_error**2).sum(axis=0)) / count,
        "ray_noise_std_error": np.where(weighted, error, np.nan),
        "recovered_fraction_spread": fraction.std(axis=0),
        "ray_noise_std_spread": np.where(weighted, spread, np.nan),
    }
    if "persistent_share" in data and "bias_share" in data:
        fields |= _persistent_and_bias(maps, share, mean)
    for name in ("false_fraction", "noise_area", "patches"):
        if name not in data:
            continue
        values = np.stack([performance_map.data[name].values.astype(float) for performance_map in maps])
        finite = np.isfinite(values)
        total, number = np.where(finite, values, 0.0).sum(axis=0), finite.sum(axis=0)
        fields[name] = total / np.where(number > 0, number, np.nan)
    for name, values in fields.items():
        data[name] = (_NODES, values.astype(np.float32), data[name].attrs)
    return PerformanceMap(data)


def _persistent_and_bias(maps: Sequence[PerformanceMap], share: np.ndarray, mean: np.ndarray) -> dict[str, np.ndarray]:
    """Return p / sigma and beta / sigma of the mean, by the ``share`` of the points and its sigma, ``mean`` [mm]."""
    persistent, bias = (
        np.stack([(one.data[name] * one.data["ray_noise_std"]).values.astype(float) for one in maps])
        for name in ("persistent_share", "bias_share")
    )
    weight = np.where(np.isfinite(persistent) & np.isfinite(bias), np.nan_to_num(share), 0.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        weight = weight / weight.sum(axis=0)
        common = (weight * np.nan_to_num(bias)).sum(axis=0)
        second_moment = (weight * np.nan_to_num(bias**2 + persistent**2)).sum(axis=0)
        rest = np.sqrt(np.maximum(second_moment - common**2, 0.0))
        return {"persistent_share": rest / mean, "bias_share": common / mean}


def with_directions(
    mean: PerformanceMap, maps: Sequence[PerformanceMap], mirror_mm: tuple[float, float]
) -> PerformanceMap:
    """Return the mean over maps of one sample with its lay in several directions, with the fields of each direction.

    The directions of the ``maps`` are equally spaced from 0 to 180 deg. ``mirror_mm`` is m of
    :mod:`characterisation.maps.lay`.
    """
    angles = np.arange(len(maps)) * 180.0 / len(maps)
    fields = {
        stored: (LAY_NODES, np.stack([one.data[name].values for one in maps], axis=1), maps[0].data[name].attrs)
        for name, stored in LAY_FIELDS.items()
    }
    described = {"units": "deg", "long_name": "direction of u of a surface with a lay, about the mirror direction"}
    middle = {"units": "mm", "long_name": "place half-way between camera and light"}
    x, y = (((), place, middle) for place in mirror_mm)
    data = mean.data.assign(fields)
    return PerformanceMap(data.assign_coords(lay=("lay", angles, described), lay_mirror_x=x, lay_mirror_y=y))


def _number_of(distances: np.ndarray, distance: float) -> int:
    number = int(np.abs(np.log(distances / distance)).argmin())
    if abs(distances[number] / distance - 1) > _SAME_DISTANCE:
        allowed = f"a distance of the first map: {', '.join(f'{value:g}' for value in distances)} mm"
        raise InputError("maps to be joined", "distance", f"{distance:g} mm", allowed)
    return number


def _on_axis(data: xr.Dataset, axis: np.ndarray) -> xr.Dataset:
    """Return the fields of a map at the nodes of another, bilinear where the nodes differ."""
    map_axis = data["a"].values.astype(float)
    if len(map_axis) == len(axis) and np.allclose(map_axis, axis, atol=1e-9):
        return data
    names = [name for name, values in data.data_vars.items() if values.dims in (_NODES, LAY_NODES)]
    return data[names].interp(a=axis, b=axis)
