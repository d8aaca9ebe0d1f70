"""Read a file that describes the cameras of a recording, in any of these formats, as a rig.

========================= ============================================================
a sensor                  preset, or sensor TOML: its cameras
a small TOML              ``[cameras.NAME]`` alone, or ``[calibration]``, as in a sensor TOML
a small JSON              ``fx fy cx cy width height``, and optionally ``distortion``, ``name``
DepthAI                   JSON with ``cameraData``: its left and right camera
a capture's               ``calibration.json`` of a capture folder
an Ensenso's              ``*_calib.json`` of a recording: left and right camera, manufacturer's rectification
a folder of EuRoC         ``cam0/sensor.yaml`` and ``cam1/sensor.yaml``
others                    YAML, XML or JSON of OpenCV, ROS, Kalibr; .mat, .npz, under the usual names; forms of
                          :mod:`mitsim.sensor.calibration_devices`
========================= ============================================================
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field

from characterisation.files.checked_files import read_bounded
from characterisation.files.documents import Document, validate
from characterisation.files.errors import InputError
from characterisation.files.toml_tables import read_toml_table
from mitsim.capture.calibration import CalibrationDocument, rig_of
from mitsim.capture.recordings.depthai_calibration import is_depthai_calibration, read_depthai_calibration
from mitsim.capture.recordings.json_fields import parsed_json
from mitsim.capture.recordings.nxlib_calibration import NxLibTree, nxlib_rig
from mitsim.capture.recordings.recording_files import plain_name
from mitsim.capture.recordings.stated_scale import stated_scales
from mitsim.sensor.calibration_eyes import cameras_of
from mitsim.sensor.calibration_formats import SUFFIXES
from mitsim.sensor.calibration_qualifiers import check_camera
from mitsim.sensor.calibration_table import CalibrationTable
from mitsim.sensor.calibration_tree import CalibrationTree, read_tree, tree_of
from mitsim.sensor.camera import Camera, Rig
from mitsim.sensor.opencv_calibration import has_pair, with_calibration
from mitsim.sensor.preset import load_sensor, presets
from mitsim.sensor.sensor_file import OpticsTable
from mitsim.sensor.unknowns import UnknownsTable

#: calibrations in a folder of EuRoC
_OF_EUROC = ("cam0/sensor.yaml", "cam1/sensor.yaml")


@dataclass(frozen=True)
class Calibrated:
    """A ``rig`` read from a file, the name of its ``sensor``, and its range if the file states one.

    ``notes``: warnings for the user. ``nominal``: whether the cameras are those of a type of device, not of one unit.
    ``unrelated``: whether they are several single cameras, such as those of colour and depth. ``depth_scales``: numbers
    of the file about the depth of one grey level, by name.
    """

    rig: Rig
    sensor: str
    range_mm: tuple[float, float] | None = None
    notes: tuple[str, ...] = ()
    nominal: bool = False
    unrelated: bool = False
    depth_scales: Mapping[str, float] = field(default_factory=dict)


class RigFile(Document):
    """A small TOML file: ``name`` of the sensor, and its cameras as in a sensor TOML.

    Statements use the ``unknowns``, which a sensor file of the same rig has.
    """

    name: str = ""
    calibration: CalibrationTable | None = None
    cameras: dict[str, OpticsTable] = Field(min_length=1, max_length=2)
    unknowns: UnknownsTable = UnknownsTable()


def read_calibration(source: str | Path, size: tuple[int, int] | None = None) -> Calibrated:
    """Read the cameras of a preset by name, or of a file by its path.

    ``size`` (width, height) [px] of the images is that of an OpenCV file without one, and the size to which the cameras
    of a preset or of a DepthAI calibration are scaled. Raises InputError if there is no such file, it has none of the
    formats above, or its numbers cannot belong to its images.
    """
    read = _read(source, size)
    if read.nominal and size is not None:
        read = _at_size(read, size)
    for name, camera in read.rig.cameras.items():
        check_camera(camera, source, f"cameras.{name}")
    return read


def _read(source: str | Path, size: tuple[int, int] | None) -> Calibrated:
    path = Path(source)
    if is_euroc(path):
        asked = {"file": list(_OF_EUROC), "projector": False, "cameras": ["cam0", "cam1"]}
        table, notes = with_calibration(path / "mav0", {"calibration": asked}, size)
        rig = {name: optics.camera() for name, optics in validate(path, table, RigFile).cameras.items()}
        return Calibrated(Rig(rig), "", notes=tuple(notes))
    if path.suffix.lower() == ".toml" or str(source) in presets():
        return _of_toml(path, size)
    if path.suffix.lower() in SUFFIXES and path.suffix.lower() != ".json":
        return _of_opencv(path, size)
    if path.suffix.lower() != ".json":
        formats = f".toml, {', '.join(SUFFIXES)}, or a preset: {', '.join(presets())}"
        raise InputError(path, "", f"the ending {path.suffix!r}", formats)
    table = parsed_json(read_bounded(path, "a calibration"), path, "a calibration in JSON")
    if is_depthai_calibration(table):
        read = read_depthai_calibration(path)
        return Calibrated(read.rig(*size) if size else read.rig(), read.name)
    if isinstance(table, dict) and isinstance(table.get("Calibration"), dict) and "cameras" not in table["Calibration"]:
        tree = NxLibTree(read_bounded(path, "a calibration"), str(path))
        return Calibrated(nxlib_rig(tree, None if tree.has("Sensor/Size") else size), str(tree.get("ModelName", "")))
    if isinstance(table, dict) and _is_of_capture(table.get("cameras")):
        return Calibrated(rig_of(validate(path, table, CalibrationDocument)), "")
    return _of_opencv(path, size)


def is_euroc(path: Path) -> bool:
    """Return whether a path is a folder as of EuRoC, of two cameras with a calibration each."""
    return all((path / name).is_file() for name in _OF_EUROC)


def _is_of_capture(cameras: Any) -> bool:
    """Return whether a value is the list of cameras of a capture folder, which another program may have, too."""
    return isinstance(cameras, list) and all(
        isinstance(camera, dict) and "sensor_from_camera" in camera for camera in cameras
    )


def calibrated_by(tables: dict[str, dict[str, Any]], where: Path, size: tuple[int, int] | None) -> Calibrated:
    """Return the cameras of ROS's ``camera_info`` messages, by topic: one camera, or the left and the right of a pair.

    ``tables`` are the fields of each message by name, in the order of the cameras; messages name the recording
    ``where``; ``size`` (width, height) [px] of the images. Raises InputError if values are missing, or cannot belong to
    the images.
    """
    cameras = ["camera"] if len(tables) == 1 else ["left", "right"]
    asked = {"file": list(tables), "projector": False, "cameras": cameras}
    table, notes = with_calibration(where, {"calibration": asked}, size, tree_of(tables))
    rig = Rig({name: optics.camera() for name, optics in validate(where, table, RigFile).cameras.items()})
    for name, camera in rig.cameras.items():
        check_camera(camera, where, f"cameras.{name}")
    return Calibrated(rig, "", notes=tuple(notes))


def camera_of(calibrated: Calibrated, name: str | None, size: tuple[int, int], where: str | Path) -> tuple[str, Camera]:
    """Return the camera of a name, or the first; of unrelated ones, the only one of the size. With its name.

    Raises InputError if no camera has that name, or its size differs.

    Parameters
    ----------
    calibrated, name
        Cameras of a calibration, and the name of one of them, None for no choice.
    size, where
        (width, height) [px] of the images, which must be that of the camera; their file, for messages.
    """
    cameras = calibrated.rig.cameras
    if name is not None and name not in cameras:
        raise InputError("--camera", "", repr(name), ", ".join(cameras))
    fitting = [label for label, camera in cameras.items() if (camera.width, camera.height) == size]
    if name is None and calibrated.unrelated and len(fitting) != 1:
        found = ", ".join(f"{label} {camera.width} x {camera.height} px" for label, camera in cameras.items())
        raise InputError(where, "--camera", f"{len(cameras)} cameras: {found}", "the one of these images", "name it")
    if name is None:
        name = fitting[0] if calibrated.unrelated else next(iter(cameras))
    camera = cameras[name]
    if (camera.width, camera.height) != size:
        allowed = f"{camera.width} x {camera.height} px, as the calibration says"
        raise InputError(where, "size", f"{size[0]} x {size[1]} px", allowed, _scaled_hint(camera, size))
    return name, camera


def _scaled_hint(camera: Camera, size: tuple[int, int]) -> str:
    """Return the optics of images scaled from the calibrated size, as a hint; empty if the sides differ in scale.

    Pixel centres lie at integers.
    """
    scale = size[0] / camera.width
    if abs(scale * camera.height - size[1]) > 1:
        return ""
    (fx, _, cx), (_, fy, cy), _ = camera.matrix.tolist()
    centre = [round((coordinate + 0.5) * scale - 0.5, 3) for coordinate in (cx, cy)]
    focal = [round(length * scale, 3) for length in (fx, fy)]
    return (
        f"if the images are scaled by {scale:g}, give a TOML with [cameras.NAME]: width = {size[0]}, "
        f"height = {size[1]}, focal_px = {focal}, principal_px = {centre}, and the same distortion"
    )


def _at_size(read: Calibrated, size: tuple[int, int]) -> Calibrated:
    """Return nominal cameras of images of another size: scaled by the longer share of the sides, and cut at the middle.

    A device that shows fewer pixels in another shape cuts its images so (RealSense: 640 x 480 of 1280 x 720).
    """
    full = {(camera.width, camera.height) for camera in read.rig.cameras.values()}
    if len(full) != 1 or full == {size} or read.rig.rectification is not None:
        return read
    (width, height), cameras = full.pop(), {}
    scale = max(size[0] / width, size[1] / height)
    for name, camera in read.rig.cameras.items():
        matrix = np.diag([scale, scale, 1.0]) @ camera.matrix
        matrix[:2, 2] += scale / 2 - 0.5 - (scale * np.array([width, height]) - size) / 2
        cameras[name] = replace(camera, matrix=matrix, width=size[0], height=size[1])
    note = (
        f"{read.sensor}: its cameras of {width} x {height} px are scaled by {scale:.4g} to images of {size[0]} x "
        f"{size[1]} px, which is wrong for depths that the device has aligned to another camera: give --calibration"
    )
    return replace(read, rig=replace(read.rig, cameras=cameras), notes=(*read.notes, note))


def _of_toml(path: Path, size: tuple[int, int] | None) -> Calibrated:
    if path.suffix.lower() == ".toml":
        written = read_toml_table(path)
        if "technology" not in written:
            content, notes = with_calibration(path, written, size)
            table = validate(path, content, RigFile)
            rig = Rig({name: optics.camera() for name, optics in table.cameras.items()})
            return Calibrated(rig, table.name, notes=tuple(notes))
    sensor = load_sensor(path, "decoding", size)
    return Calibrated(sensor.rig, sensor.name, sensor.range_mm, sensor.notes, nominal=str(path) in presets())


def _of_opencv(path: Path, size: tuple[int, int] | None) -> Calibrated:
    """Read a pair if the file has the second camera; all cameras of its maps if they belong to no pair; else one."""
    tree = read_tree([path], size)
    stated = tree.values[0].get("name")
    sensor = stated if isinstance(stated, str) else ""
    scales = dict(scale for values in tree.values for scale in stated_scales(values))
    eyes, _ = cameras_of(tree.eyes())
    if has_pair(tree) or len(eyes) < 2:
        names = ["left", "right"] if has_pair(tree) else ["camera"]
        rig, notes = _rig_of(path, tree, size, names, {})
        return Calibrated(rig, sensor, notes=tuple(notes), depth_scales=scales)
    cameras: dict[str, Camera] = {}
    told: list[str] = []
    for eye in [*eyes, *eyes]:  # only at the second time the tree knows that the others are read
        name = plain_name(eye.name.rpartition(".")[2])
        rig, notes = _rig_of(path, tree, size, [name], {name: {"matrix": eye.matrix_map}})
        if "rotation" in eye.values or not any(_sees_alike(rig.reference, other) for other in cameras.values()):
            cameras[name if name not in cameras else plain_name(eye.name)] = rig.reference
        told = notes if eye is eyes[0] else [*told, *(note for note in notes if note not in told)]
    return Calibrated(Rig(cameras), sensor, notes=tuple(told), unrelated=len(cameras) > 1, depth_scales=scales)


def _sees_alike(camera: Camera, other: Camera) -> bool:
    """Return whether two cameras have the same optics."""
    return (camera.width, camera.height, camera.model) == (other.width, other.height, other.model) and all(
        np.array_equal(a, b) for a, b in ((camera.matrix, other.matrix), (camera.distortion, other.distortion))
    )


def _rig_of(
    path: Path, tree: CalibrationTree, size: tuple[int, int] | None, cameras: list[str], keys: dict[str, dict[str, str]]
) -> tuple[Rig, list[str]]:
    asked = {"file": path.name, "projector": False, "cameras": cameras, "keys": keys}
    table, notes = with_calibration(path, {"calibration": asked}, size, tree)
    read = validate(path, table, RigFile)
    return Rig({name: optics.camera() for name, optics in read.cameras.items()}), notes
