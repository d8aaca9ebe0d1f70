"""Draw a scene before anything is rendered: from the sensor and from above, with a colour for each measured face.

Both views are ray cast. The left one is the part of the reference camera's image that shows the part, with lens
distortion, on finer rays than its pixels, and the whole image as a small map; the right one looks along -z of the part,
to scale. Shading depends on the normal alone, not on any lamp. Faces that no measurement needs are grey.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from numpy.typing import NDArray

from characterisation.files.arrays import Floats
from characterisation.plots.labels import cut, round_length, scale_bar
from characterisation.plots.part_pictures import EDGE_SHADE, shape_edges
from characterisation.plots.style import FIELD, INK, MUTED, OTHER_SHAPE, SHAPES, bare, drawing
from characterisation.words.numbers import finish_name
from mitsim.report.style import legend_patch
from mitsim.scene.first_hits import first_hits
from mitsim.scene.inspect import SceneFacts, ShapeFacts
from mitsim.scene.load import Scene
from mitsim.scene.visible_surfaces import VisibleSurfaces
from mitsim.sensor.sensor import Sensor
from mitsim.sensor.transforms import Transform
from mitsim.sensor.working_volume import common_view, depth, in_working_volume

_BACK = "#2b2d33"

#: share of the colour that remains where the sensor cannot measure
_PALE = 0.35

#: rays along the longer side of each view
_FINE = 560

#: points along each side of the raster of the working volume's section
_COARSE = 280

#: step of the raster from which the outline of the working volume is drawn [px]
_STEP = 2

#: share of the height of the top view that its small map occupies
_OVERVIEW = 0.36

#: free border around the part, relative to its size in the image
_MARGIN = 0.06

#: four edges of what a picture shows, [px] or [mm]
_Window = tuple[float, float, float, float]

_SENSOR_MARK: dict[str, Any] = {"marker": "^", "ms": 6, "mfc": "white", "mec": INK, "mew": 1.1}

#: width of the figure [in]
_WIDTH_IN = 7.5

#: height of the two views [in]
_PANEL_IN = 2.65

#: height of the titles [in]
_TITLE_IN = 0.3

#: height of a row of the legend [in]
_ROW_IN = 0.176


def preview_figure(
    scene: Scene,
    facts: SceneFacts,
    sensor: Sensor,
    pose: Transform,
    visible: VisibleSurfaces,
    first: Sequence[str] = (),
    measured: Collection[str] = (),
) -> Figure:
    """Draw both views with their legend.

    Parameters
    ----------
    scene, facts, sensor, pose, visible
        Shapes of the scene, world_from_sensor [mm], and the surfaces that the reference camera's pixels see.
    first, measured
        Names of the shapes that get the first colours; the largest of the others follow. Names of the shapes that
        measurements need: only they get a colour. Empty without measurements.
    """
    colours = _colours(facts, first, measured)
    with drawing():
        camera = sensor.rig.reference
        features = _features(facts, colours, measured)
        rows = max(len(features), 6)
        height = _TITLE_IN + _PANEL_IN + _ROW_IN * (rows + 1)
        figure = Figure((_WIDTH_IN, height))
        bottom, tall = 1 - (_TITLE_IN + _PANEL_IN) / height, _PANEL_IN / height
        wide = 0.58
        left = figure.add_axes((0.015, bottom, wide, tall))
        right = figure.add_axes((wide + 0.035, bottom, 0.95 - wide, tall))
        window = _from_sensor(left, scene, colours, sensor, pose, visible)
        below = _ROW_IN * rows / height
        _whole_image(figure.add_axes((0.425, bottom - 0.02 - below, 0.165, below)), sensor, visible.shape >= 0, window)
        _from_above(right, scene, facts, colours, sensor, pose)
        _overview(right.inset_axes((0.30, 1 - _OVERVIEW, 0.685, _OVERVIEW - 0.02)), facts, sensor, pose)
        position = pose.points(camera.centre)
        origin = ", ".join(f"{round(float(value)) + 0:g}" for value in position).replace("-", "\N{MINUS SIGN}")
        left.set_title(f"from {sensor.name} at ({origin}) mm, {camera.width} × {camera.height} px", loc="left")
        right.set_title("from above, along −z of the part", loc="left")
        under = bottom - 0.1 / height
        for handles, x in ((features, 0.008), (_marks(sensor), wide + 0.028)):
            place: dict[str, Any] = {"loc": "upper left", "bbox_to_anchor": (x, under), "borderaxespad": 0.0}
            figure.legend(handles=handles, handlelength=1.8, **place)
    return figure


def _colours(facts: SceneFacts, first: Sequence[str], measured: Collection[str]) -> list[str]:
    """Return one colour for each shape, in the order of the scene; more measured shapes than colours repeat them."""
    shapes = facts.shapes
    if measured:
        rank = {name: k for k, name in enumerate(shape.name for shape in shapes if shape.name in measured)}
        return [SHAPES[rank[shape.name] % len(SHAPES)] if shape.name in rank else OTHER_SHAPE for shape in shapes]
    order = sorted(
        range(len(shapes)),
        key=lambda i: (shapes[i].emitter, shapes[i].name not in first, -np.nan_to_num(shapes[i].area), i),
    )
    by_shape = dict(zip(order, SHAPES, strict=False))
    return [by_shape.get(i, OTHER_SHAPE) for i in range(len(shapes))]


def _painted(
    shape: NDArray[np.int16], front: NDArray[np.bool_], lit: Floats, colours: list[str], clear: NDArray[np.bool_]
) -> Floats:
    """Return an image (H, W, 3): colour by shape, shaded by ``lit`` 0..1, pale where not ``clear``."""
    palette = np.array([to_rgb(colour) for colour in [*colours, "#ffffff"]])
    colour = np.where(front[..., None] | (shape < 0)[..., None], palette[shape], to_rgb(_BACK))
    shade = np.where(shape >= 0, 0.45 + 0.55 * np.nan_to_num(lit), 1.0)
    image = colour * shade[..., None]
    share = np.where(clear | ~front, 1.0, _PALE)[..., None]
    image = share * image + (1 - share) * np.array(to_rgb(FIELD))
    image[shape_edges(shape)] *= EDGE_SHADE
    return np.asarray(image)


def _from_sensor(
    axes: Axes, scene: Scene, colours: list[str], sensor: Sensor, pose: Transform, visible: VisibleSurfaces
) -> _Window:
    """Draw the part in the image; return the part of the image that is shown: left, right, top, bottom [px]."""
    height, width = visible.shape.shape
    seen = visible.shape >= 0
    left, right, top, bottom = window = _part_in_image(axes, seen)
    step = max(right - left, bottom - top) / _FINE
    columns, rows = np.meshgrid(np.arange(left + step / 2, right, step), np.arange(top + step / 2, bottom, step))
    camera, size = sensor.rig.reference, columns.shape
    rays = camera.rays(np.stack([columns, rows], axis=-1).reshape(-1, 2))
    world = pose.directions(camera.sensor_from_camera.directions(rays))
    hits = first_hits(scene.mitsuba, np.broadcast_to(pose.points(camera.centre), world.shape), world)
    light = np.array([-0.35, -0.45, -0.82])  # from behind the sensor's left shoulder
    lit = np.clip(pose.inverse().directions(hits.normal) @ (light / np.linalg.norm(light)), 0, 1).reshape(size)
    nearest = np.rint(rows).astype(int).clip(0, height - 1), np.rint(columns).astype(int).clip(0, width - 1)
    clear = visible.seen_by_all & seen
    clear[seen] &= in_working_volume(sensor, visible.point[seen])
    source = without_leaks(hits.shape.reshape(size), hits.front.reshape(size))
    shape, front = hits.shape.reshape(-1)[source], hits.front.reshape(-1)[source]
    image = _painted(shape, front, lit.reshape(-1)[source], colours, clear[nearest])
    axes.imshow(image, extent=(left, right, bottom, top), interpolation="antialiased", zorder=0)
    _frames(axes, sensor)
    axes.set(xlim=(left, right), ylim=(bottom, top))
    bare(axes)
    if not seen.any():
        middle = ((left + right) / 2, (top + bottom) / 2)
        axes.text(*middle, "the image shows no part", ha="center", va="center", color=MUTED)
        return window
    at = float(np.median(depth(sensor, visible.point[seen])))
    pixels = float(camera.matrix[0, 0]) / at
    length = round_length(0.2 * (right - left) / pixels)
    corner = (left + 0.03 * (right - left), bottom - 0.045 * (bottom - top))
    scale_bar(axes, corner, length * pixels, f"{length:g} mm at {at:.0f} mm", -0.02 * (bottom - top))
    return window


def without_leaks(shape: NDArray[np.int16], front: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return for every pixel (H, W) the flat index of the pixel to draw: a neighbour where a ray has leaked.

    A ray that hits an edge of a mesh exactly may pass between its triangles. Its pixel then differs in shape or side
    from all four neighbours, which agree.
    """
    surface = 2 * shape.astype(np.int64) + front
    index = np.arange(surface.size).reshape(surface.shape)
    middle, left = surface[1:-1, 1:-1], surface[1:-1, :-2]
    neighbours = (surface[1:-1, 2:], surface[:-2, 1:-1], surface[2:, 1:-1])
    leaked = (middle != left) & np.logical_and.reduce([neighbour == left for neighbour in neighbours])
    index[1:-1, 1:-1] -= leaked
    return index


