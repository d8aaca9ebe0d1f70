"""Draw the pictures and the table of sensors' data sheets."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from characterisation.files.errors import InputError
from characterisation.plots.style import BLUE, FIELD, INK, MUTED, VERMILION, drawing
from characterisation.point_cloud import PointCloud, Status
from characterisation.words.numbers import two_digits
from mitsim.capture.capture import Capture
from mitsim.capture.picture import STRETCH_EXPONENT
from mitsim.maps.data_sheet import DataSheet, Recovery
from mitsim.report.cloud_figures import REASONS, draw_status
from mitsim.report.style import plain_log
from mitsim.sensor.preset_covariance import preset_covariance

_LINES = ("-", "--", ":", "-.")

#: distance at which the rays of a cloud are projected into the image [mm]; its origin is that of the camera
_FAR_MM = 1000.0

#: meaning of dark pixels in a picture of the gallery
_DARK = (
    "black in the image: no light returns, since there is nothing, a shadow of the projector, or a mirror that faces "
    "elsewhere"
)


def noise_figure(sheets: Sequence[DataSheet]) -> Figure:
    """Draw sigma over distance on matt white, a panel for each sensor, with the values that others published."""
    with drawing():
        figure, panels = _panels(len(sheets), 2.9)
        for sheet, axes in zip(sheets, panels, strict=False):
            distance, sigma, spread = np.array([(p.distance, p.sigma, p.spread) for p in sheet.noise]).reshape(-1, 3).T
            axes.loglog(distance, spread, "o-", color=BLUE, ms=4, lw=1.4, label="simulated, whole plate")
            axes.loglog(distance, sigma, "o", color=BLUE, ms=4, mfc="white", label="simulated, in discs of 113 px")
            for style, published in zip(_LINES, sheet.sensor.published_noise, strict=False):
                mark = {"marker": "D", "ls": "none", "ms": 5} if len(published.distance_mm) == 1 else {"ls": style}
                source = textwrap.shorten(published.source.split(":")[0].split(" (")[0], 48, placeholder=" ...")
                axes.loglog(published.distance_mm, published.sigma_mm, color=VERMILION, lw=1.1, label=source, **mark)  # type: ignore[arg-type]
            axes.set(title=sheet.sensor.name, xlabel="distance [mm]", ylabel="sigma along V [mm]")
            of_others = [s for published in sheet.sensor.published_noise for s in published.sigma_mm]
            largest = np.nanmax([*spread, *of_others])
            axes.set_ylim(max(axes.get_ylim()[0], largest / 300), 2.5 * largest)
            axes.set_xticks([round(float(d)) for d in distance[::2]], [f"{d:.0f}" for d in distance[::2]])
            axes.minorticks_off()
            plain_log(axes.yaxis)
            axes.legend(loc="best", fontsize=6.5)
    return figure


def residual_figure(sheets: Sequence[DataSheet]) -> Figure:
    """Draw the distribution of the residuals on a plane at mid range, with the normal one of the same spread."""
    with drawing():
        figure, panels = _panels(len(sheets), 2.6)
        for sheet, axes in zip(sheets, panels, strict=False):
            residuals = sheet.residuals
            spread = float(residuals.values.std())
            if not spread > 0:
                continue
            reach = 4.5 * spread
            bins = np.linspace(-reach, reach, 91).tolist()
            axes.hist(residuals.values, bins=bins, density=True, color=BLUE, alpha=0.75)
            x = np.linspace(-reach, reach, 200)
            axes.plot(x, np.exp(-0.5 * (x / spread) ** 2) / (spread * math.sqrt(2 * math.pi)), color=INK, lw=0.9)
            title = f"{sheet.sensor.name}, {residuals.distance:.0f} mm"
            axes.set(yticks=[], xlabel="residual along V [mm]", title=title)
            normal = f"{residuals.independent} independent: p = {residuals.p_normal:.2g}"
            label = f"kurtosis {residuals.excess_kurtosis:+.2f}\n{normal}"
            axes.text(0.02, 0.97, label, transform=axes.transAxes, va="top", fontsize=7, color=MUTED)
    return figure


def gallery_figure(sensor: str, gallery: Sequence[tuple[str, Capture, PointCloud]]) -> Figure:
    """Draw the reference camera's brightened image of each finish, and below it the status of the same pixels."""
    with drawing():
        figure = Figure((3.3 * len(gallery), 5.9), layout="constrained")
        grid = np.asarray(figure.subplots(2, len(gallery), squeeze=False))
        present: set[int] = set()
        cut = _window_around(gallery[0][2])
        for (finish, capture, cloud), (upper, lower) in zip(gallery, grid.T, strict=True):
            image = image_on_grid(capture, cloud)[cut]
            low, high = np.nanpercentile(image, (5, 99.7))
            shown = np.clip((image - low) / max(high - low, 1e-9), 0, 1) ** STRETCH_EXPONENT
            upper.imshow(np.ma.masked_invalid(shown), cmap="gray", vmin=0, vmax=1)
            upper.set_facecolor(FIELD)
            upper.set_title(finish)
            draw_status(lower, cloud.status[cut])
            present |= set(np.unique(cloud.status[cut]).tolist())
            for axes in (upper, lower):
                axes.set(xticks=[], yticks=[])
        figure.suptitle(sensor, fontsize=10)
        legend = [Patch(facecolor=REASONS[Status(s)][1], label=REASONS[Status(s)][0]) for s in sorted(present)]
        place: dict[str, Any] = {"loc": "outside lower center", "ncols": 3, "handlelength": 1.1}
        figure.legend(handles=legend, title=_DARK, title_fontsize=7.5, **place)
    return figure


