"""Name the parameters of a rig, and change some of them.

A calibration estimates these parameters, and its errors are errors of them. Names are ``EYE.PARAMETER``; the eye is a
camera's name or ``projector``:

- ``focal_x_px``, ``focal_y_px``, ``principal_x_px``, ``principal_y_px`` [px], of the matrix K;
- the distortion coefficients by OpenCV's names, ``k1 k2 p1 p2 k3 ...`` [1], ``tx ty`` [rad];
- of every eye but the reference camera ``rotation_x_rad``, y, z: a rotation vector in the eye's own frame, applied
  before its nominal rotation; and ``position_x_mm``, y, z of its centre, in the sensor frame.

A time-of-flight sensor has two more parameters, ``path.offset_mm`` and ``path.scale`` (:data:`PATH_NAMES`). They belong
to the length of the light's path, not to the optics.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from characterisation.files.errors import InputError, nearest
from mitsim.sensor.camera import Camera, Rig
from mitsim.sensor.transforms import Transform

#: OpenCV's order of distortion coefficients
PERSPECTIVE_NAMES = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tx", "ty")
FISHEYE_NAMES = ("k1", "k2", "k3", "k4")
#: coefficients after the fifth that are estimated as a group or not at all: rational, thin prism, tilted imager
_GROUPS = (("k4", "k5", "k6"), ("s1", "s2", "s3", "s4"), ("tx", "ty"))

MATRIX_NAMES = ("focal_x_px", "focal_y_px", "principal_x_px", "principal_y_px")
POSE_NAMES = tuple(f"rotation_{axis}_rad" for axis in "xyz") + tuple(f"position_{axis}_mm" for axis in "xyz")

#: half the round-trip path of the light: its additive error [mm], and its relative error [1]
PATH_NAMES = ("path.offset_mm", "path.scale")

_MATRIX_PLACES = {"focal_x_px": (0, 0), "focal_y_px": (1, 1), "principal_x_px": (0, 2), "principal_y_px": (1, 2)}


def parameter_names(rig: Rig, projector: bool = True) -> tuple[str, ...]:
    """Return the names of all parameters of a rig: camera by camera, then the projector's if ``projector`` is true.

    Of the coefficients after the fifth, a group (rational, thin prism, tilt) is included only if the rig uses it: a
    calibration does not estimate coefficients that the nominal model fixes at zero. Raises InputError if a camera is
    named ``projector`` or ``path``.
    """
    for name in ("projector", "path"):
        if name in rig.cameras:
            raise InputError("cameras", name, "a camera of this name", "any name but projector and path")
    reference = next(iter(rig.cameras))
    names = []
    for eye, camera in eyes(rig, projector).items():
        eye_names = (*MATRIX_NAMES, *distortion_names(camera), *(() if eye == reference else POSE_NAMES))
        names += [f"{eye}.{name}" for name in eye_names]
    return tuple(names)


def eyes(rig: Rig, projector: bool = True) -> dict[str, Camera]:
    """Return the cameras of a rig by name and, if ``projector`` is true, its projector's optics as ``projector``."""
    return rig.cameras | ({"projector": rig.projector} if projector and rig.projector is not None else {})


def distortion_names(camera: Camera) -> tuple[str, ...]:
    """Return the names of the distortion coefficients that a camera's model estimates."""
    if camera.model == "fisheye":
        return FISHEYE_NAMES
    names = PERSPECTIVE_NAMES[: len(camera.distortion)]
    values = dict(zip(names, camera.distortion, strict=True))
    used = [group for group in _GROUPS if any(values.get(name, 0.0) != 0 for name in group)]
    return (*names[:5], *(name for group in used for name in group))


def parameter_values(rig: Rig, names: Sequence[str]) -> NDArray[np.float64]:
    """Return the nominal values of parameters, (n,); rotations as the rotation vector of ``sensor_from_camera``.

    The two parameters of the light's path are 0, since the decoder assumes the nominal path. Raises InputError if the
    rig lacks one of the parameters.
    """
    check_names(rig, names)
    optics = eyes(rig)
    poses = {name: _pose_values(camera) for name, camera in optics.items()}
    return np.array([0.0 if name in PATH_NAMES else _value(optics, poses, name) for name in names])


