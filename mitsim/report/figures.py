"""Draw a performance map, and the patches behind it, over the orientation of the surface.

All pictures are discs as the sensor sees them. At the centre the surface faces the sensor; to the right its normal
leans along the baseline toward the second eye.

The discs are equal-area projections, in which the map is also stored; their rings are incidence angles. The talk draws
gradient space (N_x/N_z, N_y/N_z), which diverges toward grazing incidence: at 75 deg its radius is 3.7, so the centre,
where most of the map lies, would be tiny.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray

from characterisation.lambert_projection import lambert_projection
from characterisation.maps.performance_map import PerformanceMap
from characterisation.plots.discs import disc_image, disc_view, noise_limits, plain_log_ticks
from characterisation.plots.style import FIELD, NOISE, SEQUENTIAL, drawing
from characterisation.words.numbers import count, finish_name
from mitsim.report.findings import incidence_of_nodes
from mitsim.report.style import colour_scale, write_png

#: colours of the quantities of a map, the labels of their scales, and the ends beyond which values lie
SCALES = {
    "recovered_fraction": (SEQUENTIAL, "fraction of points recovered F [1]", "neither"),
    "ray_noise_std": (NOISE, "standard deviation along the view ray σ [mm], without outliers", "both"),
}

#: cells across a disc in which patches are counted
_CELLS = 61


def write_map_figures(performance_map: PerformanceMap, folder: Path) -> list[Path]:
    """Write ``map_fraction.png`` and ``map_noise.png`` into a folder, and return their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    return [
        write_png(fraction_figure(performance_map), folder / "map_fraction.png"),
        write_png(noise_figure(performance_map), folder / "map_noise.png"),
    ]


def matt_to_shiny(samples: list[tuple[str, float]]) -> list[int]:
    """Return the order in which samples are drawn: those without Ra first, then by falling Ra."""
    return sorted(range(len(samples)), key=lambda i: (not math.isnan(samples[i][1]), samples[i][0], -samples[i][1]))


def fraction_figure(performance_map: PerformanceMap) -> Figure:
    """Draw F over the orientation, a disc for each sample (across) and distance (down); all colours run from 0 to 1."""
    return _map_figure(performance_map, "recovered_fraction", Normalize(0, 1))


def noise_figure(performance_map: PerformanceMap) -> Figure:
    """Draw sigma [mm] over the orientation as in :func:`fraction_figure`, on one logarithmic scale."""
    norm = LogNorm(*noise_limits(performance_map.data["ray_noise_std"].values))
    return _map_figure(performance_map, "ray_noise_std", norm)


def _map_figure(performance_map: PerformanceMap, name: str, norm: Normalize) -> Figure:
    data, (colours, label, extend) = performance_map.data, SCALES[name]
    order, distances = matt_to_shiny(performance_map.samples), data["distance"].values
    covered = np.isfinite(data["recovered_fraction"].values).any(axis=(0, 1))
    incidence = incidence_of_nodes(performance_map)
    largest = float(incidence[covered].max()) if covered.any() else math.radians(75)
    axis = data["a"].values.astype(float)
    with drawing():
        width = max(2.35 * len(order) + 0.7, 5.5)
        figure = Figure((width, 2.25 * len(distances) + 1.45), layout="constrained")
        grid = np.asarray(figure.subplots(len(distances), len(order), squeeze=False))
        for row, distance in enumerate(distances):
            for column, sample in enumerate(order):
                axes = grid[row, column]
                disc_image(axes, data[name].values[sample, row], axis, largest).set(norm=norm, cmap=colours)
                disc_view(axes, largest)
                if row == 0:
                    axes.set_title(finish_name(*performance_map.samples[sample]).replace(", ", "\n"))
                if column == 0:
                    axes.set_ylabel(f"|V| = {distance:g} mm", labelpad=6)
        colour_bar(figure, grid, norm, colours, label, extend)
        legend = [Patch(facecolor=FIELD, label="no value (not measured, or no point returned)")]
        figure.legend(handles=legend, loc="outside lower right")
    return figure


def colour_bar(
    figure: Figure, grid: NDArray[np.object_], norm: Normalize, colours: str | Colormap, label: str, extend: str
) -> None:
    """Add one labelled colour scale below all axes of a figure.

    Parameters
    ----------
    figure, grid, norm, colours, label, extend
        ``extend``: ends beyond which values lie, ``neither``, ``both`` or ``max``.
    """
    mappable, below = ScalarMappable(norm=norm, cmap=colours), {"location": "bottom", "aspect": 45, "shrink": 0.75}
    bar = colour_scale(figure, mappable, grid.ravel().tolist(), label, extend=extend, pad=0.03, **below)
    if isinstance(norm, LogNorm):
        plain_log_ticks(bar, float(norm.vmin or 0), float(norm.vmax or 1))


def patches_figure(patches: xr.Dataset) -> Figure:
    """Draw the number of patches measured at each orientation, over all distances, a disc for each sample."""
    normal = np.stack([patches["normal_x"].values, patches["normal_y"].values], axis=-1)
    n_z = np.sqrt(np.maximum(1 - (normal**2).sum(-1), 0))
    positions = lambert_projection(np.concatenate([normal, n_z[:, None]], axis=-1))
    finishes, roughness = patches["finish"].values.astype(str), patches["roughness"].values.astype(float)
    samples = list(zip(finishes.tolist(), roughness.tolist(), strict=True))
    number = patches["sample_number"].values
    largest = float(np.arccos(n_z.min())) if len(n_z) else math.radians(75)
    reach = 2 * math.sin(largest / 2)
    edges = np.linspace(-reach, reach, _CELLS + 1)
    of_samples = [positions[number == sample] for sample in range(len(samples))]
    counts = [np.histogram2d(mine[:, 1], mine[:, 0], bins=(edges, edges))[0] for mine in of_samples]
    norm = LogNorm(1, max(2.0, max((c.max() for c in counts), default=2.0)))
    with drawing():
        figure = Figure((max(2.35 * len(samples) + 0.4, 5.5), 4.0), layout="constrained")
        grid = np.asarray(figure.subplots(1, max(len(samples), 1), squeeze=False))
        for axes, sample in zip(grid[0], matt_to_shiny(samples), strict=False):
            seen = np.where(counts[sample] > 0, counts[sample], np.nan)
            disc_image(axes, seen, (edges[1:] + edges[:-1]) / 2, largest).set(norm=norm, cmap=SEQUENTIAL)
            disc_view(axes, largest)
            title = finish_name(*samples[sample]).replace(", ", "\n")
            axes.set_title(f"{title}\n{count(int(counts[sample].sum()))} patches")
        colour_bar(figure, grid, norm, SEQUENTIAL, "patches in a cell of equal solid angle [1]", "neither")
    return figure
