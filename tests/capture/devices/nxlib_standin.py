"""A stand-in for the maker's NxLib: the C functions that the package ensenso-nxlib binds, over a tree of dicts.

The package runs unmodified: only the name ``CDLL`` in ``nxlib.api`` is replaced, by something that gives ctypes
callbacks, so that real C pointers, buffers and strings are passed. It tests our use of the interface, not the maker's
library or a camera: how a device fails is taken from the names of NxLib's errors. Its tree says ``Emulator``, and every
capture says ``source: emulator``.

A ``StandInCamera`` serves what its ``shoot`` gives, and the disparity of a plane with a strip that has none; its
point map is moved by its Link, as NxLib does it.
"""

from __future__ import annotations

import copy
import ctypes
import json
import re
from collections.abc import Callable
from ctypes import CFUNCTYPE, POINTER, c_char_p, c_double, c_int32, c_void_p
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

#: return codes of nxlib.constants
INEXISTENT, BAD_PATH, WRONG_TYPE, TOO_SMALL, FAILED, NOT_ALLOWED = 3, 4, 13, 15, 17, 23

NO_STRIP = slice(40, 60)  # columns of the disparity map without disparity


@dataclass
class Binary:
    data: np.ndarray  # (h, w, channels)
    time: float


@dataclass
class StandInCamera:
    """``shoot(node)``: stacks (frames, H, W) of left and right. ``faults``: command -> error symbol, or a callable."""

    node: dict
    shoot: Callable
    faults: dict = field(default_factory=dict)
    rounds_exposure: bool = False
    lose_after: int | None = None
    serves_points_rectified: bool = True
    stuck_link: bool = False
    log: list = field(default_factory=list)

    def capture(self):
        left, right = self.shoot(self.node)
        pairs = [
            {"Left": Binary(a[..., None], 1.0), "Right": Binary(b[..., None], 1.0)}
            for a, b in zip(left, right, strict=True)
        ]
        self.node["Images"]["Raw"] = pairs if len(pairs) > 1 else pairs[0]

    def disparity(self):
        width, height = self.node["Sensor"]["Size"]
        q = np.array(self.node["Calibration"]["Stereo"]["Reprojection"]).T
        # of the plane Z = 500 + 0.1 X in the rectified left frame: [X Y Z W] = Q [u v d 1]
        u = np.arange(width, dtype=float)
        x_over_z = (u + q[0, 3]) / q[2, 3]
        z = 500 / (1 - 0.1 * x_over_z)
        d = (q[2, 3] / z - q[3, 3]) / q[3, 2]
        row = np.round(16 * d).astype(np.int16)
        row[NO_STRIP] = -32768
        self.node["Images"]["DisparityMap"] = Binary(np.repeat(row[None, :, None], height, axis=0), 1.0)

    def points(self):
        data = self.node["Images"]["DisparityMap"].data[..., 0]
        q = np.array(self.node["Calibration"]["Stereo"]["Reprojection"]).T
        v, u = np.mgrid[: data.shape[0], : data.shape[1]]
        homogeneous = np.stack([u, v, data / 16.0, np.ones(data.shape)], axis=-1) @ q.T
        points = homogeneous[..., :3] / homogeneous[..., 3:]
        points[data == -32768] = np.nan
        if not self.serves_points_rectified:
            points = points @ np.array(self.node["Calibration"]["Stereo"]["Left"]["Rotation"]).T  # by columns: R.T
        link = self.node["Link"]
        if link.get("Target"):
            turn = Rotation.from_rotvec(link["Rotation"]["Angle"] * np.array(link["Rotation"]["Axis"])).as_matrix()
            points = (points - link["Translation"]) @ turn  # the link takes the target to the camera
        self.node["Images"]["PointMap"] = Binary(points.astype(np.float32), 1.0)


