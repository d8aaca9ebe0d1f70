"""Read any supported recording as a capture; its kind is recognised by the first bytes and names of its files.

Signal chain: path -> kind -> the kind's reader -> capture, and the original files unchanged.

A kind is one entry of :data:`KINDS`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from characterisation.files.checked_files import read_bounded
from characterisation.files.errors import InputError, MissingEnvironmentError, nearest
from mitsim.capture.capture import Capture
from mitsim.capture.grey_image import channel_of
from mitsim.capture.npy import NPY_MAGIC, numbers_of_npy
from mitsim.capture.recordings.depth_image import read_depth_image
from mitsim.capture.recordings.depthai_recording import calibration_beside, read_depthai_recording, recorded_streams
from mitsim.capture.recordings.ensenso import ensenso_originals, image_sets, read_ensenso
from mitsim.capture.recordings.image_folder import read_image_folder, size_of_images
from mitsim.capture.recordings.organised_cloud import CLOUD_UNITS_MM, Axes, StoredCloud, read_organised_cloud
from mitsim.capture.recordings.pose_file import read_pose
from mitsim.capture.recordings.recording_files import BAG_MAGIC, MCAP_MAGIC, SQLITE_MAGIC, frame_of, plain_name
from mitsim.capture.recordings.robi import is_robi, read_robi
from mitsim.capture.recordings.stereo_pair import read_stereo_pair
from mitsim.capture.recordings.zdf import HDF5_MAGIC
from mitsim.sensor.preset import load_sensor, named_sensor

AXES: tuple[Axes, ...] = ("opencv", "opengl")

#: suffixes of recordings that are one file
_RECORDED_ALONE = frozenset({".zip", ".enscam", ".ply", ".pcd", ".mcap", ".bag", ".db3", ".zdf"})

#: formats that their makers have not published: what they are, what is read instead, and how to save it
_UNPUBLISHED = {
    ".praw": (
        "a .praw of PhoXi Control, whose format Photoneo has not published",
        "a cloud that PhoXi Control saves as organised PLY",
        "open it in PhoXi Control and save it as PLY, in camera space, not unorganised",
    ),
    ".mkv": (
        "a video; of Azure Kinect's recordings the depth is not read",
        "its depth images, 16-bit PNG",
        "extract them and import one with --calibration or --sensor: ffmpeg -i FILE -map 0:1 depth_%04d.png",
    ),
}

#: options for recordings of every kind
FOR_ALL = ("range_mm", "exposure_s", "pose", "sample", "projector")


@dataclass(frozen=True)
class ReadOptions:
    """Options for reading a recording; None if not given.

    - ``sensor``: a preset or sensor file.
    - ``calibration``: see :mod:`mitsim.capture.recordings.calibration_file`; ``camera`` of it.
    - ``frame``: which of several.
    - ``range_mm``: depths to decode.
    - ``scale_mm`` of a depth image's grey level, and its ``invalid`` level.
    - ``unit`` and ``axes`` of a cloud; ``link``: an Ensenso's node that transformed it.
    - ``subpixel_bits`` of disparities.
    - ``topic`` of a bag of ROS: one, or those of a left and a right camera.
    - ``images``: a pattern of file names for each camera; ``channel`` of colour images.

    All kinds use ``exposure_s``; ``pose``, a file with ``world_from_sensor``; ``sample`` of a coupon; ``projector``,
    ``on`` or ``off``.
    """

    sensor: str | None = None
    calibration: str | None = None
    camera: str | None = None
    frame: int | str | None = None
    range_mm: tuple[float, float] | None = None
    scale_mm: float | None = None
    invalid: int | None = None
    unit: str | None = None
    axes: str | None = None
    link: str | None = None
    subpixel_bits: int | None = None
    topic: tuple[str, ...] | None = None
    images: dict[str, str] | None = None
    channel: str | None = None
    exposure_s: float | None = None
    pose: str | None = None
    sample: str | None = None
    projector: str | None = None

    @property
    def named(self) -> str | None:
        """Return the name of the sensor, if one is given."""
        return None if self.sensor is None else named_sensor(self.sensor)[0]

    @property
    def cameras(self) -> str | None:
        """Return the source of the cameras: the calibration, else the sensor."""
        return self.calibration or self.sensor


@dataclass(frozen=True)
class Imported:
    """A ``capture``, its ``kind``, and the ``originals`` by name."""

    capture: Capture
    kind: str
    originals: dict[str, bytes] = field(repr=False)


@dataclass(frozen=True)
class Kind:
    """One kind of recording: its ``name`` in words, its function ``read``, and the ``options`` that it uses."""

    name: str
    read: Callable[[Path, ReadOptions], tuple[Capture, dict[str, bytes]]]
    options: frozenset[str]


def _read_ensenso(path: Path, options: ReadOptions) -> tuple[Capture, dict[str, bytes]]:
    frame = frame_of(options.frame, path, image_sets(path))
    return read_ensenso(path, frame=frame), ensenso_originals(path, frame)


def _read_images(path: Path, options: ReadOptions) -> tuple[Capture, dict[str, bytes]]:
    if options.sensor is None:
        raise InputError(
            path,
            "",
            "a folder of images",
            "the rig that took them: --sensor my.toml",
            "for a plain stereo pair --calibration suffices",
        )
    rig = load_sensor(options.sensor, "decoding", size_of_images(path))
    if options.images:
        rig = replace(rig, images={**(rig.images or {}), **options.images})
    capture = read_image_folder(path, rig, channel_of(options.channel))
    return replace(capture, settings=capture.settings | ({"warnings": list(rig.notes)} if rig.notes else {})), {}


def _read_pair(path: Path, options: ReadOptions) -> tuple[Capture, dict[str, bytes]]:
    source = _cameras(path, options, "a stereo pair")
    capture = read_stereo_pair(
        path,
        source,
        frame=options.frame,
        sensor=options.named,
        images=options.images,
        channel=channel_of(options.channel),
    )
    kept = [path / name for name in capture.settings["files"].values()]
    return capture, _originals([*kept, *_file_of(source)])


def _read_depth(path: Path, options: ReadOptions) -> tuple[Capture, dict[str, bytes]]:
    source = _cameras(path, options, "a depth image")
    capture = read_depth_image(
        path,
        source,
        scale_mm=options.scale_mm,
        invalid=options.invalid,
        camera=options.camera,
        sensor=options.named,
    )
    return capture, _originals([path, *_file_of(source)])


def _read_cloud(path: Path, options: ReadOptions) -> tuple[Capture, dict[str, bytes]]:
    capture = _organised(path, options)
    beside = [*_file_of(options.cameras), *([] if options.link is None else [Path(options.link)])]
    return capture, _originals([path, *beside])


def _read_array(path: Path, options: ReadOptions) -> tuple[Capture, dict[str, bytes]]:
    """Read an array of rows x columns as depths, and one of rows x columns x 3 as points."""
    shape = numbers_of_npy(read_bounded(path), path).shape
    if len(shape) == 2 or (len(shape) == 3 and shape[2] == 1):
        return _read_depth(path, options)
    return _read_cloud(path, options)


def _organised(cloud: Path | StoredCloud, options: ReadOptions) -> Capture:
    """Read an organised cloud with the options of all clouds."""
    axes = next((known for known in AXES if known == (options.axes or AXES[0])), None)
    if axes is None:
        raise InputError("--axes", "", repr(options.axes), " | ".join(AXES))
    if options.unit is not None and options.unit not in CLOUD_UNITS_MM:
        raise InputError("--unit", "", repr(options.unit), " | ".join(CLOUD_UNITS_MM))
    return read_organised_cloud(
        cloud,
        calibration=options.cameras,
        unit=options.unit,
        axes=axes,
        link=options.link,
        camera=options.camera,
        sensor=options.named,
    )


def _read_depthai(path: Path, options: ReadOptions) -> tuple[Capture, dict[str, bytes]]:
    calibration = Path(options.calibration) if options.calibration else calibration_beside(path)
    capture = read_depthai_recording(
        path,
        calibration,
        frame=frame_of(options.frame, path),
        subpixel_bits=options.subpixel_bits,
        sensor=options.named,
    )
    return capture, _originals([*recorded_streams(path).values(), calibration])


def _read_ros(path: Path, options: ReadOptions) -> tuple[Capture, dict[str, bytes]]:
    with _needs_recordings(path, "a bag of ROS"):
        from mitsim.capture.recordings import ros_bag, ros_recording
    bag = ros_bag.open_bag(path)
    chosen = ros_recording.chosen_topics(bag, options.topic or ())
    frame = frame_of(options.frame, path)
    if chosen.what == "cloud":
        capture = _organised(ros_recording.read_ros_cloud(chosen, frame), options)
    elif chosen.what == "pair":
        capture = ros_recording.read_ros_pair(
            chosen,
            frame,
            calibration=options.cameras,
            channel=channel_of(options.channel),
            sensor=options.named,
        )
    else:
        capture = ros_recording.read_ros_depth(
            chosen,
            frame,
            calibration=options.cameras,
            scale_mm=options.scale_mm,
            invalid=options.invalid,
            camera=options.camera,
            sensor=options.named,
        )
    number = int(frame or 0)
    messages = {f"{plain_name(topic.name.strip('/').replace('/', '_'))}_{number}.msg": topic for topic in chosen.topics}
    kept = {name: bag.message(topic.name, number) for name, topic in messages.items() if number < topic.count}
    return capture, kept | _originals(_file_of(options.cameras))


def unorganised_cloud(path: Path, options: ReadOptions) -> NDArray[np.float32] | None:
    """Return the points (n, 3) of a bag of ROS whose chosen cloud has no grid; None for any other recording.

    Raises
    ------
    InputError
        If a bag cannot be read.
    """
    if (path.is_file() and not path.stat().st_size) or kind_of(path, options) != "ros":
        return None
    with _needs_recordings(path, "a bag of ROS"):
        from mitsim.capture.recordings import ros_bag, ros_recording
    bag = ros_bag.open_bag(path)
    chosen = ros_recording.chosen_topics(bag, options.topic or ())
    if chosen.what != "cloud":
        return None
    stored = ros_recording.read_ros_cloud(chosen, frame_of(options.frame, path))
    return stored.points.reshape(-1, 3) if stored.size is None else None


@contextmanager
def _needs_recordings(path: Path, what: str) -> Iterator[None]:
    """Say which packages a recording needs if they are not installed."""
    try:
        yield
    except ModuleNotFoundError as error:
        raise MissingEnvironmentError(
            f"{path}: {what} needs packages that are not installed ({error.name}): pip install 'mitsim[recordings]'"
        ) from None


def _read_robi(path: Path, options: ReadOptions) -> tuple[Capture, dict[str, bytes]]:
    capture, files = read_robi(path, options.calibration, frame=frame_of(options.frame, path), sensor=options.named)
    return capture, _originals(files)


_OF_CLOUDS = frozenset({"calibration", "sensor", "camera", "unit", "axes", "link"})

#: kinds of recordings by the names that ``mitsim import --as`` takes
KINDS: dict[str, Kind] = {
    "ensenso": Kind("an Ensenso recording", _read_ensenso, frozenset({"frame"})),
    "depthai": Kind(
        "a DepthAI recording", _read_depthai, frozenset({"calibration", "frame", "subpixel_bits", "sensor"})
    ),
    "ros": Kind(
        "a bag of ROS",
        _read_ros,
        frozenset({*_OF_CLOUDS, "topic", "frame", "scale_mm", "invalid", "channel"}),
    ),
    "stereo-pair": Kind(
        "a stereo pair", _read_pair, frozenset({"calibration", "sensor", "frame", "images", "channel"})
    ),
    "robi": Kind("a view of the ROBI data set", _read_robi, frozenset({"calibration", "frame", "sensor"})),
    "images": Kind("images of a structured-light rig", _read_images, frozenset({"sensor", "images", "channel"})),
    "depth": Kind("a depth image", _read_depth, frozenset({"calibration", "sensor", "camera", "scale_mm", "invalid"})),
    "ply": Kind("a PLY cloud", _read_cloud, _OF_CLOUDS),
    "pcd": Kind("a PCD cloud", _read_cloud, _OF_CLOUDS),
    "zdf": Kind("a cloud of Zivid", _read_cloud, _OF_CLOUDS),
    "npy": Kind("a NumPy array", _read_array, _OF_CLOUDS | {"scale_mm", "invalid"}),
}


def kind_of(path: str | Path, options: ReadOptions | None = None) -> str:
    """Return the kind of a recording: by its first bytes, or for a folder by the names in it and the options.

    Raises
    ------
    InputError
        If the path does not exist, or its kind is unknown.
    """
    path, options = Path(path), options or ReadOptions()
    if path.is_dir():
        return _kind_of_folder(path, options)
    if not path.is_file():
        raise InputError(path, "", "no such file or folder", "a recording")
    with path.open("rb") as stream:
        begin = stream.read(64)
    if begin.startswith(MCAP_MAGIC):
        return _kind_of_mcap(path)
    for mark, kind in (
        (b"PK\x03\x04", "ensenso"),
        (b"PK\x05\x06", "ensenso"),
        (HDF5_MAGIC, "zdf"),
        (NPY_MAGIC, "npy"),
        (b"ply\n", "ply"),
        (b"ply\r\n", "ply"),
        (BAG_MAGIC, "ros"),
        (SQLITE_MAGIC, "ros"),
        (b"\x89PNG", "depth"),
        (b"II*\x00", "depth"),
        (b"MM\x00*", "depth"),
    ):
        if begin.startswith(mark):
            return kind
    if b".PCD" in begin or begin.startswith(b"VERSION") or path.suffix.lower() == ".pcd":
        return "pcd"
    known = {".zip": "ensenso", ".enscam": "ensenso", ".ply": "ply", ".mcap": "depthai", ".png": "depth"}
    known |= {".bag": "ros", ".db3": "ros", ".zdf": "zdf", ".npy": "npy"}
    if path.suffix.lower() in known:
        return known[path.suffix.lower()]  # damaged; its reader reports the error
    if path.suffix.lower() in _UNPUBLISHED:
        raise InputError(path, "", *_UNPUBLISHED[path.suffix.lower()])
    raise InputError(
        path, "", "a file of an unknown kind", "; ".join(kind.name for kind in KINDS.values()), "say which with --as"
    )


def read_recording(path: str | Path, options: ReadOptions, kind: str | None = None) -> Imported:
    """Read a recording of any kind.

    Raises
    ------
    InputError
        If its kind is unknown, an option does not apply to its kind, or it cannot be read.
    """
    path = Path(path)
    if path.is_file() and not path.stat().st_size:
        raise InputError(path, "size", "0 bytes", "a recording", "copy or record it again")
    if kind is not None and kind not in KINDS:
        raise InputError("--as", "", repr(kind), ", ".join(KINDS), nearest(kind, list(KINDS)))
    kind = kind or kind_of(path, options)
    for name in ReadOptions.__dataclass_fields__:
        if getattr(options, name) is not None and name not in FOR_ALL and name not in KINDS[kind].options:
            used = ", ".join(_option(each) for each in (*sorted(KINDS[kind].options), *FOR_ALL))
            raise InputError(path, "", f"{_option(name)} for {KINDS[kind].name}", used)
    decoding, records = _options_for_all(options)
    capture, originals = KINDS[kind].read(path, options)
    for name in (options.images or {}) if kind in ("images", "stereo-pair") else ():
        if name not in capture.rig.cameras:
            raise InputError("--images", "", repr(name), ", ".join(capture.rig.cameras))
    pose, covariance = (None, None) if options.pose is None else read_pose(options.pose)
    capture = replace(
        capture,
        decoding=capture.decoding.model_copy(update=decoding),
        settings=capture.settings | records,
        world_from_sensor=pose or capture.world_from_sensor,
        pose_covariance=covariance if pose is not None else capture.pose_covariance,
    )
    return Imported(capture, kind, originals)


def _option(name: str) -> str:
    return "--" + name.removesuffix("_mm").removesuffix("_s").replace("_", "-")


def _options_for_all(options: ReadOptions) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return what the options for every kind change in :class:`Decoding`, and the records that they add."""
    decoding: dict[str, Any] = {}
    records: dict[str, Any] = {}
    if options.range_mm is not None:
        near, far = options.range_mm
        if not 0 < near < far <= 1e6:
            raise InputError("--range", "", f"{near:g} {far:g}", "near before far, over 0, in mm")
        decoding |= {"near_mm": near, "far_mm": far, "range_mm": (near, far)}
    if options.exposure_s is not None:
        if not 0 < options.exposure_s <= 1e3:
            raise InputError("--exposure", "", f"{options.exposure_s:g}", "seconds, over 0 to 1000")
        decoding["exposure_s"] = options.exposure_s
    if options.sample is not None:
        records["coupon"] = {"sample": options.sample}
    if options.projector is not None:
        if options.projector not in ("on", "off"):
            raise InputError("--projector", "", repr(options.projector), "on | off")
        records["projector_on"] = options.projector == "on"
    return decoding, records


