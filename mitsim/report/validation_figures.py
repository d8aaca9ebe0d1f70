"""Draw pictures and tables of how well a map predicts captures that it was not made from."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from characterisation.maps.validation import Pair, within_limits
from characterisation.plots.style import BLUE, VERMILION, drawing
from characterisation.words.numbers import finish_name

#: residuals are drawn up to this many standard deviations
HISTOGRAM_REACH = 4.0


def agreement_figure(pairs: Sequence[Pair]) -> Figure:
    """Draw F and sigma of every capture of one sample over incidence, and the residuals along V, for each distance."""
    distances = sorted({pair.distance for pair in pairs})
    with drawing():
        figure = Figure((2.4 * len(distances) + 0.6, 6.2), layout="constrained")
        grid = np.asarray(figure.subplots(3, len(distances), squeeze=False, sharey="row"))
        for column, distance in enumerate(distances):
            here = [pair for pair in pairs if pair.distance == distance]
            incidence = np.degrees([pair.incidence for pair in here])
            top, middle, bottom = grid[:, column]
            top.set_title(f"|V| = {distance:g} mm")
            for axes, name in ((top, "fraction"), (middle, "sigma")):
                measured = [getattr(pair.measured, name) for pair in here]
                predicted = [getattr(pair.predicted, name) for pair in here]
                axes.plot(incidence, measured, "o", ms=3.5, color=BLUE, label="captured")
                axes.plot(incidence, predicted, "x", ms=4.5, mew=1.0, color=VERMILION, label="from the map")
                axes.set_xlabel("incidence [deg]")
            top.set_ylim(-0.03, 1.06)
            _histograms(bottom, here)
        grid[0, 0].set_ylabel("F [1]")
        grid[1, 0].set_ylabel("sigma [mm]")
        grid[2, 0].set_ylabel("density [1]")
        grid[0, 0].legend(loc="lower left")
        figure.suptitle(finish_name(pairs[0].finish, pairs[0].roughness), fontsize=10)
    return figure


def _histograms(axes: Axes, pairs: Sequence[Pair]) -> None:
    both = [p for p in pairs if math.isfinite(p.measured.sigma) and math.isfinite(p.predicted.sigma)]
    bins = np.linspace(-HISTOGRAM_REACH, HISTOGRAM_REACH, 65).tolist()
    if both:
        measured = np.concatenate([p.measured_residuals / p.measured.sigma for p in both])
        predicted = np.concatenate([p.predicted_residuals / p.measured.sigma for p in both])
        axes.hist(measured, bins=bins, density=True, color=BLUE, alpha=0.45)
        axes.hist(predicted, bins=bins, density=True, histtype="step", color=VERMILION)
    axes.set_xlabel("residual along V / sigma [1]")


def validation_table(table: xr.Dataset) -> str:
    """Return a Markdown table with a row for each sample and distance."""
    lines = [
        "| sample | \\|V\\| [mm] | poses | F: residual (floor) | bias | sigma, by points: residual (floor) | bias "
        "| by poses | Wasserstein | holds |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    kept = within_limits(table)
    for row in range(table.sizes["row"]):
        cells = {str(name): values.values[row] for name, values in table.data_vars.items()}
        name = finish_name(str(cells["finish"]), float(cells["roughness"]))
        lines.append(
            f"| {name} | {cells['distance']:g} | {cells['captures']} | {cells['fraction_residual']:.3f} "
            f"({cells['fraction_floor']:.3f}) | {cells['fraction_bias']:+.3f} | {100 * cells['sigma_residual']:.1f} % "
            f"({100 * cells['sigma_floor']:.1f}) | {100 * cells['sigma_bias']:+.1f} % | "
            f"{100 * cells['sigma_residual_captures']:.1f} % | {cells['wasserstein']:.3f} | "
            f"{'yes' if kept[row] else 'no'} |"
        )
    return "\n".join(lines) + "\n"