class StandIn:
    """What ``CDLL`` gives: functions as attributes, and a handle that may be closed."""

    def __init__(self, *cameras):
        self._handle = ctypes.CDLL(None)._handle
        self.cameras = {camera.node["SerialNumber"]: camera for camera in cameras}
        self.initialised, self.opened = False, 0
        self.kept = []  # strings that were handed out
        self.tree = {}
        for name, (result, arguments) in SIGNATURES.items():
            method = getattr(self, "_" + re.sub(r"(?<!^)([A-Z])", r"_\1", name).lower())
            setattr(self, "nxLib" + name, CFUNCTYPE(result, *arguments)(self._guarded(method, result)))

    def __call__(self, path):  # in the place of CDLL itself
        return self

    def _guarded(self, method, result):
        def call(code, *arguments):
            try:
                if not self.initialised and method.__name__ not in ("_initialize", "_finalize"):
                    raise ReturnCodeError(NOT_ALLOWED)
                answer = method(*arguments)
                code[0] = 0
            except ReturnCodeError as error:
                answer, code[0] = None, error.code
            if result is c_void_p:
                return answer
            return answer if answer is not None or result is None else 0

        return call

    # the tree

    def _steps(self, path):
        text = path.decode()
        if text and not text.startswith("/"):
            raise ReturnCodeError(BAD_PATH)
        return [int(step[1:]) if step.startswith("\\") else step for step in text.split("/")[1:]]

    def _at(self, path):
        node = self.tree
        for step in self._steps(path):
            try:
                node = node[step]
            except (KeyError, IndexError, TypeError):
                raise ReturnCodeError(INEXISTENT) from None
        return node

    def _put(self, path, value):
        *way, last = self._steps(path)
        node = self.tree
        for step in way:
            if node.get(step) is None:
                node[step] = {}
            node = node[step]
        node[last] = value
        if last == "Command" and isinstance(value, str):
            self._execute(value, node)
        if last == "Exposure" and isinstance(value, float):
            for camera in self.cameras.values():
                if camera.rounds_exposure:
                    node[last] = round(value)

    def _execute(self, name, slot):
        slot["Result"] = {}
        serial = slot.get("Parameters", {}).get("Cameras")
        camera = self.cameras.get(serial)
        try:
            if camera is None or serial not in self.tree["Cameras"]:
                raise CommandError("CameraNotFound", f"no camera {serial}")
            camera.log.append(name)
            fault = camera.faults.get(name)
            if fault is not None:
                raise CommandError(fault, "as the test asked for")
            if name == "Capture":
                if camera.lose_after is not None and camera.log.count("Capture") > camera.lose_after:
                    del self.tree["Cameras"][serial]
                    raise CommandError("DeviceCaptureFailed", "lost")
                camera.capture()
            elif name == "ComputeDisparityMap":
                camera.disparity()
            elif name == "ComputePointMap":
                camera.points()
            elif name in ("Open", "Close"):
                camera.node["Status"] |= {"Open": name == "Open", "Available": name == "Close"}
            elif name != "Synchronize":
                raise CommandError("CommandUnknown", name)
        except CommandError as error:
            slot["Result"] = {"ErrorSymbol": error.args[0], "ErrorText": error.args[1]}
        slot["Command"] = None

    # C functions, without the return code

    def _initialize(self, wait):
        self.initialised, self.opened = True, self.opened + 1
        self.tree = {"Cameras": {s: c.node for s, c in self.cameras.items()}, "Execute": {}, "Emulator": True}

    def _finalize(self):
        self.initialised = False

    def _set_null(self, path):
        self._put(path, None)

    def _set_int(self, path, value):
        self._put(path, value)

    def _set_double(self, path, value):
        self._put(path, value)

    def _set_bool(self, path, value):
        self._put(path, bool(value))

    def _set_string(self, path, value):
        self._put(path, value.decode())

    def _set_json(self, path, value, only_writable):
        new = json.loads(value.decode())
        try:
            old = self._at(path)
        except ReturnCodeError:
            old = None
        if only_writable and isinstance(old, dict) and isinstance(new, dict):
            if not any(camera.stuck_link and old is camera.node["Link"] for camera in self.cameras.values()):
                old.update(copy.deepcopy(new))
        else:
            self._put(path, new)

    def _get_type(self, path):
        value = self._at(path)
        kinds = ((type(None), 1), (bool, 4), (int | float | Binary, 2), (str, 3), (list, 5), (dict, 6))
        return next(number for kind, number in kinds if isinstance(value, kind))

    def _plain(self, path, *kinds):
        value = self._at(path)
        if not isinstance(value, kinds) or (bool not in kinds and isinstance(value, bool)):
            raise ReturnCodeError(WRONG_TYPE)
        return value

    def _get_int(self, path):
        return int(self._plain(path, int, float))

    def _get_bool(self, path):
        return int(self._plain(path, bool))

    def _get_double(self, path):
        return float(self._plain(path, int, float))

    def _get_count(self, path):
        return len(self._plain(path, list, dict))

    def _text(self, text):
        buffer = ctypes.create_string_buffer(text.encode())
        self.kept = [*self.kept[-50:], buffer]
        return ctypes.addressof(buffer)

    def _get_string(self, path):
        return self._text(self._plain(path, str))

    def _get_json(self, path, pretty, precision, scientific):
        return self._text(json.dumps(self._at(path), default=lambda binary: binary.time))

    def _make_unique_item(self, path, name):
        node = self._at(path)
        base = name.decode() or "slot"
        unique = next(f"{base}{number}" for number in range(10_000) if f"{base}{number}" not in node)
        node[unique] = {}
        return self._text(f"{path.decode()}/{unique}")

    def _erase(self, path):
        *way, last = self._steps(path)
        del self._at("".join(f"/{step}" for step in way).encode())[last]

    def _wait_for_type(self, path, kind, equal):
        assert (self._get_type(path) == kind) == bool(equal), "commands are executed at once"

    def _get_binary_info(self, path, width, height, channels, size, is_float, time):
        binary = self._plain(path, Binary)
        height[0], width[0], channels[0] = binary.data.shape
        size[0], is_float[0], time[0] = binary.data.itemsize, int(binary.data.dtype.kind == "f"), binary.time

    def _get_binary(self, path, buffer, size, copied, time):
        binary = self._plain(path, Binary)
        data = np.ascontiguousarray(binary.data)
        if size < data.nbytes:
            raise ReturnCodeError(TOO_SMALL)
        ctypes.memmove(buffer, data.ctypes.data, data.nbytes)
        copied[0], time[0] = data.nbytes, binary.time


