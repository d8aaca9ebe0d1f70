"""Find the cameras and the projector of a calibration whose values stand in maps, as programs write YAML and JSON.

Signal chain: nested maps of one file -> eyes, the maps with a camera matrix -> values in OpenCV's form, names with +.

A camera matrix is a matrix under a usual name (:mod:`mitsim.sensor.calibration_names`); or the single numbers ``fx``,
``fy``, ``cx``, ``cy`` (``ppx``, ``ppy`` of librealsense); or two lists, such as ``focal_length`` and
``principal_point``; or one list of four beside a lens model or an image size (Kalibr, EuRoC). Distortion and pose stand
in the same map, in a map inside it, or in those around it that have no other eye; size and model in any map around it.
Poses: :mod:`mitsim.sensor.calibration_poses`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mitsim.sensor.calibration_lenses import lens_in
from mitsim.sensor.calibration_names import USUAL_NAMES
from mitsim.sensor.calibration_numbers import Composed, by_rows, dotted, number_of, vector
from mitsim.sensor.calibration_poses import named_poses, pose_in, second_from_first
from mitsim.sensor.lens_models import is_fisheye

#: number of maps around the deepest one that is searched; chosen
_DEEPEST = 8
#: length of the longest list that is searched for maps: a rig has fewer eyes; chosen
_LONGEST = 16
#: largest number of maps that are searched, which bounds the time; chosen
_MOST = 4096

#: names of focal lengths and principal points, in small letters: of single numbers, and of lists of two
_SINGLE = (("fx", "fl_x"), ("fy", "fl_y"), ("cx", "ppx"), ("cy", "ppy"))
_DOUBLE = (("focal_length", "focallength", "focal_px", "focal"), ("principal_point", "principalpoint", "principal_px"))

#: names of an image's width and height
_SIDES = (("width", "height"), ("image_width", "image_height"), ("img_width", "img_height"), ("w", "h"))

#: names in small letters: of matrices in a map, and of sizes
_MATRICES = frozenset(name.lower() for name in (*USUAL_NAMES["matrix"][0], "matrix", "intrinsics", "intrinsic"))
_SIZES = frozenset(name.lower() for name in USUAL_NAMES["size"][0])


#: a map by its dotted name
_Named = tuple[str, dict[str, Any]]


@dataclass(frozen=True)
class CalibratedEye:
    """A camera or projector: the dotted ``name`` of its map, that of its matrix, and its ``values``.

    ``values`` by ``matrix``, ``distortion``, ``size``, ``rotation`` and ``translation``, if the file states them.
    """

    name: str
    matrix_map: str
    values: dict[str, Composed] = field(repr=False)

    @property
    def rotation_sources(self) -> tuple[str, ...]:
        """Return the dotted names of the sources of its rotation; none without one."""
        return self.values["rotation"].sources if "rotation" in self.values else ()

    @property
    def is_projector(self) -> bool:
        """Return whether a map of it is named after a projector."""
        return re.search(r"proj(?!ection)", self.matrix_map.lower()) is not None

    @property
    def place(self) -> int | None:
        """Return its place among cameras, which its name states: that of left and right, or a number."""
        number = re.search(r"(\d{1,4})$", self.name)
        return self.side if self.side is not None or number is None else int(number[1])

    @property
    def side(self) -> int | None:
        """Return 0 of a left camera, 1 of a right one, which its name states."""
        name = self.name.rpartition(".")[2].lower()
        return int("right" in name) if "left" in name or "right" in name else None


def eyes_of(tree: dict[str, Any]) -> list[CalibratedEye]:
    """Return the eyes of one file, in its order.

    A matrix under a usual name in no map is none of them, since such names need no search.
    """
    matrix_paths = []
    paths = paths_of(tree)
    for path in paths:
        matrix = _matrix(*path[-1])
        if matrix is not None and not any("radialdistortion" in map(str.lower, table) for _, table in path):
            matrix_paths.append((path, matrix))  # MATLAB's, whose pixels count from 1, has other readers
    alone = not any(vector(value, 9) is not None for value in tree.values())
    out: list[CalibratedEye] = []
    for path, matrix in matrix_paths:
        depth = next(
            at + 1
            for at in range(len(path))
            if at + 1 == len(path)
            or (sum(other[at][1] is path[at][1] for other, _ in matrix_paths if len(other) > at) == 1 and (at or alone))
        )
        out.append(_eye(path, depth, matrix))
    named = named_poses([path[-1] for path in paths], [eye.name for eye in out])
    return [replace(eye, values=eye.values | named.get(eye.name, {})) for eye in out]


def paths_of(tree: dict[str, Any]) -> list[list[_Named]]:
    """Return the path to each map of a file, by their dotted names: the maps around it, and the map itself last."""
    return list(islice(_maps([("", _without_dots(tree))]), _MOST))


def poses_of(eyes: Sequence[CalibratedEye]) -> dict[str, Mapping[str, Composed]]:
    """Return the values of eyes by name, the cameras in their order and first."""
    projectors = [eye for eye in eyes if eye.is_projector]
    return {eye.name: eye.values for eye in (*cameras_of(eyes)[0], *projectors)}


def cameras_of(eyes: Sequence[CalibratedEye]) -> tuple[list[CalibratedEye], bool]:
    """Return the eyes that are no projectors, and whether it is known which is the first, and the second of a pair.

    Their names tell, or a pose. Of more than two cameras, those named left and right are the pair.
    """
    cameras = [eye for eye in eyes if not eye.is_projector]
    if len(cameras) > 2:
        sides = sorted((eye for eye in cameras if eye.side is not None), key=lambda eye: eye.side or 0)
        others = sorted((eye for eye in cameras if eye not in sides), key=lambda eye: eye.place or 0)
        return [*sides, *others], [eye.side for eye in sides] == [0, 1]
    positions = [eye.place for eye in cameras]
    if None not in positions and len(set(positions)) == len(positions):
        return sorted(cameras, key=lambda eye: eye.place or 0), True
    posed = ["rotation" in eye.values for eye in cameras]
    return sorted(cameras, key=lambda eye: "rotation" in eye.values), posed.count(False) <= 1


def usual_values(eyes: Sequence[CalibratedEye]) -> dict[str, Composed]:
    """Return the values of eyes under the usual names with a plus, and each as ``+WHAT of NAME``.

    Several cameras without an order have no usual names: the user has to choose.
    """
    out: dict[str, Composed] = {}
    for eye in eyes:
        for name in {eye.name, eye.matrix_map}:
            out |= {f"+{quantity} of {name}": value for quantity, value in eye.values.items() if name}
    cameras, ordered = cameras_of(eyes)
    if len(cameras) == 1:
        out |= _under(cameras[0], {"matrix": "+K", "distortion": "+D1", "size": "+size"})
    elif ordered and cameras:
        out |= _under(cameras[0], {"matrix": "+K1", "distortion": "+D1", "size": "+size"})
        out |= _under(cameras[1], {"matrix": "+K2", "distortion": "+D2", "size": "+size2"})
        out |= second_from_first(poses_of(eyes), cameras[0].name, cameras[1].name)
    for eye in [eye for eye in eyes if eye.is_projector][:1]:
        out |= _under(eye, {"matrix": "+K_proj", "distortion": "+D_proj", "size": "+size_proj"})
        first = cameras[0].name if cameras and (ordered or len(cameras) == 1) else ""
        posed = second_from_first(poses_of(eyes), first, eye.name)
        out |= {f"{name}_proj": value for name, value in posed.items()}
    return out


def _under(eye: CalibratedEye, names: dict[str, str]) -> dict[str, Composed]:
    return {name: eye.values[quantity] for quantity, name in names.items() if quantity in eye.values}


def _without_dots(tree: dict[str, Any]) -> dict[str, Any]:
    """Return the tree, in which names such as ``Camera.fx`` (ORB-SLAM) are maps."""
    out = dict(tree)
    for name, value in tree.items():
        holder, dot, inner = name.rpartition(".")
        if dot and isinstance(out.get(holder, {}), dict):
            out[holder] = {**out.get(holder, {}), inner: value}
    for name in ("Camera1", "Camera2"):  # ORB-SLAM3 states the size and the lens model of both once
        if isinstance(out.get(name), dict) and isinstance(out.get("Camera"), dict):
            out[name] = {**out["Camera"], **out[name]}
    return out


def _maps(path: list[_Named]) -> Iterator[list[_Named]]:
    """Yield the path to each map: all maps around it, and the map itself last."""
    yield path
    name, table = path[-1]
    if len(path) > _DEEPEST:
        return
    for key, value in table.items():
        many = value if isinstance(value, list) and len(value) <= _LONGEST else [value]
        for number, inner in enumerate(many):
            if isinstance(inner, dict):
                stated = inner.get("name")
                inner_name = (
                    key if many is not value else f"{key}.{stated if isinstance(stated, str) and stated else number}"
                )
                yield from _maps([*path, (dotted(name, inner_name), inner)])


def _eye(path: list[_Named], depth: int, matrix: Composed) -> CalibratedEye:
    """Return the eye of the last map of a path; the maps around it from ``depth`` on have no other eye."""
    maps: list[_Named] = []
    for name, table in reversed(path[depth - 1 :]):
        maps += [(name, table)]
        maps += [(dotted(name, key), value) for key, value in table.items() if _is_beside(value)]
    around = [*maps, *reversed(path[: depth - 1])]
    qualifying: dict[str, Any] = {}
    for _, table in reversed(around):
        qualifying |= {key: value for key, value in table.items() if not isinstance(value, dict) or key == "roi"}
    values = {
        "matrix": Composed(matrix.value, matrix.sources, qualifying),
        "distortion": lens_in(maps, is_fisheye(qualifying)),
        "size": _size(around),
        **pose_in(maps),
    }
    name = path[depth - 1][0] or (path[1][0] if len(path) > 1 else "")
    return CalibratedEye(
        name, path[-1][0], {quantity: value for quantity, value in values.items() if value is not None}
    )


def _is_beside(value: Any) -> bool:
    """Return whether a value is a map that may belong to an eye beside it: none with a camera matrix of its own."""
    if not isinstance(value, dict):
        return False
    matrices = [numbers for item in value.values() if (numbers := vector(item, 9)) is not None]
    return not any(numbers[0] > 1 and (numbers[6:] == (0, 0, 1)).all() for numbers in matrices)


def _matrix(name: str, table: dict[str, Any]) -> Composed | None:
    """Return the camera matrix of a map, whose name is empty for the file itself."""
    low = {key.lower(): key for key in table}
    for usual in sorted(_MATRICES & set(low)) if name else ():
        numbers = vector(table[low[usual]])
        # four pixels are fx, fy, cx, cy; those of a lens, which may have the same name, are below 1
        if numbers is not None and (len(numbers) == 9 or (len(numbers) == 4 and numbers.min() > 1)):
            K = numbers.reshape(3, 3) if len(numbers) == 9 else by_rows(numbers)[0]
            return Composed(K, (dotted(name, low[usual]),), table)
    four = vector(table.get(low.get("intrinsics", "")))
    keys = [next((low[spelling] for spelling in names if spelling in low), "") for names in (*_SINGLE, *_DOUBLE)]
    if all(keys[:4]):
        fx, fy, cx, cy = (number_of(table[key]) for key in keys[:4])
        sources = keys[:4]
        if "fl_x" in low and keys[0] == low["fl_x"]:  # of COLMAP, whose pixels have their centres at halves
            cx, cy = cx - 0.5, cy - 0.5
    elif (focal := vector(table.get(keys[4]), 2)) is not None and (centre := vector(table.get(keys[5]), 2)) is not None:
        fx, fy, cx, cy = *focal, *centre
        sources = keys[4:]
    elif four is not None and 4 <= len(four) < 9 and {"camera_model", "resolution"} & set(low):
        fx, fy, cx, cy = four[-4:]  # the parameters of other models, which are refused, precede them
        sources = [low["intrinsics"]]
    else:
        return None
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    return Composed(K, tuple(dotted(name, source) for source in sources), {})


def _size(maps: list[_Named]) -> Composed | None:
    """Return width and height in the first of several maps that has them."""
    for name, table in maps:
        low = {key.lower(): key for key in table}
        size = size_of(table)
        if size is not None:
            return Composed(size, (), table)
        for spelling in sorted(_SIZES & set(low)):
            size = size_of(table[low[spelling]])
            if size is not None:
                return Composed(size, (dotted(name, low[spelling]),), table)
    return None


def size_of(value: Any) -> NDArray[np.float64] | None:
    """Return width and height of a list of two, or of a map that names them; None of anything else."""
    if not isinstance(value, dict):
        return vector(value, 2)
    low = {str(key).lower(): key for key in value}
    for sides in _SIDES:
        numbers = vector([value.get(low.get(side, "")) for side in sides], 2)
        if numbers is not None:
            return numbers
    return None
