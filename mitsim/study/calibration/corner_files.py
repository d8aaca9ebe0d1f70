"""Read the corners of a calibration board from images or from the files of other programs.

Signal chain: folder of images, table of corners, OpenCV's file or arrays -> pixels of every corner by pose and camera
-> poses in which every camera sees the same corners (:class:`~mitsim.study.calibration.recorded.RecordedBoard`).

Four forms are read:

- **A folder of images.** Camera and pose follow from the names: ``left-0001.png`` and ``right-0001.png`` of ROS, or
  folders ``left`` and ``right`` with images of equal names. Names without a camera belong to one camera.
- **A table**, ``.csv``: columns ``pose, camera, column, row, x_px, y_px``. ``column`` and ``row`` count the inner
  corners from 0. A camera named ``projector`` is a projector. Lines ``# size CAMERA WIDTH HEIGHT`` give the sizes.
- **OpenCV's file**, ``.yml``, ``.yaml``, ``.xml`` or ``.json`` of its calibration sample: ``image_points`` (poses,
  corners) of two channels, or ``image_points1`` and ``image_points2`` of a pair; ``image_width``, ``image_height``.
- **Arrays**, ``.npz``: the same names or ``imgpoints``, ``imgpoints_l`` and ``imgpoints_r``; ``image_size``.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from characterisation.files.arrays import Floats
from characterisation.files.checked_files import read_text_bounded
from characterisation.files.errors import InputError
from mitsim.capture.grey_image import CHANNELS, SUFFIXES, read_grey
from mitsim.sensor.calibration_formats import read_documents
from mitsim.sensor.fitted_to import FittedCapture, joined_digest, stack_digest
from mitsim.study.calibration.board import Board
from mitsim.study.calibration.recorded import RecordedBoard, RecordedCorners

#: pixel (2,) of every corner, by pose and camera
Seen = dict[str, dict[str, dict[int, Floats]]]

#: width and height [px] of every camera's images
Sizes = dict[str, tuple[int, int]]

#: fewest corners of a pose that all cameras see
_LEAST_CORNERS = 12

#: fewest poses of two cameras whose corners tell whether one of them stands upside down: two planes leave it open
_LEAST_PAIRS = 3

#: least distance [px] of corners from epipolar lines in a wrong order; chosen: 0.4 in the right one, 16 in a wrong one
_OFF_LINES_PX = 3.0

#: least ratio of this distance to that of the reverse order; chosen likewise
_TIMES_NEARER = 3.0

#: names of a pair's arrays, of the first and of the second camera
_PAIRS = (("image_points1", "image_points2"), ("imgpoints_l", "imgpoints_r"), ("imgpointsL", "imgpointsR"))

#: names of one camera's array
_SINGLES = ("image_points", "imgpoints", "Image_points")

#: suffixes of files of arrays
_OF_ARRAYS = (".npz", ".yml", ".yaml", ".xml", ".json")

#: the camera within the name of an image: a word of its own, or a capital letter at the end or before a number there
_WITHIN = re.compile(
    r"(?<![a-zA-Z0-9])(?i:left|right|l|r|(?:camera|cam|ir|infra)[-_ ]?\d{1,2})(?![a-zA-Z0-9])|[LR](?=\d*$)"
)

#: folders within that of a camera: ``cam0/data`` of EuRoC, ``left/images``
_OF_NO_CAMERA = ("data", "frames", "image", "image_raw", "images", "img", "raw", "rgb")

_COLUMNS = ("pose", "camera", "column", "row", "x_px", "y_px")


def read_corners(path: str | Path, board: Board) -> RecordedCorners:
    """Read the corners of a board, in any of the forms of this module.

    Raises
    ------
    InputError
        If there is no such file or folder, it has another form, or corners do not belong to the board.
    """
    path = Path(path)
    images: dict[str, FittedCapture] = {}
    if path.is_dir():
        seen, sizes, images = _of_images(path, board)
    elif path.suffix.lower() == ".csv":
        seen, sizes = _of_table(path, board)
    elif path.suffix.lower() in _OF_ARRAYS:
        arrays = {name: value for document in read_documents(path) for name, value in document.items()}
        seen, sizes = _of_arrays(path, arrays, board)
    else:
        allowed = "a folder of images, or a file .csv, .npz, .yml, .yaml, .xml or .json"
        raise InputError(path, "", "a file of another kind" if path.exists() else "nothing there", allowed)
    return _together(path, board, seen, sizes, images)


def _together(
    path: Path, board: Board, seen: Seen, sizes: Sizes, images: Mapping[str, FittedCapture]
) -> RecordedCorners:
    """Return the poses whose corners all eyes see; ``seen`` has the pixels (2,) by pose, eye and corner."""
    sizes = dict(sorted(sizes.items(), key=lambda item: item[0] == "projector"))  # the reference is a camera
    if len(sizes) > 2 or set(sizes) == {"projector"}:
        allowed = "one or two cameras, or a camera and a projector"
        raise InputError(path, "cameras", ", ".join(sizes), allowed, "name images left and right")
    boards, left_out = [], []
    used: dict[str, dict[str, Floats]] = {}
    for pose, by_eye in seen.items():
        lacking = [eye for eye in sizes if eye not in by_eye]
        common = sorted(set.intersection(*[set(by_eye[eye]) for eye in sizes])) if not lacking else []
        if len(common) < _LEAST_CORNERS:
            few = f"{len(common)} of at least {_LEAST_CORNERS} corners that all cameras see"
            why = f"no board in {', '.join(lacking)}" if lacking else few
            left_out.append(f"{pose}: {why}")
            continue
        pixels = {eye: np.array([by_eye[eye][corner] for corner in common]) for eye in sizes}
        _check_inside(path, pose, pixels, sizes)
        # a copy of an image has the same pixels
        equal = (name for name, other in used.items() if all(np.array_equal(pixels[eye], other[eye]) for eye in pixels))
        twin = next(equal, None)
        if twin is not None:
            left_out.append(f"{pose}: the same as {twin}")
            continue
        used[pose] = pixels
        boards.append(RecordedBoard(np.array(common, np.intp), pixels, images.get(pose), pose))
    if not boards:
        reasons = "; ".join(left_out[:3]) or "no pose"
        raise InputError(path, "", reasons, f"poses with {_LEAST_CORNERS} corners or more", "check --board")
    return RecordedCorners(board, boards, sizes, left_out)


def _check_inside(path: Path, pose: str, pixels: dict[str, Floats], sizes: Sizes) -> None:
    """Check that the corners (n, 2) [px] of a pose lie in the images.

    Raises
    ------
    InputError
        If one does not: the size belongs to other images, or x and y are exchanged.
    """
    for eye, corners in pixels.items():
        width, height = sizes[eye]
        outside = (corners < -1).any(axis=1) | (corners > (width, height)).any(axis=1)
        if outside.any():
            x, y = corners[outside][0]
            hint = "are these corners of images of another size, or are x and y exchanged?"
            corner = f"a corner at {x:.1f}, {y:.1f} px"
            raise InputError(path, f"{eye}, pose {pose}", corner, f"corners within {width} x {height} px", hint)


def _of_images(path: Path, board: Board) -> tuple[Seen, Sizes, dict[str, FittedCapture]]:
    files = sorted(file for file in path.rglob("*") if file.suffix.lower() in SUFFIXES and file.is_file())
    seen: Seen = {}
    sizes: Sizes = {}
    digests: dict[str, dict[str, bytes]] = {}
    for file, (camera, pose) in _named(files, path).items():
        if camera in digests.get(pose, {}):
            raise InputError(file, "", f"a second image of {camera}, pose {pose}", "one of each pose by each camera")
        image = read_grey(file, channel=CHANNELS["green"])  # as captures of the same camera are imported
        size = (image.shape[1], image.shape[0])
        if sizes.setdefault(camera, size) != size:
            allowed = "{} x {} px, as the others".format(*sizes[camera])
            raise InputError(file, "size", f"{size[0]} x {size[1]} px", allowed)
        corners = found_corners(image, board)
        seen.setdefault(pose, {})
        digests.setdefault(pose, {})[camera] = stack_digest(image[None])
        if corners is not None:
            seen[pose][camera] = dict(enumerate(corners))
    both = [by_camera for by_camera in seen.values() if len(by_camera) == 2]
    pairs = [[np.array(list(by_camera[name].values())) for name in sorted(by_camera)] for by_camera in both]
    for by_camera, corners in zip(both, turned_alike(pairs), strict=True):
        by_camera[max(by_camera)] = dict(enumerate(corners))
    if not files:
        raise InputError(path, "", "no image", f"images {', '.join(sorted(SUFFIXES))} of the board")
    images = {
        pose: FittedCapture(
            name=f"{path / pose}", images_sha256=joined_digest(by_camera[camera] for camera in sorted(by_camera))
        )
        for pose, by_camera in digests.items()
    }
    return seen, dict(sorted(sizes.items())), images


def found_corners(image: NDArray[np.generic], board: Board) -> Floats | None:
    """Return the inner corners (n, 2) [px] of a chequerboard in an image, in the order of the board; None without."""
    shape = (board.columns - 1, board.rows - 1)
    levels = np.asarray(image, float)
    low, high = np.percentile(levels, [1, 99])
    grey = np.clip(255 * (levels - low) / max(high - low, 1e-9), 0, 255).astype(np.uint8)
    for flags in (cv2.CALIB_CB_ACCURACY, cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_EXHAUSTIVE):
        detected, corners = cv2.findChessboardCornersSB(grey, shape, flags=flags)
        if detected:
            break
    return np.asarray(corners, float).reshape(-1, 2) if detected else None


def turned_alike(pairs: Sequence[Sequence[Floats]]) -> list[Floats]:
    """Return the corners (n, 2) [px] of a second camera at each pose in the order of those of a first.

    A board whose rows and columns are both even or both odd in number looks the same after half a turn. The diagonals
    of the board get the same sense in both images; or the opposite one at all poses, if the corners then lie nearer to
    their epipolar lines, as of a camera that stands upside down.
    """
    alike = [two[:: 1 if (one[-1] - one[0]) @ (two[-1] - two[0]) > 0 else -1] for one, two in pairs]
    opposite = [second[::-1] for second in alike]
    if len(pairs) < _LEAST_PAIRS:
        return alike
    first = np.concatenate([corners for corners, _ in pairs])
    off, other = (_from_epipolar_lines(first, np.concatenate(corners)) for corners in (alike, opposite))
    return opposite if off > max(_OFF_LINES_PX, _TIMES_NEARER * other) else alike


def _from_epipolar_lines(first: Floats, second: Floats) -> float:
    """Return the root mean square distance [px] of corners (n, 2) from the epipolar lines that fit all of them best."""
    fundamental = cv2.findFundamentalMat(first, second, cv2.FM_8POINT)[0]
    if fundamental is None:
        return np.inf
    lines = np.column_stack([first, np.ones(len(first))]) @ fundamental[:3].T
    off = (lines[:, :2] * second).sum(axis=1) + lines[:, 2]
    return float(np.sqrt(np.mean((off / np.hypot(lines[:, 0], lines[:, 1])) ** 2)))


def _named(files: Sequence[Path], path: Path) -> dict[Path, tuple[str, str]]:
    """Return camera and pose of the images below ``path``; a folder whose images name several cameras is none."""
    by_name = {file: _by_name(file) for file in files} | _pairs_within(files)
    stated: dict[Path, set[str]] = {}
    for file, (camera, pose) in by_name.items():
        stated.setdefault(file.parent, set()).update({camera} if pose != file.stem else ())
    out = {}
    for file, (camera, pose) in by_name.items():
        inner = file.parent.name.lower() in _OF_NO_CAMERA and file.parent.parent != path
        folder = (file.parent.parent if inner or (file.parent.parent / "sensor.yaml").exists() else file.parent).name
        if file.parent == path or len(stated[file.parent]) > 1:
            out[file] = camera, pose
        else:
            out[file] = folder, pose if camera == folder.lower() else file.stem
    return out


def _by_name(file: Path) -> tuple[str, str]:
    """Return the camera and the pose that the name of an image states."""
    match = re.match(r"(left|right|[lr](?=[-_ \d])|camera\d*|cam\d*)[-_ ]?(.*)$", file.stem, re.IGNORECASE)
    if match and match[2]:
        return {"l": "left", "r": "right"}.get(match[1].lower(), match[1].lower()), match[2]
    match = re.match(r"(.*?)[-_ ](left|right|l|r)$", file.stem, re.IGNORECASE)
    if match:
        return {"l": "left", "r": "right"}.get(match[2].lower(), match[2].lower()), match[1]
    return "camera", file.stem


def _pairs_within(files: Sequence[Path]) -> dict[Path, tuple[str, str]]:
    """Return the camera and the pose of images named as ``img_left_1`` and ``img_right_1``, if most are such pairs.

    Any image without such a name, as of a board at the left, at the right and in the middle, belongs to one camera.
    """
    out: dict[Path, tuple[str, str]] = {}
    poses: dict[str, set[str]] = {}
    for file in files:
        match = _WITHIN.search(file.stem)
        if match is None:
            return {}
        camera, pose = match[0].lower(), f"{file.stem[: match.start()]}{file.stem[match.end() :]}"
        out[file] = {"l": "left", "r": "right"}.get(camera, camera), re.sub(r"[-_ ]{2,}", "_", pose).strip("-_ ")
        poses.setdefault(out[file][0], set()).add(out[file][1])
    if len(poses) != 2 or len(out) != sum(map(len, poses.values())):
        return {}
    first, second = poses.values()
    return out if len(first & second) > len(first | second) / 2 else {}


def _of_table(path: Path, board: Board) -> tuple[Seen, Sizes]:
    text = read_text_bounded(path)
    sizes: Sizes = {}
    for line in text.splitlines():
        if match := re.match(r"#\s*size\s+(\S+)\s+(\d{1,5})\s+(\d{1,5})\s*$", line):
            size = int(match[2]), int(match[3])
            if sizes.setdefault(match[1], size) != size:
                other = "{} x {} px".format(*sizes[match[1]])
                raise InputError(path, match[1], f"a size of {size[0]} x {size[1]} px after {other}", "one size")
    written = "\n".join(line for line in text.splitlines() if not line.startswith("#"))
    lines = csv.reader(io.StringIO(written), skipinitialspace=True)
    try:
        rows = [[cell.strip() for cell in line] for line in lines if line]
    except csv.Error as error:
        raise InputError(path, "", str(error), "lines of values with commas between them") from None
    header = rows.pop(0) if rows else []
    if tuple(header) != _COLUMNS:
        raise InputError(path, "header", ", ".join(header)[:200] or "nothing", ", ".join(_COLUMNS))
    seen: Seen = {}
    for number, row in enumerate(rows, 1):
        try:
            pose, camera = row[:2]
            column, line_of_board = (int(cell) for cell in row[2:4])
            pixel = np.array([float(cell) for cell in row[4:6]]).reshape(2)
        except ValueError:
            raise InputError(path, f"row {number}", str(row)[:60], "whole numbers, and two pixels") from None
        inside = 0 <= column < board.columns - 1 and 0 <= line_of_board < board.rows - 1
        if not inside or not np.isfinite(pixel).all():
            corners = f"corners 0 to {board.columns - 2} and 0 to {board.rows - 2} of the board, with finite pixels"
            raise InputError(path, f"row {number}", f"corner {column}, {line_of_board}", corners)
        if camera not in sizes:
            raise InputError(path, camera, "no size", f"a line # size {camera} WIDTH HEIGHT")
        by_eye = seen.setdefault(pose, {}).setdefault(camera, {})
        corner = line_of_board * (board.columns - 1) + column
        if corner in by_eye:
            found, hint = f"corner {column}, {line_of_board} of {camera} a second time", "give every pose its own name"
            raise InputError(path, f"row {number}, pose {pose}", found, "each corner of a pose once", hint)
        by_eye[corner] = pixel
    return seen, sizes


def _of_arrays(path: Path, arrays: Mapping[str, Any], board: Board) -> tuple[Seen, Sizes]:
    names = next((pair for pair in _PAIRS if all(name in arrays for name in pair)), None)
    single = next((name for name in _SINGLES if name in arrays), None)
    if names is None and single is None:
        allowed = ", ".join([*_SINGLES, *(" and ".join(pair) for pair in _PAIRS)])
        raise InputError(path, "", ", ".join(list(arrays)[:8]) or "no array", f"corners named {allowed}")
    if names is not None:
        by_eye = {"left": arrays[names[0]], "right": arrays[names[1]]}
    else:
        by_eye = {"camera": arrays[str(single)]}
    size = _size(path, arrays)
    count = len(board.corners)
    seen: Seen = {}
    for eye, values in by_eye.items():
        try:
            pixels = np.asarray(values, float).squeeze()
            if pixels.ndim > 2 and pixels.size not in (2 * count, 2 * count * len(pixels)):
                raise ValueError  # poses of another board
            pixels = pixels.reshape(-1, count, 2)
        except (OverflowError, TypeError, ValueError):
            shape = f"{values.shape}" if isinstance(values, np.ndarray) else str(values)[:60]
            raise InputError(path, eye, shape, f"(poses, {count}, 2), for {board}", "check --board") from None
        for pose, corners in enumerate(pixels):
            finite = np.isfinite(corners).all(axis=1)
            seen.setdefault(str(pose), {})[eye] = {int(k): corners[k] for k in np.flatnonzero(finite)}
    return seen, dict.fromkeys(by_eye, size)


def _size(path: Path, arrays: Mapping[str, Any]) -> tuple[int, int]:
    size = arrays.get("image_size", [arrays.get("image_width"), arrays.get("image_height")])
    try:
        width, height = (int(value) for value in np.asarray(size).ravel())
    except (OverflowError, TypeError, ValueError):
        raise InputError(path, "image_size", size, "width and height of the images [px]") from None
    if not (0 < width <= 65535 and 0 < height <= 65535):
        raise InputError(path, "image_size", f"{width} x {height}", "1 to 65535 px")
    return width, height
