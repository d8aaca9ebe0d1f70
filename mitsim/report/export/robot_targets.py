r"""Write views as a robot's targets: the pose of the tool in the part frame, in each manufacturer's order and units.

A pose is a position p and a rotation R, which takes coordinates of the tool to the part frame. The controller's user
frame (work object, base) must be the part frame. The tool is the flange if the run knows the sensor's pose on it
(``[views.flange_from_sensor]``). Otherwise it is the sensor's own frame, which must then be the controller's tool
frame.

| name | manufacturer's term | length | rotation |
|---|---|---|---|
| ``abb`` | RAPID ``robtarget`` | mm | unit quaternion q1..q4 = w, x, y, z |
| ``kuka`` | KRL ``FRAME`` X Y Z A B C | mm | A about z, B about the new y, C about the new x [deg] |
| ``ur`` | URScript pose ``p[x, y, z, rx, ry, rz]`` | m | rotation vector, axis times angle [rad] |
| ``moveit`` | ROS ``geometry_msgs/Pose`` | m | unit quaternion x, y, z, w |

Sources: ABB, Technical reference manual RAPID, data types orient and robtarget; KUKA's own ``mat_to_rot``, which has
T = Rot_z(A) Rot_y(B) Rot_x(C) with B from -90 to 90 deg; Universal Robots, script manual, module motion (position,
and axis times angle); ROS, geometry_msgs/Quaternion and REP 103.

A quaternion has w >= 0; q and -q are the same rotation. If KUKA's B is -90 or 90 deg, A and C rotate about the same
line; then C is set to 0.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from characterisation.files.checked_files import read_json_object
from characterisation.files.errors import InputError
from mitsim.report.export.run_scene import numbers_of, quaternion
from mitsim.sensor.transforms import Transform
from mitsim.study.run_folder import read_run
from mitsim.views.written_poses import written_poses

#: |sin B| from here on counts as 1
_GIMBAL = 1 - 1e-12


@dataclass(frozen=True)
class RobotTarget:
    """A named pose of the tool in the part frame [mm]: ``name`` of letters, digits and underscores."""

    name: str
    part_from_tool: Transform


@dataclass(frozen=True)
class RobotFormat:
    """A controller's file: its description, its suffix, and the function that writes targets for a tool."""

    description: str
    suffix: str
    write: Callable[[Sequence[RobotTarget], str], str]


def read_targets(folder: str | Path, views: str = "best") -> tuple[list[RobotTarget], str]:
    """Return the targets of a run's views, or of a folder of ``mitsim study score``; and the name of their tool.

    ``views``: ``best``, the run's set of views, or the best of every measurement, with the view of the statement first;
    ``all``; or numbers, ``3,12``. Raises InputError if there are no poses, a pose was changed after it was written,
    ``best`` is used for a folder without a race, or a view does not exist.
    """
    path = Path(folder) / "poses" / "poses.json"
    document = read_json_object(path, "a folder made by mitsim run or mitsim study score")
    tool = "sensor" if document.get("flange_from_sensor") is None else "flange"
    poses = {number: forms[f"part_from_{tool}"] for number, forms in written_poses(path, document).items()}
    run = read_run(folder) if views == "best" or (Path(folder) / "run.json").exists() else None
    if run is not None:
        run.check("poses/poses.json")
    if run is not None and views == "best":
        about, stated = run.about, run.statement
        chosen = sorted({*(about.view_sets[0].views if about.view_sets else about.leaders.values())})
        if stated is not None:
            chosen.sort(key=lambda number: number != stated.view)  # stable: the others stay ascending
    else:
        chosen = numbers_of(views, list(poses))
    missing = [number for number in chosen if number not in poses]
    if missing or not chosen:
        allowed = "the poses.json of this run, with every view that it names"
        raise InputError(path, "views", f"no entry of view {missing[0]}" if chosen else "no view", allowed)
    return [RobotTarget(f"view_{number:04d}", poses[number]) for number in chosen], tool


def kuka_numbers(pose: Transform) -> NDArray[np.float64]:
    """Return X, Y, Z [mm], A, B, C [deg] of a pose, R = Rz(A) Ry(B) Rx(C)."""
    r = pose.rotation
    sine = -float(r[2, 0])
    if abs(sine) >= _GIMBAL:  # A and C rotate about one line: assign all to A
        a, b, c = math.atan2(-r[0, 1], r[1, 1]), math.copysign(math.pi / 2, sine), 0.0
    else:
        a, b, c = math.atan2(r[1, 0], r[0, 0]), math.asin(sine), math.atan2(r[2, 1], r[2, 2])
    return np.array([*pose.translation, *np.degrees([a, b, c])])


