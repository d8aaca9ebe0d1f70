"""Organised point clouds in PLY and PCD files, to captures.

Signal chain: file -> points on their grid, as they are -> axes and unit -> ``Link`` of an Ensenso undone -> the camera
that saw them so, fitted or given -> points in its frame [mm], NaN where there is none.

F needs the number of points that there could have been, so a cloud must keep its grid: WIDTH x HEIGHT of a PCD, what a
PLY tells, or the size of a given camera if there are as many points. What has lost it is refused.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from characterisation.checked_files import read_bounded
from characterisation.errors import InputError
from mitsim.capture.capture import Capture
from mitsim.capture.readers.calibration_file import Calibrated, camera_of, read_calibration
from mitsim.capture.readers.nxlib_tree import NxLibTree, link_of
from mitsim.capture.readers.pcd import decode_pcd
from mitsim.capture.readers.pinhole_fit import LEAST_POINTS, PINHOLE_RMS_PX, fit_pinhole, off_the_rays
from mitsim.capture.readers.ply import decode_ply
from mitsim.sensor.camera import Rig

Points = NDArray[np.float32]
Axes = Literal["opencv", "opengl"]

#: lengths of one unit [mm]
UNITS_MM = {"um": 1e-3, "mm": 1.0, "cm": 10.0, "m": 1000.0}

#: median distance of the points, in the file's numbers, under which they are taken for metres. No sensor here looks
#: closer than 20 mm or farther than 20 m
METRES_UNDER = 20.0

#: coordinates beyond this are no measurement [mm]
FARTHEST_MM = 1e6

#: median distance of the points from the pixels of a camera that was given, up to which it is believed [px]; assumed
CAMERA_OFF_PX = 1.0


def read_organised_cloud(
    path: str | Path, *, calibration: str | Path | None = None, unit: str | None = None, axes: Axes = "opencv",
    link: str | Path | None = None, camera: str | None = None, sensor: str | None = None,
) -> Capture:  # fmt: skip
    """Read one PLY or PCD file.

    Parameters
    ----------
    calibration
        The camera of the grid, see :mod:`mitsim.capture.readers.calibration_file`; without it a pinhole is fitted.
    unit
        ``um``, ``mm``, ``cm`` or ``m``; without it metres, if the median distance is under :data:`METRES_UNDER`, else
        millimetres.
    axes
        ``opencv``: x right, y down, z forward; ``opengl``: y up and z backward, which is turned.
    link
        The ``*_calib.json`` of an Ensenso, whose ``Link`` the points have been moved by: it is undone.
    camera
        Name of the camera in the calibration; without it the first.
    sensor
        Name of the sensor; without it that of the calibration, or ``point-cloud``.

    Raises
    ------
    InputError
        If the file is damaged, has no grid, or no camera at the origin sees its points where they stand in the grid.
    """
    path = Path(path)
    points, told, given = _on_grid(path, calibration, camera)
    settings: dict[str, Any] = {"imported_from": path.name, "axes_of_file": axes} | told
    points[~np.isfinite(points).all(axis=-1) | (points == 0).all(axis=-1)] = np.nan
    count = int(np.isfinite(points[..., 0]).sum())
    if count < LEAST_POINTS:
        raise InputError(path, "", f"{count} points", f"{LEAST_POINTS} or more")
    if axes == "opengl":
        points *= np.array([1, -1, -1], np.float32)
    settings["unit_of_file"] = unit or _unit_of(points)
    farthest = float(np.nanmax(np.abs(points))) * UNITS_MM[settings["unit_of_file"]]
    if farthest > FARTHEST_MM:
        raise InputError(path, "x, y, z", f"{farthest:.3g} mm", f"up to {FARTHEST_MM:g} mm", "is the --unit right?")
    points *= np.float32(UNITS_MM[settings["unit_of_file"]])
    if link is not None:
        camera_from_target = link_of(NxLibTree(read_bounded(Path(link), "an Ensenso's *_calib.json"), str(link)))
        points = camera_from_target.points(points).astype(np.float32)
        settings["link_undone"] = camera_from_target.matrix().tolist()
    rig, found = _seen_by(points, path, given, camera)
    settings |= found
    points = rig.reference.sensor_from_camera.points(points).astype(np.float32)
    if given is not None and given.range_mm is not None:
        settings |= {"near_mm": given.range_mm[0], "far_mm": given.range_mm[1]}
    return Capture(
        sensor=sensor or (given.sensor if given else "") or "point-cloud", technology="point_map", source="device",
        rig=rig, images={}, bits=16, settings=settings, derived={"points": points},
    )  # fmt: skip


def _on_grid(
    path: Path, calibration: str | Path | None, camera: str | None
) -> tuple[Points, dict[str, Any], Calibrated | None]:
    """Points (H, W, 3) as they are in the file, what it says of itself, and the given calibration."""
    data = read_bounded(path, "a PLY or PCD file")
    hint = "save it organised, a point or NaN for each pixel, or give the camera of its pixels: --calibration"
    given = None if calibration is None else read_calibration(calibration)
    if data.startswith(b"ply"):
        read = decode_ply(data, path)
        if any(line.startswith("comment mitsim ") for line in read.lines):
            raise InputError(path, "", "a cloud that mitsim wrote", "one of another program", "it needs no import")
        size = read.size
        if size is None and given is not None:
            eye = given.rig.reference if camera is None else given.rig.cameras.get(camera, given.rig.reference)
            size = eye.width, eye.height
        if size is None or size[0] * size[1] != len(read.points):
            found = f"{len(read.points)} points without a grid" if size is None else f"{len(read.points)} points"
            allowed = "an organised cloud" if size is None else f"{size[0]} x {size[1]}, one for each pixel"
            raise InputError(path, "", found, allowed, hint)
        return read.points.reshape(size[1], size[0], 3).copy(), {}, given
    points, header = decode_pcd(data, path)
    if (
        points.shape[0] == 1
        and given is not None
        and given.rig.reference.width * given.rig.reference.height == (points.shape[1])
    ):
        points = points.reshape(given.rig.reference.height, given.rig.reference.width, 3)
    if points.shape[0] == 1:
        raise InputError(path, "HEIGHT", "1: a cloud without a grid", "an organised cloud", hint)
    return points.copy(), {"viewpoint_of_file": header.get("VIEWPOINT", "")}, given


def _unit_of(points: Points) -> str:
    seen = points[np.isfinite(points[..., 0])]
    return "m" if np.median(np.linalg.norm(seen.astype(float), axis=-1)) < METRES_UNDER else "mm"


def _seen_by(
    points: Points, path: Path, given: Calibrated | None, name: str | None
) -> tuple[Rig, dict[str, Any]]:  # fmt: skip
    """Rig of the camera in whose own frame, and on whose view rays, the points (H, W, 3) [mm] lie."""
    height, width = points.shape[:2]
    hint = (
        "are they in a robot's or workspace's frame? Save them in the camera's, or undo an Ensenso's Link with --link; "
        "of a lens with distortion give the --calibration"
    )
    ahead = points[..., 2] > 0
    if ahead.sum() < 0.5 * np.isfinite(points[..., 2]).sum():
        raise InputError(path, "z", "points behind the camera: z under 0", "z forward, y down",
                         "with y up and z backward import it with --axes opengl")  # fmt: skip
    if given is not None:
        eye = camera_of(given, name, (width, height), path)
        off = off_the_rays(eye.sensor_from_camera.points(points), eye)
        if not off <= CAMERA_OFF_PX:
            found = f"points {off:.3g} px from the view rays of their pixels (median)"
            allowed = f"up to {CAMERA_OFF_PX:g} px: points in the frame of the calibrated camera"
            raise InputError(path, "", found, allowed, hint)
        alone = Rig({name or next(iter(given.rig.cameras)): eye}, given.rig.projector)
        return alone, {"off_the_rays_px": round(off, 6)}
    fitted = fit_pinhole(points)
    if fitted is None or fitted[1] > PINHOLE_RMS_PX:
        found = "points that no pinhole at the origin sees so" + (f": {fitted[1]:.3g} px rms" if fitted else "")
        raise InputError(path, "", found, f"points on the view rays of a pinhole, to {PINHOLE_RMS_PX:g} px", hint)
    return Rig({"camera": fitted[0]}), {"fitted_camera_rms_px": round(fitted[1], 6)}
