"""Draw a quantity over the orientation of a surface, as a disc of normals in the equal-area projection.

At the centre the surface faces the sensor; to the right its normal leans along the baseline toward the second eye. The
rings are incidence angles.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colorbar import Colorbar
from matplotlib.colors import LogNorm, Normalize
from matplotlib.image import AxesImage
from matplotlib.patches import Circle
from numpy.typing import NDArray

from characterisation.plots.style import FIELD, INK, NOISE, SEQUENTIAL, figure_of

RINGS_DEG = (15, 30, 45, 60, 75)

#: percentiles of sigma at the ends of the colour scale
NOISE_PERCENTILES = (2, 95)


def noise_limits(sigma: NDArray[np.floating]) -> tuple[float, float]:
    """Return the ends of the colour scale of sigma [mm], at :data:`NOISE_PERCENTILES` of all positive values."""
    positive = sigma[np.isfinite(sigma) & (sigma > 0)]
    if not len(positive):
        return 0.1, 1.0
    low, high = (float(np.percentile(positive, p)) for p in NOISE_PERCENTILES)
    return (low, high) if high > 1.05 * low else (low / 1.05, high * 1.05)


def disc(axes: Axes, radius: float) -> Circle:
    """Turn axes into an empty disc about the origin, and return its circle for clipping."""
    limits = (-1.08 * radius, 1.08 * radius)
    axes.set(aspect="equal", xlim=limits, ylim=limits, xticks=[], yticks=[])
    for spine in axes.spines.values():
        spine.set_visible(False)
    circle = Circle((0, 0), radius, facecolor=FIELD, edgecolor="none", zorder=0)
    axes.add_patch(circle)
    return circle


def disc_image(axes: Axes, values: NDArray[np.floating], axis: NDArray[np.floating], largest: float) -> AxesImage:
    """Draw values at the nodes of a disc of normals.

    Parameters
    ----------
    axes, values, axis, largest
        Axes to draw into; values (b, a) at the nodes, NaN is left empty; nodes (n,) of both coordinates [1],
        equidistant, Lambert's equal-area projection; largest incidence [rad].
    """
    rim = disc(axes, 2 * math.sin(largest / 2))
    reach = float(axis[-1]) + float(axis[1] - axis[0]) / 2
    extent = (-reach, reach, -reach, reach)
    shown = axes.imshow(np.ma.masked_invalid(values), origin="lower", extent=extent, interpolation="none", zorder=1)
    shown.set_clip_path(rim)
    return shown


def disc_view(axes: Axes, largest: float, labelled: bool = True) -> None:
    """Draw rings of incidence angle and the direction of the baseline on a disc of normals up to ``largest`` [rad]."""
    angle = np.linspace(0, 2 * math.pi, 181)
    for ring in RINGS_DEG:
        if math.radians(ring) > largest + 0.03:
            continue
        radius = 2 * math.sin(math.radians(ring) / 2)
        axes.plot(radius * np.cos(angle), radius * np.sin(angle), color=INK, lw=0.4, alpha=0.45, zorder=2)
        if not labelled:
            continue
        x, y = radius * math.cos(math.radians(62)), radius * math.sin(math.radians(62))
        text = axes.text(x, y, f"{ring}°", fontsize=6, ha="center", va="center", zorder=4)
        text.set_bbox({"facecolor": "white", "alpha": 0.75, "edgecolor": "none", "pad": 0.6})
        text.set_color("#1c1c1c")  # the label's box is white in every page theme
    if not labelled:
        return
    rim = 2 * math.sin(largest / 2)
    arrow = {"arrowstyle": "->", "color": INK, "lw": 0.8, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", (rim, -1.06 * rim), (0.35 * rim, -1.06 * rim), annotation_clip=False, arrowprops=arrow)
    axes.text(0.32 * rim, -1.06 * rim, "baseline", fontsize=6.5, ha="right", va="center")


def plain_log_ticks(bar: Colorbar, low: float, high: float) -> None:
    """Label a logarithmic colour scale 0.1, 0.2, 0.5, 1 instead of with powers of ten."""
    steps = np.array([m * 10.0**e for e in range(-6, 7) for m in (1, 1.5, 2, 3, 5, 7)])
    ticks = steps[(steps >= low) & (steps <= high)]
    bar.set_ticks(ticks.tolist(), labels=[f"{tick:g}" for tick in ticks])
    bar.minorticks_off()


def draw_performance(
    pair: NDArray[np.object_],
    fraction: NDArray[np.floating],
    sigma: NDArray[np.floating],
    axis: NDArray[np.floating],
    largest: float,
    limits: tuple[float, float],
) -> None:
    """Draw F and sigma into two axes, on discs of normals.

    Parameters
    ----------
    pair, fraction, sigma, limits
        Axes (2,) of F and of sigma; F [1] and sigma [mm] (b, a) at the nodes; ends of the scale of sigma [mm].
    axis, largest
        As in :func:`disc_image`.
    """
    quantities = (
        (fraction, Normalize(0, 1), SEQUENTIAL, "fraction of points recovered F [1]", "neither"),
        (sigma, LogNorm(*limits), NOISE, "standard deviation along the ray σ [mm]", "both"),
    )
    for axes, (values, norm, colours, label, extend) in zip(pair, quantities, strict=True):
        shown = disc_image(axes, values, axis, largest)
        shown.set(norm=norm, cmap=colours)
        disc_view(axes, largest)
        place: dict[str, Any] = {"location": "bottom", "shrink": 0.85, "pad": 0.04}
        bar = figure_of(axes).colorbar(shown, ax=axes, label=label, extend=extend, **place)
        if isinstance(norm, LogNorm):
            plain_log_ticks(bar, *limits)
        bar.outline.set_visible(False)  # type: ignore[operator]
