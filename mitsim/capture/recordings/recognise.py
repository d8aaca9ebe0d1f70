"""Recognise the kind of a recording by the first bytes of its file, or by the names of the files in its folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from characterisation.files.errors import InputError
from characterisation.files.toml_tables import read_toml_table
from mitsim.capture.npy import NPY_MAGIC
from mitsim.capture.recordings.calibration_file import is_euroc
from mitsim.capture.recordings.recording_files import BAG_MAGIC, EXR_MAGIC, MCAP_MAGIC, SQLITE_MAGIC
from mitsim.capture.recordings.robi import is_robi
from mitsim.capture.recordings.zdf import HDF5_MAGIC
from mitsim.sensor.preset import named_sensor

#: kinds of recordings in words, by the names that ``mitsim import --as`` takes
NAMES = {
    "ensenso": "an Ensenso recording",
    "depthai": "a DepthAI recording",
    "ros": "a bag of ROS",
    "stereo-pair": "a stereo pair",
    "robi": "a view of the ROBI data set",
    "images": "images of a structured-light rig",
    "depth": "a depth image",
    "ply": "a PLY cloud",
    "pcd": "a PCD cloud",
    "zdf": "a cloud of Zivid",
    "npy": "a NumPy array",
}

#: suffixes of files that describe cameras, a sensor or a study, and are no recordings
_DESCRIPTIONS = frozenset({".toml", ".yml", ".yaml", ".xml", ".json", ".mat", ".conf", ".cameramodel"})

#: first bytes of the files of a kind
_MARKS = {
    "ensenso": (b"PK\x03\x04", b"PK\x05\x06"),
    "zdf": (HDF5_MAGIC,),
    "npy": (NPY_MAGIC,),
    "ply": (b"ply\n", b"ply\r\n"),
    "ros": (BAG_MAGIC, SQLITE_MAGIC),
    "depth": (b"\x89PNG", b"II*\x00", b"MM\x00*", b"II+\x00", b"MM\x00+", b"P5", EXR_MAGIC, b"Pf\n"),
}

#: suffixes of the files of a kind whose first bytes are unknown
_SUFFIXES = {
    "ensenso": (".zip", ".enscam"),
    "ply": (".ply",),
    "pcd": (".pcd",),
    "depthai": (".mcap",),
    "depth": (".png", ".pgm", ".pfm", ".exr", ".bmp", ".jpg", ".jpeg"),
    "ros": (".bag", ".db3"),
    "zdf": (".zdf",),
    "npy": (".npy",),
}

#: suffixes of recordings that are one file
_RECORDED_ALONE = frozenset({".zip", ".enscam", ".ply", ".pcd", ".mcap", ".bag", ".db3", ".zdf"})

#: files that are not read: what they are, what is read instead, and how to make it
_NOT_READ = {
    **dict.fromkeys(
        (".raw", ".bin"),
        ("bytes without their size", "a 16-bit PNG, or an .npy: np.fromfile(...).reshape(rows, columns)", ""),
    ),
    ".praw": (
        "a .praw of PhoXi Control, whose format Photoneo has not published",
        "a cloud that PhoXi Control saves as organised PLY",
        "open it in PhoXi Control and save it as PLY, in camera space, not unorganised",
    ),
    **dict.fromkeys(
        (".e57", ".las", ".laz", ".ptx", ".vtk", ".vtp", ".dae"),
        ("a cloud in a format that is not read", "PLY, PCD or text", "convert it, as with CloudCompare"),
    ),
    **dict.fromkeys(
        (".stl", ".obj", ".off", ".3mf", ".glb", ".step", ".stp"),
        ("the file of a part or a mesh", "a cloud: PLY, PCD or text", "mitsim part makes a scene of a part"),
    ),
    ".mkv": (
        "a video; of Azure Kinect's recordings the depth is not read",
        "its depth images, 16-bit PNG",
        "extract them and import one with --calibration or --sensor: ffmpeg -i FILE -map 0:1 depth_%04d.png",
    ),
}


def kind_of(path: str | Path, *, sensor: str | None = None, calibration: str | None = None) -> str:
    """Return the kind of a recording: by its first bytes, or for a folder by the names in it.

    ``sensor`` and ``calibration`` are those that the user gives; a folder of images needs one of them. Raises
    InputError if the path does not exist, or its kind is unknown.
    """
    path = Path(path)
    if path.is_dir():
        return _kind_of_folder(path, sensor, calibration)
    if not path.is_file():
        raise InputError(path, "", "no such file or folder", "a recording")
    with path.open("rb") as stream:
        begin = stream.read(64)
    suffix = path.suffix.lower()
    if suffix == ".npz":
        return "npy"
    if suffix == ".3mf":  # a zip
        raise InputError(path, "", *_NOT_READ[suffix])
    if begin.startswith(MCAP_MAGIC):
        return _kind_of_mcap(path)
    for kind, marks in _MARKS.items():
        if begin.startswith(marks):
            return kind
    if b".PCD" in begin or begin.startswith(b"VERSION"):
        return "pcd"
    for kind, suffixes in _SUFFIXES.items():
        if suffix in suffixes:
            return kind  # damaged; its reader reports the error
    if suffix in _NOT_READ:
        raise InputError(path, "", *_NOT_READ[suffix])
    if suffix in _DESCRIPTIONS:
        raise _no_recording(path, path)
    raise InputError(path, "", "a file of an unknown kind", "; ".join(NAMES.values()), "say which with --as")


def _no_recording(where: Path, file: Path) -> InputError:
    """Return the error of a path without images, and how to import images with what the file describes."""
    keys = read_toml_table(file) if file.suffix.lower() == ".toml" else {"calibration": ()}
    found, hint = f"a TOML file with {', '.join(list(keys)[:4])}", ""
    if "technology" in keys:
        found, hint = "a sensor file, in mitsim's own form", f"mitsim import FOLDER_OF_IMAGES --sensor {file}"
        named = _own_files(keys)
        hint += f", with {named} of your rig beside it" if named else ""
    elif {"calibration", "cameras"} & set(keys):
        found = "a calibration, or another description"
        hint = f"if it is that of a camera or rig: mitsim import FOLDER_OF_IMAGES --calibration {file}"
    found = found if where == file else f"a folder with {file.name}, {found}"
    return InputError(where, "", found, "a recording, or a folder of images", hint)


def _own_files(keys: dict[str, Any]) -> str:
    """Return the calibration files that a sensor file names."""
    calibration = keys.get("calibration")
    named = calibration.get("file") if isinstance(calibration, dict) else None
    return named if isinstance(named, str) else " and ".join(map(str, named)) if isinstance(named, list) else ""


def _kind_of_folder(path: Path, sensor: str | None, calibration: str | None) -> str:
    if is_robi(path):
        return "robi"
    levels = [sorted(path.glob(pattern)) for pattern in ("*", "*/*", "*/*/*")]
    names = [file.name.lower() for entries in levels for file in entries if file.is_file()]
    if any(name.endswith("_calib.json") for name in names) and any(
        name.endswith(("_left.png", "_left.tif", "_left.tiff")) for name in names
    ):
        return "ensenso"
    files = [file for file in levels[0] if file.is_file()]
    top = [file.name.lower() for file in files]
    packed = (".mcap", ".db3", ".db3.zstd", ".mcap.zstd")
    recorded = [file for file in files if file.name.lower().endswith(packed)]
    if "metadata.yaml" in top or any(file.suffix.lower() == ".db3" for file in recorded):
        return "ros"
    if recorded and recorded[0].suffix.lower() == ".mcap" and _kind_of_mcap(recorded[0]) == "ros":
        return "ros"
    if recorded or any(name.endswith((".mp4", ".h264", ".h265")) for name in top):
        return "depthai"
    if calibration is not None or is_euroc(path):
        return "stereo-pair"
    if sensor is not None:
        return "images" if named_sensor(sensor)[1] == "structured_light" else "stereo-pair"
    if "capture.json" in top:
        raise InputError(path, "", "a capture folder", "a recording of another program", "it needs no import")
    if files and all(file.suffix.lower() in _DESCRIPTIONS for file in files):
        raise _no_recording(path, files[0])
    entries = ", ".join(entry.name + "/" * entry.is_dir() for entry in levels[0][:4])
    alone = next((entry for entry in levels[0] if entry.suffix.lower() in _RECORDED_ALONE), None)
    allowed = "a recording of an Ensenso, of DepthAI or ROS; or images, with --sensor or --calibration"
    hint = "" if alone is None else f"name the recording in it: {alone}"
    raise InputError(path, "", f"a folder with {entries or 'nothing in it'}", allowed, hint)


def _kind_of_mcap(path: Path) -> str:
    """Return ``ros`` for an MCAP file of ROS, else ``depthai``."""
    try:
        from mitsim.capture.recordings.ros_bag import is_ros_mcap
    except ModuleNotFoundError:
        with path.open("rb") as stream:
            return "ros" if b"ros" in stream.read(64)[21:24] else "depthai"
    return "ros" if is_ros_mcap(path) else "depthai"
