"""Define the style of all figures: colours, text, and axes for the ``plot`` methods."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from copy import copy
from typing import Any

import numpy as np
from matplotlib import rcParams
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure
from numpy.typing import NDArray

from characterisation.files.errors import InputError

#: colour of text; a page may replace it and the next four
INK = "#1a1c20"

#: colour of muted lines
MUTED = "#6a7079"

#: colour of areas without data
FIELD = "#e3e5e9"

#: colour of the background
PAPER = "#fdfdfc"

#: colour of points
BLUE = "#0072b2"

#: for highlights (Okabe and Ito's palette, as is BLUE)
VERMILION = "#d55e00"

#: Okabe and Ito's palette, safe for colour-blind readers; shapes without a colour of their own are grey
SHAPES = ("#e69f00", "#56b4e9", "#009e73", "#f0e442", "#0072b2", "#d55e00", "#cc79a7")
OTHER_SHAPE = "#9a9fa8"

#: colour map whose order colour-blind readers can see
SEQUENTIAL = "viridis"

#: such a map for noise, other than the first
NOISE = "cividis"

#: such a map with a middle
DIVERGING = "RdBu_r"

#: ``text.parse_math`` is off, since names of features and measurements are text, not formulae
STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 9.0,
    "axes.titlesize": 9.5,
    "axes.titleweight": "normal",
    "text.parse_math": False,
    "text.color": INK,
    "axes.edgecolor": MUTED,
    "axes.labelcolor": INK,
    "axes.titlecolor": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.7,
    "axes.facecolor": "none",
    "figure.facecolor": "none",
    "legend.frameon": False,
    "legend.fontsize": 8.0,
    "image.interpolation": "none",
    "svg.fonttype": "path",
    "svg.hashsalt": "mitsim",
    "axes.unicode_minus": True,
}


@contextmanager
def drawing() -> Iterator[None]:
    """Draw every figure within this context.

    Only the settings of :data:`STYLE` are put back. ``rc_context`` puts back all, among them ``interactive``, which a
    notebook's backend sets when the first figure is made; no later figure would then be shown.
    """
    before = {key: copy(rcParams[key]) for key in STYLE}
    rcParams.update(STYLE)
    try:
        yield
    finally:
        rcParams.update(before)


@contextmanager
def axes_for(
    ax: Any, shape: tuple[int, int], size_in: tuple[float, float], **subplots: Any
) -> Iterator[NDArray[np.object_]]:
    """Yield (rows, columns) axes to draw into, within :func:`drawing`.

    Raises InputError if ``ax`` has another number of axes.

    Parameters
    ----------
    ax
        Axes of the caller, one or an array of as many as ``shape`` has; None for a new figure of pyplot, which a
        notebook shows.
    shape, size_in, subplots
        Rows and columns, width and height [in], and further arguments of a new figure.
    """
    with drawing():
        if ax is None:
            import matplotlib.pyplot as plt  # loads a backend, which callers with axes of their own have chosen

            figure, grid = plt.subplots(*shape, figsize=size_in, layout="compressed", squeeze=False, **subplots)
            figure.set_facecolor("white")  # a notebook with a dark page would hide dark text
            yield np.asarray(grid)
            return
        array = np.atleast_1d(np.asarray(ax, object)).ravel()
        if len(array) != shape[0] * shape[1] or not all(isinstance(item, Axes) for item in array):
            found = f"{len(array)} axes" if all(isinstance(item, Axes) for item in array) else type(ax).__name__
            raise InputError("plot", "ax", found, f"{shape[0] * shape[1]} of matplotlib's Axes, or None")
        yield array.reshape(shape)


def figure_of(axes: Axes) -> Figure:
    """Return the whole figure that axes belong to."""
    figure = axes.get_figure(root=True)
    assert figure is not None
    return figure


def side_bar(axes: Axes, shown: ScalarMappable, label: str) -> None:
    """Add a colour scale to the right of axes, as high as they are, for values that may lie beyond its ends."""
    bar = figure_of(axes).colorbar(shown, cax=axes.inset_axes((1.02, 0.0, 0.03, 1.0)), label=label, extend="both")
    low, high = sorted((shown.norm.vmin or 0.0, shown.norm.vmax or 1.0))
    bar.set_ticks([tick for tick in bar.get_ticks() if low <= tick <= high])  # others would be drawn at the ends
    bar.outline.set_visible(False)  # type: ignore[operator]


def bare(axes: Axes) -> None:
    """Remove ticks from axes, and draw a frame around them in the proportions of the data."""
    axes.set(xticks=[], yticks=[], aspect="equal")
    for spine in axes.spines.values():
        spine.set(visible=True, color=MUTED)
