"""Read a camera's node of Ensenso's NxLib tree: cameras, rectification, and workspace of ``Link``.

Signal chain: node -> camera matrices, distortion, rectifying rotations, baseline -> rig in the sensor frame; and
``Link`` with the left rectifying rotation -> ``sensor_from_workspace``.

The sensor frame is that of the raw left camera. The files do not state the following; real recordings confirm it:

- Every matrix is stored column by column: transpose.
- Distortion is an array k1 k2 t1 t2 k3 in old files and an object K1 K2 K3 T1 T2 Rx Ry in new ones. Rx and Ry are
  OpenCV's tilts tau_x and tau_y, entries 13 and 14 of 14.
- ``Calibration/Dynamic/Stereo`` is the calibration as last corrected by the device. Its camera matrices belong to the
  disparity map shrunk by ``Parameters/DisparityMap/Scaling``, so they are divided by it (all of fx, fy, cx, cy, without
  half-pixel shift).
- The right camera follows from the rectifying rotations and the baseline B: its centre is rotation_left^T (B, 0, 0).
- ``Link`` is the pose of the camera: it takes coordinates of its target, a workspace or another camera, to those of the
  *rectified* left camera, by a rotation about an axis and a translation [mm]. The manufacturer's manual (*Common Tree
  Elements*) says that links go "from Target to object". NxLib's own point maps are in the target's frame. In the
  recording ``locate_pattern`` of ensenso/ros_driver, the vendor's own pose of a dot pattern is reproduced within
  0.05 mm from there; from the raw left frame the error is 52 mm.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from characterisation.files.errors import InputError
from mitsim.capture.recordings.json_fields import JsonFields, parsed_json
from mitsim.sensor.calibration_qualifiers import check_camera
from mitsim.sensor.camera import Camera, Rectification, Rig
from mitsim.sensor.transforms import Transform

#: longest side of an image [px], as in a capture folder
LARGEST_IMAGE_PX = 16384


class NxLibTree(JsonFields):
    """A node of the NxLib tree, read by paths such as ``Calibration/Stereo/Baseline``."""

    def __init__(self, text: bytes, where: str) -> None:
        expected = "the camera's node as NxLib saves it"
        root = parsed_json(text, where, expected)
        if not isinstance(root, dict):
            raise InputError(where, "", type(root).__name__, f"a JSON object: {expected}")
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


def nxlib_rig(tree: NxLibTree, size: tuple[int, int] | None = None, *, dynamic: bool = True) -> Rig:
    """Return the left and right camera of a node, in the sensor frame, with the manufacturer's rectification.

    ``tree`` is the node of the camera in the tree of NxLib; ``size`` (width, height) [px] of the raw images is by
    default ``Sensor/Size``. ``dynamic`` takes the rectification as last corrected by the device, if present, not the
    factory's. Raises InputError if the node lacks a field, or a field is invalid.
    """
    if size is None:
        columns, rows = tree.numbers("Sensor/Size", (2,)).astype(int).tolist()
        if not (1 <= columns <= LARGEST_IMAGE_PX and 1 <= rows <= LARGEST_IMAGE_PX):
            raise tree.fault("Sensor/Size", f"columns and rows of the images, 1 to {LARGEST_IMAGE_PX} px")
        size = columns, rows
    stereo = stereo_node(tree, dynamic)
    scaling = 1.0
    if "Dynamic" in stereo and tree.has("Parameters/DisparityMap/Scaling"):
        scaling = float(tree.numbers("Parameters/DisparityMap/Scaling", ()))
        if not 0 < scaling <= 1:
            raise tree.fault("Parameters/DisparityMap/Scaling", "0 to 1")
    baseline = float(tree.numbers("Calibration/Stereo/Baseline", ()))
    if baseline <= 0:
        raise tree.fault("Calibration/Stereo/Baseline", "a positive distance [mm]: right camera to the right")
    K = {side: _camera_matrix(tree, f"{stereo}/{side}/Camera") / scaling for side in ("Left", "Right")}
    for matrix in K.values():
        matrix[2, 2] = 1.0
    if not np.allclose(K["Left"][:2, :2], K["Right"][:2, :2]) or not np.isclose(K["Left"][1, 2], K["Right"][1, 2]):
        raise tree.fault(f"{stereo}/Right/Camera", "the focal length and row of the left one: a rectified pair")
    rotation = {side: _rotation(tree, f"{stereo}/{side}/Rotation") for side in ("Left", "Right")}
    width, height = size
    rectification = Rectification(K["Left"], K["Right"], rotation["Left"], rotation["Right"], baseline, width, height)
    left_from_right = Transform(
        rotation["Left"].T @ rotation["Right"], rotation["Left"].T @ np.array([baseline, 0.0, 0.0])
    )
    cameras = {
        side.lower(): Camera(
            matrix=_camera_matrix(tree, f"Calibration/Monocular/{side}/Camera"),
            distortion=_distortion(tree, f"Calibration/Monocular/{side}/Distortion"),
            width=width,
            height=height,
            sensor_from_camera=pose,
        )
        for side, pose in (("Left", Transform.identity()), ("Right", left_from_right))
    }
    for side, camera in cameras.items():
        check_camera(camera, tree.where, f"Calibration/Monocular/{side.capitalize()}/Camera")
    return Rig(cameras, rectification=rectification)


def stereo_node(tree: NxLibTree, dynamic: bool = True) -> str:
    """Return the path of the rectification: as last corrected by the device, else the factory's."""
    return "Calibration/Dynamic/Stereo" if dynamic and tree.has("Calibration/Dynamic/Stereo") else "Calibration/Stereo"