class ReturnCodeError(Exception):
    def __init__(self, code):
        self.code = code


class CommandError(Exception):
    pass


_code, _int, _double = POINTER(c_int32), POINTER(c_int32), POINTER(c_double)

SIGNATURES = {
    "Initialize": (None, [_code, c_int32]),
    "Finalize": (None, [_code]),
    "SetNull": (None, [_code, c_char_p]),
    "SetInt": (None, [_code, c_char_p, c_int32]),
    "SetDouble": (None, [_code, c_char_p, c_double]),
    "SetBool": (None, [_code, c_char_p, c_int32]),
    "SetString": (None, [_code, c_char_p, c_char_p]),
    "SetJson": (None, [_code, c_char_p, c_char_p, c_int32]),
    "GetType": (c_int32, [_code, c_char_p]),
    "GetInt": (c_int32, [_code, c_char_p]),
    "GetBool": (c_int32, [_code, c_char_p]),
    "GetDouble": (c_double, [_code, c_char_p]),
    "GetCount": (c_int32, [_code, c_char_p]),
    "GetString": (c_void_p, [_code, c_char_p]),
    "GetJson": (c_void_p, [_code, c_char_p, c_int32, c_int32, c_int32]),
    "MakeUniqueItem": (c_void_p, [_code, c_char_p, c_char_p]),
    "Erase": (None, [_code, c_char_p]),
    "WaitForType": (None, [_code, c_char_p, c_int32, c_int32]),
    "GetBinaryInfo": (None, [_code, c_char_p, _int, _int, _int, _int, _int, _double]),
    "GetBinary": (None, [_code, c_char_p, POINTER(c_void_p), c_int32, _int, _double]),
}


# cameras to be served


def by_columns(matrix):
    return np.asarray(matrix, float).T.tolist()


def small_node(serial="150358", size=(160, 120)):
    """The node of a small camera with a rig of its own, in the layout of 2022."""
    width, height = size
    turned = Rotation.from_rotvec([0.0, 0.05, 0.0]).as_matrix()
    f, baseline = 1.2 * width, 100.0
    centre = [[f, 0, (width - 1) / 2], [0, f, (height - 1) / 2], [0, 0, 1]]
    q = np.eye(4)
    q[:3, 3], q[2, 2], q[3, 2], q[3, 3] = [-centre[0][2], -centre[1][2], f], 0.0, 1 / baseline, 0.0
    side = {"Camera": by_columns(centre), "Rotation": by_columns(turned)}
    return node_around(
        serial, size, {"Left": centre, "Right": centre}, dict.fromkeys(("Left", "Right"), side), baseline, q
    )


def node_around(serial, size, matrices, rectified, baseline, q, distortion=None):
    """A camera's node of these parts; matrices by rows, ``rectified`` already as NxLib stores it."""
    zero = {"K1": 0.0, "K2": 0.0, "K3": 0.0, "T1": 0.0, "T2": 0.0, "Rx": 0.0, "Ry": 0.0}
    stereo = copy.deepcopy({**rectified, "Baseline": baseline, "Reprojection": by_columns(q)})
    return {
        "SerialNumber": serial,
        "ModelName": "StandIn-N10",
        "Type": "Stereo",
        "Status": {"Available": True, "Open": False},
        "Sensor": {"Size": list(size)},
        "Link": {"Target": "", "Rotation": None, "Translation": None},
        "Images": {"Raw": {"Left": None, "Right": None}, "DisparityMap": None, "PointMap": None},
        "Calibration": {
            "Monocular": {
                name: {"Camera": by_columns(matrix), "Distortion": dict((distortion or {}).get(name, zero))}
                for name, matrix in matrices.items()
            },
            "Stereo": stereo,
        },
        "Parameters": {
            "Capture": {
                "Projector": False,
                "FrontLight": True,
                "FlexView": False,
                "AutoExposure": True,
                "Exposure": 3.0,
                "AutoGain": False,
                "Gain": 1.0,
                "HardwareGamma": False,
            },
            "DisparityMap": {"Scaling": 1, "StereoMatching": {"NumberOfDisparities": 128}},
        },
    }


def counted_frames(node):
    """Images that tell frame and side: as many as FlexView asks for."""
    width, height = node["Sensor"]["Size"]
    count = int(node["Parameters"]["Capture"]["FlexView"]) or 1
    base = np.add.outer(np.arange(height), np.arange(width)) % 100
    left = np.stack([base + 10 * frame for frame in range(count)]).astype(np.uint8)
    return left, left + np.uint8(1)


def installed(monkeypatch, *cameras):
    """Put the stand-in where the package looks for the library."""
    import nxlib.api

    library = StandIn(*cameras)
    if nxlib.api._nxlib is not None:
        nxlib.api._nxlib.reset()
    monkeypatch.setattr(nxlib.api, "CDLL", library)
    return library
