"""Draw a measured cloud: its distances with the windows in it, or its difference from another cloud."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from characterisation.acceptance.cloud_difference import Difference
from characterisation.plots.style import BLUE, INK, SEQUENTIAL, VERMILION, drawing
from characterisation.point_cloud import PointCloud
from characterisation.region_of_interest import Roi
from mitsim.report.style import colour_scale, pixel_axes

#: percentile of |difference| at the ends of the colours, against outliers; chosen
_PERCENTILE = 98.0

#: robust deviations from the median at the ends of the colours, if that is less; chosen
_DEVIATIONS = 6.0


def distance_figure(cloud: PointCloud, windows: Mapping[str, Roi]) -> Figure:
    """Draw the distance from the sensor along each view ray [mm] over rows and columns, with the named windows."""
    distance = np.linalg.norm(cloud.points.astype(float) - cloud.grid.origin, axis=-1)
    distances = distance[np.isfinite(distance)]
    near, far = np.percentile(distances, [1, 99]) if len(distances) else (0.0, 1.0)
    with drawing():
        rows, columns = distance.shape
        figure = Figure((9.0, min(max(8.0 * rows / columns, 2.5), 9.0)), layout="constrained")
        axes = figure.subplots()
        pixel_axes(axes)
        drawn = axes.imshow(distance, cmap=SEQUENTIAL, vmin=near, vmax=max(far, near + 1e-6))
        colour_scale(figure, drawn, axes, "distance along the view ray [mm]")
        _outline(axes, windows)
    return figure


def difference_figure(
    difference: NDArray[np.float64], distribution: Difference, windows: Mapping[str, Roi], part: Roi | None = None
) -> Figure:
    """Draw the signed difference of every pixel, in the whole image or a part, and its histogram.

    Parameters
    ----------
    difference, distribution
        (H, W) [mm], NaN where a pixel has no counterpart, and its distribution.
    windows, part
        Windows to outline [px], by name; part of the image that is shown [px], None for all of it.
    """
    part = part or Roi.whole(difference.shape[1], difference.shape[0])
    values = difference[np.isfinite(difference)]
    reach = float(np.percentile(np.abs(values), _PERCENTILE)) if len(values) else 1.0
    if distribution.robust_deviation > 0:
        reach = min(reach, abs(distribution.median) + _DEVIATIONS * distribution.robust_deviation)
    reach = max(reach, 1e-6)
    with drawing():
        tall = min(max(7.4 * part.height / part.width, 2.0), 7.0)
        figure = Figure((9.0, tall + 1.9), layout="constrained")
        axes, histogram = figure.subplots(2, 1, height_ratios=[tall, 1.2])
        drawn = axes.imshow(difference, cmap="RdBu_r", vmin=-reach, vmax=reach)
        pixel_axes(axes)
        axes.set(xlim=(part.left - 0.5, part.right - 0.5), ylim=(part.bottom - 0.5, part.top - 0.5))
        colour_scale(figure, drawn, axes, "farther than the reference by [mm]")
        _outline(axes, windows)
        histogram.hist(np.clip(values, -1.5 * reach, 1.5 * reach), 121, color=BLUE)
        histogram.axvline(distribution.median, color=VERMILION, label=f"median {distribution.median:.3g} mm")
        histogram.set_xlabel("farther than the reference by [mm]; the end bins include all values beyond")
        histogram.set_ylabel("pixels")
        histogram.legend(loc="upper right")
    return figure


def _outline(axes: Axes, windows: Mapping[str, Roi]) -> None:
    for name, window in windows.items():
        corner = (window.left - 0.5, window.top - 0.5)
        axes.add_patch(Rectangle(corner, window.width, window.height, fill=False, edgecolor=VERMILION, linewidth=1.2))
        label = {"facecolor": "white", "edgecolor": VERMILION, "boxstyle": "square,pad=0.2"}
        axes.text(*corner, name, color=INK, va="bottom", fontsize=8.0, bbox=label, clip_on=True)
