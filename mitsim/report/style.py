"""How every picture of a report looks, and how a figure becomes part of a page.

Figures are drawn with matplotlib's ``Figure`` alone, never with pyplot. In the page they are inline SVG whose ink is a
CSS variable: one picture serves light and dark pages.
"""

from __future__ import annotations

import html
import io
import re
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from characterisation.atomic_io import atomic_write

#: colours that the page may exchange: writing, quiet lines, where there are no data, the page itself, and points
INK, MUTED, FIELD, PAPER, BLUE = "#1a1c20", "#6a7079", "#e3e5e9", "#fdfdfc", "#0072b2"
_VARIABLES = {INK: "--ink", MUTED: "--muted", FIELD: "--field", PAPER: "--paper", BLUE: "--blue"}

#: for what must stand out (Okabe and Ito's palette, as is BLUE)
VERMILION = "#d55e00"

#: colour maps that keep their order for every kind of colour vision
SEQUENTIAL, NOISE = "viridis", "cividis"

#: names of a user's features and measurements are text, not formulae: ``text.parse_math`` is off
STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans", "font.size": 9.0, "axes.titlesize": 9.5, "axes.titleweight": "normal",
    "text.parse_math": False, "text.color": INK, "axes.edgecolor": MUTED, "axes.labelcolor": INK,
    "axes.titlecolor": INK, "xtick.color": INK, "ytick.color": INK, "xtick.labelsize": 8.0, "ytick.labelsize": 8.0,
    "axes.spines.top": False, "axes.spines.right": False, "axes.linewidth": 0.7, "axes.facecolor": "none",
    "figure.facecolor": "none", "legend.frameon": False, "legend.fontsize": 8.0, "image.interpolation": "none",
    "svg.fonttype": "path", "svg.hashsalt": "mitsim", "axes.unicode_minus": True,
}  # fmt: skip

_DPI = 160


def drawing() -> AbstractContextManager[None]:
    """Context in which every figure is drawn."""
    return rc_context(STYLE)


@dataclass(frozen=True)
class Picture:
    """A picture of the page: ``markup`` (safe HTML), and one sentence that says what it means."""

    markup: str
    caption: str


def as_svg(figure: Figure, alt: str) -> str:
    """Inline SVG of a figure, with ``alt`` as its text for those who do not see it."""
    buffer = io.StringIO()
    nothing = dict.fromkeys(("Date", "Creator", "Format", "Type"))
    with drawing():
        figure.savefig(buffer, format="svg", metadata=nothing, dpi=_DPI)
    text = buffer.getvalue()
    text = re.sub(r"<metadata>.*?</metadata>|<!--.*?-->", "", text[text.index("<svg") :], flags=re.DOTALL)
    text = re.sub(r'<g id="[^"]*"', "<g", text)  # names of groups would be there twice on one page
    for colour, variable in _VARIABLES.items():
        text = text.replace(colour, f"var({variable})")
    width, height = figure.get_size_inches() * 96
    opening = (
        f'<svg role="img" aria-label="{html.escape(alt, quote=True)}" viewBox="0 0 {width * 0.75:g} {height * 0.75:g}" '
        f'style="max-width:{width:.0f}px">'
    )
    return opening + re.sub(r"\n\s*", "\n", text[text.index(">") + 1 :].strip())


def write_png(figure: Figure, path: Path, dpi: int = _DPI) -> Path:
    """Write a figure as PNG on white, whole or not at all."""
    picture = io.BytesIO()
    with drawing():
        FigureCanvasAgg(figure)
        figure.savefig(picture, format="png", dpi=dpi, facecolor="white")
    with atomic_write(path) as file:  # Pillow, given the file, would say "encoder error" on a full disk
        file.write_bytes(picture.getvalue())
    return path


def disc(axes: Axes, radius: float, colour: str = FIELD) -> Circle:
    """Turn axes into an empty disc about the origin; the circle is returned to clip what is drawn on it."""
    axes.set_aspect("equal")
    axes.set_xlim(-1.08 * radius, 1.08 * radius)
    axes.set_ylim(-1.08 * radius, 1.08 * radius)
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_visible(False)
    circle = Circle((0, 0), radius, facecolor=colour, edgecolor="none", zorder=0)
    axes.add_patch(circle)
    return circle


def plain_log(axis: Axis, few: bool = False) -> None:
    """Label an axis 0.1, 0.2, 0.5, 1 if it is logarithmic, not in powers of ten; or with a ``few`` of these."""
    if axis.get_scale() != "log":
        return
    low, high = axis.get_view_interval()
    narrow = high < (5 if few else 200) * low
    axis.set_major_locator(LogLocator(subs=(1, 2, 5) if narrow else (1,), numticks=4 if few else 12))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_locator(NullLocator())
