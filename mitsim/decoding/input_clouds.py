"""Read the clouds to measure, from cloud files, capture folders and recordings.

Signal chain: path -> cloud file of ``mitsim decode``; or capture folder, decoded; or recording that ``mitsim import``
reads without options, decoded; or points without a camera (:mod:`mitsim.decoding.plain_clouds`) -> cloud, and its
capture if there is one.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from characterisation import cloud_files
from characterisation.files.errors import InputError
from characterisation.files.value_digest import value_digest
from characterisation.point_cloud import PointCloud
from characterisation.words.progress import say
from mitsim.capture.capture import Capture
from mitsim.capture.folder import read_capture
from mitsim.capture.recordings.any_recording import KINDS, read_recording
from mitsim.capture.recordings.organised_cloud import NoGridError, read_organised_cloud, read_stored_cloud
from mitsim.capture.recordings.read_options import ReadOptions
from mitsim.capture.recordings.recognise import kind_of
from mitsim.decoding.cloud import Settings, decoder_settings
from mitsim.decoding.coded_images import decoded_once
from mitsim.decoding.kept_clouds import kept_cloud
from mitsim.decoding.plain_clouds import is_array_or_text, is_map_of_depths, plain_cloud, read_plain_cloud
from mitsim.sensor.matcher import MatcherSettings

#: suffixes of cloud files that are found in a folder
_SUFFIXES = (".ply", ".pcd", ".zdf")

#: options of reading that every command with clouds has
_OPTIONS = {"--sensor", "--topic", "--frame", "--unit"}

#: text that identifies a cloud file of ``mitsim decode``
_MARK = b"\ncomment mitsim "

#: number of bytes at the start of a file in which this text is searched; chosen
_HEAD = 1 << 20


@dataclass(frozen=True)
class InputCloud:
    """A cloud to measure."""

    path: Path  # of its file or capture folder
    cloud: PointCloud  # in the sensor frame [mm]
    capture: Capture | None  # that it was decoded from, None for a cloud file of ``mitsim decode``
    margin_px: int = 0  # pixels beside an edge whose points may mix both sides (:func:`margin_of`)


def cloud_paths(paths: Iterable[Path]) -> list[Path]:
    """Return paths of clouds; a folder is replaced by the clouds and captures in it, sorted by name.

    Arrays and texts count where a folder has nothing else: beside clouds they may be notes and are left out, which is
    said. A folder that contains none is kept.
    """
    out: list[Path] = []
    for path in paths:
        if not path.is_dir() or (path / "capture.json").exists():
            out.append(path)
            continue
        entries = [entry for entry in sorted(path.iterdir()) if not entry.name.startswith(".")]
        plain = [entry for entry in entries if is_array_or_text(entry)]
        contained = [
            entry
            for entry in entries
            if (entry / "capture.json").exists() or (entry.is_file() and entry.suffix.lower() in _SUFFIXES)
        ]
        if contained and plain:
            left_out = ", ".join(entry.name for entry in plain[:3]) + ", ..." * (len(plain) > 3)
            say(f"warning: {path}: left out {left_out}, beside clouds of other formats: name them to measure them")
        # a folder without them may be a recording as its device saved it
        out += contained or (plain if plain == entries else []) or [path]
    return out


def read_cloud(
    path: Path,
    sensor: str | None = None,
    reference: bool = False,
    *,
    topic: tuple[str, ...] | None = None,
    frame: str | None = None,
    unit: str | None = None,
) -> InputCloud:
    """Read a cloud file, or decode a capture folder or recording.

    Parameters
    ----------
    path
        Cloud file, capture folder or recording.
    sensor
        Preset or sensor file whose settings decode it; by default, those of the capture. It also supplies the camera of
        a recording that has none.
    reference
        Whether its points may lie anywhere; those of another cloud with a grid lie on the view rays of its camera.
    topic, frame
        Message of a recording, as of ``mitsim import``.
    unit
        Unit of length of a cloud of another program; by default the one that its file states, else that of its median
        distance.

    Raises
    ------
    InputError
        If the path does not exist, or its content cannot be read or decoded.

    See Also
    --------
    cloud_paths : the files that a user names
    """
    if path.is_file() and _is_mitsim_ply(path):
        return InputCloud(path, cloud_files.read_cloud(path), None)
    if is_array_or_text(path) and not is_map_of_depths(path):
        return _plain(path, *read_plain_cloud(path, unit))
    if (path / "capture.json").exists():
        capture = read_capture(path)
    elif path.is_file() and path.suffix.lower() in _SUFFIXES:
        stored = read_stored_cloud(path)
        if stored.size is None:
            return _plain(path, *plain_cloud(stored.points, path, unit, stored.unit))
        try:
            capture = read_organised_cloud(stored, ReadOptions(unit=unit))
        except InputError as error:
            if not reference:
                raise _of_import(error) from None
            return _plain(path, *plain_cloud(stored.points, path, unit, stored.unit))
    elif path.exists():
        kind = kind_of(path, sensor=sensor)
        used = sensor if "sensor" in KINDS[kind].options else None
        try:
            options = ReadOptions(topic=topic, frame=frame, sensor=used, unit=unit)
            capture = read_recording(path, options, kind).capture
        except NoGridError as error:
            return _plain(path, *plain_cloud(error.stored.points, path, unit, error.stored.unit))
        except InputError as error:
            raise _of_import(error) from None
    else:
        raise InputError(
            path,
            "",
            "no such file or folder",
            "a cloud (.ply, .pcd, .npy, .npz, .mat, .xyz), a capture folder, or folders of these",
        )
    if not (path / "capture.json").exists():
        for warning in capture.settings.get("warnings", []):
            say(f"warning: {warning}")
    settings, imager = decoder_settings(capture, sensor)
    cloud = kept_cloud((capture, settings, imager), lambda: decoded_once(capture, settings, imager)[0])
    return InputCloud(path, cloud, capture, margin_of(settings))


def tell_of_copies(found: dict[str, Path], input_cloud: InputCloud) -> None:
    """Add the digest of a cloud's points to those ``found``, and say if they are those of another cloud.

    Copies have no scatter, so they make the standard deviation over clouds too small.
    """
    cloud = input_cloud.cloud
    first = found.setdefault(value_digest(cloud.points[cloud.valid]), input_cloud.path)
    if first is not input_cloud.path and cloud.valid.any():
        say(f"warning: {input_cloud.path} has the points of {first}: the same noise twice is not a repeat")


def _plain(path: Path, cloud: PointCloud, about: str) -> InputCloud:
    say(about)
    return InputCloud(path, cloud, None)


def _of_import(error: InputError) -> InputError:
    """Return an error that names where options are that reading has and its command lacks."""
    if not {*re.findall("--[a-z]+", f"{error.allowed} {error.hint}")} - _OPTIONS:
        return error
    hint = "; ".join(filter(None, [error.hint, "mitsim import has these options"]))
    return InputError(error.where, error.field, error.found, error.allowed, hint)


def margin_of(settings: Settings) -> int:
    """Return the margin beside an edge [px] where points may mix both sides: half the pixels of a match plus 1."""
    return settings.support_px // 2 + 1 if isinstance(settings, MatcherSettings) else 0


def _is_mitsim_ply(path: Path) -> bool:
    """Return whether a file is a cloud of ``mitsim decode``: one that ``mitsim export`` wrote states no grid."""
    with path.open("rb") as file:
        head = file.read(_HEAD)
    return head.startswith(b"ply\n") and b'"grid"' in head.partition(_MARK)[2].partition(b"\n")[0]
