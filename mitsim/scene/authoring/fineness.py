"""Choose the mesh size of a part for a sensor; a chord error of 10 um is visible to a fringe projector.

The facets of a measured face shift its fit as a whole, and the fit averages the noise of many points: the chord error
of such a face is a small share of the noise of a point. A small part of a sphere or cylinder has few points, which
hardly tell its radius from the place of its centre: its facets may be coarser by as much. No fit averages over a torus
or a free form: its facets need only be smaller than what one point resolves. The number of triangles is inversely
proportional to the chord error.
"""

from __future__ import annotations

import numpy as np

from characterisation.files.errors import InputError
from characterisation.maps.performance_map import PerformanceMap
from characterisation.maps.shipped import shipped_maps
from mitsim.scene.authoring.read_step import Fineness
from mitsim.sensor.preset import load_sensor

#: allowed deviation of the mesh from a measured surface, as a share of the standard deviation of a point
SHARE = 0.01

#: the same for tori and free forms: a deviation of a tenth increases the standard deviation by 0.5 %
SHARE_OF_OTHERS = 0.1

#: allowed shift of a fitted radius, as a share of its standard uncertainty by noise at the nearest working distance: a
#: tenth increases the uncertainty by 0.5 %
SHARE_OF_RADIUS = 0.1

#: mean distance of an equilateral facet from a sphere, relative to its chord error; 2/3 for a cylinder
_MEAN_OF_CHORD = 0.75

#: most triangles of a part [1]: 34 MB of files
MOST_TRIANGLES = 400_000


def sensor_sigma_mm(name: str) -> float:
    """Return a sensor's least sigma [mm] on matt white, by its shipped map or published figures; else InputError."""
    sensor = load_sensor(name)
    path = shipped_maps().get(sensor.name)
    if path is not None:
        data = PerformanceMap.load(path).data
        middle = {axis: int(np.abs(data[axis].values).argmin()) for axis in ("a", "b")}
        sigma = data["ray_noise_std"].isel(middle).values[data["finish"].values == "matt_white"]
        if np.isfinite(sigma).any():
            return float(np.nanmin(sigma))
    published = [sigma for noise in sensor.published_noise for sigma in noise.sigma_mm]
    if not published:
        hint = "give --chord in mm, or add [[published_noise]] to its file"
        raise InputError("--sensor", "", f"{name}, whose noise is unknown", "a sensor with a map", hint)
    return min(published)


def fineness_for(name: str) -> Fineness:
    """Return how fine a mesh is for a sensor; raises as :func:`sensor_sigma_mm`."""
    sigma, sensor = sensor_sigma_mm(name), load_sensor(name)
    matrix, nearest = sensor.rig.reference.matrix, sensor.working_range_mm[0]
    point_mm2 = nearest**2 / float(matrix[0, 0] * matrix[1, 1])
    fitted = SHARE_OF_RADIUS / _MEAN_OF_CHORD * sigma * point_mm2**0.5
    return Fineness(SHARE * sigma, SHARE_OF_OTHERS * sigma, MOST_TRIANGLES, fitted)
