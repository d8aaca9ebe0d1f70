"""Draw the images of a capture: grey levels of every camera, with saturated pixels marked; or the maps of a device."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap, PowerNorm
from matplotlib.patches import Patch
from numpy.typing import NDArray

from characterisation.files.errors import InputError
from characterisation.plots.clouds import depth_limits
from characterisation.plots.style import SEQUENTIAL, VERMILION, axes_for, side_bar
from mitsim.capture.capture import DERIVED_UNITS, Capture

#: percentiles of the grey values shown as black and white, and the display exponent, since metal is dark but for its
#: highlights
STRETCH_PERCENTILES, STRETCH_EXPONENT = (5, 99.9), 0.7

#: width of the picture of a camera, width of the colour scale, and height of title and legend [in]
_WIDTH_IN, _SCALE_IN, _LABELS_IN = 4.8, 0.8, 0.55


def grey_limits(frames: Sequence[NDArray[np.number[Any]]]) -> tuple[float, float]:
    """Return the grey values [DN] shown as black and white for images that share one scale."""
    ends = np.array([np.percentile(frame, STRETCH_PERCENTILES) for frame in frames])
    black = float(ends[:, 0].min())
    return black, float(max(ends[:, 1].max(), black + 1))


def draw_capture(capture: Capture, ax: Any, camera: str | None, image: int) -> NDArray[np.object_]:
    """Draw one image of every camera, or of one; of a capture without images, the maps that the device computed.

    Parameters
    ----------
    capture
        Capture to draw.
    ax
        Axes to draw into, one for each camera; None for those of a new figure.
    camera
        Draw this camera alone; None for all.
    image
        Number of the image, from 0; negative numbers count from the last.

    Raises
    ------
    InputError
        If there is no such camera or image, nothing to draw, or another number of axes.
    """
    if not capture.images:
        return _draw_derived(capture, ax)
    if camera is not None and camera not in capture.images:
        raise InputError("plot", "camera", repr(camera), ", ".join(capture.images))
    chosen = {name: stack for name, stack in capture.images.items() if camera in (None, name)}
    count = min(len(stack) for stack in chosen.values())
    if not -count <= image < count:
        raise InputError("plot", "image", image, f"0 to {count - 1}")
    frames = {name: stack[image] for name, stack in chosen.items()}
    black, white = grey_limits(list(frames.values()))
    full_scale = 2**capture.bits - 1
    rows, columns = next(iter(frames.values())).shape
    size = (_WIDTH_IN * len(frames) + _SCALE_IN, _WIDTH_IN * rows / columns + _LABELS_IN)
    with axes_for(ax, (1, len(frames)), size) as grid:
        for axes, (name, frame) in zip(grid[0], frames.items(), strict=True):
            norm = PowerNorm(STRETCH_EXPONENT, black, white, clip=True)
            shown = axes.imshow(frame, cmap="gray", norm=norm, interpolation="antialiased")
            saturated = frame >= full_scale
            if saturated.any():
                mask = np.ma.masked_equal(saturated, False)
                axes.imshow(mask, cmap=ListedColormap([VERMILION]), interpolation="nearest")
                label = f"saturated, {full_scale} DN: {100 * saturated.mean():.2g} % of the pixels"
                place = {"loc": "upper left", "bbox_to_anchor": (0.0, -0.02), "borderaxespad": 0.0, "handlelength": 1.1}
                axes.legend(handles=[Patch(facecolor=VERMILION, label=label)], **place)
            number = f", image {image % count + 1} of {count}" if count > 1 else ""
            _title(axes, f"{name}{number}: {capture.sensor}, {capture.source}")
        side_bar(grid[0, -1], shown, f"grey level [DN], exponent {STRETCH_EXPONENT}")
    return np.asarray(grid[0])


def _draw_derived(capture: Capture, ax: Any) -> NDArray[np.object_]:
    """Draw the maps of a device, of points their depth."""
    if not capture.derived:
        raise InputError(f"capture of {capture.sensor}", "images", "none", "at least one image or map to draw")
    maps = {name: values[..., 2] if name == "points" else values for name, values in capture.derived.items()}
    rows, columns = next(iter(maps.values())).shape
    size = ((_WIDTH_IN + _SCALE_IN) * len(maps), _WIDTH_IN * rows / columns + _LABELS_IN)
    with axes_for(ax, (1, len(maps)), size) as grid:
        for axes, (name, values) in zip(grid[0], maps.items(), strict=True):
            low, high = depth_limits(values)
            shown = axes.imshow(
                np.ma.masked_invalid(values), cmap=SEQUENTIAL, vmin=low, vmax=high, interpolation="nearest"
            )
            side_bar(axes, shown, f"{name} [{DERIVED_UNITS[name]}]")
            _title(axes, f"{name} by the device: {capture.sensor}, {capture.source}")
    return np.asarray(grid[0])


def _title(axes: Axes, title: str) -> None:
    axes.set_title(title)
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_visible(False)
