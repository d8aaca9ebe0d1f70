"""Read calibration files of the usual programs into one tree of names and numbers.

Signal chain: files -> names and arrays of each document of each file (:mod:`mitsim.sensor.calibration_formats`) ->
values of other programs in OpenCV's form (:mod:`mitsim.sensor.calibration_programs`) -> one tree that records which
values were read, so that unread values can be reported.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from characterisation.files.errors import InputError
from mitsim.sensor.calibration_eyes import CalibratedEye, cameras_of, eyes_of, poses_of
from mitsim.sensor.calibration_formats import read_documents
from mitsim.sensor.calibration_numbers import Composed, vector
from mitsim.sensor.calibration_poses import MOTIONS, is_motion, second_from_first
from mitsim.sensor.calibration_programs import with_usual_names

#: names of quantities derived from the rest of a calibration, or that state its quality
_DERIVED = re.compile(
    r"E|F|Q|[RPH][12]|.*(err|std|rms|reproj).*|active.*|rvecs?|tvecs?|.*per_?view.*|(rectification|projection)_matrix",
    re.IGNORECASE,
)

#: names of the first single coefficient of a lens: k1, dist_k1, kc1, radial_1, kappa of HALCON
_FIRST = re.compile(r"(?:.*_)?(?:k[cr]?|kappa)_?1(?:_.*)?|kappa|(?:.*_)?(?:radial|dist|distortion)_?1")

#: letters of a name from which its capital letters do not matter
_SHORTEST = 5


@dataclass(frozen=True)
class Found:
    """A value of a tree, its file, and the ``table`` that qualifies the value: the map in which it stands.

    ``name``: that of the file; of a composed value, those of its sources.
    """

    file: Path
    value: Any
    table: dict[str, Any]
    name: str = ""


@dataclass
class CalibrationTree:
    """Values of one or several files by name: one map for each document of a file.

    ``seen`` holds the document and the dotted name of each value that was read.
    """

    files: list[Path]
    values: list[dict[str, Any]]
    seen: set[tuple[int, str]] = field(default_factory=set)

    def find(self, key: str) -> Found | None:
        """Return the value of a name; dots step into maps, and ``file.yml:name`` searches one file only.

        Raises InputError if several files, or several documents of a file, give different values.
        """
        file, mark, name = key.rpartition(":")
        matches: list[Found] = []
        for i, path in enumerate(self.files):
            if mark and path.parts[-len(Path(file).parts) :] != Path(file).parts:
                continue
            written, value, table = _stepped(self.values[i], name)
            if value is None:
                continue
            self.seen.add((i, written))
            if isinstance(value, Composed):
                self.seen.update((i, source) for source in value.sources)
                matches.append(Found(path, value.value, value.table, ", ".join(value.sources)))
            else:
                matches.append(Found(path, value, table, written))
        for other in matches[1:]:
            first = matches[0]
            if not _same(first.value, other.value):
                if other.file == first.file:
                    raise InputError(first.file, name, "other values in a later document of the file", "one document")
                both = f"other values in {first.file.name} than in {other.file.name}"
                hint = f'name the file to use: file = "{first.file.name}" in [calibration.keys.NAME]'
                raise InputError(other.file, name, both, "a value of one file, or the same in all", hint)
        return matches[0] if matches else None

    def eyes(self) -> list[CalibratedEye]:
        """Return the cameras and projectors that stand in maps."""
        return [eye for tree in self.values for eye in eyes_of(tree)]

    def relative(self, first: Found | None, second: Found | None) -> dict[str, Found] | None:
        """Return rotation and translation from an eye to another, which their matrices name; empty if no pose tells.

        None if they are not two eyes in maps of one document.
        """
        for i, tree in enumerate(self.values):
            eyes = eyes_of(tree)
            named = {", ".join(eye.values["matrix"].sources): eye.name for eye in eyes}
            names = [named.get(each.name) for each in (first, second) if each and each.file == self.files[i]]
            if len(eyes) > 1 and len(names) == 2 and names[0] is not None and names[1] is not None:
                posed = second_from_first(poses_of(eyes), names[0], names[1])
                if not posed and len(eyes) == 2:
                    posed = {key: tree[key] for key in ("+R", "+T") if isinstance(tree.get(key), Composed)}
                self.seen.update((i, source) for value in posed.values() for source in value.sources)
                return {
                    quantity: Found(self.files[i], posed[key].value, posed[key].table, ", ".join(posed[key].sources))
                    for quantity, key in (("rotation", "+R"), ("translation", "+T"))
                    if key in posed
                }
        return None

    def names(self) -> list[str]:
        """Return the names in all files; those in maps are dotted."""
        return list(dict.fromkeys(name for tree in self.values for name, _ in _leaves(tree)))

    def unread(self) -> list[str]:
        """Return the names of values that look like optics, or like poses of several eyes, and were not read."""
        eyes = self.eyes()
        understood = {source for eye in eyes for source in eye.rotation_sources}
        return [
            name
            for i, tree in enumerate(self.values)
            for name, value in _leaves(tree)
            if name not in understood
            and not any((i, name[:end]) in self.seen for end in _ends(name))
            and not _DERIVED.fullmatch(name.rpartition(".")[2])
            and (_is_optics(name, value) or (len(eyes) > 1 and _is_pose(name, value)))
        ]


def read_tree(files: list[Path], size: tuple[int, int] | None = None) -> CalibrationTree:
    """Read calibration files, of cameras with images of a ``size`` (width, height) [px] if a file has several.

    Raises InputError if a file is missing or cannot be read.
    """
    read = [(file, with_usual_names(document)) for file in files for document in read_documents(file, size)]
    tree = CalibrationTree([file for file, _ in read], [values for _, values in read])
    if len(files) == len(read) == 2:  # of one camera each, as of EuRoC
        first, second = (cameras_of(eyes_of(values))[0] for values in tree.values)
        if len(first) == len(second) == 1 and first[0].rotation_sources:
            tree.values[1] |= second_from_first({"1": first[0].values, "2": second[0].values}, "1", "2")
            tree.seen.update((0, source) for source in first[0].rotation_sources)
    return tree


def tree_of(tables: dict[str, dict[str, Any]]) -> CalibrationTree:
    """Return the tree of tables that have been read from a recording, by the names of their sources."""
    return CalibrationTree([Path(name) for name in tables], [with_usual_names(table) for table in tables.values()])


def _leaves(tree: dict[str, Any], before: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the dotted names and values of a tree, without composed values."""
    for name, value in tree.items():
        if isinstance(value, dict):
            yield from _leaves(value, f"{before}{name}.")
        elif not isinstance(value, Composed):
            yield f"{before}{name}", value


