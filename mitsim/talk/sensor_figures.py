"""Draw the figures of the talk's first seven slides: surfaces, coupons, noise, maps and their validation."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse, Patch
from numpy.typing import NDArray
from scipy import stats

from characterisation.files.arrays import Floats
from characterisation.lambert_projection import lambert_projection
from characterisation.maps.performance_map import PerformanceMap
from characterisation.plots.clouds import depth_limits, residual_limit
from characterisation.plots.discs import noise_limits, plain_log_ticks
from characterisation.plots.style import BLUE, DIVERGING, FIELD, INK, MUTED, NOISE, SEQUENTIAL, VERMILION, drawing
from characterisation.point_cloud import Status
from characterisation.words.numbers import finish_name
from mitsim.report.cloud_figures import REASONS, draw_status
from mitsim.report.figures import colour_bar, matt_to_shiny
from mitsim.report.style import colour_scale
from mitsim.talk.coupon_pieces import NO_POINT, STEP_MM
from mitsim.talk.noise_pieces import TwoNormals

#: largest gradient that is drawn: incidence of 68 deg
_GRADIENT = 2.5


def _bare(axes: Axes) -> None:
    axes.set(xticks=[], yticks=[])


def opening_figure(frames: Mapping[str, xr.Dataset]) -> Figure:
    """Draw the rendered frames of each sensor in a strip."""
    with drawing():
        shown = [(name, frame) for name, dataset in frames.items() for frame in dataset["frames"].values]
        across = min(len(shown), 6)
        down = -(-len(shown) // across)
        figure = Figure((1.85 * across, 1.6 * down))
        grid = np.asarray(figure.subplots(down, across, squeeze=False)).ravel()
        for axes in grid:
            axes.set_axis_off()
        before = ""
        for axes, (name, frame) in zip(grid, shown, strict=False):
            axes.imshow(frame, cmap="gray", vmin=0, vmax=255)
            if name != before:
                axes.set_title(name, loc="left", fontsize=8)
            before = name
        figure.subplots_adjust(0.004, 0.01, 0.996, 0.88, 0.02, 0.15)
    return figure


def surfaces_figure(datasets: Mapping[str, xr.Dataset]) -> Figure:
    """Draw image, cloud and status of the artefact in each finish."""
    with drawing():
        figure = Figure((3.1 * len(datasets), 7.3), layout="constrained")
        grid = np.asarray(figure.subplots(3, len(datasets), squeeze=False))
        depth = np.concatenate([dataset["depth"].values.ravel() for dataset in datasets.values()])
        low, high = depth_limits(depth[np.isfinite(depth)], 2.0)
        present: set[int] = set()
        for (name, dataset), (image, cloud, status) in zip(datasets.items(), grid.T, strict=True):
            image.imshow(dataset["image"].values, cmap="gray", vmin=0, vmax=255)
            image.set_title(f"{name}: {100 * share(dataset):.0f} % of the points")
            shown = cloud.imshow(np.ma.masked_invalid(dataset["depth"].values), cmap=SEQUENTIAL, vmin=low, vmax=high)
            cloud.set_facecolor(FIELD)
            draw_status(status, dataset["status"].values)
            present |= set(np.unique(dataset["status"].values).tolist())
            for axes in (image, cloud, status):
                _bare(axes)
        colour_scale(figure, shown, grid[1].tolist(), "depth [mm]", aspect=18)
        legend = [Patch(facecolor=REASONS[Status(s)][1], label=REASONS[Status(s)][0]) for s in sorted(present)]
        figure.legend(handles=legend, loc="outside lower center", ncols=3, handlelength=1.1)
    return figure


def share(dataset: xr.Dataset) -> float:
    """Return the share of possible points on the artefact's features that were recovered."""
    return float(dataset["points"].sum() / dataset["possible"].sum())


