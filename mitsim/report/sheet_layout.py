"""Set text on an A4 page by its measured width: wrapped lines, and a table whose columns never overlap.

Signal chain: text, size, weight -> width [in] by the renderer's own font metrics -> lines that fit, or columns as
wide as their widest cell, set smaller until the table fits -> texts on a figure.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import lru_cache
from itertools import accumulate
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.lines import Line2D

from characterisation.plots.style import INK, STYLE

#: width of an A4 page [in]
WIDTH = 8.27

#: height of an A4 page [in]
HEIGHT = 11.69

#: margin of a page on each side [in]
MARGIN = 0.6

#: height of the last line of a page [in]; chosen
FOOT = 0.22

#: distance between columns [in]; chosen
GAP = 0.07

#: width between the margins [in]
ACROSS = WIDTH - 2 * MARGIN

#: height of a line over the size of its text [in / pt]
LINE = 1.35 / 72

#: sizes that a table may have [pt], largest first
_SIZES = (8.0, 7.5, 7.0, 6.5, 6.0, 5.5)

#: least width of the first column of a table, unless no size leaves it [in]
_FIRST = 1.3

_DPI = 200

#: relative difference of a line's width from the sum of those of its pieces, which kerning stays below; chosen
_KERNING = 0.02

#: resolution of widths: advances that are rounded to pixels would differ from those of a PDF by 1 %
_METRICS_DPI = 1200


@lru_cache(maxsize=1)
def _renderer() -> Any:
    canvas: Any = FigureCanvasAgg(Figure(dpi=_METRICS_DPI))
    return canvas.get_renderer()


@lru_cache(maxsize=4096)
def text_width(text: str, size: float, weight: str = "normal") -> float:
    """Return the width [in] of one line of text of a size [pt]."""
    font = FontProperties(family=STYLE["font.family"], size=size, weight=weight)
    return float(_renderer().get_text_width_height_descent(text, font, False)[0]) / _METRICS_DPI


def wrapped(text: str, size: float, across: float, weight: str = "normal") -> list[str]:
    """Return the lines of a text of a size [pt] that are at most ``across`` [in] wide.

    A line breaks at a space, or after an underscore or a slash; a longer word breaks where it must.
    """
    lines, line, width = list[str](), "", 0.0
    for word in text.split(" "):
        for number, piece in enumerate(re.split("(?<=[_/])(?=.)", word)):
            added = (" " if line and number == 0 else "") + piece
            longer = width + text_width(added, size, weight)
            fits = longer < across
            if abs(longer - across) < _KERNING * across:  # only a line that nearly fits needs its own width
                fits = text_width(line + added, size, weight) <= across
            if fits:
                line, width = line + added, longer
                continue
            if line:
                lines.append(line)
            line = piece
            while text_width(line, size, weight) > across and len(line) > 1:
                cut = next(k for k in range(len(line), 0, -1) if text_width(line[:k], size, weight) <= across or k == 1)
                lines.append(line[:cut])
                line = line[cut:]
            width = text_width(line, size, weight)
    return [*lines, line]


class Page:
    """One A4 page; ``place`` [in] above its lower edge is where the next line goes."""

    def __init__(self) -> None:
        self.figure = Figure((WIDTH, HEIGHT), dpi=_DPI)
        self.place = HEIGHT - MARGIN

    @property
    def room(self) -> float:
        """Return the height that is left above the last line of the page [in]."""
        return self.place - MARGIN - FOOT

    def put(self, left: float, text: str, size: float, colour: str = INK, weight: str = "normal") -> None:
        """Write one line, its top at ``place``.

        Parameters
        ----------
        left, text
            Distance from the margin [in], and the line.
        size, colour, weight
            Of the font; the size in pt.
        """
        x, y = (MARGIN + left) / WIDTH, self.place / HEIGHT
        self.figure.text(x, y, text, fontsize=size, color=colour, fontweight=weight, va="top")

    def write(self, text: str, size: float, colour: str = INK, weight: str = "normal") -> None:
        """Write wrapped lines, and move down by each.

        Parameters
        ----------
        text, size, colour, weight
            The text, and its font; the size in pt.
        """
        for line in wrapped(text, size, ACROSS, weight):
            self.put(0, line, size, colour, weight)
            self.place -= size * LINE

    def rule(self, colour: str, left: float = 0.0, right: float = ACROSS) -> None:
        """Draw a thin horizontal line at ``place``."""
        ends = [(MARGIN + left) / WIDTH, (MARGIN + right) / WIDTH]
        height = self.place / HEIGHT
        self.figure.add_artist(Line2D(ends, [height, height], color=colour, lw=0.6))


class Columns:
    """Columns of a table as wide as their widest cell, at the largest size of text at which they fit a page.

    ``lefts`` [in] from the margin, ``widths`` [in], ``size`` up to ``largest`` [pt]; ``heads`` in lines. Cells of the
    first column wrap if they are wider than :data:`_FIRST` and the other columns leave no more. Where one would wrap,
    all are ``above``: they have lines of their own, over the other cells, which are a little to the right, and the
    first column has no head.
    """

    def __init__(self, rows: Sequence[Sequence[str]], heads: Sequence[Sequence[str]], largest: float) -> None:
        self._fit(rows, heads, largest, _FIRST)
        self.above = any(len(wrapped(row[0], self.size, self.widths[0], "bold")) > 1 for row in rows)
        if self.above:
            self._fit([["", *row[1:]] for row in rows], [[""], *heads[1:]], largest, 0.3)

    def _fit(self, rows: Sequence[Sequence[str]], heads: Sequence[Sequence[str]], largest: float, first: float) -> None:
        self.heads = heads
        for size in _SIZES[_SIZES.index(largest) :]:
            self.size = size
            self.widths = [
                max(text_width(line, size, "bold") for line in (*(row[k] for row in rows), *head))
                for k, head in enumerate(heads)
            ]
            remaining_width = sum(self.widths[1:]) + GAP * (len(heads) - 1)
            if min(self.widths[0], first) + remaining_width <= ACROSS:
                break
        self.widths[0] = max(min(self.widths[0], ACROSS - remaining_width), first / 2)
        spare = max(0.0, ACROSS - self.widths[0] - remaining_width) / max(len(heads) - 1, 1)
        self.lefts = list(accumulate(self.widths[:-1], lambda left, width: left + width + GAP + spare, initial=0.0))