def sensor_from_rectified(tree: NxLibTree, *, dynamic: bool = True) -> Transform:
    """Return the rotation from the rectified left frame, that of NxLib's point maps, to the sensor frame.

    Raises InputError if the node has no rectifying rotation of the left camera.
    """
    return Transform(_rotation(tree, f"{stereo_node(tree, dynamic)}/Left/Rotation").T, np.zeros(3))


def sensor_from_workspace(tree: NxLibTree, *, dynamic: bool = True) -> Transform | None:
    """Return ``Link`` as a transform from its target, a workspace, to the sensor frame [mm]; None without a link.

    Raises InputError if the link or the left rectifying rotation is incomplete or invalid.
    """
    link = link_of(tree)
    return None if link is None else sensor_from_rectified(tree, dynamic=dynamic) @ link


def link_of(tree: NxLibTree) -> Transform | None:
    """Return ``rectified_from_target`` of the tree's ``Link`` [mm], target to rectified left camera; None without one.

    Raises InputError if the link is present but invalid.
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


def _camera_matrix(tree: NxLibTree, path: str) -> NDArray[np.float64]:
    K = tree.numbers(path, (3, 3)).T
    if K[0, 0] <= 0 or K[1, 1] <= 0 or np.any(K[2] != [0, 0, 1]) or K[1, 0] != 0:
        raise tree.fault(path, "a camera matrix, stored by columns, with positive focal lengths")
    return K


def _rotation(tree: NxLibTree, path: str) -> NDArray[np.float64]:
    return tree.rotation(path, 1e-4, by_columns=True)


def _distortion(tree: NxLibTree, path: str) -> NDArray[np.float64]:
    """Return fourteen coefficients in OpenCV's order, from either form of storage."""
    if isinstance(tree.get(path), dict):
        named = ["K1", "K2", "T1", "T2", "K3"]
        k1, k2, t1, t2, k3 = (float(tree.numbers(f"{path}/{name}", ())) for name in named)
        tilts = [float(tree.numbers(f"{path}/{n}", ())) if tree.has(f"{path}/{n}") else 0.0 for n in ("Rx", "Ry")]
    else:
        k1, k2, t1, t2, k3 = tree.numbers(path, (5,)).tolist()
        tilts = [0.0, 0.0]
    return np.array([k1, k2, t1, t2, k3, *[0.0] * 7, *tilts])
