"""Pictures of a measured cloud: its distances with the windows in it, or its difference from another."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from characterisation.acceptance.cloud_difference import Difference
from characterisation.point_cloud import PointCloud
from mitsim.report.style import BLUE, FIELD, INK, SEQUENTIAL, VERMILION, drawing

#: (column, row, width, height) [px] of a window
Box = tuple[int, int, int, int]

#: percentile of |difference| that ends the colours
_PERCENTILE = 98.0


def distance_figure(cloud: PointCloud, windows: Mapping[str, Box]) -> Figure:
    """Distance from the sensor along each view ray [mm], with rows and columns, and windows by name."""
    distance = np.linalg.norm(cloud.points.astype(float) - cloud.grid.origin, axis=-1)
    known = distance[np.isfinite(distance)]
    near, far = np.percentile(known, [1, 99]) if len(known) else (0.0, 1.0)
    with drawing():
        figure, axes = _picture(distance.shape)
        drawn = axes.imshow(distance, cmap=SEQUENTIAL, vmin=near, vmax=max(far, near + 1e-6))
        bar = figure.colorbar(drawn, ax=axes, label="distance along the view ray [mm]", extend="both", pad=0.01)
        bar.outline.set_visible(False)  # type: ignore[operator]
        _outline(axes, windows, "white")
    return figure


def difference_figure(difference: NDArray[np.float64], found: Difference, windows: Mapping[str, Box]) -> Figure:
    """Signed difference [mm] of every pixel, and its histogram."""
    known = difference[np.isfinite(difference)]
    reach = float(np.percentile(np.abs(known), _PERCENTILE)) if len(known) else 1.0
    reach = max(reach, 1e-6)
    with drawing():
        tall = min(max(7.4 * difference.shape[0] / difference.shape[1], 2.0), 7.0)
        figure = Figure((9.0, tall + 1.9), layout="constrained")
        axes, histogram = figure.subplots(2, 1, height_ratios=[tall, 1.2])
        drawn = axes.imshow(difference, cmap="RdBu_r", vmin=-reach, vmax=reach)
        axes.set_facecolor(FIELD)
        axes.set_xlabel("column [px]")
        axes.set_ylabel("row [px]")
        bar = figure.colorbar(drawn, ax=axes, label="farther than the reference by [mm]", extend="both", pad=0.01)
        bar.outline.set_visible(False)  # type: ignore[operator]
        _outline(axes, windows, INK)
        histogram.hist(np.clip(known, -1.5 * reach, 1.5 * reach), 121, color=BLUE)
        histogram.axvline(found.median, color=VERMILION, label=f"median {found.median:.3g} mm")
        histogram.set_xlabel("farther than the reference by [mm]; the ends hold all beyond")
        histogram.set_ylabel("pixels")
        histogram.legend(loc="upper right")
    return figure


def _picture(shape: tuple[int, ...]) -> tuple[Figure, Axes]:
    figure = Figure((9.0, min(max(8.0 * shape[0] / shape[1], 2.5), 9.0)), layout="constrained")
    axes = figure.subplots()
    axes.set_facecolor(FIELD)
    axes.set_xlabel("column [px]")
    axes.set_ylabel("row [px]")
    return figure, axes


def _outline(axes: Axes, windows: Mapping[str, Box], colour: str) -> None:
    for name, (column, row, width, height) in windows.items():
        axes.add_patch(Rectangle((column - 0.5, row - 0.5), width, height, fill=False, edgecolor=colour, linewidth=1.0))
        axes.text(column + 4, row + 4, name, color=colour, va="top", fontsize=8.0)
