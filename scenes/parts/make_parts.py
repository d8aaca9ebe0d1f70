"""Write the parts that view scores and statements are judged on: a scene, a task and the meshes of each.

    python scenes/parts/make_parts.py [FOLDER]

Every part is a function that returns its shapes and its task. Round faces are Mitsuba's own cylinders, spheres and
disks, which are exact; flat faces with holes, cones, bends and the casting are meshes, whose chords lie less than 1 um
from the surface. Lengths are mm, and the part stands on the plane z = 0.

`OPEN` parts may be looked at while something is developed, and numbers may be read off them. `SEALED` parts are for
the pages of `python -m tests.proofs` alone: see scenes/parts/README.md.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np
import trimesh

#: corners around a circle: a chord of a radius of 30 mm lies 0.6 um inside
_AROUND = 512

_MAIN, _SECOND = "main", "second"


@dataclass
class Part:
    """Shapes of a part as XML and as meshes by file name, and its task as TOML."""

    title: str
    finishes: tuple[float, ...] = (0.37,)
    shapes: list[str] = field(default_factory=list)
    meshes: dict[str, trimesh.Trimesh] = field(default_factory=dict)
    features: list[str] = field(default_factory=list)
    measurements: list[str] = field(default_factory=list)

    def plane(
        self,
        name: str,
        centre: tuple[float, ...],
        size: tuple[float, float],
        normal: str = "z",
        turn_deg: float = 0,
        finish: str = _MAIN,
        measured: bool = True,
    ) -> None:
        """Add a rectangle of ``size`` about ``centre`` with its normal along an axis, then turned about y."""
        about, angle = {"z": ("z", 0), "x": ("y", 90), "-x": ("y", -90), "y": ("x", -90), "-y": ("x", 90)}[normal]
        first = f'<rotate {about}="1" angle="{angle}"/>' if angle else ""
        second = f'<rotate y="1" angle="{turn_deg:g}"/>' if turn_deg else ""
        x, y, z = centre
        self._shape(
            "rectangle",
            name,
            finish,
            f"""<transform name="to_world">
            <scale x="{size[0] / 2:g}" y="{size[1] / 2:g}"/>{first}{second}<translate x="{x:g}" y="{y:g}" z="{z:g}"/>
        </transform>""",
        )
        if measured:
            axis = {"z": (0, 0, 1), "x": (1, 0, 0), "-x": (-1, 0, 0), "y": (0, 1, 0), "-y": (0, -1, 0)}[normal]
            a = math.radians(turn_deg)
            turned = (
                axis[0] * math.cos(a) + axis[2] * math.sin(a),
                axis[1],
                axis[2] * math.cos(a) - axis[0] * math.sin(a),
            )
            self.feature(name, "plane", point_mm=centre, direction=turned)

    def cylinder(
        self,
        name: str,
        start: tuple[float, ...],
        end: tuple[float, ...],
        radius: float,
        ends: str = "both",
        finish: str = _MAIN,
        measured: bool = True,
        inside: bool = False,
    ) -> None:
        """Add a cylinder from ``start`` to ``end``, with disks at its ``ends``: both, end, or none."""
        flip = '\n        <boolean name="flip_normals" value="true"/>' if inside else ""
        self._shape(
            "cylinder",
            name,
            finish,
            f"""<point name="p0" {_xyz(start)}/>
        <point name="p1" {_xyz(end)}/>
        <float name="radius" value="{radius:g}"/>{flip}""",
        )
        along = np.subtract(end, start)
        along = along / np.linalg.norm(along)
        for label, place, sign in (("start", start, -1), ("end", end, 1)):
            if ends == "both" or ends == label:
                self.disk(f"{name}_{label}", place, tuple(sign * along), radius, finish)
        if measured:
            self.feature(name, "cylinder", point_mm=start, direction=tuple(along), radius_mm=radius)

    def disk(
        self,
        name: str,
        centre: tuple[float, ...],
        normal: tuple[float, ...],
        radius: float,
        finish: str = _MAIN,
    ) -> None:
        """Add a disk."""
        n = np.asarray(normal, float)
        side = np.cross(n, (1.0, 0, 0) if abs(n[0]) < 0.9 else (0, 1.0, 0))
        side /= np.linalg.norm(side)
        matrix = np.eye(4)
        matrix[:3, 0], matrix[:3, 1], matrix[:3, 2] = radius * side, radius * np.cross(n, side), n
        matrix[:3, 3] = centre
        numbers = " ".join(f"{value:.10g}" for value in matrix.ravel())
        self._shape("disk", name, finish, f'<transform name="to_world"><matrix value="{numbers}"/></transform>')

    def sphere(self, name: str, centre: tuple[float, ...], radius: float, finish: str = _MAIN) -> None:
        """Add a sphere."""
        self._shape(
            "sphere",
            name,
            finish,
            f"""<point name="center" {_xyz(centre)}/>
        <float name="radius" value="{radius:g}"/>""",
        )
        self.feature(name, "sphere", point_mm=centre, radius_mm=radius)

    def mesh(self, name: str, mesh: trimesh.Trimesh, finish: str = _MAIN, flat: bool = True) -> None:
        """Add a mesh; ``flat`` if its faces are flat, otherwise it is shaded by its vertices' normals."""
        self.meshes[f"{name}.ply"] = mesh
        face = '\n        <boolean name="face_normals" value="true"/>' if flat else ""
        self._shape("ply", name, finish, f'<string name="filename" value="{name}.ply"/>{face}')

    def feature(self, name: str, kind: str, **keys: object) -> None:
        """Add a feature to the task."""
        lines = [f"[features.{name}]", f'kind = "{kind}"', *(f"{key} = {_toml(value)}" for key, value in keys.items())]
        self.features.append("\n".join(lines))

    def measure(self, name: str, kind: str, features: list[str], nominal: float, unit: str = "mm") -> None:
        """Add a measurement to the task."""
        self.measurements.append(
            "\n".join(
                [
                    f"[measurements.{name}]",
                    f'kind = "{kind}"',
                    f"features = {_toml(features)}",
                    f"nominal = {_toml(nominal)}",
                    f'unit = "{unit}"',
                ]
            )
        )

    def write(self, folder: Path) -> None:
        """Write the scene, the task and the meshes to a folder of the part's name."""
        folder.mkdir(parents=True, exist_ok=True)
        second = self.finishes[1] if len(self.finishes) > 1 else None
        defaults = [
            f'    <default name="Ra" value="{self.finishes[0]:g}"/>',
            '    <default name="finish" value="metal"/>',
        ]
        metals = [_metal(_MAIN, "$Ra")]
        if second is not None:
            defaults.append(f'    <default name="second_Ra" value="{second:g}"/>')
            metals.append(_metal(_SECOND, "$second_Ra"))
        head = f"<!-- {self.title} Written by scenes/parts/make_parts.py. finish: metal, or white. Lengths in mm. -->"
        body = "\n\n".join(["\n".join(defaults), *metals, *self.shapes])
        (folder / f"{folder.name}.xml").write_text(
            f'{head}\n<scene version="3.0.0">\n{body}\n</scene>\n', encoding="utf-8"
        )
        task = "\n\n".join(
            [f"# {self.title} Written by scenes/parts/make_parts.py.", *self.features, *self.measurements]
        )
        (folder / "task.toml").write_text(task + "\n", encoding="utf-8")
        for file, mesh in self.meshes.items():
            (folder / file).write_bytes(
                mesh.export(file_type="ply", vertex_normal="face_normals" not in self._of(file))
            )

    def _of(self, file: str) -> str:
        return next(shape for shape in self.shapes if f'"{file}"' in shape)

    def _shape(self, kind: str, name: str, finish: str, inner: str) -> None:
        ref = f'<ref id="{finish}_$finish"/>'
        self.shapes.append(f'    <shape type="{kind}" id="{name}">\n        {inner}\n        {ref}\n    </shape>')