def _part_in_image(axes: Axes, seen: NDArray[np.bool_]) -> _Window:
    """Return left, right, top, bottom [px] in the proportions of the axes: the part, or the whole image without one."""
    height, width = seen.shape
    rows, columns = np.nonzero(seen)
    low = np.array([columns.min(), rows.min()]) if len(rows) else np.zeros(2)
    high = np.array([columns.max(), rows.max()]) if len(rows) else np.array([width - 1.0, height - 1.0])
    shape = _proportions(axes)
    extent = (1 + 2 * _MARGIN) * np.maximum(high - low + 1, 8.0)
    across = max(float(extent[0]), shape * float(extent[1]))
    cx, cy = ((low + high) / 2).tolist()
    return cx - across / 2, cx + across / 2, cy - across / shape / 2, cy + across / shape / 2


def _proportions(axes: Axes) -> float:
    """Return the width of axes over their height."""
    box, figure = axes.get_position(), axes.get_figure()
    assert isinstance(figure, Figure)
    width, height = figure.get_size_inches()
    return float(box.width * width / (box.height * height))


def _frames(axes: Axes, sensor: Sensor) -> None:
    """Draw which pixels all eyes see, at the ends of the working range."""
    near, far = sensor.working_range_mm
    for at, style in ((near, "--"), (far, ":")):
        region = np.pad(common_view(sensor, at, _STEP), 1).astype(float)
        rows, columns = ((np.arange(count) - 1) * _STEP for count in region.shape)
        axes.contour(columns, rows, region, [0.5], colors=INK, linewidths=0.9, linestyles=style)


