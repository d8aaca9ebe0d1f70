"""Read organised point clouds in PLY, PCD, ZDF and NumPy files as captures.

A device with a rectified pair outputs its points on the pixels and in the frame of the *rectified* left camera. The
sensor frame of mitsim is that of the raw first camera. The points are therefore rotated by the rectifying rotation,
from the ``--link`` file or from a calibration with a rectification.

F needs the number of possible points, so a cloud must keep its grid: WIDTH x HEIGHT of a PCD, the size stated in a PLY
or found from its points, or the size of a given camera if the number of points matches. A cloud without a grid is
rejected.
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from characterisation.files.checked_files import read_bounded
from characterisation.files.errors import InputError
from characterisation.pinhole_grid import LEAST_POINTS, PINHOLE_RMS_PX
from mitsim.capture.capture import Capture
from mitsim.capture.decoding import Decoding
from mitsim.capture.npy import NPY_MAGIC
from mitsim.capture.recordings.array_file import map_in
from mitsim.capture.recordings.calibration_file import Calibrated, camera_of, read_calibration
from mitsim.capture.recordings.cloud_numbers import leave_out_marks, near_note, scale_to_mm
from mitsim.capture.recordings.nxlib_calibration import NxLibTree, link_of, sensor_from_rectified
from mitsim.capture.recordings.pcd import decode_pcd
from mitsim.capture.recordings.pinhole_fit import fit_pinhole, grid_of, off_the_rays
from mitsim.capture.recordings.ply import decode_ply
from mitsim.capture.recordings.read_options import ReadOptions
from mitsim.capture.recordings.zdf import HDF5_MAGIC, read_zdf
from mitsim.sensor.calibration_qualifiers import LENGTHS_MM, check_camera
from mitsim.sensor.camera import Camera, Rig
from mitsim.sensor.transforms import Transform

Points = NDArray[np.float32]
#: directions of the axes of a cloud: x right, y down, z forward; or y up and z backward
AXES = ("opencv", "opengl")

#: largest accepted median distance of the points from the pixels of a given camera [px]; assumed
CAMERA_OFF_PX = 1.0


@dataclass(frozen=True)
class StoredCloud:
    """Points of a PLY or PCD file, as they are in it.

    - ``path`` of the file.
    - ``points`` (n, 3) of a PLY, (H, W, 3) of others.
    - ``size`` (width, height) of the grid; None without one.
    - ``records`` that a capture of them keeps.
    - ``camera`` that the file states; None if it states none.
    - ``grey``: image (H, W) of the grid, uint8; None without one.
    - ``unit`` that the file states, one of :data:`~mitsim.sensor.calibration_qualifiers.LENGTHS_MM`; None without one.
    - ``note`` about missing points; empty without one.
    """

    path: Path
    points: Points
    size: tuple[int, int] | None
    records: dict[str, Any]
    camera: Calibrated | None = None
    grey: NDArray[np.uint8] | None = None
    unit: str | None = None
    note: str = ""


class NoGridError(InputError):
    """A cloud that is not organised, where an organised one is needed; the cloud ``stored`` in the file."""

    stored: StoredCloud


def read_stored_cloud(path: Path) -> StoredCloud:
    """Read a PLY, PCD, ZDF or NumPy file of another program; what its bytes are counts, not its suffix.

    A PLY often does not state its grid, though it has a point for every pixel, as PhoXi Control and Zivid Studio write
    it: the grid is then found from the points.
    """
    expected = "a PLY, PCD, ZDF or NumPy file"
    if path.suffix.lower() == ".zdf" or read_bounded(path, expected, first=len(HDF5_MAGIC)) == HDF5_MAGIC:
        return _of_zdf(path)
    data = read_bounded(path, expected)
    if data.startswith(b"ply"):
        read = decode_ply(data, path)
        if any(line.startswith("comment mitsim ") and '"grid"' in line for line in read.lines):
            raise InputError(path, "", "a cloud written by mitsim", "a cloud of another program", "it needs no import")
        note = leave_out_marks(read.points)
        size = read.size or grid_of(read.points)
        records = {} if read.size or size is None else {"grid_from": "the points"}
        return StoredCloud(path, read.points, size, records, unit=read.unit, note=note)
    if data.startswith(NPY_MAGIC) or path.suffix.lower() == ".npz":
        return _of_npy(path, data)
    if path.suffix.lower() == ".ply" and b"FIELDS" not in data[:4096]:
        raise InputError(path, "", "a file without the header of a PLY", "a PLY file, whose first line is ply")
    points, header = decode_pcd(data, path)
    note = leave_out_marks(points)
    height, width = points.shape[:2]
    size = (width, height) if height > 1 else grid_of(points.reshape(-1, 3))
    return StoredCloud(path, points, size, {"viewpoint_of_file": header.get("VIEWPOINT", "")}, note=note)


def _of_zdf(path: Path) -> StoredCloud:
    read = read_zdf(path)
    height, width = read.points.shape[:2]
    records: dict[str, Any] = {}
    if read.snr is not None and np.isfinite(read.snr).any():
        records["snr_median"] = round(float(np.nanmedian(read.snr)), 3)
    camera = None
    if read.matrix is not None:
        lens = np.zeros(5) if read.distortion is None else read.distortion
        eye = Camera(read.matrix, lens, width, height)
        # where the file keeps its matrix is not published: it is believed only if it sees the points on their pixels
        with suppress(InputError):
            check_camera(eye, path, "camera matrix")
            camera = Calibrated(Rig({"camera": eye}), "", nominal=True)
    grey = None if read.colour is None else np.ascontiguousarray(read.colour[..., 1])
    return StoredCloud(path, read.points, (width, height), records, camera, grey)


def _of_npy(path: Path, data: bytes) -> StoredCloud:
    values = map_in(data, path)
    if values.ndim != 3 or min(values.shape[:2]) < 2:
        found = f"{values.dtype} of {' x '.join(map(str, values.shape))}"
        raise InputError(path, "shape", found, "points of rows x columns x 3, or depths of rows x columns")
    with np.errstate(over="ignore"):
        points = values.astype(np.float32)
    note = leave_out_marks(points)
    return StoredCloud(path, points, (values.shape[1], values.shape[0]), {}, note=note)


def read_organised_cloud(path: str | Path | StoredCloud, options: ReadOptions) -> Capture:
    """Read an organised cloud of a file, or the one that was read from it.

    Without a calibration, a pinhole is fitted. If a calibration has a rectification, the grid may also be that of the
    rectified left image, at full or reduced size. The unit is by default that of the file, else metres if the median
    distance is under :data:`~mitsim.capture.recordings.cloud_numbers.METRES_UNDER`, else millimetres. Axes of
    ``opengl`` are converted to ``opencv``. ``link``, the ``*_calib.json`` of an Ensenso whose ``Link`` transformed the
    points, is inverted, and the points are rotated from the rectified left frame to the sensor frame. Raises InputError
    if the file is damaged or has no grid, or no camera at the origin sees its points on the pixels of the grid.
    """
    axes, link = options.axes or AXES[0], options.link
    if axes not in AXES:
        raise InputError("--axes", "", repr(axes), " | ".join(AXES))
    if options.unit is not None and options.unit not in LENGTHS_MM:
        raise InputError("--unit", "", repr(options.unit), " | ".join(LENGTHS_MM))
    stored = path if isinstance(path, StoredCloud) else read_stored_cloud(Path(path))
    path = stored.path
    points, calibrated = _on_grid(stored, options.cameras, options.camera)
    settings: dict[str, Any] = {"imported_from": path.name, "axes_of_file": axes} | stored.records
    points[points[..., 2] == 0] = np.nan  # in the plane of the optical centre
    settings["unit_of_file"], distance = scale_to_mm(points, path, options.unit or stored.unit, "check --unit")
    count = int(np.isfinite(points[..., 0]).sum())
    if count < LEAST_POINTS and calibrated is None:
        raise InputError(path, "", f"{count} points", f"{LEAST_POINTS} or more")
    if axes == "opengl":
        points *= np.array([1, -1, -1], np.float32)
    turn = Transform.identity()
    if link is not None:
        tree = NxLibTree(read_bounded(Path(link), "an Ensenso's *_calib.json"), str(link))
        turn, rectified_from_workspace = sensor_from_rectified(tree), link_of(tree)
        if rectified_from_workspace is not None:
            points = rectified_from_workspace.points(points).astype(np.float32)
            settings["link_target"] = str(tree.get("Link/Target") or "")
            settings["sensor_from_workspace"] = (turn @ rectified_from_workspace).matrix().tolist()
    rig, records = _seen_by(points, path, calibrated, options.camera, turn)
    settings |= records
    images = {} if stored.grey is None else {next(iter(rig.cameras)): stored.grey[None]}
    points = rig.reference.sensor_from_camera.points(points).astype(np.float32)
    notes = calibrated.notes if calibrated is not None and "off_the_rays_px" in records else ()
    near_by = "" if options.unit or stored.unit else near_note(distance, "--unit cm, or inch")
    if warnings := [note for note in (stored.note, *notes, near_by) if note]:
        settings["warnings"] = warnings
    near, far = (calibrated.range_mm if calibrated else None) or (None, None)
    return Capture(
        sensor=options.named or (calibrated.sensor if calibrated else "") or "point-cloud",
        technology="point_map",
        source="device",
        rig=rig,
        images=images,
        bits=8 if images else 16,
        decoding=Decoding(near_mm=near, far_mm=far),
        settings=settings,
        derived={"points": points},
    )


def _on_grid(
    stored: StoredCloud, calibration: str | Path | None, camera: str | None
) -> tuple[Points, Calibrated | None]:
    """Return the points (H, W, 3) as in the file, and the given calibration."""
    size, count = stored.size, stored.points.size // 3
    calibrated = None if calibration is None else read_calibration(calibration, size)
    if size is None and calibrated is not None:
        eye = calibrated.rig.cameras.get(camera or "", calibrated.rig.reference)
        size = eye.width, eye.height
    calibrated = calibrated or stored.camera
    hint = "save it organised, a point or NaN for each pixel, or give the camera of its pixels: --calibration"
    if size is None:
        of_pcd = stored.points.ndim == 3
        field, found = ("HEIGHT", "1: a cloud") if of_pcd else ("", f"{count} points")
        error = NoGridError(stored.path, field, f"{found} without a grid", "an organised cloud", hint)
        error.stored = replace(stored, points=stored.points.reshape(-1, 3))
        raise error
    if size[0] * size[1] != count:
        raise InputError(stored.path, "", f"{count} points", f"{size[0]} x {size[1]}, one for each pixel", hint)
    return stored.points.reshape(size[1], size[0], 3).copy(), calibrated


def _seen_by(
    points: Points, path: Path, calibrated: Calibrated | None, name: str | None, turn: Transform
) -> tuple[Rig, dict[str, Any]]:
    """Return the rig of the camera in whose frame, and on whose view rays, the points (H, W, 3) [mm] lie.

    ``turn`` takes that frame to the sensor frame if the rotation is known.
    """
    height, width = points.shape[:2]
    hint = (
        "if they are in the frame of a robot or workspace, save them in the camera's, or invert an Ensenso's Link with "
        "--link; for an unusual lens give --calibration"
    )
    if (points[..., 2] > 0).sum() < 0.5 * np.isfinite(points[..., 2]).sum():
        turned = "if y is up and z backward, use --axes opengl"
        raise InputError(path, "z", "points behind the camera: z under 0", "z forward, y down", turned)
    if calibrated is not None:
        eyes = _possible_cameras(calibrated, name, (width, height), path, turn)
        measured = [(off_the_rays(eye.sensor_from_camera.points(points), eye), label, eye) for label, eye in eyes]
        off, label, best = min(measured, key=lambda candidate: candidate[0], default=(math.inf, "", None))
        if best is not None and off <= CAMERA_OFF_PX:
            return Rig({label: best}, calibrated.rig.projector), {"off_the_rays_px": round(off, 6)}
        if not calibrated.nominal:
            found = f"points {off:.3g} px from the view rays of their pixels (median)"
            allowed = f"up to {CAMERA_OFF_PX:g} px: points in the frame of the calibrated camera"
            raise InputError(path, "", found, allowed, hint)
    fitted = fit_pinhole(points)
    if fitted is None or fitted[1] > PINHOLE_RMS_PX:
        found = "points that match no camera at the origin" + (f": {fitted[1]:.3g} px rms" if fitted else "")
        allowed = f"points on the view rays of a pinhole or a lens, to {PINHOLE_RMS_PX:g} px"
        raise InputError(path, "", found, allowed, hint)
    placed = replace(fitted[0], sensor_from_camera=turn)
    return Rig({"camera": placed}), {"fitted_camera_rms_px": round(fitted[1], 6)}


def _possible_cameras(
    calibrated: Calibrated, name: str | None, size: tuple[int, int], path: Path, turn: Transform
) -> list[tuple[str, Camera]]:
    """Return the cameras that may own a grid of ``size`` (width, height), in the sensor frame, with their names.

    These are the camera itself and, for the first camera of a pair with a rectification, its rectified camera. The
    latter may be scaled as a device scales its maps: fx, fy, cx and cy by the same factor.
    """
    eyes, pair = [], calibrated.rig.rectification
    first, left = next(iter(calibrated.rig.cameras.items()))
    if pair is not None and (name is None or calibrated.rig.cameras.get(name) is left):
        scale = size[0] / pair.width
        if abs(scale * pair.height - size[1]) < 1:  # a side may be rounded
            pose = left.sensor_from_camera @ Transform(pair.rotation_left.T, np.zeros(3))
            matrix = np.diag([scale, scale, 1.0]) @ pair.matrix_left
            eyes.append((first, Camera(matrix, np.zeros(5), *size, sensor_from_camera=pose)))
    if not eyes or size == (left.width, left.height):
        if calibrated.nominal and size != (left.width, left.height):
            return eyes
        label, eye = camera_of(calibrated, name, size, path)
        eyes.append((label, replace(eye, sensor_from_camera=eye.sensor_from_camera @ turn)))
    return eyes
