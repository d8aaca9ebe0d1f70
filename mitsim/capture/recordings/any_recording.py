"""Read any supported recording as a capture.

Signal chain: path -> kind (:mod:`mitsim.capture.recordings.recognise`) -> its reader in :data:`KINDS` -> capture, and
the original files unchanged.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from characterisation.files.checked_files import read_bounded
from characterisation.files.errors import InputError, nearest
from mitsim.capture.capture import Capture
from mitsim.capture.grey_image import channel_of
from mitsim.capture.recordings.along_ray import depths_of_ranges, reads_as_ranges
from mitsim.capture.recordings.array_file import map_in
from mitsim.capture.recordings.depth_image import read_depth_image
from mitsim.capture.recordings.depthai_recording import calibration_beside, read_depthai_recording, recorded_streams
from mitsim.capture.recordings.ensenso import ensenso_originals, image_sets, read_ensenso
from mitsim.capture.recordings.image_folder import at_size_of_images, read_image_folder
from mitsim.capture.recordings.organised_cloud import read_organised_cloud
from mitsim.capture.recordings.pose_file import read_pose, unit_note
from mitsim.capture.recordings.read_options import ReadOptions
from mitsim.capture.recordings.recognise import NAMES, kind_of
from mitsim.capture.recordings.recording_files import frame_of, needs_recordings, plain_name
from mitsim.capture.recordings.robi import read_robi
from mitsim.capture.recordings.stereo_pair import read_stereo_pair
from mitsim.sensor.preset import load_sensor

#: what the numbers of a depth image are distances along
ALONG = ("axis", "ray")

#: options for recordings of every kind
FOR_ALL = ("range_mm", "exposure_s", "pose", "sample", "projector")


@dataclass(frozen=True)
class Imported:
    """A ``capture``, its ``kind``, and the ``originals`` by name."""

    capture: Capture
    kind: str
    originals: dict[str, bytes] = field(repr=False)


@dataclass(frozen=True)
class Kind:
    """One kind of recording: its function ``read``, and the ``options`` that it uses."""

    read: Callable[[Path, ReadOptions], tuple[Capture, dict[str, bytes]]]
    options: frozenset[str]


def _read_ensenso(path: Path, options: ReadOptions) -> tuple[Capture, dict[str, bytes]]:
    frame = frame_of(options.frame, path, image_sets(path))
    return read_ensenso(path, frame=frame), ensenso_originals(path, frame)


def _read_images(path: Path, options: ReadOptions) -> tuple[Capture, dict[str, bytes]]:
    if (source := options.sensor) is None:
        hint = "for a plain stereo pair --calibration suffices"
        raise InputError(path, "", "a folder of images", "the rig that took them: --sensor my.toml", hint)
    rig = at_size_of_images(path, lambda size: load_sensor(source, "decoding", size))
    if options.images:
        rig = replace(rig, images={**(rig.images or {}), **options.images})
    capture = read_image_folder(path, rig, channel_of(options.channel))
    return replace(capture, settings=capture.settings | ({"warnings": list(rig.notes)} if rig.notes else {})), {}


def _read_pair(path: Path, options: ReadOptions) -> tuple[Capture, dict[str, bytes]]:
    capture = read_stereo_pair(path, options)
    kept = [path / name for name in capture.settings["files"].values()]
    return capture, _originals([*kept, *_file_of(options.cameras)])


def _read_depth(path: Path, options: ReadOptions) -> tuple[Capture, dict[str, bytes]]:
    return read_depth_image(path, options), _originals([path, *_file_of(options.cameras)])


def _read_cloud(path: Path, options: ReadOptions) -> tuple[Capture, dict[str, bytes]]:
    capture = read_organised_cloud(path, options)
    beside = [*_file_of(options.cameras), *([] if options.link is None else [Path(options.link)])]
    return capture, _originals([path, *beside])


def _read_array(path: Path, options: ReadOptions) -> tuple[Capture, dict[str, bytes]]:
    """Read an array of rows x columns as depths, and one of rows x columns x 3 as points."""
    is_depth = map_in(read_bounded(path), path, frame_of(options.frame, path)).ndim == 2
    for name in ("unit", "axes", "link") if is_depth else ("scale_mm", "invalid", "along", "frame"):
        if getattr(options, name) is not None:
            found = f"{_option(name)} for an array of {'depths' if is_depth else 'points'}"
            allowed = "--scale, --invalid, --along and --frame of depths; --unit, --axes and --link of points"
            raise InputError(path, "", found, allowed)
    return _read_depth(path, options) if is_depth else _read_cloud(path, options)


def _read_depthai(path: Path, options: ReadOptions) -> tuple[Capture, dict[str, bytes]]:
    capture = read_depthai_recording(path, options)
    calibration = Path(options.calibration or calibration_beside(path))
    return capture, _originals([*recorded_streams(path).values(), calibration])


def _read_ros(path: Path, options: ReadOptions) -> tuple[Capture, dict[str, bytes]]:
    with needs_recordings(path, "a bag of ROS"):
        from mitsim.capture.recordings import ros_bag, ros_recording
    bag = ros_bag.open_bag(path)
    chosen = ros_recording.chosen_topics(bag, options.topic or ())
    frame = frame_of(options.frame, path)
    numbers: tuple[int, ...] = (frame or 0,)
    if chosen.content == "cloud":
        capture = read_organised_cloud(ros_recording.read_ros_cloud(chosen, frame), options)
    elif chosen.content == "pair":
        capture, numbers = ros_recording.read_ros_pair(chosen, frame, options)
    else:
        capture = ros_recording.read_ros_depth(chosen, frame, options)
    kept = {
        f"{plain_name(topic.name.strip('/').replace('/', '_'))}_{number}.msg": bag.message(topic.name, number)
        for topic, number in zip(chosen.topics, numbers, strict=True)
    }
    return capture, kept | _originals(_file_of(options.cameras))


def _read_robi(path: Path, options: ReadOptions) -> tuple[Capture, dict[str, bytes]]:
    capture, files = read_robi(path, options)
    return capture, _originals(files)


_OF_CLOUDS = frozenset({"calibration", "sensor", "camera", "unit", "axes", "link"})

#: readers by the names that ``mitsim import --as`` takes
KINDS: dict[str, Kind] = {
    "ensenso": Kind(_read_ensenso, frozenset({"frame"})),
    "depthai": Kind(_read_depthai, frozenset({"calibration", "frame", "subpixel_bits", "sensor"})),
    "ros": Kind(_read_ros, frozenset({*_OF_CLOUDS, "topic", "frame", "scale_mm", "invalid", "along", "channel"})),
    "stereo-pair": Kind(_read_pair, frozenset({"calibration", "sensor", "frame", "images", "channel"})),
    "robi": Kind(_read_robi, frozenset({"calibration", "frame", "sensor"})),
    "images": Kind(_read_images, frozenset({"sensor", "images", "channel"})),
    "depth": Kind(_read_depth, frozenset({"calibration", "sensor", "camera", "scale_mm", "invalid", "along"})),
    "ply": Kind(_read_cloud, _OF_CLOUDS),
    "pcd": Kind(_read_cloud, _OF_CLOUDS),
    "zdf": Kind(_read_cloud, _OF_CLOUDS),
    "npy": Kind(_read_array, _OF_CLOUDS | {"scale_mm", "invalid", "along", "frame"}),
}


def read_recording(path: str | Path, options: ReadOptions, kind: str | None = None) -> Imported:
    """Read a recording of any kind.

    Raises InputError if its kind is unknown, an option does not apply to its kind, or it cannot be read.
    """
    path = Path(path)
    if path.is_file() and not path.stat().st_size:
        raise InputError(path, "size", "0 bytes", "a recording", "copy or record it again")
    if kind is not None and kind not in KINDS:
        raise InputError("--as", "", repr(kind), ", ".join(KINDS), nearest(kind, list(KINDS)))
    kind = kind or kind_of(path, sensor=options.sensor, calibration=options.calibration)
    for name in ReadOptions.__dataclass_fields__:
        if getattr(options, name) is not None and name not in FOR_ALL and name not in KINDS[kind].options:
            used = ", ".join(_option(option) for option in (*sorted(KINDS[kind].options), *FOR_ALL))
            raise InputError(path, "", f"{_option(name)} for {NAMES[kind]}", used)
    decoding, records = _options_for_all(options)
    if options.along not in (None, *ALONG):
        raise InputError("--along", "", repr(options.along), " | ".join(ALONG))
    capture, originals = KINDS[kind].read(path, options)
    if "along" in KINDS[kind].options:
        capture = _along_axis(capture, path, options.along)
    for name in (options.images or {}) if kind in ("images", "stereo-pair") else ():
        if name not in capture.rig.cameras:
            raise InputError("--images", "", repr(name), ", ".join(capture.rig.cameras))
    pose = None if options.pose is None else read_pose(options.pose)
    if pose is not None and (note := unit_note(pose, str(options.pose))):
        records["warnings"] = [*capture.settings.get("warnings", []), note]
    capture = replace(
        capture,
        decoding=capture.decoding.model_copy(update=decoding),
        settings=capture.settings | records,
        world_from_sensor=pose or capture.world_from_sensor,
    )
    return Imported(capture, kind, originals)


def _along_axis(capture: Capture, path: Path, along: str | None) -> Capture:
    """Return a capture with depths along the axis of its camera, and a warning if planes show that it had none."""
    depth = capture.derived.get("depth")
    if depth is None:
        if along is not None:
            raise InputError(path, "", f"--along of a recording as {capture.technology}", "--along of depths alone")
        return capture
    camera = next(iter(capture.rig.cameras.values()))
    if along == "ray":
        derived = capture.derived | {"depth": depths_of_ranges(depth, camera)}
        return replace(capture, derived=derived, settings=capture.settings | {"along": along})
    if along is None and reads_as_ranges(depth, camera):
        note = "planes are flat only if the numbers are distances along the rays: say --along ray, or axis"
        warnings = [*capture.settings.get("warnings", []), note]
        return replace(capture, settings=capture.settings | {"warnings": warnings})
    return capture


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