def image_on_grid(capture: Capture, cloud: PointCloud) -> NDArray[np.float64]:
    """Return the reference camera's brightest image (H, W) on the pixels of a cloud; NaN where it does not reach.

    A cloud of two cameras has the pixels of the rectified image, without the lens distortion of the raw one.
    """
    image, camera = _brightest(capture), capture.rig.reference
    if image.shape != (camera.height, camera.width):  # a device's own map
        return image if image.shape == cloud.status.shape else np.full(cloud.status.shape, np.nan)
    pixels = camera.project(cloud.grid.origin + _FAR_MM * cloud.grid.rays())
    places = [pixels[..., 1], pixels[..., 0]]
    return np.asarray(map_coordinates(image, places, order=1, mode="constant", cval=math.nan), float)


def sheet_table(sheets: Sequence[DataSheet]) -> str:
    """Return the table of all sensors, in Markdown."""
    head = (
        "| sensor | floor: offset, flatness square [mm] | tilted 20 deg [mm] | ball: radius, error [mm] | "
        "sigma and spread, near, mid, far [mm] | published over spread | F on ground Ra 0.4 at 0, 20, 40 deg | "
        "polished Ra 0.09 |\n"
        "|---|---|---|---|---|---|---|---|\n"
    )
    return head + "".join(_row(sheet) + "\n" for sheet in sheets)


def sheet_leaves_out(sheets: Sequence[DataSheet]) -> str:
    """Return a Markdown line for each sensor: the effects of calibration and drift, which its noise and floor omit."""
    return "".join(f"- {sheet.sensor.name}: {_left_out(sheet)}\n" for sheet in sheets)