def _metal(name: str, ra: str) -> str:
    return f"""    <bsdf type="machined_metal" id="{name}_metal">
        <string name="metal" value="aluminium"/>
        <string name="process" value="ground"/>
        <float name="Ra" value="{ra}"/>
    </bsdf>
    <bsdf type="matt_white" id="{name}_white"/>"""


def _xyz(point: tuple[float, ...]) -> str:
    return " ".join(f'{axis}="{value:.10g}"' for axis, value in zip("xyz", point, strict=True))


def _toml(value: object) -> str:
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_toml(one) for one in value) + "]"
    return f"{float(value) + 0.0:.10g}"  # type: ignore[arg-type]


def _quads(*corners: list[tuple[float, float, float]]) -> trimesh.Trimesh:
    """Flat quadrilaterals, anticlockwise as seen from outside."""
    vertices = np.array(corners, float).reshape(-1, 3)
    faces = [
        face for k in range(len(corners)) for face in ((4 * k, 4 * k + 1, 4 * k + 2), (4 * k, 4 * k + 2, 4 * k + 3))
    ]
    return trimesh.Trimesh(vertices, faces, process=False)


def _frame(a: float, b: float, p: float, q: float, z: float) -> trimesh.Trimesh:
    """A face z = const of 2a x 2b with a rectangular hole of 2p x 2q in its middle."""
    left, right = [(-a, -q, z), (-p, -q, z), (-p, q, z), (-a, q, z)], [(p, -q, z), (a, -q, z), (a, q, z), (p, q, z)]
    front, rear = [(-a, -b, z), (a, -b, z), (a, -q, z), (-a, -q, z)], [(-a, q, z), (a, q, z), (a, b, z), (-a, b, z)]
    return _quads(left, right, front, rear)


