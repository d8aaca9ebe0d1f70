"""Draw the part with the sensor at its recommended pose, faces coloured by their verdicts.

Signal chain: triangles, pose of the sensor, verdict of every feature -> a viewpoint from which neither hides the other
-> depth buffer of the part, shaded by the normal -> frustum and eyes, in front of the part or behind -> labels in two
columns beside the part, sorted so that their lines do not cross -> the axes of the part, to which the pose refers.

The projection is orthographic, so lengths along one direction can be compared anywhere in the picture.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure, FigureBase
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.patheffects import withStroke
from matplotlib.transforms import offset_copy
from numpy.typing import ArrayLike, NDArray

from characterisation.files.arrays import Floats
from characterisation.plots.labels import label_columns
from characterisation.plots.part_pictures import EDGE_SHADE, depth_buffer, innermost_pixel, viewer_frame
from characterisation.plots.style import INK, MUTED, PAPER, drawing
from mitsim.study.scene_geometry import SceneGeometry

#: colour of faces by verdict (Okabe and Ito, safe for colour-blind readers), worst last; faces without measurements are
#: grey
VERDICTS = {
    "fits": "#009e73",
    "no tolerance": "#0072b2",
    "not decided": "#e69f00",
    "does not fit": "#d55e00",
    "undecidable": "#a3447c",
}
_NOT_ASKED = "#b9bdc4"

#: words of the legend, where they are not the verdict
_LEGEND = {"no tolerance": "measured, without tolerance"}

#: pixels along the longer side of the picture, and of the raster in which labels are anchored
_PIXELS = 900
_LABEL_PIXELS = 240

#: share of a face's pixels from the better side, over which it counts as seen; its outline alone has 1 %; chosen
_SEEN_SHARE = 0.25

#: azimuth of the picture's viewpoint relative to the sensor [deg]; chosen
_ASIDE_DEG = 62.0

#: minimum elevation of the viewpoint [deg]; chosen
_LOWEST_DEG = 18.0

#: length of the axes of the part [pt]: their heads and names do not shrink in a low picture of a full sheet; chosen
_AXES_PT = 16.0

#: largest number of times that a picture is widened for its texts: it shrinks, and they do not
_WIDENINGS = 12

#: size of the figure [in]
_SIZE_IN = (7.4, 3.9)

#: size of the figure with the part below the sensor [in]
_STACKED_IN = (3.9, 5.6)

#: left, bottom, width and height of both pictures in each figure, as shares of its size
_BESIDE = (0.0, 0.09, 0.46, 0.91), (0.46, 0.09, 0.54, 0.91)
_STACKED = (0.0, 0.54, 1.0, 0.46), (0.0, 0.1, 1.0, 0.42)

#: gap above the legend, as a share of the figure's height; chosen
_ABOVE_LEGEND = 0.03

#: keeps text readable on lines
_HALO = [withStroke(linewidth=2.5, foreground=PAPER)]


def face_verdicts(measurements: Mapping[str, tuple[Sequence[str], str]]) -> dict[str, str]:
    """Return the worst verdict of each feature; ``measurements`` are (features, verdict) by name."""
    order = list(VERDICTS)
    out = dict[str, str]()
    for features, verdict in measurements.values():
        for name in features:
            if verdict in order and order.index(verdict) >= order.index(out.get(name, order[0])):
                out[name] = verdict
    return out


def placement_figure(
    geometry: SceneGeometry, poses: Sequence[tuple[str, ArrayLike]], verdicts: Mapping[str, str], stacked: bool = False
) -> Figure:
    """Draw a part with a sensor at each pose as a figure of its own; the rest as for :func:`draw_placement`."""
    with drawing():
        figure = Figure(_STACKED_IN if stacked else _SIZE_IN)
    draw_placement(figure, geometry, poses, verdicts, stacked)
    return figure


def draw_placement(
    figure: FigureBase,
    geometry: SceneGeometry,
    poses: Sequence[tuple[str, ArrayLike]],
    verdicts: Mapping[str, str],
    stacked: bool = False,
) -> None:
    """Draw a part with a sensor at each pose, label and part_from_sensor (4, 4) [mm], the first in full.

    The figure is about 1.9 times as wide as high; if ``stacked``, 0.7 times: the enlarged part is then below, not on
    the right. ``verdicts`` of features are keys of :data:`VERDICTS`.
    """
    matrices = [np.asarray(pose, float) for _, pose in poses]
    with drawing():
        middle = (geometry.corners.min(axis=(0, 1)) + geometry.corners.max(axis=(0, 1))) / 2
        turn = _viewpoint(geometry, matrices[0], middle, verdicts)
        flat, depth = _projected(geometry.corners - middle, turn)
        foot = _legend(figure, verdicts, geometry.camera, 2 if stacked else None) + _ABOVE_LEGEND
        whole, near = (
            figure.add_axes((left, max(bottom, foot), width, bottom + height - max(bottom, foot)))
            for left, bottom, width, height in (_STACKED if stacked else _BESIDE)
        )
        picture, extent = _part(geometry, flat, depth, turn, verdicts)
        for axes in (whole, near):
            axes.imshow(picture, origin="lower", extent=extent, interpolation="antialiased", zorder=2)
            axes.set_aspect("equal")
            axes.set_axis_off()
        for number in reversed(range(len(poses))):
            _sensor(whole, geometry, matrices[number], middle, turn, poses[number][0], number == 0)
        whole.margins(0.04, 0.1)
        _labels(near, geometry, flat, depth, verdicts)
        _axes_of_part(near, turn)
        for axes in (whole, near):
            _make_room_for_texts(axes)


def _viewpoint(
    geometry: SceneGeometry, part_from_sensor: Floats, middle: Floats, verdicts: Mapping[str, str]
) -> Floats:
    """Return rows (3, 3) right, up, toward the viewer, on the side of the line of sight with more judged faces."""
    away = part_from_sensor[:3, 3] - middle
    azimuth = math.atan2(away[1], away[0]) if np.hypot(away[0], away[1]) > 1e-6 else -math.pi / 2
    elevation = math.atan2(away[2], math.hypot(away[0], away[1]))
    low = max(math.radians(_LOWEST_DEG), min(math.radians(28.0), elevation * 0.6))

    turns = [viewer_frame(azimuth + side * math.radians(_ASIDE_DEG), low) for side in (1, -1)]
    pixels = np.stack([_pixels_by_face(geometry, *_projected(geometry.corners - middle, turn)) for turn in turns])
    asked = [name in verdicts for name in geometry.names]
    shown = (pixels > _SEEN_SHARE * pixels.max(axis=0))[:, asked].sum(axis=1)
    return turns[int(shown.argmax())]


def _pixels_by_face(geometry: SceneGeometry, flat: Floats, depth: Floats) -> NDArray[np.int64]:
    index = _raster(flat, depth, _LABEL_PIXELS)[0]
    return np.bincount(geometry.shape[index[index >= 0]], minlength=len(geometry.names))


def _projected(points: Floats, turn: Floats) -> tuple[Floats, Floats]:
    """Return positions (..., 2) in the picture and depth (...), larger nearer the viewer, about ``middle``."""
    seen = points @ turn.T
    return np.asarray(seen[..., :2]), np.asarray(seen[..., 2])


def _part(
    geometry: SceneGeometry, flat: Floats, depth: Floats, turn: Floats, verdicts: Mapping[str, str]
) -> tuple[Floats, tuple[float, float, float, float]]:
    """Return the picture of the part, (rows, columns, 4), and its extent: left, right, bottom and top."""
    index, low, _, scale = _raster(flat, depth, _PIXELS)
    colours = np.array([to_rgb(VERDICTS.get(verdicts.get(name, ""), _NOT_ASKED)) for name in geometry.names])
    normal = np.cross(geometry.corners[:, 1] - geometry.corners[:, 0], geometry.corners[:, 2] - geometry.corners[:, 0])
    length = np.linalg.norm(normal, axis=1)
    facing = np.abs(normal @ (turn.T @ np.array([-0.35, 0.45, 0.82]))) / np.where(length > 0, length, 1.0)
    shade = 0.5 + 0.5 * np.clip(facing, 0, 1)
    picture = np.zeros((*index.shape, 4))
    hit = index >= 0
    picture[hit, :3] = colours[geometry.shape[index[hit]]] * shade[index[hit], None]
    picture[hit, 3] = 1.0
    # dark lines between shapes
    shown = np.where(hit, geometry.shape[np.maximum(index, 0)], -1)
    edge = np.zeros_like(hit)
    edge[:-1] |= shown[:-1] != shown[1:]
    edge[:, :-1] |= shown[:, :-1] != shown[:, 1:]
    picture[edge & hit, :3] *= EDGE_SHADE
    half = 0.5 / scale
    (left, bottom), (right, top) = low - half, low + np.array(index.shape[::-1]) / scale - half
    return picture, (left, right, bottom, top)


def _raster(flat: Floats, depth: Floats, pixels: int) -> tuple[NDArray[np.int64], Floats, Floats, float]:
    """Return the nearest triangle of every pixel, the ends of the part in the picture (2,), and pixels per mm."""
    low, high = flat.reshape(-1, 2).min(axis=0), flat.reshape(-1, 2).max(axis=0)
    scale = pixels / max(float((high - low).max()), 1e-9)
    size = tuple(np.ceil((high - low) * scale).astype(int) + 1)
    return depth_buffer((flat - low) * scale, depth, size)[0], low, high, scale


def _sensor(
    axes: Axes,
    geometry: SceneGeometry,
    part_from_sensor: Floats,
    middle: Floats,
    turn: Floats,
    label: str,
    strong: bool,
) -> None:
    """Draw the eyes, the body between them, and the reference camera's frustum, or its axis alone if not ``strong``."""
    centres = geometry.centres @ part_from_sensor[:3, :3].T + part_from_sensor[:3, 3] - middle
    rays = geometry.rays[0] @ part_from_sensor[:3, :3].T
    axis = rays.mean(axis=0)
    reach = -(centres[0] @ axis) / (rays @ axis)
    ends = centres[0] + rays * reach[:, None]
    colour, width, alpha = (INK, 1.1, 1.0) if strong else (MUTED, 0.8, 0.7)
    eye, _ = _projected(centres[0], turn)
    corners, _ = _projected(ends, turn)
    for corner in corners if strong else corners.mean(axis=0, keepdims=True):
        axes.plot([eye[0], corner[0]], [eye[1], corner[1]], color=colour, lw=width, alpha=alpha, zorder=3)
    if strong:
        loop = np.concatenate([corners, corners[:1]])
        axes.plot(loop[:, 0], loop[:, 1], color=colour, lw=0.8, ls="--", zorder=1)
        axes.fill(corners[:, 0], corners[:, 1], color=MUTED, alpha=0.08, zorder=0, lw=0)
    body, _ = _projected(centres, turn)
    size, place = 5 if strong else 3, tuple(body[np.argmax(body[:, 1])])
    axes.plot(body[:, 0], body[:, 1], color=colour, lw=size, solid_capstyle="round", zorder=5, alpha=alpha)
    axes.plot(body[:, 0], body[:, 1], "o", ms=size, mfc="white", mec=colour, mew=1.2, zorder=6)
    words: dict[str, Any] = {"ha": "center", "va": "bottom", "fontsize": 8.5, "color": colour, "path_effects": _HALO}
    axes.annotate(label, place, (0, 8), textcoords="offset points", zorder=9, **words)


