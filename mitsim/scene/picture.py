"""Draw a scene: its shapes in colours with their names, as seen along a direction, to scale.

Signal chain: pose or default viewpoint -> parallel rays through a raster about the scene -> nearest shapes and their
normals -> colour by shape, shaded by the normal -> names beside the picture, on lines that do not cross.

The projection is orthographic, so lengths along one direction can be compared anywhere in the picture. Shading depends
on the normal alone to show the form, not on any lamp.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from numpy.typing import NDArray

from characterisation.files.arrays import Floats
from characterisation.plots.labels import label_columns, round_length, scale_bar
from characterisation.plots.part_pictures import EDGE_SHADE, innermost_pixel, shape_edges, viewer_frame
from characterisation.plots.style import INK, OTHER_SHAPE, SHAPES, axes_for, figure_of
from mitsim.scene.first_hits import Hits, first_hits
from mitsim.sensor.transforms import Transform

#: rays along the longer side of the picture
_RAYS = 520

#: width of a new figure [in]
_WIDTH_IN = 7.4

#: azimuth of the viewpoint without a pose [rad]: from the front; chosen
_AZIMUTH = np.radians(-60.0)

#: elevation of the viewpoint without a pose [rad]: from above; chosen
_ELEVATION = np.radians(35.0)


def draw_scene(scene: Any, names: tuple[str, ...], bounds: Floats, ax: Any, pose: Transform | None) -> Axes:
    """Draw the shapes of a scene with their names, from the default viewpoint or as a sensor at ``pose`` sees them.

    ``scene``, ``names``, ``bounds``: the ``mi.Scene``, the names of its shapes, and the corners (2, 3) of the bounding
    box [mm]. ``ax``: axes to draw into; None for those of a new figure. ``pose``: ``world_from_sensor`` [mm]; None for
    the default viewpoint. Raises InputError if ``ax`` is not one axes.
    """
    frame = (
        viewer_frame(_AZIMUTH, _ELEVATION) if pose is None else np.array([1.0, -1.0, -1.0])[:, None] * pose.rotation.T
    )
    corners = np.stack(np.meshgrid(*bounds.T, indexing="ij"), axis=-1).reshape(-1, 3)
    seen = corners @ frame.T
    low, high = seen.min(axis=0), seen.max(axis=0)
    step = float((high - low)[:2].max()) / _RAYS
    x, y = (np.arange(low[k] - 2 * step, high[k] + 2 * step, step) for k in (0, 1))
    points = np.stack([*np.meshgrid(x, y), np.full((len(y), len(x)), high[2] + 1.0)], axis=-1)
    hits = first_hits(scene, points.reshape(-1, 3) @ frame, np.broadcast_to(-frame[2], (points[..., 0].size, 3)))
    shape = hits.shape.reshape(points.shape[:2])
    extent = (x[0] - step / 2, x[-1] + step / 2, y[0] - step / 2, y[-1] + step / 2)
    with axes_for(ax, (1, 1), (_WIDTH_IN, _WIDTH_IN)) as grid:
        axes: Axes = grid[0, 0]
        axes.imshow(_shaded(hits, shape, frame), origin="lower", extent=extent, interpolation="antialiased", zorder=2)
        axes.set_aspect("equal")
        axes.set_axis_off()
        low_corner, high_corner = np.array(extent).reshape(2, 2).T
        label_columns(axes, _label_points(names, shape, x, y), low_corner, high_corner, longest=24)
        length = round_length(0.3 * (extent[1] - extent[0]))
        bottom = min(axes.get_ylim()[0], extent[2] - 0.15 * (extent[1] - extent[0]))
        axes.set_ylim(bottom, None)
        scale_bar(axes, (extent[0], bottom), length, f"{length:g} mm", 0.015 * (extent[1] - extent[0]))
        _directions(axes, frame, (extent[1], bottom), 0.09 * (extent[1] - extent[0]))
        hidden = len(names) - len(np.unique(shape[shape >= 0]))
        view = "from the front and above" if pose is None else "as the sensor sees them, to scale"
        if ax is None:
            across, tall = np.ptp(axes.get_xlim()), np.ptp(axes.get_ylim())
            figure_of(axes).set_figheight(min(_WIDTH_IN * tall / across, 9.0) + 0.4)
        axes.set_title(f"{len(names)} shapes, {view}" + (f"; {hidden} hidden" if hidden else ""))
    return axes


def _shaded(hits: Hits, shape: NDArray[np.int16], frame: Floats) -> Floats:
    """Return the picture (rows, columns, 4): a colour for each shape, shaded by its normal, with dark edges."""
    palette = np.array([to_rgb(SHAPES[i]) if i < len(SHAPES) else to_rgb(OTHER_SHAPE) for i in range(shape.max() + 2)])
    light = np.array([-0.4, 0.35, 0.85]) @ frame
    lit = np.clip(np.nan_to_num(hits.normal) @ (light / np.linalg.norm(light)), 0, 1).reshape(shape.shape)
    image = np.concatenate([palette[shape] * (0.45 + 0.55 * lit)[..., None], (shape >= 0)[..., None]], axis=-1)
    image[shape_edges(shape), :3] *= EDGE_SHADE
    return np.asarray(image)


def _label_points(names: tuple[str, ...], shape: NDArray[np.int16], x: Floats, y: Floats) -> dict[str, Floats]:
    """Return the point of each visible shape that is farthest from its edges, largest shapes first."""
    numbers, counts = np.unique(shape[shape >= 0], return_counts=True)
    points = {}
    for number in numbers[np.argsort(-counts, kind="stable")]:
        row, column = innermost_pixel(shape == number)
        points[names[number]] = np.array([x[column], y[row]])
    return points


def _directions(axes: Axes, frame: Floats, corner: tuple[float, float], size: float) -> None:
    """Draw the directions x, y and z of the world in a corner, each as long as it appears."""
    named: list[Floats] = []
    origin = np.array([corner[0] - 1.5 * size, corner[1] + 0.4 * size])
    for number, name in enumerate("xyz"):
        tip = origin + size * frame[:2, number]
        axes.annotate("", tuple(tip), tuple(origin), arrowprops={"arrowstyle": "->", "color": INK, "lw": 0.9})
        way = tip - origin
        beyond = tip + 0.3 * size * way / max(float(np.linalg.norm(way)), 0.2 * size)
        while any(np.linalg.norm(beyond - other) < 0.25 * size for other in named):
            beyond = beyond + np.array([0.25 * size, 0.0])  # two directions that look the same
        named.append(beyond)
        axes.text(float(beyond[0]), float(beyond[1]), name, ha="center", va="center", fontsize=8)