def _strip(lower: np.ndarray, upper: np.ndarray, normals: np.ndarray | None = None) -> trimesh.Trimesh:
    """A surface between two lines of points (n, 3), its normals as given."""
    n = len(lower)
    k = np.arange(n - 1)
    faces = np.concatenate([np.stack([k, k + 1, n + k + 1], 1), np.stack([k, n + k + 1, n + k], 1)])
    both = None if normals is None else np.concatenate([normals, normals])
    return trimesh.Trimesh(np.concatenate([lower, upper]), faces, vertex_normals=both, process=False)


def _face_with_holes(
    x: list[float], y: tuple[float, float], z: float, holes: list[tuple[float, float, float]]
) -> trimesh.Trimesh:
    """A face z = const between borders ``x`` and ``y``, a round hole (x, y, radius) in each of its columns."""
    parts = []
    for (left, right), (cx, cy, radius) in zip(pairwise(x), holes, strict=True):
        corners = [math.atan2(b - cy, a - cx) for a in (left, right) for b in y]
        angles = np.sort(np.concatenate([np.linspace(-np.pi, np.pi, _AROUND, endpoint=False), corners]))
        angles = np.append(angles, angles[0])
        c, s = np.cos(angles), np.sin(angles)
        with np.errstate(divide="ignore"):
            reach = np.minimum(
                np.maximum((left - cx) / c, (right - cx) / c), np.maximum((y[0] - cy) / s, (y[1] - cy) / s)
            )
        ring = np.stack([cx + radius * c, cy + radius * s, np.full_like(c, z)], 1)
        border = np.stack([cx + reach * c, cy + reach * s, np.full_like(c, z)], 1)
        parts.append(_strip(border, ring))
    return trimesh.util.concatenate(parts)


def balls_on_plate() -> Part:
    """Two balls on a plate."""
    part = Part("Two balls on a ground plate.", (0.46,))
    part.plane("plate", (0, 0, 0), (120, 90))
    part.sphere("large_ball", (-28, -6, 15), 15)
    part.sphere("small_ball", (30, 12, 10), 10)
    part.measure("large_radius", "radius", ["large_ball"], 15)
    part.measure("small_radius", "radius", ["small_ball"], 10)
    part.measure("large_height", "point_plane_distance", ["large_ball", "plate"], 15)
    part.measure(
        "balls_distance", "point_distance", ["large_ball", "small_ball"], math.dist((-28, -6, 15), (30, 12, 10))
    )
    return part


