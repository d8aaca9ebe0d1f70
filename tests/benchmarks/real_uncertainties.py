"""Stated uncertainties against real recordings: pitch of plates of dots, and noise that does not average out.

python tests/benchmarks/real_uncertainties.py FOLDER_OF_RECORDINGS
python tests/benchmarks/real_uncertainties.py --twin RECORDED_CAPTURE SIMULATED_CAPTURE

Plates: rigs are drawn from the covariance of the preset's calibration and the default drift, about the rig of the
recording; ideal dots go through the drawn rig and come back through the recorded one, as the decoder works. Their pitch
is the statement, with the scatter of the dots; the print of the plate is not in it.

Planes: the mean of a square cell of n pixels scatters by sigma sqrt(A / n), and less the mean of its four neighbours by
sqrt(5 / 4) as much; the difference knows nothing of a bend, and nothing of what neighbours share. Sigma and A are those
of the map that comes with the preset, and once more with the sigma of the recording itself. With ``--twin``, the same
of a recorded capture and its twin by ``mitsim compare``, decoded by the settings of the recording.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from two_rays import triangulate

from characterisation.coupon.metrics import ray_noise_std
from characterisation.coupon.view_frame import in_view_frame
from characterisation.maps.noise_structure import noise_structure
from characterisation.maps.performance_map import PerformanceMap
from characterisation.maps.shipped import map_path
from characterisation.point_cloud import PointCloud
from characterisation.region_of_interest import Roi
from mitsim.capture.capture import Capture
from mitsim.capture.folder import read_capture
from mitsim.capture.recordings.ensenso import read_ensenso
from mitsim.decoding.cloud import capture_cloud, decoder_settings
from mitsim.decoding.plate import Plate, PlateDots, image_on_grid, plate_dots, plate_scale
from mitsim.sensor.camera import Rig
from mitsim.sensor.drift import Drift, drift_modes
from mitsim.sensor.preset import load_sensor
from mitsim.sensor.preset_covariance import preset_covariance
from mitsim.sensor.rig_covariance import RigCovariance
from mitsim.sensor.rig_parameters import moved, parameter_names

Floats = NDArray[np.float64]
PITCH, DRAWS = 18.75, 400
#: last columns of the table of plates
LAST = ["u [mm]", "95 % interval", "verdict"]
#: recording, of the folder ``ensenso``, its own or the factory's calibration, preset whose unknowns are taken, window
PLATES = (
    ("N10, left plate", "locate_multiple_patterns", True, "ensenso-n10", (110, 120, 200, 190)),
    ("N10, right plate", "locate_multiple_patterns", True, "ensenso-n10", (345, 130, 220, 200)),
    ("N10, right, factory's calibration", "locate_multiple_patterns", False, "ensenso-n10", (345, 130, 220, 200)),
    ("N35-806, one plate", "stereo_camera", True, "ensenso-n35", (380, 180, 480, 480)),
)
#: side of a cell [px]; degree of the smooth surface that the sheet may have
CELLS, DEGREE = (10, 20, 40), 3
PLANE_HEADS = (
    "| plane | cell [px] | cells | scatter [mm] | from the preset's map "
    "| from the map's A and the recording's sigma |\n| --- | --- | --- | --- | --- | --- |"
)
#: part of the sheet that the twin shows, too
TWIN_WINDOW = Roi(400, 290, 480, 300)


def main(data: Path) -> None:
    """Print both tables."""
    np.seterr(all="ignore")
    plates = [
        plate_cells(name, data / "ensenso" / folder / "camera.zip", dynamic, preset, window)
        for name, folder, dynamic, preset, window in PLATES
    ]
    heads = list(dict.fromkeys(head for cells in plates for head in cells if head not in LAST))
    heads += LAST
    print("| " + " | ".join(heads) + " |\n" + "| --- " * len(heads) + "|")
    for cells in plates:
        print("| " + " | ".join(cells.get(head, "-") for head in heads) + " |")
    print(f"\n{PLANE_HEADS}")
    sheet = read_ensenso(data / "ensenso" / "colorized_point_cloud" / "stereo.zip")
    settings, imager = decoder_settings(sheet)
    cloud = capture_cloud(sheet, settings, imager=imager)
    plane_rows("N35-604, sheet", cloud, baseline(sheet.rig), Roi(360, 270, 560, 340), "ensenso-n35")


def twins(recorded: Path, simulated: Path) -> None:
    """Print the rows of a recorded sheet and of its twin, in a window that both fill."""
    np.seterr(all="ignore")
    real = read_capture(recorded)
    settings, imager = decoder_settings(real)
    print(PLANE_HEADS)
    for name, capture in (("recorded", real), ("its twin", read_capture(simulated))):
        cloud = capture_cloud(capture, settings, imager=imager)
        plane_rows(name, cloud, baseline(capture.rig), TWIN_WINDOW, "ensenso-n35")


def baseline(rig: Rig) -> Floats:
    """From the first camera to the second, in the sensor frame."""
    first, second = list(rig.cameras.values())[:2]
    return second.centre - first.centre


def plate_cells(
    name: str, path: Path, dynamic: bool, preset: str, window: tuple[int, int, int, int] | None
) -> dict[str, str]:
    """One plate: measured, and the interval stated without its print; its parts in ppm."""
    capture = read_ensenso(path, dynamic=dynamic, frame=0)
    settings, imager = decoder_settings(capture)
    cloud = capture_cloud(capture, settings, imager=imager)
    where = Roi(*(window or (0, 0, cloud.grid.width, cloud.grid.height)))
    dots = plate_dots(name, Plate(where, PITCH), cloud, image_on_grid(capture, cloud.grid))
    scale, scatter, *_ = plate_scale(dots, PITCH)
    parts, (axes, shear) = contributions(capture, preset, dots.centres), axes_of(dots)
    total = PITCH * float(np.sqrt(scatter**2 + sum(part**2 for part in parts.values())))
    pitch = scale * PITCH
    low, high = pitch - 1.96 * total, pitch + 1.96 * total
    return {
        "plate": name,
        "pitch [mm]": f"{pitch:.3f}",
        "error": f"{1e3 * (scale - 1):+.2f} per mille",
        "along the axes [per mille]": f"{1e3 * axes[0]:+.2f}, {1e3 * axes[1]:+.2f}",
        "shear [mrad]": f"{1e3 * shear:+.2f}",
        "dots [ppm]": f"{1e6 * scatter:.0f}",
        **{f"{key} [ppm]": f"{1e6 * part:.0f}" for key, part in parts.items()},
        "u [mm]": f"{total:.3f}",
        "95 % interval": f"{low:.3f} to {high:.3f}",
        "verdict": "holds" if low <= PITCH <= high else "misses",
    }


def axes_of(dots: PlateDots) -> tuple[Floats, float]:
    """Return the scales along the two rows of a plate's dots, relative to the print, and the rows' shear [rad]."""
    found = dots.centres - dots.centres.mean(axis=0)
    plane = found @ np.linalg.svd(found, full_matrices=False)[2][:2].T
    printed = (dots.indices - dots.indices.mean(axis=0)) * PITCH
    along = np.linalg.lstsq(printed, plane, rcond=None)[0]
    scale = np.linalg.norm(along, axis=1)
    return scale - 1, float(along[0] @ along[1] / np.prod(scale))


def contributions(capture: Capture, preset: str, dots: Floats) -> dict[str, float]:
    """Standard deviation of the scale of dots (n, 3) in the sensor frame, by the calibration and each way to drift."""
    rig = capture.rig
    own = parameter_names(rig, False)
    calibration = preset_covariance(load_sensor(preset), Drift.none())
    chosen = [index for index, name in enumerate(calibration.names) if name in own]
    names = tuple(calibration.names[index] for index in chosen)
    covariance = RigCovariance(names, calibration.covariance[np.ix_(chosen, chosen)], "")
    rng = np.random.default_rng(1)
    out = {"calibration": float(np.std([scale_through(rig, names, covariance.draw(rng), dots) for _ in range(DRAWS)]))}
    for mode in drift_modes(rig, own, load_sensor(preset).unknowns.calibration.drift()):
        step = mode.sigma * np.array([mode.step.get(name, 0.0) for name in own])
        out[mode.name.replace(" of right", "")] = abs(scale_through(rig, own, step, dots) - 1)
    return {key: value for key, value in out.items() if value > 2e-6}


def scale_through(rig: Rig, names: tuple[str, ...], values: Floats, points: Floats) -> float:
    """Scale of points (n, 3) that a rig moved by values sees and the nominal one decodes."""
    true = moved(rig, names, values)
    (first, one), (second, other) = list(true.cameras.items())[:2]
    nominal = rig.cameras
    back, _ = triangulate(nominal[first], one.project(points), nominal[second], other.project(points))
    start, _ = triangulate(
        nominal[first], nominal[first].project(points), nominal[second], nominal[second].project(points)
    )
    spread = [np.sqrt(((each - each.mean(axis=0)) ** 2).sum()) for each in (back, start)]
    return float(spread[0] / spread[1])


def smooth_residuals(points: Floats) -> Floats:
    """Residuals [mm] along the ray of points (n, 3) off a smooth surface, whose inverse depth is fitted."""
    slopes, inverse = points[:, :2] / points[:, 2:], 1 / points[:, 2]
    x, y = ((slopes - slopes.mean(axis=0)) / slopes.std(axis=0)).T
    terms = np.stack([x**i * y**j for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i)], axis=1)
    kept = np.ones(len(points), bool)
    for _ in range(4):
        fit = np.linalg.lstsq(terms[kept], inverse[kept], rcond=None)[0]
        off = inverse - terms @ fit
        kept = np.abs(off) < 4 * 1.4826 * np.median(np.abs(off[kept]))
    return np.asarray(-off / inverse * np.linalg.norm(points, axis=1))


def plane_rows(name: str, cloud: PointCloud, across: Floats, window: Roi, preset: str) -> None:
    """Scatter of the means of cells of one flat thing against what the map says of it."""
    part = cloud.points[window.slices].astype(float)
    there = np.isfinite(part).all(axis=-1)
    off = np.full(there.shape, np.nan)
    off[there] = smooth_residuals(part[there])
    off[np.abs(off) > 5 * 1.4826 * np.nanmedian(np.abs(off))] = np.nan
    middle = np.nanmedian(part[there], axis=0)
    normal = np.linalg.svd(part[there][::7] - part[there].mean(axis=0), full_matrices=False)[2][-1]
    normal = normal if normal @ middle < 0 else -normal
    view = middle / np.linalg.norm(middle)
    facing = in_view_frame(normal[None], view[None], across / np.linalg.norm(across))
    distance = np.array([np.linalg.norm(middle)])
    performance_map = PerformanceMap.load(map_path(preset))
    told = performance_map.query("matt_white", np.nan, distance, facing)
    structure = noise_structure(performance_map, "matt_white", np.nan, distance, facing)
    sigma, area = float(told.sigma[0]), float(structure.area[0])
    disc = 40
    patches = [
        part[row : row + disc, column : column + disc].reshape(-1, 3)
        for row in range(0, off.shape[0] - disc + 1, disc)
        for column in range(0, off.shape[1] - disc + 1, disc)
    ]
    own = float(np.nanmedian(ray_noise_std(np.array(patches)).sigma))
    said = f"{name}: {distance[0]:.0f} mm, sigma {own:.3f} of the recording, {sigma:.3f} of the map, A {area:.0f} px^2"
    print(said, file=sys.stderr)
    for side in CELLS:
        rows, columns = off.shape[0] // side, off.shape[1] // side
        cells = off[: rows * side, : columns * side].reshape(rows, side, columns, side).swapaxes(1, 2)
        cells = cells.reshape(rows, columns, -1)
        means = np.where(np.isfinite(cells).mean(axis=-1) > 0.8, np.nanmean(cells, axis=-1), np.nan)
        around = means[:-2, 1:-1] + means[2:, 1:-1] + means[1:-1, :-2] + means[1:-1, 2:]
        second = (means[1:-1, 1:-1] - around / 4)[np.isfinite(around + means[1:-1, 1:-1])]
        if len(second) < 9:
            continue
        scatter = float(1.4826 * np.median(np.abs(second)) / np.sqrt(1.25))
        by = [one * float(np.sqrt(area)) / side for one in (sigma, own)]
        print(f"| {name} | {side} | {len(second)} | {scatter:.3f} | {by[0]:.3f} | {by[1]:.3f} |", flush=True)


if __name__ == "__main__":
    if sys.argv[1] == "--twin":
        twins(Path(sys.argv[2]), Path(sys.argv[3]))
    else:
        main(Path(sys.argv[1]))