def _whole_image(small: Axes, sensor: Sensor, seen: NDArray[np.bool_], window: _Window) -> None:
    """Draw the whole image of the reference camera as a small map, with the part that the large picture shows."""
    height, width = seen.shape
    small.imshow(np.where(seen, 0.6, 1.0), cmap="gray", vmin=0, vmax=1, interpolation="antialiased")
    _frames(small, sensor)
    left, right, top, bottom = window
    small.add_patch(Rectangle((left, top), right - left, bottom - top, fill=False, edgecolor=MUTED, lw=0.7))
    small.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))
    bare(small)
    small.set_anchor("NE")


def _from_above(
    axes: Axes, scene: Scene, facts: SceneFacts, colours: list[str], sensor: Sensor, pose: Transform
) -> None:
    window = _window(axes, *facts.bounds[:, :2])
    left, right, bottom, top = window
    step = max(right - left, top - bottom) / _FINE
    x, y = np.arange(left + step / 2, right, step), np.arange(top - step / 2, bottom, -step)
    raster = np.stack(np.meshgrid(x, y), axis=-1)
    size = raster.shape[:2]
    above = float(facts.bounds[1, 2] + 1 + 0.1 * (right - left))
    origins = np.concatenate([raster, np.full((*size, 1), above)], axis=-1).reshape(-1, 3)
    hits = first_hits(scene.mitsuba, origins, np.broadcast_to([0.0, 0.0, -1.0], origins.shape))
    light = np.array([-0.4, 0.35, 0.85])
    lit = np.clip(hits.normal @ (light / np.linalg.norm(light)), 0, 1).reshape(size)
    shape, front = hits.shape.reshape(size), hits.front.reshape(size)
    image = _painted(shape, front, lit, colours, np.ones(size, bool))
    axes.imshow(image, extent=window, interpolation="antialiased", zorder=0)
    _outline(axes, facts, sensor, pose, window)
    axes.set(xlim=(left, right), ylim=(bottom, top))
    bare(axes)
    length = round_length(0.3 * (right - left))
    corner = (left + 0.04 * (right - left), bottom + 0.045 * (top - bottom))
    scale_bar(axes, corner, length, f"{length:g} mm", 0.02 * (top - bottom))
    _axes_mark(axes)


def _window(axes: Axes, low: Floats, high: Floats) -> _Window:
    """Return left, right, bottom, top [mm] in the proportions of the axes: the part, and space for the overview."""
    shape = _proportions(axes)
    part = np.maximum(high - low, 1e-3)
    across = max(1.12 * part[0], shape * part[1] / (1 - _OVERVIEW - 0.17))
    tall = across / shape
    cx = float(low[0] + high[0]) / 2
    bottom = float(low[1]) - 0.5 * ((1 - _OVERVIEW) * tall - part[1]) - 0.02 * tall
    return cx - across / 2, cx + across / 2, bottom, bottom + tall