def stepped_block() -> Part:
    """Three steps, the width of the top one between its edges."""
    part = Part("A block with three steps.", (0.74, 0.37))
    heights, borders = (10, 25, 45), (-60, -20, 15, 50)
    for k, height in enumerate(heights):
        left, right = borders[k], borders[k + 1]
        part.plane(f"step_{k + 1}", ((left + right) / 2, 0, height), (right - left, 70), finish=_MAIN if k else _SECOND)
        below = heights[k - 1] if k else 0
        part.plane(f"riser_{k + 1}", (left, 0, (below + height) / 2), (height - below, 70), "-x", measured=False)
        for end, side, y in (("front", "-y", -35), ("rear", "y", 35)):
            part.plane(
                f"side_{k + 1}_{end}", ((left + right) / 2, y, height / 2), (right - left, height), side, measured=False
            )
    part.plane("back", (50, 0, 22.5), (45, 70), "x", measured=False)
    for name, x, way in (("left_edge", 15, -1), ("right_edge", 50, 1)):
        part.feature(name, "edge_point", of=["step_3"], point_mm=(x, 0, 45), direction=(way, 0, 0), reach_mm=12)
    part.measure("first_step", "plane_distance", ["step_2", "step_1"], 15)
    part.measure("second_step", "plane_distance", ["step_3", "step_2"], 20)
    part.measure("steps_angle", "plane_angle", ["step_3", "step_1"], 0, "deg")
    part.measure("top_width", "point_distance", ["left_edge", "right_edge"], 35)
    return part


def cone_and_dome() -> Part:
    """A cone and a dome on a plate."""
    part = Part("A truncated cone and a dome on a plate.", (0.37,))
    part.plane("plate", (0, 0, 0), (140, 90))
    wide, narrow, height, x = 30.0, 12.0, 40.0, -32.0
    turn = np.linspace(0, 2 * np.pi, _AROUND + 1)
    c, s = np.cos(turn), np.sin(turn)
    half = math.atan2(wide - narrow, height)
    lower = np.stack([x + wide * c, wide * s, np.zeros_like(c)], 1)
    upper = np.stack([x + narrow * c, narrow * s, np.full_like(c, height)], 1)
    normals = np.stack([math.cos(half) * c, math.cos(half) * s, np.full_like(c, math.sin(half))], 1)
    part.mesh("cone", _strip(lower, upper, normals), flat=False)
    part.feature(
        "cone", "cone", point_mm=(x, 0, 0), direction=(0, 0, -1), radius_mm=wide, half_angle_deg=math.degrees(half)
    )
    part.disk("cone_top", (x, 0, height), (0, 0, 1), narrow)
    part.sphere("dome", (38, 0, 5), 25)
    part.measure("cone_angle", "cone_angle", ["cone"], 2 * math.degrees(half), "deg")
    part.measure("cone_upright", "plane_axis_angle", ["plate", "cone"], 0, "deg")
    part.measure("dome_radius", "radius", ["dome"], 25)
    part.measure("dome_height", "point_plane_distance", ["dome", "plate"], 5)
    return part


