"""Compare sensors: draw their performance maps side by side on one scale.

Signal chain: maps -> each at its knot nearest to the requested distance, or in the middle of its range -> discs of F
and of sigma, a row for each sensor and a column for each sample; and a strip of both over distance, normal and tilted.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

import numpy as np
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter
from numpy.typing import NDArray

from characterisation.files.errors import InputError
from characterisation.maps.performance_map import PerformanceMap
from characterisation.plots.discs import disc, disc_image, disc_view, noise_limits
from characterisation.plots.style import drawing
from characterisation.words.numbers import finish_name
from mitsim.report.figures import SCALES, colour_bar, matt_to_shiny

Sample = tuple[str, float]

#: largest incidence that is drawn [rad]
_LARGEST = math.radians(75)

#: tilts in the strip [deg], about the axis across the baseline; at 0 deg the highlight of a shiny surface saturates
TILTS_DEG = (0, 20, 40)


def common_samples(maps: Sequence[PerformanceMap]) -> list[Sample]:
    """Return the samples (finish, Ra [um]) of all maps, matt ones first, then by falling Ra."""
    every = dict.fromkeys(_key(sample) for performance_map in maps for sample in performance_map.samples)
    samples = [(name, float(roughness)) for name, roughness in every]
    return [samples[i] for i in matt_to_shiny(samples)]


def comparison_figure(
    maps: Sequence[PerformanceMap], quantity: Literal["fraction", "noise"], distance_mm: float | None = None
) -> Figure:
    """Draw discs over the orientation, a row for each map and a column for each sample, on one colour scale."""
    samples = common_samples(maps)
    limits = np.array([noise_limits(performance_map.data["ray_noise_std"].values) for performance_map in maps])
    norm = Normalize(0, 1) if quantity == "fraction" else LogNorm(float(limits[:, 0].min()), float(limits[:, 1].max()))
    variable = "recovered_fraction" if quantity == "fraction" else "ray_noise_std"
    colours, label, extend = SCALES[variable]
    with drawing():
        figure = Figure((1.75 * len(samples) + 1.1, 1.7 * len(maps) + 1.3), layout="constrained")
        grid = np.asarray(figure.subplots(len(maps), len(samples), squeeze=False))
        for number, (performance_map, row) in enumerate(zip(maps, grid, strict=True)):
            knot = nearest_distance(performance_map, distance_mm)
            for sample, axes in zip(samples, row, strict=True):
                index = _index(performance_map, sample)
                if index is None:
                    disc(axes, 2 * math.sin(_LARGEST / 2))
                else:
                    values = performance_map.data[variable].values[index, knot]
                    disc_image(axes, values, performance_map.data["a"].values, _LARGEST).set(norm=norm, cmap=colours)
                disc_view(axes, _LARGEST, labelled=number == 0)
                if number == 0:
                    axes.set_title(finish_name(*sample).replace(", ", "\n"), fontsize=8)
            distance = float(performance_map.data["distance"].values[knot])
            row[0].set_ylabel(f"{sensor_name(performance_map)}\n{distance:g} mm", labelpad=6, fontsize=7.5)
        colour_bar(figure, grid, norm, colours, label, extend)
    return figure


def strip_figure(maps: Sequence[PerformanceMap]) -> Figure:
    """Draw F and sigma over distance, a column for each sample and a line for each map, normal and tilted."""
    samples = common_samples(maps)
    cycle = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7f7f7f", "#8a6d00", "#333333"]
    with drawing():
        figure = Figure((2.1 * len(samples) + 0.8, 5.4), layout="constrained")
        upper, lower = np.asarray(figure.subplots(2, len(samples), squeeze=False, sharex=True, sharey="row"))
        for number, performance_map in enumerate(maps):
            low, high = performance_map.data["distance"].values[[0, -1]]
            distance = np.geomspace(low, high, 41)
            for sample, top, bottom in zip(samples, upper, lower, strict=True):
                if _index(performance_map, sample) is None:
                    continue
                for tilt, line in zip(TILTS_DEG, ("-", "--", ":"), strict=True):
                    normal = np.tile([0.0, math.sin(math.radians(tilt)), math.cos(math.radians(tilt))], (41, 1))
                    answer = performance_map.query(*sample, distance, normal)
                    style = {"ls": line, "color": cycle[number % len(cycle)], "lw": 1.1}
                    label = sensor_name(performance_map) if tilt == 0 else None
                    top.plot(distance, answer.fraction, **style, label=label)
                    # clouds without noise have sigma = 0, which a logarithmic scale cannot show
                    bottom.plot(distance, np.where(answer.sigma > 0, answer.sigma, np.nan), **style)
        for sample, top, bottom in zip(samples, upper, lower, strict=True):
            top.set_title(finish_name(*sample).replace(", ", "\n"), fontsize=8)
            top.set_ylim(-0.03, 1.03)
            bottom.set(xscale="log", yscale="log")
            if not any(np.isfinite(line.get_ydata()).any() for panel in lower for line in panel.lines):
                # matplotlib finds no limits if no map has a noise
                bottom.set_ylim(*noise_limits(maps[0].data["ray_noise_std"].values))
            bottom.set_xlabel("|V| [mm]")
            ticks = [300, 500, 1000, 2000, 4000]
            bottom.set_xticks(ticks, labels=[str(tick) for tick in ticks], fontsize=6.5)
            bottom.set_xticks([], minor=True)
        lower[0].yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        upper[0].set_ylabel("F [1]")
        lower[0].set_ylabel("σ [mm]")
        handles, labels = upper[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=5, fontsize=7)
        tilts = "{}° solid, {}° dashed, {}° dotted".format(*TILTS_DEG)
        figure.suptitle(f"over distance; tilted across the baseline by {tilts}", fontsize=9)
    return figure


def nearest_distance(performance_map: PerformanceMap, distance_mm: float | None) -> int:
    """Return the index of the knot nearest in ratio to a distance [mm], or to mid range if None is given."""
    knots: NDArray[np.float64] = performance_map.data["distance"].values.astype(float)
    target = math.sqrt(knots[0] * knots[-1]) if distance_mm is None else distance_mm
    return int(np.abs(np.log(knots / target)).argmin())


def check_distance(maps: Sequence[PerformanceMap], distance_mm: float) -> None:
    """Check that every map covers a distance |V| [mm].

    Raises InputError, naming the maps that do not cover it, and their ranges.
    """
    outside = []
    for performance_map in maps:
        near, far = map(float, performance_map.data["distance"].values[[0, -1]])
        if not near <= distance_mm <= far:
            outside.append(f"{sensor_name(performance_map)} from {near:g} to {far:g} mm")
    if outside:
        allowed = f"a distance that all maps cover; {', '.join(outside)}"
        hint = "omit those maps, or omit --distance to draw each map in the middle of its range"
        raise InputError("--distance", "", f"{distance_mm:g} mm", allowed, hint)


def sensor_name(performance_map: PerformanceMap) -> str:
    """Return the name of the sensor of a map."""
    return str(performance_map.data.attrs.get("sensor", "unnamed"))


def _index(performance_map: PerformanceMap, sample: Sample) -> int | None:
    samples = list(map(_key, performance_map.samples))
    return samples.index(_key(sample)) if _key(sample) in samples else None


def _key(sample: Sample) -> tuple[str, str]:
    return sample[0], f"{sample[1]}"  # as texts, NaN equals NaN
