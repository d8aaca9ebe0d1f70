"""Export a performance map with a small numpy-only kernel, for simulators without mitsim.

The folder contains ``map.npz`` (F as probits and ln sigma at the nodes, as in :mod:`characterisation.maps.tables`),
``sensor_map.py`` (a copy of :mod:`mitsim.report.export.map_kernel`, with its licence) and ``README.md``.
"""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from characterisation.files.atomic_io import write_folder
from characterisation.files.errors import InputError
from characterisation.maps.performance_map import PerformanceMap
from characterisation.maps.tables import to_probit
from characterisation.words.version import __version__
from mitsim.report.export import map_kernel

#: files of an export, all that another one replaces
_FILES = ("map.npz", "sensor_map.py", "README.md")

_README = """# Performance map of {sensor}

Made by mitsim {version} from {source} captures. Licence: Apache-2.0, see the head of `sensor_map.py`.

- `sensor_map.py` needs only numpy.
- `map.npz`: `probit` and `log_sigma` (sample, distance, b, a), `finish` and `roughness` [um] of the samples, `distance`
  [mm], `axis` of a and b, `baseline` (camera frame), `sensor`. F = (Phi(probit) - m) / (1 - 2 m) with m = 0.5 / 113.

```python
import numpy as np
from sensor_map import SensorMap

sensor = SensorMap("map.npz")
fraction, sigma = sensor.image(depth, normals, K, {finish!r}{roughness})
```

`depth` (H, W) is in mm along the optical axis, `normals` (H, W, 3) are unit vectors toward the camera in its frame: x
right, y down, z forward. Surfaces (Ra in um): {surfaces}. Distances: {near:g} to {far:g} mm.

Sources of depth and normals:

- Gazebo: the depth camera has depth in m, times 1000; normals by `normals_from_depth(depth, K)`.
- Isaac Sim: `distance_to_image_plane` in m, times 1000; `normals` are in the world frame: rotate them into the
  camera's.
- Open3D: `RaycastingScene.create_rays_pinhole` and `cast_rays` give depth as `t_hit`; `primitive_normals` are in the
  world frame: rotate them into the camera's, pointing to the camera. Pixel centres are at halves: subtract 0.5 from cx
  and cy.

The map covers direct light on flat faces: exclude pixels in shadow, hidden from the second camera or projector, or
within a few pixels of an edge. `draw` makes errors of neighbouring pixels independent; real ones are correlated.
"""


def write_map_kernel(performance_map: PerformanceMap, folder: str | Path, baseline: NDArray[np.float64]) -> None:
    """Write the folder atomically; ``baseline`` (3,) is the sensor's, in its reference camera's frame.

    Raises InputError if the folder exists and is no export. Other files in an export stay.
    """
    folder = Path(folder)
    if folder.exists() and any(folder.iterdir()) and not (folder / "sensor_map.py").is_file():
        raise InputError("--output", "", f"{folder}, which has other files", "a new folder, or one written before")
    data = performance_map.data
    probit, _ = to_probit(data["recovered_fraction"].values.astype(float))
    with np.errstate(divide="ignore", invalid="ignore"):
        sigma = data["ray_noise_std"].values.astype(float)
        log_sigma = np.log(np.where(sigma > 0, sigma, np.nan))
    sensor = str(data.attrs.get("sensor", ""))
    packed = io.BytesIO()
    np.savez_compressed(
        packed,
        sensor=np.str_(sensor),
        finish=np.array([name for name, _ in performance_map.samples]),
        roughness=data["roughness"].values.astype(float),
        distance=data["distance"].values.astype(float),
        axis=data["a"].values.astype(float),
        baseline=np.asarray(baseline, float),
        probit=probit.astype(np.float32),
        log_sigma=log_sigma.astype(np.float32),
    )
    finish, roughness = performance_map.samples[0]
    distances = data["distance"].values
    readme = _README.format(
        sensor=sensor,
        version=__version__,
        source=data.attrs.get("source", ""),
        finish=finish,
        roughness="" if np.isnan(roughness) else f", {roughness:g}",
        near=distances.min(),
        far=distances.max(),
        surfaces=", ".join(name + ("" if np.isnan(ra) else f" Ra {ra:g}") for name, ra in performance_map.samples),
    )
    kernel = Path(map_kernel.__file__).read_bytes()
    files = {"map.npz": packed.getvalue(), "sensor_map.py": kernel, "README.md": readme.encode("utf-8")}
    write_folder(folder, files, overwrite=_FILES)