def _kind_of_folder(path: Path, options: ReadOptions) -> str:
    if is_robi(path):
        return "robi"
    names = [file.relative_to(path).as_posix().lower() for file in _down_to(path, 3) if file.is_file()]
    if any(name.endswith("_calib.json") for name in names) and any(
        name.endswith(("_left.png", "_left.tif", "_left.tiff")) for name in names
    ):
        return "ensenso"
    top = [name for name in names if "/" not in name]
    recorded = [path / name for name in top if name.endswith((".mcap", ".db3", ".db3.zstd", ".mcap.zstd"))]
    if "metadata.yaml" in top or any(file.suffix == ".db3" for file in recorded):
        return "ros"
    if recorded and recorded[0].suffix == ".mcap" and _kind_of_mcap(recorded[0]) == "ros":
        return "ros"
    if recorded or any(name.endswith((".mp4", ".h264", ".h265")) for name in top):
        return "depthai"
    if options.calibration is not None:
        return "stereo-pair"
    if options.sensor is not None:
        return "images" if named_sensor(options.sensor)[1] == "structured_light" else "stereo-pair"
    if any(name == "capture.json" for name in top):
        raise InputError(path, "", "a capture folder", "a recording of another program", "it needs no import")
    alone = next((file.name for file in _down_to(path, 1) if file.suffix.lower() in _RECORDED_ALONE), None)
    raise InputError(
        path,
        "",
        f"a folder with {', '.join(top[:4]) or 'nothing in it'}",
        "a recording of an Ensenso, of DepthAI or ROS; or images, with --sensor or --calibration",
        "" if alone is None else f"name the recording in it: {path / alone}",
    )