def _labels(axes: Axes, geometry: SceneGeometry, flat: Floats, depth: Floats, verdicts: Mapping[str, str]) -> None:
    """Draw the names of the measured features in columns left and right of the part, with lines that do not cross."""
    index, low, high, scale = _raster(flat, depth, _LABEL_PIXELS)
    shown = np.where(index >= 0, geometry.shape[np.maximum(index, 0)], -1)
    anchors = {}
    for number, name in enumerate(geometry.names):
        if name in verdicts and (shown == number).any():
            anchors[name] = low + np.array(innermost_pixel(shown == number)[::-1]) / scale
    order = sorted(anchors, key=lambda name: (-list(VERDICTS).index(verdicts[name]), anchors[name][0]))  # worst first
    label_columns(axes, {name: anchors[name] for name in order}, low, high)


def _axes_of_part(axes: Axes, turn: Floats) -> None:
    """Draw the directions x, y and z of the part below it, each as long as it appears from the viewpoint."""
    (low, high), bottom = axes.get_xlim(), axes.get_ylim()[0]

    def at(place: Floats) -> Any:
        return offset_copy(axes.transData, axes.figure.figure, float(place[0]), float(place[1]), "points")

    below, origin = ((low + high) / 2, bottom), np.array([0.0, -1.4 * _AXES_PT])
    for number, name in enumerate("xyz"):
        way = _AXES_PT * turn[:2, number]
        arrow = {"arrowstyle": "->", "color": MUTED, "lw": 1.0, "shrinkA": 0, "shrinkB": 0, "mutation_scale": 8}
        axes.annotate("", below, below, xycoords=at(origin + way), textcoords=at(origin), arrowprops=arrow)
        beyond = origin + way + 5.0 * way / max(float(np.linalg.norm(way)), 0.2 * _AXES_PT)
        axes.text(*below, name, transform=at(beyond), ha="center", va="center", fontsize=8, color=MUTED)


