"""Read a stereo pair saved as two images, with the calibration of its cameras, as a capture for the matcher."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from characterisation.files.errors import InputError
from mitsim.capture.capture import Capture
from mitsim.capture.decoding import Decoding
from mitsim.capture.grey_image import (
    CHANNELS,
    SUFFIXES,
    Image,
    bits_of,
    channel_of,
    from_bit_0,
    is_colour,
    read_grey,
)
from mitsim.capture.recordings.calibration_file import Calibrated, camera_of, is_euroc, read_calibration
from mitsim.capture.recordings.image_folder import at_size_of_images
from mitsim.capture.recordings.read_options import ReadOptions
from mitsim.capture.recordings.recording_files import chosen_frame, frame_of
from mitsim.sensor.camera import Rig
from mitsim.sensor.projector_images import counted

#: what to do without a pose of the second camera
_POSE = (
    "name the values in a TOML beside the file: [calibration] with file (one, or that of each camera), cameras, "
    "projector = false and [calibration.keys.NAME], where rotation and translation take points of the first camera to "
    "the second (also both the same 3 x 4 or 4 x 4 matrix); of rectified images R is the unit matrix and T = "
    "[-baseline, 0, 0]"
)

#: what to do with more than two cameras
_TWO = (
    'name two of them in a TOML beside the file: [calibration] with file, cameras = ["left", "right"], projector = '
    "false, and matrix = NAME in each of [calibration.keys.left] and [calibration.keys.right]"
)


def read_stereo_pair(folder: str | Path, options: ReadOptions) -> Capture:
    """Read one pair of images whose names begin with those of the two cameras, ``left_0.png``, or lie in their folders.

    A folder of EuRoC has its own calibration; any other has two cameras, the left one first. ``images`` are patterns of
    file names for cameras whose images are not named after them. ``frame`` is the number of the pair, counted from 0,
    or the name of its left image; required if there are several. Of colour images one ``channel`` is used.
    """
    folder = Path(folder)
    own = str(folder) if is_euroc(folder) else None
    calibration, frame = options.cameras or own or options.cameras_of(folder, "a stereo pair"), options.frame
    channel = channel_of(options.channel)
    calibrated = at_size_of_images(folder, lambda size: read_calibration(calibration, size))  # for the names alone
    names = names_of_pair(calibrated, calibration)
    files = {name: pair_files(folder, name, (options.images or {}).get(name)) for name in names}
    counts = [len(paths) for paths in files.values()]
    if counts[0] != counts[1] or counts[0] == 0:
        found = " and ".join(f"{len(paths)} of {name}" for name, paths in files.items())
        hint = f"or name them: --images {names[0]}='cam0_*.png' --images {names[1]}='cam1_*.png'"
        allowed = "as many of each, named after the camera: left_0.png, right_0.png"
        raise InputError(folder, "images", found, allowed, hint)
    stems = [file.stem for file in files[names[0]]]
    number = chosen_frame(frame_of(frame, folder, stems), counts[0], folder, f"pairs, {stems[0]} to {stems[-1]}")
    chosen = {name: paths[number] for name, paths in files.items()}
    left, right = ([int((re.findall(r"\d+", path.stem) or [-1])[-1]) for path in paths] for paths in files.values())
    if left[number] != right[number] and {*left} & {*right} - {-1}:
        found = " with ".join(path.name for path in chosen.values())
        hint = f"remove images without a partner, or name one pair by --images {names[0]}=FILE --images {names[1]}=FILE"
        raise InputError(folder, f"pair {number}", found, "images of the same number", hint)
    levels = {name: read_grey(file, channel=channel) for name, file in chosen.items()}
    first = levels[names[0]]
    read = read_calibration(calibration, (first.shape[1], first.shape[0]))
    settings: dict[str, Any] = {"files": {name: file.relative_to(folder).as_posix() for name, file in chosen.items()}}
    if is_colour(chosen[names[0]]):
        settings["channel"] = list(CHANNELS)[channel]
    return pair_capture(levels, chosen, read, settings, options.named)


def names_of_pair(calibrated: Calibrated, where: str | Path) -> list[str]:
    """Return the names of the left and the right camera of a calibration, which must be that of a pair."""
    names = list(calibrated.rig.cameras)
    if len(names) < 2 or calibrated.unrelated:
        stated = f"{', '.join(names)}{', without the pose of the second' if len(names) == 2 else ''}"
        hint = "; ".join([*calibrated.notes, _TWO if len(names) > 2 else _POSE])
        raise InputError(where, "cameras", stated, "two cameras with R and T: a stereo pair", hint)
    return names[:2]


def pair_capture(
    levels: Mapping[str, Image],
    places: Mapping[str, str | Path],
    calibrated: Calibrated,
    settings: dict[str, Any],
    sensor: str | None = None,
) -> Capture:
    """Return the capture of a stereo pair.

    ``levels`` are images (H, W) [DN] by name of their camera, the left one first, ``places`` the file or topic of each,
    and ``settings`` records of the import. Raises InputError if the size of an image differs from its camera's, or its
    type from that of the left one.
    """
    first = next(iter(levels.values()))
    for name, image in levels.items():
        camera_of(calibrated, name, (image.shape[1], image.shape[0]), places[name])
        if image.dtype != first.dtype:
            raise InputError(places[name], "depth", f"{8 * image.itemsize} bits", f"{8 * first.itemsize}, as the left")
    if calibrated.notes:
        settings["warnings"] = list(calibrated.notes)
    shown, empty = from_bit_0(dict(levels))
    if empty:
        settings["empty_bits"] = empty
    near, far = calibrated.range_mm or (None, None)
    rig = calibrated.rig
    return Capture(
        sensor=sensor or calibrated.sensor or "stereo-pair",
        technology="active_stereo",
        source="device",
        rig=Rig({name: rig.cameras[name] for name in levels}, rig.projector, rig.rectification),
        images={name: np.asarray(image)[None] for name, image in shown.items()},
        bits=bits_of(shown.values()),
        decoding=Decoding(near_mm=near, far_mm=far),
        settings=settings,
    )


def pair_files(folder: Path, camera: str, pattern: str | None = None) -> list[Path]:
    """Return the images of a camera in a folder, ordered by number: by a name pattern, beginning or folder."""
    if not folder.is_dir():
        raise InputError(folder, "", "no such folder", "a folder of images")
    if pattern is not None:
        if Path(pattern).is_absolute() or ".." in Path(pattern).parts:
            raise InputError("--images", "", repr(pattern), "a pattern inside the folder")
        return sorted((path for path in folder.glob(pattern) if path.is_file()), key=counted)
    inside = [path for path in folder.iterdir() if path.is_file() and path.name.lower().startswith(camera.lower())]
    folders = (path for path in folder.iterdir() if path.is_dir() and path.name.lower() == camera.lower())
    groups: list[Iterable[Path]] = [inside, *(path.rglob("*") for path in folders)]
    for files in groups:
        images = sorted((path for path in files if path.suffix.lower() in SUFFIXES and path.is_file()), key=counted)
        if images:
            return images
    return []