def _outline(axes: Axes, facts: SceneFacts, sensor: Sensor, pose: Transform, window: _Window) -> Floats:
    """Draw the working volume's outline at the part's half height; return the points (n, 2) of the window inside."""
    x, y = np.linspace(*window[:2], _COARSE), np.linspace(*window[2:], _COARSE)
    grid = np.meshgrid(x, y)
    points = np.stack([*grid, np.full_like(grid[0], facts.bounds[:, 2].mean())], axis=-1)
    section = in_working_volume(sensor, pose.inverse().points(points))
    if section.any() and not section.all():
        axes.contour(x, y, section.astype(float), [0.5], colors=INK, linewidths=0.9, linestyles="-.")
    return np.asarray(points[section][:, :2])


def _overview(axes: Axes, facts: SceneFacts, sensor: Sensor, pose: Transform) -> None:
    """Draw a small map: the part's box, the working volume at its half height, the sensor."""
    low, high = facts.bounds[:, :2]
    stand = pose.points(sensor.rig.reference.centre)[:2]
    reach = 1.2 * sensor.working_range_mm[1]
    middle = (np.minimum(low, stand) + np.maximum(high, stand)) / 2
    half = np.maximum(np.abs(high - middle), reach)
    wide = (middle[0] - half[0], middle[0] + half[0], middle[1] - half[1], middle[1] + half[1])
    inside = _outline(axes, facts, sensor, pose, wide)
    (left, bottom), (width, height) = low.tolist(), (high - low).tolist()
    axes.add_patch(Rectangle((left, bottom), width, height, facecolor=OTHER_SHAPE, edgecolor="none", zorder=1))
    axes.plot(*stand.tolist(), **_SENSOR_MARK, zorder=6)
    shown = np.concatenate([np.stack([low, high, stand]), inside])
    margin = 0.08 * float(np.ptp(shown, axis=0).max())
    axes.set_xlim(shown[:, 0].min() - margin, shown[:, 0].max() + margin)
    axes.set_ylim(shown[:, 1].min() - margin, shown[:, 1].max() + margin)
    bare(axes)
    axes.set_anchor("NE")
    axes.set_facecolor("white")


def _axes_mark(axes: Axes) -> None:
    """Draw the directions of the part's x and y in the upper left corner."""
    for name, (dx, dy) in {"x": (0.11, 0.0), "y": (0.0, 0.11)}.items():
        arrow = {"arrowstyle": "->", "color": INK, "lw": 0.9, "shrinkA": 0, "shrinkB": 0}
        end, place = (0.04 + dx, 0.84 + dy), (0.045 + 1.15 * dx, 0.845 + 1.1 * dy)
        axes.annotate("", end, (0.04, 0.84), xycoords="axes fraction", zorder=6, arrowprops=arrow)
        axes.text(*place, name, transform=axes.transAxes, fontsize=7.5, va="center", zorder=6)


def _features(facts: SceneFacts, colours: list[str], measured: Collection[str]) -> list[Patch | Line2D]:
    named = [i for i, colour in enumerate(colours) if colour != OTHER_SHAPE]
    handles: list[Patch | Line2D] = [legend_patch(colours[i], _label(facts.shapes[i])) for i in named]
    if grey := len(colours) - len(named):
        handles.append(legend_patch(OTHER_SHAPE, f"{grey} {'not measured' if measured else 'more shapes'}"))
    return handles


def _marks(sensor: Sensor) -> list[Patch | Line2D]:
    near, far = sensor.working_range_mm
    return [
        Line2D([], [], color=INK, lw=0.9, ls="--", label=f"seen by all eyes, {near:g} mm deep"),
        Line2D([], [], color=INK, lw=0.9, ls=":", label=f"seen by all eyes, {far:g} mm deep"),
        Line2D([], [], color=INK, lw=0.9, ls="-.", label="working volume at half height"),
        Line2D([], [], ls="none", label="sensor", **_SENSOR_MARK),
        legend_patch(FIELD, "pale: not visible to every eye"),
        legend_patch(_BACK, "black: back of a face"),
    ]


def _label(shape: ShapeFacts) -> str:
    name = cut(shape.name, 22)
    if shape.finish is not None:
        return f"{name}  {finish_name(shape.finish.name, shape.finish.roughness)}"
    return f"{name}  {'lamp' if shape.emitter else shape.bsdf}"