def _make_room_for_texts(axes: Axes) -> None:
    """Widen the limits along x and y until all texts lie in the axes' part of the figure."""
    renderer = _renderer(axes.figure)
    for _ in range(_WIDENINGS):
        axes.apply_aspect()
        cell = axes.get_position(original=True).transformed(axes.figure.transSubfigure)
        boxes = [text.get_window_extent(renderer) for text in axes.texts if text.get_text()]
        ends = np.array([(box.x0, -box.x1, box.y0, -box.y1) for box in boxes]).reshape(-1, 2, 2)
        beyond = ([(cell.x0, -cell.x1), (cell.y0, -cell.y1)] - ends).max(axis=0, initial=0.0)
        if beyond.max() <= 0:
            return
        drawn = axes.get_window_extent(renderer)
        for axis, size, ends in zip((axes.xaxis, axes.yaxis), drawn.size, beyond, strict=True):
            if ends.max() > 0:
                low, high = axis.get_view_interval()
                before, after = (ends + 2) * (high - low) / size
                axis.set_view_interval(low - before, high + after, ignore=True)


def _renderer(figure: Any) -> Any:
    canvas: Any = FigureCanvasAgg(figure.figure)
    return canvas.get_renderer()


def _legend(figure: Any, verdicts: Mapping[str, str], camera: str, columns: int | None) -> float:
    """Draw the legend at the foot of a figure, and return its upper end as a share of the figure's height."""
    used = [verdict for verdict in VERDICTS if verdict in verdicts.values()]
    handles: list[Any] = [Patch(facecolor=VERDICTS[verdict], label=_LEGEND.get(verdict, verdict)) for verdict in used]
    seen = f"field of view of the {camera or 'first'} camera".replace("camera camera", "camera")
    handles += [Patch(facecolor=_NOT_ASKED, label="not measured"), Line2D([], [], c=INK, lw=0.8, ls="--", label=seen)]
    layout: dict[str, Any] = {"ncols": columns or len(handles), "columnspacing": 1.4 if columns is None else 0.8}
    legend = figure.legend(handles=handles, loc="lower center", handlelength=1.2, **layout)
    return float(legend.get_window_extent(_renderer(figure)).transformed(figure.transSubfigure.inverted()).y1)
