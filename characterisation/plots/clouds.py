"""Draw an organised cloud as an image: a quantity where a pixel has a point, the reason where it has none."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.patches import Patch
from matplotlib.transforms import ScaledTranslation
from numpy.typing import NDArray

from characterisation.files.arrays import MEDIAN_TO_STD
from characterisation.plots.style import DIVERGING, FIELD, SEQUENTIAL, figure_of, side_bar

#: meaning and colour of each status, by name: Okabe and Ito's palette, and greys of different lightness
REASONS: dict[str, tuple[str, str]] = {
    "VALID": ("a point", "#009e73"),
    "NO_SURFACE": ("no surface visible", FIELD),
    "OUT_OF_RANGE": ("out of range, or outside the map", "#56b4e9"),
    "SATURATED": ("saturated", "#f0e442"),
    "LOW_MODULATION": ("low modulation", "#5b6b8c"),
    "SHADOWED": ("in the projector's shadow", "#2b2b2b"),
    "HIDDEN": ("hidden from the second camera, or rejected by it", "#d55e00"),
    "AMBIGUOUS": ("ambiguous match", "#cc79a7"),
    "PHASE_INCONSISTENT": ("phase inconsistent", "#9467bd"),
    "INTERREFLECTION": ("interreflection", "#8c564b"),
    "DROPPED": ("lost at random, 1 − F", "#e69f00"),
    "UNCALIBRATED": ("no unique ray by the calibration", "#0072b2"),
}

#: share of the points beyond each end of the colour scale with a predicted cloud beside it [%]; chosen
_BEYOND_PREDICTED = 0.5

#: the same for a cloud alone [%], since false matches can lie at any distance; chosen
_BEYOND = 2.0

#: distance of the legend from the picture: its ticks and label lie between [in]
_UNDER_IN = 0.42

#: end of the colour scale of residuals, in standard deviations by the median
_RESIDUAL_SIGMAS = 3.0


def depth_limits(values: NDArray[np.floating], beyond: float = _BEYOND_PREDICTED) -> tuple[float, float]:
    """Return the ends of a colour scale of depths or distances [mm]; ``beyond`` per cent lie outside each end."""
    finite = values[np.isfinite(values)]
    if not len(finite):
        return 0.0, 1.0
    near, far = (float(np.percentile(finite, p)) for p in (beyond, 100 - beyond))
    return (near, far) if far > near else (near - 0.5, far + 0.5)


def residual_limit(values: NDArray[np.floating]) -> float:
    """Return the end of a symmetric colour scale of residuals [mm]."""
    sizes = np.abs(values[np.isfinite(values)])
    limit = _RESIDUAL_SIGMAS * MEDIAN_TO_STD * float(np.median(sizes)) if len(sizes) else 0.0
    return limit if limit > 0 else 1.0


def draw_cloud(
    axes: Axes,
    values: NDArray[np.floating],
    status: NDArray[np.integer],
    names: Mapping[int, str],
    label: str,
    residual: bool = False,
) -> None:
    """Draw a quantity of the pixels (H, W) with a scale, and the status of all other pixels with a legend.

    Parameters
    ----------
    axes, values, label, residual
        To draw into; (H, W) [mm], NaN where a pixel has no point; label of their scale, that of a residual symmetric.
    status, names
        (H, W) number of each pixel's status, and names by number, as in :data:`REASONS`.
    """
    missing = ~np.isfinite(values)
    numbers = sorted(names)
    colours = ListedColormap([REASONS[names[number]][1] for number in numbers])
    steps = BoundaryNorm(np.append(np.array(numbers) - 0.5, numbers[-1] + 0.5), len(numbers))
    axes.imshow(np.ma.masked_array(status, ~missing), cmap=colours, norm=steps, interpolation="nearest")
    if residual:
        limit = residual_limit(values)
        low, high, scale = -limit, limit, DIVERGING
    else:
        low, high = depth_limits(values, _BEYOND)
        scale = SEQUENTIAL
    shown = axes.imshow(np.ma.masked_invalid(values), cmap=scale, vmin=low, vmax=high, interpolation="nearest")
    axes.set(xlabel="column [px]", ylabel="row [px]")
    side_bar(axes, shown, label)
    counts = np.bincount(status[missing].ravel(), minlength=numbers[-1] + 1)
    legend = []
    for number in np.argsort(-counts, kind="stable").tolist():
        if counts[number]:
            words, colour = REASONS[names[number]]
            legend.append(Patch(facecolor=colour, label=f"{words}: {100 * counts[number] / status.size:.2g} %"))
    if legend:
        under = axes.transAxes + ScaledTranslation(0, -_UNDER_IN, figure_of(axes).dpi_scale_trans)
        place: dict[str, Any] = {"loc": "upper left", "bbox_to_anchor": (0.0, 0.0), "bbox_transform": under}
        title: dict[str, Any] = {"title": "pixels without a point", "title_fontsize": 8.0, "alignment": "left"}
        axes.legend(handles=legend, borderaxespad=0.0, handlelength=1.1, **place, **title)
