"""Draw images of cameras in grey, with saturated pixels marked, or maps that a device computed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap, PowerNorm
from matplotlib.patches import Patch
from numpy.typing import NDArray

from characterisation.files.errors import InputError
from characterisation.plots.clouds import depth_limits
from characterisation.plots.style import SEQUENTIAL, VERMILION, axes_for, side_bar
from characterisation.words.numbers import percent

#: percentiles of the grey values shown as black and white; chosen: the few highlights of metal may be white
STRETCH_PERCENTILES = (5, 99.9)

#: exponent of the display, under 1, since metal is dark but for its highlights; chosen
STRETCH_EXPONENT = 0.7

#: width of the picture of a camera [in]
_WIDTH_IN = 4.8

#: width of the colour scale [in]
_SCALE_IN = 0.8

#: height of title and legend [in]
_LABELS_IN = 0.55


def grey_limits(frames: Sequence[NDArray[np.number[Any]]]) -> tuple[float, float]:
    """Return the grey values [DN] shown as black and white for images that share one scale."""
    ends = np.array([np.percentile(frame, STRETCH_PERCENTILES) for frame in frames])
    black = float(ends[:, 0].min())
    return black, float(max(ends[:, 1].max(), black + 1))


def draw_images(
    stacks: Mapping[str, NDArray[np.unsignedinteger[Any]]], full_scale: int, caption: str, ax: Any, image: int
) -> NDArray[np.object_]:
    """Draw one image of every camera, all of one scale; return their axes.

    ``stacks`` are (frames, H, W) [DN] by camera name, ``full_scale`` the value of a saturated pixel [DN], and ``ax``
    the axes for the cameras, None for those of a new figure. Negative numbers of an ``image`` count from the last.
    """
    count = min(len(stack) for stack in stacks.values())
    if not -count <= image < count:
        raise InputError("plot", "image", image, f"0 to {count - 1}")
    frames = {name: stack[image] for name, stack in stacks.items()}
    black, white = grey_limits(list(frames.values()))
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
                label = f"saturated, {full_scale} DN: {percent(float(saturated.mean()))} of the pixels"
                layout = {"loc": "upper left", "bbox_to_anchor": (0.0, -0.02), "borderaxespad": 0, "handlelength": 1.1}
                axes.legend(handles=[Patch(facecolor=VERMILION, label=label)], **layout)
            number = f", image {image % count + 1} of {count}" if count > 1 else ""
            _title(axes, f"{name}{number}: {caption}")
        side_bar(grid[0, -1], shown, f"grey level [DN], exponent {STRETCH_EXPONENT}")
    return np.asarray(grid[0])


def draw_maps(
    maps: Mapping[str, NDArray[np.float32]], units: Mapping[str, str], caption: str, ax: Any
) -> NDArray[np.object_]:
    """Draw maps (H, W), NaN where a value is missing, in colours as :func:`draw_images` does; return their axes."""
    rows, columns = next(iter(maps.values())).shape
    size = ((_WIDTH_IN + _SCALE_IN) * len(maps), _WIDTH_IN * rows / columns + _LABELS_IN)
    with axes_for(ax, (1, len(maps)), size) as grid:
        for axes, (name, values) in zip(grid[0], maps.items(), strict=True):
            low, high = depth_limits(values)
            known = np.ma.masked_invalid(values)
            shown = axes.imshow(known, cmap=SEQUENTIAL, vmin=low, vmax=high, interpolation="nearest")
            side_bar(axes, shown, f"{name} [{units[name]}]")
            _title(axes, f"{name} by the device: {caption}")
    return np.asarray(grid[0])


def _title(axes: Axes, title: str) -> None:
    axes.set_title(title)
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_visible(False)
