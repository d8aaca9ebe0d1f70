"""Choose the mesh size of a part for a sensor; a chord error of 10 um is visible to a fringe projector."""

from __future__ import annotations

import numpy as np

from characterisation.files.errors import InputError
from characterisation.maps.performance_map import PerformanceMap
from characterisation.maps.shipped import shipped_maps
from mitsim.sensor.preset import load_sensor

#: allowed deviation of the mesh from the surface, as a share of the standard deviation of a point
SHARE = 0.01


def sensor_sigma_mm(name: str) -> float:
    """Return a sensor's smallest standard deviation [mm] of a point on matt white at normal incidence.

    The source is the performance map shipped with mitsim, else published figures of the sensor.

    Raises
    ------
    InputError
        If there is no such sensor, or its noise is unknown.
    """
    sensor = load_sensor(name)
    path = shipped_maps().get(sensor.name)
    if path is not None:
        data = PerformanceMap.load(path).data
        middle = {axis: int(np.abs(data[axis].values).argmin()) for axis in ("a", "b")}
        sigma = data["ray_noise_std"].isel(middle).values[data["finish"].values == "matt_white"]
        if np.isfinite(sigma).any():
            return float(np.nanmin(sigma))
    published = [sigma for one in sensor.published_noise for sigma in one.sigma_mm]
    if not published:
        hint = "give --chord in mm, or add [[published_noise]] to its file"
        raise InputError("--sensor", "", f"{name}, whose noise is unknown", "a sensor with a map", hint)
    return min(published)


def chord_for(name: str) -> float:
    """Return the chord error [mm] of a mesh for a sensor: a hundredth of its sigma."""
    return SHARE * sensor_sigma_mm(name)
