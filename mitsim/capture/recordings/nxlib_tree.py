"""Read the camera's node of Ensenso's NxLib tree: values by path, and the transform of ``Link``.

Every matrix is stored column by column. ``Link`` is the pose of the camera: it takes coordinates of its target, a
workspace or another camera, to those of the *rectified* left camera, by a rotation about an axis and a translation
[mm]. The manufacturer's manual (*Common Tree Elements*) says that links go "from Target to object". The vendor's own
pose of a pattern agrees (recording ``locate_pattern``, see :mod:`mitsim.capture.recordings.nxlib_calibration`). NxLib's
own point maps are in the target's frame.
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from characterisation.files.errors import InputError
from mitsim.sensor.transforms import Transform


class NxLibTree:
    """A node of the NxLib tree, read by paths such as ``Calibration/Stereo/Baseline``; errors name missing fields."""

    def __init__(self, text: bytes, where: str) -> None:
        self.where = where
        self.root = _parse(text, where)

    def get(self, path: str, default: Any = None) -> Any:
        """Return the value at a path, or ``default`` without one."""
        node: Any = self.root
        for key in path.split("/"):
            if not isinstance(node, dict) or key not in node:
                return default
            node = node[key]
        return node

    def has(self, path: str) -> bool:
        """Return whether a path has a value other than null."""
        return self.get(path) is not None

    def text(self, path: str) -> str:
        """Return the text at a path."""
        value = self.get(path)
        if not isinstance(value, str):
            raise self.fault(path, "a text")
        return value

    def numbers(self, path: str, shape: tuple[int, ...]) -> NDArray[np.float64]:
        """Return finite numbers of a given shape at a path, as stored."""
        allowed = f"{shape} finite numbers" if shape else "a finite number"
        try:
            values = np.asarray(self.get(path))
        except ValueError:  # lists of unequal lengths
            raise self.fault(path, allowed) from None
        if values.dtype.kind not in "iuf" or values.shape != shape or not (np.abs(values.astype(float)) <= 1e9).all():
            raise self.fault(path, allowed)
        return values.astype(np.float64)

    def fault(self, path: str, allowed: str) -> InputError:
        """Return an error about a missing or invalid field."""
        value = self.get(path)
        found = "nothing" if value is None else repr(value)
        return InputError(self.where, path, found if len(found) <= 80 else found[:77] + "...", allowed)

    def is_virtual(self) -> bool:
        """Return whether the vendor's simulator made the images: a model or port contains "Virtual"."""
        sensor = self.root.get("Sensor")
        nodes = [self.root, sensor, *(sensor.values() if isinstance(sensor, dict) else ())]
        for node in (node for node in nodes if isinstance(node, dict)):
            port = node.get("Port")
            named = [node.get("ModelName"), node.get("Type"), port.get("Type") if isinstance(port, dict) else None]
            if any("virtual" in str(name).lower() for name in named):
                return True
        return False


def link_of(tree: NxLibTree) -> Transform | None:
    """Return ``rectified_from_target`` of the tree's ``Link`` [mm], target to rectified left camera; None without one.

    Raises
    ------
    InputError
        If the link is present but invalid.
    """
    if not tree.has("Link/Rotation") and not tree.has("Link/Translation"):
        return None
    translation = tree.numbers("Link/Translation", (3,))
    angle, axis = float(tree.numbers("Link/Rotation/Angle", ())), tree.numbers("Link/Rotation/Axis", (3,))
    length = float(np.linalg.norm(axis))
    if angle != 0 and abs(length - 1) > 1e-3:
        raise tree.fault("Link/Rotation/Axis", "a unit vector")
    turn = Rotation.from_rotvec(angle * axis / length if length > 0 else np.zeros(3))
    return Transform(turn.as_matrix(), translation)


def _parse(text: bytes, where: str) -> dict[str, Any]:
    try:
        tree = json.loads(text.decode("utf-8-sig"), parse_constant=lambda _: None)  # NaN is not a value
    except (ValueError, RecursionError) as error:
        raise InputError(where, "", f"text that is not JSON ({error})", "the camera's node as NxLib saves it") from None
    if not isinstance(tree, dict):
        raise InputError(where, "", type(tree).__name__, "a JSON object: the camera's node as NxLib saves it")
    return tree