def rapid_module(targets: Sequence[RobotTarget], tool: str) -> str:
    r"""Return a RAPID module of robtargets, with the part frame as work object.

    Configurations are 0 and external axes are unused: ``ConfL\Off`` and ``ConfJ\Off`` let the controller choose.
    """
    lines = [
        "MODULE mitsim_views",
        f"  ! poses of the {tool} in the part frame, which must be the work object; mm",
        "  ! [[x, y, z], [q1 = w, q2 = x, q3 = y, q4 = z], configuration, external axes]",
    ]
    unused = ", ".join(["9E+09"] * 6)
    for target in targets:
        x, y, z, w = quaternion(target.part_from_tool)
        pose = f"[{_listed(target.part_from_tool.translation, 4)}], [{_listed((w, x, y, z), 9)}]"
        lines.append(f"  CONST robtarget {target.name} := [{pose}, [0, 0, 0, 0], [{unused}]];")
    return "\n".join([*lines, "ENDMODULE", ""])


def krl_data(targets: Sequence[RobotTarget], tool: str) -> str:
    """Return a KRL data list of FRAMEs, with the part frame as base."""
    lines = [
        "DEFDAT mitsim_views PUBLIC",
        "; a controller reads this list from a file of its name, mitsim_views.dat",
        f"; poses of the {tool} in the part frame, which must be the BASE; mm, deg",
        "; A about z, B about the new y, C about the new x: R = Rz(A) Ry(B) Rx(C)",
    ]
    for target in targets:
        numbers = zip(("X", "Y", "Z", "A", "B", "C"), kuka_numbers(target.part_from_tool), strict=True)
        said = ", ".join(f"{axis} {_number(value, 6)}" for axis, value in numbers)
        lines.append(f"DECL GLOBAL FRAME {target.name}={{{said}}}")
    return "\n".join([*lines, "ENDDAT", ""])


def urscript(targets: Sequence[RobotTarget], tool: str) -> str:
    """Return URScript poses, with the part frame as feature; ``pose_trans(part, view_0012)`` is a pose in the base."""
    lines = [
        f"# poses of the {tool} in the part frame; m, rotation vector in rad",
        "# move there: movej(pose_trans(part, view_...)), with part the pose of the part frame in the base",
    ]
    for target in targets:
        turn = Rotation.from_matrix(target.part_from_tool.rotation).as_rotvec()
        lines.append(f"{target.name} = p[{_listed([*(target.part_from_tool.translation / 1000), *turn], 9)}]")
    return "\n".join([*lines, ""])


def moveit_poses(targets: Sequence[RobotTarget], tool: str) -> str:
    """Return YAML of ``PoseStamped`` by name, in the frame ``part``; no exponents, which YAML 1.1 reads as text."""
    lines = [f"# poses of the {tool} in the part frame; m, quaternion x y z w", f"tool: {tool}", "poses:"]
    for target in targets:
        origin, turn = target.part_from_tool.translation / 1000, quaternion(target.part_from_tool)
        position = ", ".join(f"{k}: {_number(v, 9)}" for k, v in zip("xyz", origin, strict=True))
        orientation = ", ".join(f"{k}: {_number(v, 12)}" for k, v in zip("xyzw", turn, strict=True))
        lines += [
            f"  {target.name}:",
            "    header: {frame_id: part}",
            f"    pose: {{position: {{{position}}}, orientation: {{{orientation}}}}}",
        ]
    return "\n".join([*lines, ""])


#: controllers by name
ROBOT_FORMATS = {
    "abb": RobotFormat("ABB RAPID module of robtargets", ".mod", rapid_module),
    "kuka": RobotFormat("KUKA KRL data list of FRAMEs", ".dat", krl_data),
    "ur": RobotFormat("Universal Robots URScript poses", ".script", urscript),
    "moveit": RobotFormat("MoveIt: PoseStamped in YAML", ".yaml", moveit_poses),
}


def _number(value: float, decimals: int) -> str:
    return f"{round(float(value), decimals) + 0.0:.{decimals}f}"


def _listed(values: Iterable[float], decimals: int) -> str:
    return ", ".join(_number(value, decimals) for value in values)