def _kind_of_mcap(path: Path) -> str:
    """Return ``ros`` for an MCAP file of ROS, else ``depthai``."""
    try:
        from mitsim.capture.recordings.ros_bag import is_ros_mcap
    except ModuleNotFoundError:
        with path.open("rb") as stream:
            return "ros" if b"ros" in stream.read(64)[21:24] else "depthai"
    return "ros" if is_ros_mcap(path) else "depthai"


def _down_to(path: Path, levels: int) -> Iterable[Path]:
    for level in range(levels):
        yield from sorted(path.glob("/".join(["*"] * (level + 1))))


def _cameras(path: Path, options: ReadOptions, what: str) -> str:
    if options.cameras is None:
        raise InputError(path, "", f"{what} alone", "the camera that took it: --calibration FILE, or --sensor")
    return options.cameras


def _file_of(source: Any) -> list[Path]:
    """Return a calibration's file, if it is a file and not a preset's name."""
    return [Path(source)] if source is not None and Path(source).is_file() else []


def _originals(files: Iterable[Path]) -> dict[str, bytes]:
    """Return the bytes of files by plain names; equal names are numbered."""
    out: dict[str, bytes] = {}
    for file in files:
        name, number = plain_name(file.name), 1
        while name in out:
            number += 1
            name = plain_name(f"{number}_{file.name}")
        out[name] = read_bounded(file)
    return out
