"""Predict each sample of the maps that come with mitsim by the optically nearest other one.

``python tests/benchmarks/nearest_finish.py`` prints, over the distance of the two, the root mean square errors of F and
of ln sigma up to 60 deg of incidence: the constants of ``characterisation/maps/nearest.py``. It takes some seconds.
"""

import numpy as np

from characterisation.lambert_projection import inverse_lambert_projection
from characterisation.maps.nearest import place_of
from characterisation.maps.performance_map import PerformanceMap
from characterisation.maps.shipped import map_path, shipped_maps

LARGEST_DEG = 60.0


def rows(sensor):
    """Yield sample, nearest other sample, distance, and rms errors of F and ln sigma, for every sample of a map."""
    known = PerformanceMap.load(map_path(sensor))
    data = known.data
    b, a = np.meshgrid(data["b"].values, data["a"].values, indexing="ij")
    cosine = inverse_lambert_projection(np.stack([a, b], axis=-1))[..., 2]
    near = np.degrees(np.arccos(np.clip(cosine, -1, 1))) < LARGEST_DEG
    fraction, sigma = data["recovered_fraction"].values, data["ray_noise_std"].values
    places = np.array([place_of(light) for light in known.lights])
    for i, place in enumerate(places):
        distances = np.linalg.norm(places - place, axis=1)
        distances[i] = np.inf
        j = int(distances.argmin())
        both = np.isfinite(fraction[i]) & np.isfinite(fraction[j]) & near
        off = (fraction[j] - fraction[i])[both]
        both &= np.isfinite(sigma[i]) & np.isfinite(sigma[j])
        ratio = np.log(sigma[j] / sigma[i])[both]
        yield known.samples[i], known.samples[j], distances[j], *(np.sqrt((x**2).mean()) for x in (off, ratio))


def main():
    found = []
    for sensor in shipped_maps():
        for one, other, distance, off, ratio in rows(sensor):
            print(f"{sensor:24} {one!s:28} by {other!s:28} at {distance:.2f}: F {off:.2f}, ln sigma {ratio:.2f}")
            found.append((distance, off, ratio))
    distance, off, ratio = np.array(found).T
    for name, error in (("F", off), ("ln sigma", ratio)):
        slope = np.sqrt((error**2).sum() / (distance**2).sum())
        print(f"{name}: {slope:.2f} of the distance, root mean square over {len(found)} samples")


if __name__ == "__main__":
    main()
