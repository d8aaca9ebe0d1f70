"""Place names and scales on pictures of parts."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from matplotlib.axes import Axes

from characterisation.files.arrays import Floats
from characterisation.plots.style import INK, MUTED

#: rows of labels in the height of a picture
_ROWS = 7

#: distance of the columns of labels from the picture, as a share of its longer side
_ASIDE = 0.09

#: space for the labels, as a share of the picture's longer side
_ROOM = 0.34

#: largest number of names on a side; chosen
_MOST = 9


def label_columns(axes: Axes, positions: Mapping[str, Floats], low: Floats, high: Floats, longest: int = 16) -> None:
    """Draw names in columns left and right of a picture, with lines to their positions that do not cross.

    Of more than :data:`_MOST` names on a side the least important ones are left out.

    Parameters
    ----------
    axes, positions, low, high
        To draw into, with limits set to hold the picture and the names; place (2,) of each name, the most important
        names first; corners (2,) of the picture.
    longest
        Largest number of characters of a name; longer ones lack their middle.
    """
    span = high - low
    step = float(max(span[1], 0.62 * span[0])) / _ROWS
    aside = _ASIDE * float(span.max())
    from_left = sorted(positions, key=lambda name: positions[name][0])
    middle = float(low[0] + high[0]) / 2
    first = sum(bool(positions[name][0] < middle) for name in from_left)
    if max(first, len(from_left) - first) > _MOST:
        first = len(from_left) // 2
    left, right = from_left[:first], from_left[first:]
    every = [float(low[1]), float(high[1])]
    for names, x, side, way in ((left, low[0] - aside, "right", -1), (right, high[0] + aside, "left", 1)):
        kept = [name for name in positions if name in names][:_MOST]
        chosen = sorted(kept, key=lambda name: positions[name][1])
        heights = spread([float(positions[name][1]) for name in chosen], step)
        every += heights
        for name, y in zip(chosen, heights, strict=True):
            position = positions[name]
            axes.plot([x, position[0]], [y, position[1]], color=MUTED, lw=0.7, zorder=4)
            axes.plot(*position, "o", ms=2.5, color=INK, zorder=5)
            beside = x + way * 0.01 * float(span.max())
            axes.text(beside, y, cut(name, longest), ha=side, va="center", fontsize=8, zorder=8)
    room = aside + _ROOM * float(span.max())
    axes.set_xlim(low[0] - room, high[0] + room)
    axes.set_ylim(min(every) - step / 2, max(every) + step / 2)


def cut(name: str, longest: int) -> str:
    """Return a name of at most ``longest`` characters, of which the middle is left out: ends tell names apart."""
    kept = longest - 1
    return name if len(name) <= longest else f"{name[: kept - kept // 2]}…{name[-(kept // 2) :]}"


def spread(heights: Sequence[float], step: float) -> list[float]:
    """Return ascending heights, moved as little as possible to be at least ``step`` apart (pooled neighbours)."""
    groups = list[list[float]]()  # first height and number of labels of each group of touching labels
    for height in heights:
        groups.append([height, 1.0])
        while len(groups) > 1 and groups[-1][0] < groups[-2][0] + groups[-2][1] * step:
            (first, before), (second, more) = groups[-2], groups[-1]
            # least squares: the mean of the shifts of its labels is 0
            groups[-2:] = [[(first * before + (second - before * step) * more) / (before + more), before + more]]
    return [first + k * step for first, number in groups for k in range(int(number))]


def scale_bar(axes: Axes, left_end: tuple[float, float], length: float, label: str, rise: float) -> None:
    """Draw a bar from a place to the right, with its label above it.

    Parameters
    ----------
    axes, left_end, length, label, rise
        Axes to draw into; left end (x, y) and length of the bar; text above it, and its distance; in data units.
    """
    x, y = left_end
    axes.plot([x, x + length], [y, y], color=INK, lw=2.2, solid_capstyle="butt", zorder=6)
    text = axes.text(x, y + rise, label, fontsize=8, va="bottom", zorder=6)
    text.set_bbox({"facecolor": "white", "alpha": 0.75, "edgecolor": "none", "pad": 0.8})


def round_length(length: float) -> float:
    """Return the largest of 1, 2, 5 times a power of ten that is at most ``length``."""
    power = 10.0 ** math.floor(math.log10(length))
    return max(m for m in (1.0, 2.0, 5.0) if m * power <= length * 1.0000001) * power