def parameter_differences(nominal: Rig, other: Rig, names: Sequence[str]) -> NDArray[np.float64]:
    """Return the values (n,) by which :func:`moved` changes a nominal rig into another with the same eyes."""
    out = parameter_values(other, names) - parameter_values(nominal, names)
    before, after = eyes(nominal), eyes(other)
    for index, name in enumerate(names):
        eye, _, parameter = name.rpartition(".")
        if parameter in POSE_NAMES[:3]:
            turn = before[eye].sensor_from_camera.rotation.T @ after[eye].sensor_from_camera.rotation
            out[index] = Rotation.from_matrix(turn).as_rotvec()[POSE_NAMES.index(parameter)]
    return out


def moved(rig: Rig, names: Sequence[str], values: ArrayLike) -> Rig:
    """Return the rig with ``values`` (n,) added to the parameters ``names``; the others stay.

    Parameters of the light's path do not change the rig; :func:`path_error` reads them. A ``rectification`` recorded by
    a device also stays, because it is an input of the decoder, not a property of the cameras. A rig without one is
    rectified anew from its cameras. Raises InputError if the rig lacks one of the parameters. Raises ValueError if the
    numbers of values and names differ.
    """
    check_names(rig, names)
    steps: dict[str, dict[str, float]] = {}
    for name, value in zip(names, np.asarray(values, float).reshape(-1), strict=True):
        if name not in PATH_NAMES:
            eye, _, parameter = name.rpartition(".")
            steps.setdefault(eye, {})[parameter] = float(value)
    cameras = {name: _moved_camera(camera, steps.get(name, {})) for name, camera in rig.cameras.items()}
    projector = rig.projector if rig.projector is None else _moved_camera(rig.projector, steps.get("projector", {}))
    return replace(rig, cameras=cameras, projector=projector)


def path_error(names: Sequence[str], values: ArrayLike) -> tuple[float, float]:
    """Return offset [mm] and scale [1] of a time-of-flight path from ``values`` (n,); 0 if not named.

    The sensor reports the distance along the ray ``offset + (1 + scale) * distance``.
    """
    by_name = dict(zip(names, np.asarray(values, float).reshape(-1), strict=True))
    return float(by_name.get("path.offset_mm", 0.0)), float(by_name.get("path.scale", 0.0))


def check_names(rig: Rig, names: Sequence[str], where: str = "parameters") -> None:
    """Raise an :class:`InputError` listing all names that are no parameter of the rig, or that occur twice."""
    rig_names = [*parameter_names(rig), *PATH_NAMES]
    unknown = [name for name in names if name not in rig_names]
    if unknown:
        allowed = f"{', '.join(rig_names[:4])}, ... ({len(rig_names)} of them: {', '.join(eyes(rig))})"
        raise InputError(
            where, ", ".join(unknown[:8]), "no parameter of this rig", allowed, nearest(unknown[0], rig_names)
        )
    twice = sorted({name for name in names if list(names).count(name) > 1})
    if twice:
        raise InputError(where, ", ".join(twice[:8]), "a parameter named twice", "each parameter once")


def _pose_values(camera: Camera) -> NDArray[np.float64]:
    """Return the six numbers of a camera's pose, in the order of :data:`POSE_NAMES`."""
    rotation = Rotation.from_matrix(camera.sensor_from_camera.rotation).as_rotvec()
    return np.concatenate([rotation, camera.centre])


def _value(optics: dict[str, Camera], poses: dict[str, NDArray[np.float64]], name: str) -> float:
    eye, _, parameter = name.rpartition(".")
    camera = optics[eye]
    if parameter in _MATRIX_PLACES:
        return float(camera.matrix[_MATRIX_PLACES[parameter]])
    if parameter in POSE_NAMES:
        return float(poses[eye][POSE_NAMES.index(parameter)])
    return float(camera.distortion[_distortion_order(camera).index(parameter)])


def _moved_camera(camera: Camera, steps: dict[str, float]) -> Camera:
    if not steps:
        return camera
    matrix, distortion = camera.matrix.copy(), camera.distortion.copy()
    for parameter, step in steps.items():
        if parameter in _MATRIX_PLACES:
            matrix[_MATRIX_PLACES[parameter]] += step
        elif parameter not in POSE_NAMES:
            distortion[_distortion_order(camera).index(parameter)] += step
    pose = np.array([steps.get(name, 0.0) for name in POSE_NAMES])
    frame = camera.sensor_from_camera
    if pose.any():
        turned = frame.rotation @ Rotation.from_rotvec(pose[:3]).as_matrix()
        frame = Transform(turned, frame.translation + pose[3:])
    return replace(camera, matrix=matrix, distortion=distortion, sensor_from_camera=frame)


def _distortion_order(camera: Camera) -> tuple[str, ...]:
    return FISHEYE_NAMES if camera.model == "fisheye" else PERSPECTIVE_NAMES
