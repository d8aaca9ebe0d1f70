"""Read the camera's node of Ensenso's NxLib tree: values by path, and the transform of ``Link``.

Every matrix is stored column by column. ``Link`` is the pose of the camera: it takes coordinates of its target, a
workspace or another camera, to those of the *rectified* left camera, by a rotation about an axis and a translation
[mm]. The manufacturer's manual (*Common Tree Elements*) says that links go "from Target to object". The vendor's own
pose of a pattern agrees (recording ``locate_pattern``, see :mod:`mitsim.capture.recordings.nxlib_calibration`). NxLib's
own point maps are in the target's frame.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from characterisation.files.errors import InputError
from mitsim.capture.recordings.json_fields import JsonFields, parsed_json
from mitsim.sensor.transforms import Transform


class NxLibTree(JsonFields):
    """A node of the NxLib tree, read by paths such as ``Calibration/Stereo/Baseline``."""

    def __init__(self, text: bytes, where: str) -> None:
        what = "the camera's node as NxLib saves it"
        root = parsed_json(text, where, what)
        if not isinstance(root, dict):
            raise InputError(where, "", type(root).__name__, f"a JSON object: {what}")
        super().__init__(root, where, separator="/")

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