def pocket() -> Part:
    """A rectangular pocket with upright walls."""
    part = Part("A block with a pocket of 60 x 40 mm, 20 mm deep.", (0.46, 0.2))
    a, b, p, q, top, floor = 55.0, 40.0, 30.0, 20.0, 30.0, 10.0
    part.mesh("top", _frame(a, b, p, q, top))
    part.feature("top", "plane", point_mm=(0, 30, top), direction=(0, 0, 1))
    part.plane("floor", (0, 0, floor), (2 * p, 2 * q), finish=_SECOND)
    middle, deep = (top + floor) / 2, top - floor
    part.plane("wall_left", (-p, 0, middle), (deep, 2 * q), "x", finish=_SECOND)
    part.plane("wall_right", (p, 0, middle), (deep, 2 * q), "-x", finish=_SECOND)
    part.plane("wall_front", (0, -q, middle), (2 * p, deep), "y", finish=_SECOND)
    part.plane("wall_back", (0, q, middle), (2 * p, deep), "-y", finish=_SECOND)
    for name, centre, size, normal in (
        ("side_left", (-a, 0, top / 2), (top, 2 * b), "-x"),
        ("side_right", (a, 0, top / 2), (top, 2 * b), "x"),
        ("side_front", (0, -b, top / 2), (2 * a, top), "-y"),
        ("side_back", (0, b, top / 2), (2 * a, top), "y"),
    ):
        part.plane(name, centre, size, normal, measured=False)
    part.measure("depth", "plane_distance", ["top", "floor"], 20)
    part.measure("floor_angle", "plane_angle", ["floor", "top"], 0, "deg")
    part.measure("wall_angle", "plane_angle", ["wall_back", "floor"], 90, "deg")
    return part


def casting() -> Part:
    """A freeform body as cast, with two machined pads and a boss."""
    part = Part("A casting: a freeform body with two machined pads and a boss.", (0.74, 0.37))
    x, y = np.meshgrid(np.linspace(-65, 65, 66), np.linspace(-45, 45, 46), indexing="ij")
    z = (
        11
        + 5 * np.cos(x / 19) * np.cos(y / 23 + 0.4)
        + 3 * np.sin((x + 2 * y) / 31)
        - (np.hypot(x / 70, y / 52)) ** 4 * 2
    )
    rows, columns = x.shape
    k = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    faces = np.concatenate([np.stack([k, k + columns, k + columns + 1], 1), np.stack([k, k + columns + 1, k + 1], 1)])
    slope_x, slope_y = np.gradient(z, 2.0, 2.0)
    normals = np.stack([-slope_x, -slope_y, np.ones_like(z)], -1).reshape(-1, 3)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    vertices = np.stack([x, y, z], -1).reshape(-1, 3)
    part.mesh("body", trimesh.Trimesh(vertices, faces, vertex_normals=normals, process=False), flat=False)
    for name, cx, cy, height, radius in (("pad_left", -40, -12, 22, 16), ("pad_right", 36, 18, 26, 14)):
        part.cylinder(f"{name}_side", (cx, cy, 0), (cx, cy, height), radius, "none", measured=False)
        part.disk(name, (cx, cy, height), (0, 0, 1), radius, _SECOND)
        part.feature(name, "plane", point_mm=(cx, cy, height), direction=(0, 0, 1))
    part.cylinder("boss", (0, -22, 0), (0, -22, 42), 12, "end", _SECOND)
    part.measure("pads_step", "plane_distance", ["pad_right", "pad_left"], 4)
    part.measure("pads_angle", "plane_angle", ["pad_right", "pad_left"], 0, "deg")
    part.measure("boss_radius", "radius", ["boss"], 12)
    part.measure("boss_upright", "plane_axis_angle", ["pad_right", "boss"], 0, "deg")
    return part


def spindle() -> Part:
    """A turned shaft of three diameters that lies over a plate."""
    part = Part("A lying shaft of three diameters.", (0.37, 0.74))
    part.plane("plate", (0, 0, 0), (170, 90), finish=_SECOND, measured=False)
    z = 30.0
    ends = ((-70, -20, 14.0), (-20, 25, 24.0), (25, 75, 9.0))
    for k, (left, right, radius) in enumerate(ends):
        part.cylinder(f"step_{k + 1}", (left, 0, z), (right, 0, z), radius)
    part.measure("first_radius", "radius", ["step_1"], 14)
    part.measure("second_radius", "radius", ["step_2"], 24)
    part.measure("third_radius", "radius", ["step_3"], 9)
    part.measure("axes_angle", "axis_angle", ["step_1", "step_3"], 0, "deg")
    return part


