"""Noise of planes before PrimeSense's sensors, recorded, against the preset's: sigma, correlation and noise area.

python tests/benchmarks/primesense_planes.py FOLDER_OF_RECORDINGS [BLOCK_SIZE ...]

Windows of 60 px that are smooth to a polynomial of third degree in inverse depth, the quietest six of every cloud; of
the simulated plate, tilted by 12 deg, all. Sigma in px of disparity at f = 575 px and a baseline of 75 mm; correlation
of neighbours 1, 2, 4 and 6 px apart along rows and columns; A: n times the variance of means of cells of n pixels, over
sigma squared [px^2]. The polynomial takes some of what is correlated away, of both alike.

``table_scene_mug_stereo_textured`` of the same folder is no PrimeSense's: its camera has 964 px, and its depths lie
1/16 px of a stereo pair 90 mm apart from one another.
"""

from __future__ import annotations

import sys
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from real_uncertainties import smooth_residuals

from mitsim.capture.recordings.organised_cloud import read_organised_cloud
from mitsim.capture.recordings.read_options import ReadOptions
from mitsim.capture.simulated.rendering import Rendering
from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.decoding.cloud import capture_cloud
from mitsim.scene import backend
from mitsim.scene.load import scene_from_dict
from mitsim.sensor.preset import load_sensor
from mitsim.sensor.sensor import Sensor
from mitsim.sensor.transforms import look_at

Floats = NDArray[np.float64]
CLOUDS = (("milk_cartoon_all_small_clorox", "opengl"), *((f"capture000{number}", "opencv") for number in range(1, 6)))
SIDE, APART, CELLS = 60, (1, 2, 4, 6), (5, 10)
FOCAL_BASELINE = 575.0 * 75.0
HEAD = "| planes | distance [mm] | windows | sigma [px] | along rows | along columns | A, cells of 5 and 10 px |"


def main(data: Path, blocks: list[int]) -> None:
    """Print the table."""
    np.seterr(all="ignore")
    warnings.simplefilter("ignore", RuntimeWarning)  # cells without a point
    print(HEAD + "\n| --- | --- | --- | --- | --- | --- | --- |")
    for name, axes in CLOUDS:
        points = read_organised_cloud(data / "primesense_pcl" / f"{name}.pcd", ReadOptions(axes=axes)).derived["points"]
        rows = windows(np.asarray(points, float), step=20)
        chosen: list[tuple[float, int, int, Floats]] = []
        for one in sorted(rows, key=lambda row: row[0]):
            if all(abs(one[1] - other[1]) + abs(one[2] - other[2]) >= SIDE for other in chosen) and len(chosen) < 6:
                chosen.append(one)
        show(name, [one[3] for one in chosen])
    preset = load_sensor("primesense-carmine-1.09")
    backend.activate()
    for block in blocks:
        for distance in (800.0, 1400.0):
            matcher = preset.matcher.model_copy(update={"block_size": block, "far_mm": 3500})
            points = simulated(replace(preset, matcher=matcher), distance)
            show(f"simulated, block of {block} px", [row[3] for row in windows(points, step=SIDE)])


def simulated(sensor: Sensor, distance: float, tilt: float = 12.0) -> Floats:
    """Points (H, W, 3) of a white plate."""
    half = 0.19 * distance
    size = backend.mi.ScalarTransform4f().scale([half, half, 1])
    white = {"type": "matt_white", "reflectance": 0.85}
    scene = scene_from_dict({"plate": {"type": "rectangle", "to_world": size, "bsdf": white}}, sensor.wavelength_nm)
    slope = np.radians(tilt)
    eye = (0.8 * distance * np.sin(slope), 0.6 * distance * np.sin(slope), distance * np.cos(slope))
    capture = SimulatedSensor(sensor).capture(
        scene, look_at(eye, (0, 0, 0), (0, 1, 0), 0.0), rendering=Rendering(samples=16), seed=1
    )
    return capture_cloud(capture, sensor.matcher, imager=sensor.imager).points.astype(float)


def windows(points: Floats, step: int) -> list[tuple[float, int, int, Floats]]:
    """Smooth windows: noise over distance squared, column, row, and the figures of the table."""
    there = np.isfinite(points[..., 2])
    rows, columns = np.flatnonzero(there.any(axis=1)), np.flatnonzero(there.any(axis=0))
    out = []
    for row in range(rows[0] + 5, rows[-1] - SIDE, step):
        for column in range(columns[0] + 5, columns[-1] - SIDE, step):
            part = points[row : row + SIDE, column : column + SIDE].reshape(-1, 3)
            seen = np.isfinite(part).all(axis=1)
            if seen.mean() < 0.95:
                continue
            off = np.full(SIDE * SIDE, np.nan)
            off[seen] = smooth_residuals(part[seen])
            robust = 1.4826 * np.nanmedian(np.abs(off))
            if np.mean(np.abs(off[seen]) < 4 * max(robust, 0.3)) < 0.97:
                continue
            distance = float(np.median(part[seen, 2]))
            figures = _figures(off.reshape(SIDE, SIDE), distance)
            out.append((figures[1], column, row, figures))
    return out


def _figures(off: Floats, distance: float) -> Floats:
    sigma = float(np.nanstd(off))
    there, value = np.isfinite(off), np.nan_to_num(off)

    def correlation(down: int, along: int) -> float:
        both = there[down:, along:] & there[: SIDE - down, : SIDE - along]
        return float((value[down:, along:] * value[: SIDE - down, : SIDE - along]).sum() / both.sum() / sigma**2)

    areas = []
    for side in CELLS:
        count = SIDE // side
        cells = off.reshape(count, side, count, side).swapaxes(1, 2).reshape(count * count, -1)
        areas.append(float((np.nanstd(np.nanmean(cells, axis=-1)) / sigma * side) ** 2))
    return np.array(
        [
            distance,
            sigma / distance**2 * FOCAL_BASELINE,
            *(correlation(0, k) for k in APART),
            *(correlation(k, 0) for k in APART),
            *areas,
        ]
    )


def show(name: str, figures: list[Floats]) -> None:
    """One row: medians over windows."""
    middle = np.median(figures, axis=0)
    rows, columns = (", ".join(f"{x:.2f}" for x in part) for part in (middle[2:6], middle[6:10]))
    print(
        f"| {name} | {middle[0]:.0f} | {len(figures)} | {middle[1]:.3f} | {rows} | {columns} | "
        f"{middle[10]:.1f}, {middle[11]:.1f} |",
        flush=True,
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]), [int(size) for size in sys.argv[2:]] or [9, 7, 5])
