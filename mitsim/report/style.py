"""Write figures as pictures, and embed them in a page.

Figures use matplotlib's ``Figure`` directly, never pyplot. The page embeds them as inline SVG in which CSS variables
replace the text colours, so that one picture serves light and dark themes.
"""

from __future__ import annotations

import html
import io
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.colorbar import Colorbar
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator
from PIL import Image

from characterisation.files.atomic_io import atomic_write
from characterisation.plots.style import BLUE, FIELD, INK, MUTED, PAPER, drawing

#: colours that the page replaces by its own
_VARIABLES = {INK: "--ink", MUTED: "--muted", FIELD: "--field", PAPER: "--paper", BLUE: "--blue"}

_DPI = 160

#: of SVG in matplotlib, whatever is asked for
_SVG_DPI = 72


@dataclass(frozen=True)
class Picture:
    """A picture of the page: ``markup`` (safe HTML) and a caption of one sentence."""

    markup: str
    caption: str


def as_svg(figure: Figure, alt: str) -> str:
    """Return a figure as inline SVG, with ``alt`` as its alternative text."""
    buffer = io.StringIO()
    nothing = dict.fromkeys(("Date", "Creator", "Format", "Type"))
    with drawing():
        canvas: Any = FigureCanvasSVG(figure)
        _lay_out(figure)
        figure.dpi = _DPI
        canvas.print_svg(buffer, metadata=nothing)  # type: ignore[no-untyped-call]
    text = buffer.getvalue()
    text = re.sub(r"<metadata>.*?</metadata>|<!--.*?-->", "", text[text.index("<svg") :], flags=re.DOTALL)
    text = re.sub(r'<g id="[^"]*"', "<g", text)  # ids of groups would not be unique on a page
    for colour, variable in _VARIABLES.items():
        text = text.replace(colour, f"var({variable})")
    width, height = figure.get_size_inches() * 96
    opening = (
        f'<svg role="img" aria-label="{html.escape(alt, quote=True)}" viewBox="0 0 {width * 0.75:g} {height * 0.75:g}" '
        f'style="max-width:{width:.0f}px">'
    )
    return opening + re.sub(r"\n\s*", "\n", text[text.index(">") + 1 :].strip())


def _lay_out(figure: Figure) -> None:
    """Place the axes of a figure for SVG, as ``savefig`` does, which draws everything a second time for it."""
    engine = figure.get_layout_engine()
    if engine is not None:
        figure.dpi = _SVG_DPI
        engine.execute(figure)
        figure.set_layout_engine("none")


def write_png(figure: Figure, path: Path, dpi: int = _DPI, colours: int | None = None) -> Path:
    """Write a figure atomically as PNG on white.

    Parameters
    ----------
    figure, path, dpi, colours
        ``colours`` of a palette, which halves the size of a noisy image; None for all colours.
    """
    picture = io.BytesIO()
    with drawing():
        FigureCanvasAgg(figure)
        figure.savefig(picture, format="png", dpi=dpi, facecolor="white")
    if colours is not None:
        full, picture = Image.open(picture).convert("RGB"), io.BytesIO()
        few = full.quantize(colours, method=Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
        few.save(picture, format="png", optimize=True)
    with atomic_write(path) as file:  # Pillow, given the file itself, would report "encoder error" on a full disk
        file.write_bytes(picture.getvalue())
    return path


def colour_scale(figure: Figure, shown: Any, axes: Any, label: str, **options: Any) -> Colorbar:
    """Add a colour scale without a frame, for values that may lie beyond its ends.

    Parameters
    ----------
    figure, shown, axes, label, options
        Of :meth:`matplotlib.figure.Figure.colorbar`.
    """
    options = {"extend": "both", "pad": 0.01, **options}
    bar = figure.colorbar(shown, ax=axes, label=label, **options)
    bar.outline.set_visible(False)  # type: ignore[operator]
    return bar


def legend_patch(colour: str, label: str) -> Patch:
    """Return a framed area of a colour for a legend."""
    return Patch(facecolor=colour, edgecolor=MUTED, lw=0.5, label=label)


def pixel_axes(axes: Axes) -> None:
    """Label the axes of an image of all pixels, and colour those without a value."""
    axes.set_facecolor(FIELD)
    axes.set(xlabel="column [px]", ylabel="row [px]")


def plain_log(axis: Axis) -> None:
    """Label a logarithmic axis 0.1, 0.2, 0.5, 1 instead of with powers of ten."""
    if axis.get_scale() != "log":
        return
    low, high = axis.get_view_interval()
    axis.set_major_locator(LogLocator(subs=(1, 2, 5) if high < 200 * low else (1,), numticks=12))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_locator(NullLocator())