def _ends(name: str) -> list[int]:
    """Return the ends of a dotted name and of the maps in which it stands."""
    return [*(at for at, letter in enumerate(name) if letter == "."), len(name)]


def _is_optics(name: str, value: Any) -> bool:
    """Return whether a value looks like a camera matrix, distortion coefficients, or a rotation."""
    own = name.rpartition(".")[2].lower()
    if _FIRST.fullmatch(own) and not isinstance(value, (list, np.ndarray)):
        alone = vector(value, 1)
        return alone is not None and bool(alone.any())
    try:
        numbers = np.asarray(value, float)
    except (ValueError, TypeError, OverflowError):
        return False
    if not numbers.size or not np.isfinite(numbers).all():
        return False
    if numbers.shape == (3, 3):
        matrix = numbers[0, 0] > 0 and np.abs(numbers[2] - [0, 0, 1]).max() < 1e-9 and numbers[0, 2] > 0
        return bool(matrix or np.abs(numbers @ numbers.T - np.eye(3)).max() < 1e-4)
    is_vector = numbers.ndim and numbers.size == max(numbers.shape)
    lens = numbers.size in (4, 5, 8, 12, 14) or (numbers.size > 1 and ("radial" in own or "distortion" in own))
    return bool(is_vector and lens and np.abs(numbers).max() < 100 and numbers.any())


def _is_pose(name: str, value: Any) -> bool:
    """Return whether a value is a rigid motion, 4 x 4, under a name that tells no frames."""
    numbers = None if name.rpartition(".")[2] in MOTIONS else vector(value, 16)
    motion = np.zeros((4, 4)) if numbers is None else numbers.reshape(4, 4)
    return is_motion(motion) and bool(np.abs(motion[:3, :3] @ motion[:3, :3].T - np.eye(3)).max() < 1e-4)


def _stepped(tree: dict[str, Any], name: str) -> tuple[str, Any, dict[str, Any]]:
    """Return a dotted name as it is written, its value, and the map in which it stands; None and no map without it."""
    table: Any = tree
    parts = [name] if name in tree else name.split(".")
    written = []
    for part in parts:
        if isinstance(table, list):  # of cameras, say: a number steps into it
            table = {str(index): value for index, value in enumerate(table)}
        if not isinstance(table, dict):
            return name, None, {}
        holder = table
        written.append(part if part in holder else _spelt(part, holder))
        table = holder.get(written[-1])
    return ".".join(written), table, holder


def _spelt(name: str, table: dict[str, Any]) -> str:
    """Return the name that a map has in other capitals (``Camera_Matrix``); a short one stays as it is: r is not R."""
    if len(name) < _SHORTEST:
        return name
    return next((key for key in table if key.lower() == name.lower()), name)


def _same(value: Any, other: Any) -> bool:
    try:
        return bool(np.array_equal(np.asarray(value, float), np.asarray(other, float)))
    except (ValueError, TypeError, OverflowError):
        return bool(value == other)
