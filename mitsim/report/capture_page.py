"""Write the page that compares a real with a simulated capture: images, histograms, residuals, statuses, table.

Signal chain: data of the specimen in either capture (:class:`~mitsim.twin.compare.captures_run.Shown`) -> one figure,
both captures on the same scales -> ``side_by_side.png`` and ``index.md``, Markdown.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from characterisation.files.atomic_io import write_text
from characterisation.plots.style import BLUE, FIELD, VERMILION, drawing
from characterisation.point_cloud import Status
from characterisation.words.numbers import percent
from mitsim.report.cloud_figures import REASONS
from mitsim.report.style import colour_scale, write_png
from mitsim.twin.compare.captures_run import Shown

#: percentile of |residual| at the ends of the colour scale, so that a few wrong matches do not set it
_RESIDUAL_PERCENTILE = 97.0

#: quantiles of the specimen's grey levels that are shown black and white
_STRETCH = (0.01, 0.995)

_DPI = 90

PICTURE = "side_by_side.png"


def write_capture_page(folder: Path, preamble: str, table: str, real: Shown, simulated: Shown) -> Path:
    """Write ``index.md`` and its picture into a folder, and return the path of the page.

    Parameters
    ----------
    folder, preamble, table, real, simulated
        The folder exists; the texts are Markdown.
    """
    write_png(capture_figure(real, simulated), folder / PICTURE, dpi=_DPI)
    page, picture = folder / "index.md", f"![Images, residuals, grey levels and statuses of both captures]({PICTURE})"
    note = (
        "`u` is the standard uncertainty of the difference, from a block bootstrap over patches. A quantity agrees "
        "if the difference is at most 2 u, or at most the margin."
    )
    write_text(page, f"# Simulated against real\n\n{preamble}\n{table}\n{picture}\n\n{note}\n")
    return page


def capture_figure(real: Shown, simulated: Shown) -> Figure:
    """Draw both captures side by side, each pair of pictures on one scale."""
    sides = (real, simulated)
    residuals = np.concatenate([np.abs(side.residual[np.isfinite(side.residual)]) for side in sides])
    reach = float(np.percentile(residuals, _RESIDUAL_PERCENTILE)) if len(residuals) else 1.0
    shares = np.cumsum(real.levels) / real.levels.sum()
    black, white = (int(np.searchsorted(shares, share)) for share in _STRETCH)
    tall = min(max(4.4 * real.image.shape[0] / real.image.shape[1], 1.4), 4.4)
    with drawing():
        figure = Figure((9.4, 2 * tall + 3.3), layout="constrained")
        axes = np.asarray(figure.subplots(3, 2, height_ratios=[tall, tall, 2.4]))
        for column, side in enumerate(sides):
            image, field = axes[0, column], axes[1, column]
            image.imshow(side.image, cmap="gray", vmin=black, vmax=max(white, black + 1))
            image.set_title(f"{side.name} ({side.source})")
            drawn = field.imshow(side.residual, cmap="RdBu_r", vmin=-reach, vmax=reach)
            field.set_facecolor(FIELD)
            for panel in (image, field):
                panel.set(xticks=[], yticks=[])
        # the residuals stay below their image
        colour_scale(figure, drawn, axes[1].tolist(), "residual along V [mm]", panchor=False)
        _histograms(axes[2, 0], sides)
        _statuses(axes[2, 1], sides)
    return figure


def _histograms(axes: Axes, sides: tuple[Shown, Shown]) -> None:
    last = max(int(np.flatnonzero(side.levels)[-1]) for side in sides) + 2
    # bins hold whole numbers of levels: other widths would alias with the integer levels
    step = max(-(-last // 128), 1)
    edges = np.arange(0, last + step, step) - 0.5
    for side, label in zip(sides, ("real", "simulated"), strict=True):
        padded = np.pad(side.levels[:last], (0, max(len(edges) * step - min(last, len(side.levels)), 0)))
        density = padded[: (len(edges) - 1) * step].reshape(-1, step).sum(axis=1) / (side.levels.sum() * step)
        if label == "real":
            axes.stairs(density, edges, fill=True, color=BLUE, alpha=0.45, label=label)
        else:
            axes.stairs(density, edges, color=VERMILION, label=label)
    axes.set(xlim=(0, float(edges[-1])), xlabel="grey level on the specimen [DN]", ylabel="density [1/DN]")
    axes.legend(loc="upper right")


def _statuses(axes: Axes, sides: tuple[Shown, Shown]) -> None:
    present = [status for status in Status if any(side.shares.get(status, 0) > 0 for side in sides)]
    for row, side in enumerate(sides):
        start = 0.0
        for status in present:
            share = side.shares.get(status, 0.0)
            words, colour = REASONS[status]
            both = " | ".join(percent(other.shares.get(status, 0.0)) for other in sides)
            axes.barh(row, share, left=start, color=colour, label=f"{words}: {both}" if row == 0 else None)
            start += share
    axes.set_yticks([0, 1], ["real", "simulated"])
    axes.invert_yaxis()
    axes.set(xlim=(0, 1), xlabel="share of the specimen's pixels [1]")
    axes.legend(loc="upper center", bbox_to_anchor=(0.45, -0.24), ncols=1, fontsize=7.5)