def gradient(x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Return the gradient space (N_x / N_z, N_y / N_z) of normals."""
    z = np.sqrt(np.maximum(1 - x**2 - y**2, 1e-9))
    return x / z, y / z


def _gradient_axes(axes: Axes, blinding: tuple[float, float] | None = None) -> None:
    angle = np.linspace(0, 2 * math.pi, 181)
    for ring in (20, 40, 60):
        radius = math.tan(math.radians(ring))
        axes.plot(radius * np.cos(angle), radius * np.sin(angle), color=MUTED, lw=0.5, zorder=1)
        axes.text(0, -radius, f"{ring}°", fontsize=6.5, ha="center", va="center", zorder=4, color=INK)
    if blinding is not None:
        axes.plot(*blinding, "+", ms=9, mew=1.6, color=VERMILION, zorder=5)
    axes.set(xlim=(-_GRADIENT, _GRADIENT), ylim=(-_GRADIENT, _GRADIENT), aspect="equal")
    axes.set(xlabel="N$_x$/N$_z$".replace("$", ""), ylabel="N$_y$/N$_z$".replace("$", ""))


def collection_figure(poses: xr.Dataset, cut: xr.Dataset, tilts: xr.Dataset, blinding: tuple[float, float]) -> Figure:
    """Draw the poses of the coupon in gradient space, a cloud cut into sub-clouds, and the area of these.

    Parameters
    ----------
    poses, cut, tilts
        Results of :mod:`~mitsim.talk.coupon_pieces`: ``characterised``, ``sub_clouds`` and ``tilts``.
    blinding
        Gradient of the surface that mirrors the projector into the camera.
    """
    with drawing():
        figure = Figure((10.6, 3.6), layout="constrained")
        left, middle, right = figure.subplots(1, 3, width_ratios=(1, 1.05, 0.95))
        level = poses["level"].values
        for number, colour, words in ((0, MUTED, "planned"), (1, BLUE, "added")):
            x, y = gradient(poses["shot_x"].values[level == number], poses["shot_y"].values[level == number])
            left.plot(x, y, "o", ms=2.6, color=colour, label=f"{words}: {len(x)}")
        _gradient_axes(left, blinding)
        left.legend(loc="upper right", handletextpad=0.1)
        left.set_title("poses; + self-blinding")
        middle.imshow(np.ma.masked_invalid(cut["depth"].values), cmap=SEQUENTIAL)
        middle.set_facecolor(FIELD)
        for row, column in zip(cut["row"].values, cut["column"].values, strict=True):
            middle.add_patch(Ellipse((float(column), float(row)), 12, 12, fc="none", ec="white", lw=0.7))
        _bare(middle)
        middle.set_title(f"sub-clouds at {cut.attrs['tilt_deg']:g}°, as the sensor sees them")
        tilt = tilts["tilt"].values
        ratio = tilts["solid_angle"].values / tilts["solid_angle"].values[0]
        right.plot(tilt, ratio, "o-", color=BLUE, label="projected area")
        right.plot(tilt, ratio / np.cos(np.radians(tilt)), "s--", ms=4, color=MUTED, label="area on the coupon")
        right.set(xlabel="tilt [deg]", ylabel="over that at 0 deg [1]", ylim=(0, None))
        right.legend()
    return figure


def processing_figure(tilts: xr.Dataset) -> Figure:
    """Draw F by three definitions, and sigma along V and along N, over the tilt."""
    with drawing():
        figure = Figure((8.2, 3.3), layout="constrained")
        left, right = figure.subplots(1, 2)
        tilt = tilts["tilt"].values
        for name, mark, words in (
            ("fraction_pixels", "o-", "points over pixels"),
            ("fraction_density", "x--", "density over the possible one"),
            ("fraction_reference", "s:", "points over those on matt white"),
        ):
            left.plot(tilt, tilts[name].values, mark, ms=4.5, label=words)
        left.set(xlabel="tilt [deg]", ylabel="F [1]", ylim=(-0.03, 1.08))
        left.legend(loc="lower left")
        right.plot(tilt, tilts["along_ray"].values, "o-", color=BLUE, label="along V")
        right.plot(tilt, tilts["along_normal"].values, "s--", color=VERMILION, label="along N")
        right.set(xlabel="tilt [deg]", ylabel="σ on matt white [mm]", ylim=(0, None))
        right.legend(loc="best")
    return figure


def noise_figure(datasets: Mapping[str, xr.Dataset]) -> Figure:
    """Draw the residuals of each sensor as a picture, and their histogram with the normal curve."""
    with drawing():
        figure = Figure((2.65 * len(datasets), 5.0), layout="constrained")
        grid = np.asarray(figure.subplots(2, len(datasets), squeeze=False))
        for (name, dataset), (picture, curve) in zip(datasets.items(), grid.T, strict=True):
            limit = residual_limit(dataset["image"].values)
            shown = picture.imshow(dataset["image"].values, cmap=DIVERGING, vmin=-limit, vmax=limit)
            picture.set_facecolor(FIELD)
            _bare(picture)
            picture.set_title(name, fontsize=8.5)
            colour_scale(figure, shown, picture, "residual along V [mm]", location="bottom", aspect=16)
            middle, sigma = dataset["middle"].values.astype(float), dataset.attrs["sigma"]
            curve.fill_between(middle, dataset["histogram"].values, step="mid", color=BLUE, alpha=0.4, lw=0)
            curve.plot(middle, stats.norm.pdf(middle, 0, sigma), color=INK, lw=1.2, label="normal")
            if dataset.attrs["two"]:
                both = TwoNormals(dataset.attrs["narrow"], dataset.attrs["wide"], dataset.attrs["share"])
                curve.plot(middle, both.density(middle), "--", color=VERMILION, lw=1.2, label="sum of two")
            kurtosis = f"{dataset.attrs['kurtosis']:+.2f}".replace("-", "−")
            curve.set_title(f"σ {sigma:.2g} mm, kurtosis {kurtosis}", fontsize=8.5)
            curve.set(xlabel="residual [mm]", yticks=[])
            curve.legend(fontsize=7, loc="upper right", handlelength=1.2)
    return figure


def results_figure(characterised: xr.Dataset, blinding: tuple[float, float]) -> Figure:
    """Draw samples, F and sigma in gradient space for one coupon at one distance, with the named regions."""
    with drawing():
        figure = Figure((10.4, 3.7), layout="constrained")
        panels = figure.subplots(1, 3)
        x, y = gradient(characterised["patch_x"].values.astype(float), characterised["patch_y"].values.astype(float))
        panels[0].plot(x, y, ".", ms=1.6, color=BLUE)
        panels[0].set_title(f"{characterised.attrs['patches']:,} point cloud samples".replace(",", " "))
        sigma = characterised["ray_noise_std"].values
        norms = (Normalize(0, 1), LogNorm(*noise_limits(sigma)))
        inside = _in_gradient_space(characterised["a"].values.astype(float))
        for axes, values, norm, colours, label in (
            (panels[1], characterised["recovered_fraction"].values, norms[0], SEQUENTIAL, "F [1]"),
            (panels[2], sigma, norms[1], NOISE, "σ [mm]"),
        ):
            image, extent = np.ma.masked_invalid(values[inside]), (-_GRADIENT, _GRADIENT) * 2
            shown = axes.imshow(image, origin="lower", extent=extent, norm=norm, cmap=colours)
            bar = colour_scale(figure, shown, axes, label, extend="neither", shrink=0.8)
            if isinstance(norm, LogNorm):
                plain_log_ticks(bar, float(norm.vmin or 0), float(norm.vmax or 1))
        for axes in panels:
            _gradient_axes(axes, blinding if axes is not panels[2] else None)
        arrow = {"arrowstyle": "->", "color": INK}
        box = {"facecolor": "white", "alpha": 0.8, "edgecolor": "none", "pad": 1.0}
        for words, target, at in (
            ("self-blinding", blinding, (1.2, 1.0)),
            ("adverse scattering", (0.0, -2.1), (1.2, -1.3)),
        ):
            panels[1].annotate(words, target, at, arrowprops=arrow, bbox=box, fontsize=8, ha="center", zorder=6)
    return figure


def _in_gradient_space(axis: Floats) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the nodes (b, a) of a map's equal-area grid at a regular grid of gradients."""
    steps = np.linspace(-_GRADIENT, _GRADIENT, 201)
    x, y = np.meshgrid(steps, steps)
    normals = np.stack([x, y, np.ones_like(x)], axis=-1)
    positions = lambert_projection(normals / np.linalg.norm(normals, axis=-1, keepdims=True))
    step = axis[1] - axis[0]
    nodes = np.clip(np.rint((positions - axis[0]) / step), 0, len(axis) - 1).astype(np.int64)
    return nodes[..., 1], nodes[..., 0]


def maps_figure(performance_map: PerformanceMap) -> Figure:
    """Draw F and sigma of every sample (down) and distance (across) as small discs of normals."""
    data = performance_map.data
    order, distances = matt_to_shiny(performance_map.samples), data["distance"].values
    axis = data["a"].values
    reach = float(axis[-1])
    with drawing():
        figure = Figure((1.3 * 2 * len(distances) + 0.4, 1.3 * len(order) + 1.1), layout="constrained")
        grid = np.asarray(figure.subplots(len(order), 2 * len(distances), squeeze=False))
        sigma = data["ray_noise_std"].values
        for first, values, norm, colours, label in (
            (0, data["recovered_fraction"].values, Normalize(0, 1), SEQUENTIAL, "F [1]"),
            (len(distances), sigma, LogNorm(*noise_limits(sigma)), NOISE, "σ [mm]"),
        ):
            block = grid[:, first : first + len(distances)]
            for row, sample in enumerate(order):
                for column, distance in enumerate(distances):
                    axes = block[row, column]
                    shown = np.ma.masked_invalid(values[sample, column])
                    axes.imshow(shown, origin="lower", extent=(-reach, reach) * 2, norm=norm, cmap=colours)
                    _bare(axes)
                    for spine in axes.spines.values():
                        spine.set_visible(False)
                    if row == 0:
                        axes.set_title(f"{distance:g} mm", fontsize=8)
                    if first == 0 and column == 0:
                        name = finish_name(*performance_map.samples[sample]).split(", ")[-1]
                        axes.set_ylabel(name, fontsize=8)
            colour_bar(figure, block, norm, colours, label, "both" if isinstance(norm, LogNorm) else "neither")
    return figure


def validation_figure(clouds: xr.Dataset, cells: Sequence[tuple[str, float, xr.Dataset]], shown: str) -> Figure:
    """Draw captured and drawn cloud of the shown sample, its F and sigma over incidence, and the residuals of all.

    ``cells`` are the name of a sample, the distance and the result of the validation.
    """
    with drawing():
        figure = Figure((10.4, 6.3), layout="constrained")
        axes = figure.subplot_mosaic([["captured", "drawn", "F", "sigma"], ["rF", "rF", "rs", "rs"]])
        pictures = {
            name: np.where(clouds[name].values == NO_POINT, np.nan, STEP_MM * clouds[name].values.astype(float))
            for name in ("captured", "drawn")
        }
        limit = residual_limit(np.concatenate([residuals.ravel() for residuals in pictures.values()]))
        for name, residuals in pictures.items():
            picture = axes[name].imshow(residuals, cmap=DIVERGING, vmin=-limit, vmax=limit)
            axes[name].set_facecolor(FIELD)
            axes[name].set_title(f"{shown} at {clouds.attrs['distance_mm']:g} mm: {name}", fontsize=8.5)
            _bare(axes[name])
        colour_scale(figure, picture, [axes["captured"], axes["drawn"]], "off the plane [mm]", location="bottom")
        residuals_of = {(name, distance): dataset for name, distance, dataset in cells}
        if (dataset := residuals_of.get((shown, clouds.attrs["distance_mm"]))) is not None:
            order = np.argsort(dataset["incidence"].values)
            incidence = np.degrees(dataset["incidence"].values[order])
            for key, name, label in (("F", "fraction", "F [1]"), ("sigma", "sigma", "σ [mm]")):
                captured, drawn = (dataset[f"{name}_{side}"].values[order] for side in ("measured", "predicted"))
                axes[key].plot(incidence, captured, "o-", ms=4, color=BLUE, label="captured")
                axes[key].plot(incidence, drawn, "x--", color=VERMILION, label="from the map")
                axes[key].set(xlabel="incidence [deg]", ylabel=label, ylim=(0, None))
        axes["F"].legend(loc="best")
        names = list(dict.fromkeys(name for name, _, _ in cells))
        distances = sorted({distance for _, distance, _ in cells})
        width = 0.8 / len(distances)
        for key, name, label in (
            ("rF", "fraction_residual", "mean |residual| of F [%]"),
            ("rs", "sigma_residual", "mean |residual| of σ [%]"),
        ):
            for number, distance in enumerate(distances):
                found = [residuals_of.get((sample, distance)) for sample in names]
                values = [math.nan if dataset is None else 100 * float(dataset[name]) for dataset in found]
                positions = np.arange(len(names)) + (number - (len(distances) - 1) / 2) * width
                axes[key].bar(positions, values, 0.92 * width, label=f"{distance:g} mm", color=f"C{number}")
            axes[key].axhline(10, color=VERMILION, lw=1)
            axes[key].set_xticks(range(len(names)), names)
            axes[key].set(ylabel=label, ylim=(0, max(13.0, axes[key].get_ylim()[1])))
        axes["rF"].legend(loc="upper left")
    return figure


def light_figure(pairs: Mapping[str, tuple[xr.Dataset, xr.Dataset]]) -> Figure:
    """Draw captured over expected F of the artefact's features, in direct light alone and in all light, by sample."""
    with drawing():
        figure = Figure((2.1 * len(pairs) + 0.5, 2.9), layout="constrained")
        row = np.asarray(figure.subplots(1, len(pairs), squeeze=False, sharey=True))[0]
        for axes, (name, pair) in zip(row, pairs.items(), strict=True):
            for dataset, mark, colour, words in zip(pair, "ox", (MUTED, VERMILION), ("direct", "all"), strict=True):
                axes.plot(*fractions(dataset), mark, ms=4.5, color=colour, label=f"{words} light")
            axes.plot([0, 1], [0, 1], color=INK, lw=0.6)
            axes.set(xlim=(-0.04, 1.04), ylim=(-0.04, 1.04), aspect="equal", xlabel="F from the map")
            axes.set_title(name)
        row[0].set_ylabel("F captured")
        row[0].legend(loc="upper left", handletextpad=0.1)
    return figure


def fractions(dataset: xr.Dataset) -> tuple[Floats, Floats]:
    """Return expected and captured F of the features of some views, of those with 100 possible points or more."""
    enough = dataset["possible"].values >= 100
    possible = dataset["possible"].values[enough]
    return dataset["expected"].values[enough] / possible, dataset["points"].values[enough] / possible