def ramp_bracket() -> Part:
    """A plate with a ramp of 30 deg, a lying bar and a ball."""
    part = Part("A plate with a ramp of 30 deg, a lying bar and a ball.", (0.46,))
    part.plane("plate", (0, 0, 0), (150, 100))
    x0, run, wide = 8.0, 45.0, 25.0
    rise = run * math.tan(math.radians(30))
    length = math.hypot(run, rise)
    part.plane("ramp", (x0 + run / 2, -10, rise / 2), (length, 2 * wide), turn_deg=-30)
    part.plane("ramp_back", (x0 + run, -10, rise / 2), (rise, 2 * wide), "x", measured=False)
    for name, y in (("ramp_front", -10 - wide), ("ramp_rear", -10 + wide)):
        corners = [(x0, y, 0), (x0 + run, y, 0), (x0 + run, y, rise)]
        part.mesh(name, trimesh.Trimesh(corners, [(0, 1, 2) if y < 0 else (0, 2, 1)], process=False))
    part.cylinder("bar", (-45, -40, 9), (-45, 40, 9), 9)
    part.sphere("ball", (-12, 28, 12), 12)
    part.measure("ramp_angle", "plane_angle", ["ramp", "plate"], 30, "deg")
    part.measure("bar_radius", "radius", ["bar"], 9)
    part.measure("bar_lies", "plane_axis_angle", ["plate", "bar"], 90, "deg")
    part.measure("ball_radius", "radius", ["ball"], 12)
    part.measure("ball_height", "point_plane_distance", ["ball", "plate"], 12)
    return part


def bore_plate() -> Part:
    """A plate with bores of four sizes."""
    part = Part("A plate with bores of four sizes.", (0.37,))
    high, border = 16.0, [-70.0, -30.0, 0.0, 28.0, 70.0]
    holes = [(-48.0, 0.0, 14.0), (-14.0, 8.0, 9.0), (14.0, -8.0, 6.0), (48.0, 0.0, 16.0)]
    part.mesh("top", _face_with_holes(border, (-40.0, 40.0), high, holes))
    part.feature("top", "plane", point_mm=(0, 0, high), direction=(0, 0, 1))
    part.plane("table", (0, 0, 0), (140, 80), measured=False)
    for name, centre, size, normal in (
        ("side_left", (-70, 0, high / 2), (high, 80), "-x"),
        ("side_right", (70, 0, high / 2), (high, 80), "x"),
        ("side_front", (0, -40, high / 2), (140, high), "-y"),
        ("side_back", (0, 40, high / 2), (140, high), "y"),
    ):
        part.plane(name, centre, size, normal, measured=False)
    for k, (x, y, radius) in enumerate(holes):
        part.cylinder(f"bore_{k + 1}", (x, y, 0), (x, y, high), radius, "none", measured=False, inside=True)
        part.feature(f"rim_{k + 1}", "circle", of=["top"], point_mm=(x, y, high), radius_mm=radius)
    for k in (0, 1, 3):
        part.measure(f"diameter_{k + 1}", "diameter", [f"rim_{k + 1}"], 2 * holes[k][2])
    part.measure("outer_distance", "point_distance", ["rim_1", "rim_4"], 96)
    return part