def _left_out(sheet: DataSheet) -> str:
    base = "decoded with exactly the geometry of the rendering; "
    try:
        details = preset_covariance(sheet.sensor).details
    except InputError:
        return base + f"it has no calibration: `mitsim calibrate {sheet.sensor.name}.toml` computes its effect"
    names = ("middle_mm", "depth_sigma_mm", "sphere_spacing_sigma_mm", "flatness_median_mm")
    keys = ("calibration_" + names[0], *("with_drift_" + name for name in names[1:]))
    if not all(isinstance(details.get(key), float) for key in keys):
        return base + "the effect of its calibration is not known"
    middle, depth, length, flatness = (float(details[key]) for key in keys)
    return base + (
        f"a calibration and its drift since then add, at {middle:.0f} mm, {_mm(depth)} mm to a distance and "
        f"{_mm(length)} mm to a length (one sigma), {_mm(flatness)} mm to the flatness of a plate"
    )


def _row(sheet: DataSheet) -> str:
    square, tilted = (f"{_mm(p.offset)}, {_mm(p.flatness)}" for p in sheet.planes)
    chosen = (sheet.noise[0], sheet.noise[len(sheet.noise) // 2], sheet.noise[-1])
    noise = ", ".join(f"{_mm(p.sigma)} and {_mm(p.spread)} at {p.distance:.0f}" for p in chosen)
    ball = f"{sheet.radius_mm:.0f}, {_mm(sheet.radius_error)}"
    metal = [_fractions([p for p in sheet.metal if p.finish.startswith(kind)]) for kind in ("ground", "polished")]
    return "| " + " | ".join([sheet.sensor.name, square, tilted, ball, noise, _ratios(sheet), *metal]) + " |"


def _ratios(sheet: DataSheet) -> str:
    """Return the smallest to largest ratio of the published to the simulated spread, where both are known."""
    recovered = [point for point in sheet.noise if point.spread > 0]
    if not recovered:
        return "none in range"
    distance, spread = np.log([(point.distance, point.spread) for point in recovered]).T
    ratios: list[float] = []
    for published in sheet.sensor.published_noise:
        at = np.log(published.distance_mm)
        inside = (at >= distance[0] - 1e-6) & (at <= distance[-1] + 1e-6)
        ratios += np.exp(np.log(published.sigma_mm) - np.interp(at, distance, spread))[inside].tolist()
    if not ratios:
        return "none in range"
    low, high = two_digits(min(ratios)), two_digits(max(ratios))
    return low if low == high else f"{low} to {high}"


def _fractions(points: Sequence[Recovery]) -> str:
    return ", ".join("-" if math.isnan(p.fraction) else f"{p.fraction:.2f}" for p in points)


def _mm(value: float) -> str:
    if math.isnan(value):
        return "-"
    return two_digits(value) if abs(value) >= 1e-4 else "0.0000"


def _panels(count: int, height: float) -> tuple[Figure, NDArray[np.object_]]:
    across = min(3, count)
    down = math.ceil(count / across)
    figure = Figure((3.4 * across, height * down), layout="constrained")
    panels = np.asarray(figure.subplots(down, across, squeeze=False)).ravel()
    for spare in panels[count:]:
        spare.set_visible(False)
    return figure, panels


def _window_around(cloud: PointCloud) -> tuple[slice, slice]:
    """Return the rows and columns of the grid around all points, with a margin of a fifth of their extent."""
    rows, columns = np.nonzero(cloud.valid)
    if not len(rows):
        return slice(0, cloud.grid.height), slice(0, cloud.grid.width)
    cut = []
    for indices, size in ((rows, cloud.grid.height), (columns, cloud.grid.width)):
        first, last = np.percentile(indices, (1, 99))
        beyond = 0.2 * (last - first) + 4
        cut.append(slice(max(0, int(first - beyond)), min(size, int(last + beyond) + 1)))
    return cut[0], cut[1]


def _brightest(capture: Capture) -> NDArray[np.float64]:
    """Return the reference camera's image of the largest mean; for time of flight, the light that it sees."""
    name, stack = next(iter(capture.images.items()))
    if capture.technology == "time_of_flight":
        return capture.brightness(name)
    step = max(1, len(stack) // 12)
    return np.asarray(max(stack[::step], key=lambda image: float(image.mean())), float)