def shaft_in_v_blocks() -> Part:
    """A shaft in two V-blocks."""
    part = Part("A shaft in two V-blocks of 90 deg.", (0.2, 0.74))
    part.plane("plate", (0, 0, 0), (170, 100), finish=_SECOND)
    bottom, reach, radius = 12.0, 26.0, 14.0
    for name, left, right in (("left", -60.0, -35.0), ("right", 35.0, 60.0)):
        for side, way in (("a", -1.0), ("b", 1.0)):
            rim, high = way * reach, bottom + reach
            face = [(left, 0, bottom), (right, 0, bottom), (right, rim, high), (left, rim, high)]
            outer = [(left, rim, high), (right, rim, high), (right, rim, 0), (left, rim, 0)]
            part.mesh(f"v_{name}_{side}", _quads(face if way > 0 else face[::-1]), _SECOND)
            part.mesh(f"block_{name}_{side}", _quads(outer if way > 0 else outer[::-1]), _SECOND)
            part.feature(
                f"v_{name}_{side}",
                "plane",
                point_mm=((left + right) / 2, rim * 0.9, bottom + 0.9 * reach),
                direction=(0, -way * math.sqrt(0.5), math.sqrt(0.5)),
            )
            for end, x in (("start", left), ("end", right)):
                sheet = [(x, 0, 0), (x, rim, 0), (x, rim, high), (x, 0, bottom)]
                outward = (end == "end") == (way > 0)
                part.mesh(f"block_{name}_{side}_{end}", _quads(sheet if outward else sheet[::-1]), _SECOND)
    z = bottom + radius * math.sqrt(2)
    part.cylinder("shaft", (-80, 0, z), (80, 0, z), radius)
    part.measure("shaft_radius", "radius", ["shaft"], radius)
    part.measure("shaft_lies", "plane_axis_angle", ["plate", "shaft"], 90, "deg")
    part.measure("v_angle", "plane_angle", ["v_left_a", "v_right_b"], 90, "deg")
    part.measure("v_flush", "plane_angle", ["v_left_a", "v_right_a"], 0, "deg")
    return part


def bent_sheet() -> Part:
    """A sheet of 2 mm, bent by 80 deg."""
    part = Part("A sheet of 2 mm, bent by 80 deg about an outer radius of 12 mm.", (0.74,))
    thick, outer, flange, wide, bend = 2.0, 12.0, 55.0, 90.0, math.radians(80)
    # across y: a lying flange from x = -flange to 0, the bend upward about x = 0, z = outer, the other flange
    profiles = []
    for name, radius, way in (("outside", outer, 1), ("inside", outer - thick, -1)):
        turn = np.linspace(0, bend, _AROUND // 4 + 1)
        c, s = np.sin(turn), -np.cos(turn)  # away from the axis of the bend
        line = np.stack([radius * c, np.zeros_like(c), outer + radius * s], 1)
        normals = way * np.stack([c, np.zeros_like(c), s], 1)
        step = np.array([0, wide / 2, 0])
        front, back = line - step, line + step
        part.mesh(f"bend_{name}", _strip(*((back, front) if way > 0 else (front, back)), normals), flat=False)
        along, across = np.array([math.cos(bend), 0, math.sin(bend)]), np.array([c[-1], 0, s[-1]])
        root = np.array([0, 0, outer]) + radius * across
        low = [
            (-flange, -wide / 2, outer - radius),
            (0, -wide / 2, outer - radius),
            (0, wide / 2, outer - radius),
            (-flange, wide / 2, outer - radius),
        ]
        high = [
            tuple(root - step),
            tuple(root + flange * along - step),
            tuple(root + flange * along + step),
            tuple(root + step),
        ]
        part.mesh(f"lying_{name}", _quads(low[::-1] if way > 0 else low))
        part.mesh(f"upright_{name}", _quads(high[::-1] if way > 0 else high))
        profiles.append(np.concatenate([low[:1], line - step, [root + flange * along - step]]))
        part.feature(f"lying_{name}", "plane", point_mm=(-flange / 2, 0, outer - radius), direction=(0, 0, -way))
        part.feature(
            f"upright_{name}", "plane", point_mm=tuple(root + flange / 2 * along), direction=tuple(way * across)
        )
        part.feature(f"bend_{name}", "cylinder", point_mm=(0, -wide / 2, outer), direction=(0, 1, 0), radius_mm=radius)
    beyond = np.array([0, wide, 0])
    below, above = profiles
    part.mesh("edge_front", _strip(below, above))
    part.mesh("edge_rear", _strip(above + beyond, below + beyond))
    part.mesh("edge_left", _quads([below[0] + beyond, below[0], above[0], above[0] + beyond][::-1]))
    part.mesh("edge_top", _quads([below[-1] + beyond, below[-1], above[-1], above[-1] + beyond]))
    part.measure("inner_angle", "plane_angle", ["upright_inside", "lying_inside"], 80, "deg")
    part.measure("inner_radius", "radius", ["bend_inside"], outer - thick)
    return part


def pins_in_bin() -> Part:
    """Pins that lie in a bin."""
    part = Part("Pins that lie in a bin.", (0.37, 0.74))
    a, b, high = 85.0, 60.0, 35.0
    part.plane("floor", (0, 0, 0), (2 * a, 2 * b), finish=_SECOND)
    part.plane("wall_left", (-a, 0, high / 2), (high, 2 * b), "x", finish=_SECOND, measured=False)
    part.plane("wall_right", (a, 0, high / 2), (high, 2 * b), "-x", finish=_SECOND, measured=False)
    part.plane("wall_front", (0, -b, high / 2), (2 * a, high), "y", finish=_SECOND, measured=False)
    part.plane("wall_back", (0, b, high / 2), (2 * a, high), "-y", finish=_SECOND, measured=False)
    for name, x, y, size, normal in (
        ("left", -a - 3, 0, (high, 2 * b + 6), "-x"),
        ("right", a + 3, 0, (high, 2 * b + 6), "x"),
        ("front", 0, -b - 3, (2 * a + 6, high), "-y"),
        ("back", 0, b + 3, (2 * a + 6, high), "y"),
    ):
        part.plane(f"outside_{name}", (x, y, high / 2), size, normal, finish=_SECOND, measured=False)
    c, d = a + 3, b + 3
    part.mesh("rim", _frame(c, d, a, b, high), _SECOND)
    pins = [
        (-55, -30, 20, 8),
        (-50, 25, -35, 8),
        (-8, 0, 80, 8),
        (35, -32, -15, 8),
        (45, 25, 40, 8),
    ]  # x, y, turn, radius
    for k, (x, y, turn, radius) in enumerate(pins):
        step = 25 * np.array([math.cos(math.radians(turn)), math.sin(math.radians(turn)), 0])
        middle = np.array([x, y, radius], float)
        part.cylinder(f"pin_{k + 1}", tuple(middle - step), tuple(middle + step), radius)
    leaning = np.array([math.cos(math.radians(25)), 0.2, math.sin(math.radians(25))])
    leaning *= 25 / np.linalg.norm(leaning)
    middle = np.array([12.0, 38.0, 8 + leaning[2] + 1])
    part.cylinder("pin_6", tuple(middle - leaning), tuple(middle + leaning), 8)
    part.measure("radius_1", "radius", ["pin_1"], 8)
    part.measure("radius_5", "radius", ["pin_5"], 8)
    part.measure("angle_1_4", "axis_angle", ["pin_1", "pin_4"], 35, "deg")
    part.measure("lies_3", "plane_axis_angle", ["floor", "pin_3"], 90, "deg")
    return part


def slim_pillars() -> Part:
    """Two slim pillars on a plane."""
    part = Part("Two pillars of radius 9 mm on a plane.", (0.2,))
    part.plane("plane", (0, 0, 0), (130, 90))
    for name, x in (("pillar_left", -25), ("pillar_right", 25)):
        part.cylinder(name, (x, 0, 0), (x, 0, 50), 9, "end")
    part.measure("distance", "intersection_distance", ["plane", "pillar_left", "pillar_right"], 50)
    part.measure("pillars_angle", "axis_angle", ["pillar_left", "pillar_right"], 0, "deg")
    part.measure("left_upright", "plane_axis_angle", ["plane", "pillar_left"], 0, "deg")
    part.measure("right_radius", "radius", ["pillar_right"], 9)
    return part


OPEN: tuple[Callable[[], Part], ...] = (balls_on_plate, stepped_block, cone_and_dome, pocket, casting, spindle)
SEALED: tuple[Callable[[], Part], ...] = (
    ramp_bracket,
    bore_plate,
    shaft_in_v_blocks,
    bent_sheet,
    pins_in_bin,
    slim_pillars,
)


def main() -> None:
    """Write all parts to the folder given, or beside this script."""
    where = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent
    for make in OPEN + SEALED:
        make().write(where / make.__name__)
        print(where / make.__name__)


if __name__ == "__main__":
    main()
