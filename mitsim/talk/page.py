"""Write a talk that was made again: ``talk.html``, self-contained, and ``the-talk.md`` with its pictures in ``images``.

Signal chain: results -> slides (:mod:`mitsim.talk.slides`) -> pictures -> page and Markdown, which hold the same words.
"""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import xarray as xr
from matplotlib.figure import Figure
from PIL import Image

from characterisation.files.atomic_io import write_text
from characterisation.words.numbers import listed
from mitsim.report.style import write_png
from mitsim.report.templates import write_page
from mitsim.talk import claims_of_coupons, claims_of_sensors, claims_of_views
from mitsim.talk.results import Results
from mitsim.talk.sensor_figures import opening_figure
from mitsim.talk.slides import Claim, Slide, Verdict
from mitsim.talk.talk_file import Talk, sensor_key

TITLE = "The talk, made again"

#: colour of each verdict (Okabe and Ito's palette)
COLOURS: dict[Verdict, str] = {
    "holds": "#009e73",
    "holds in part": "#e69f00",
    "does not hold": "#d55e00",
    "shown": "#0072b2",
    "missing": "#6a7079",
}

#: resolution of the pictures [1/in]
_DPI = 120

#: number of colours of the pictures, which keeps their files small; chosen
_COLOURS = 160

#: resolution at which the page shows them [1/in]
_SHOWN_DPI = 92


@dataclass(frozen=True)
class _Picture:
    """A picture that was written: its file, alternative text and size in pixels of the page."""

    path: Path
    alt: str
    width: int
    height: int

    def shown(self) -> dict[str, Any]:
        """Return the content for the template: the picture itself, its text and its size."""
        data = base64.b64encode(self.path.read_bytes()).decode("ascii")
        return {"data": f"data:image/png;base64,{data}", "alt": self.alt, "width": self.width, "height": self.height}


def slides_of(talk: Talk, results: Results, measured: dict[str, xr.Dataset]) -> list[Slide]:
    """Return all slides from the results that there are; ``measured`` errors replace those of virtual measurements."""
    lacking = Slide("")
    judged = claims_of_views.judged_of(talk, results, measured, lacking)
    accuracy = claims_of_views.accuracy(judged)
    accuracy.missing.extend(lacking.missing)
    collection, processing, regions = claims_of_coupons.coupons(talk, results)
    return [
        claims_of_sensors.surfaces(talk, results),
        collection,
        processing,
        claims_of_sensors.noise(talk, results),
        regions,
        claims_of_sensors.performance_maps(talk),
        claims_of_coupons.validation(talk, results),
        claims_of_views.scoring(talk, judged),
        claims_of_views.view_score(talk, judged),
        claims_of_views.examples(talk, judged),
        accuracy,
    ]


def write_talk(
    talk: Talk, results: Results, folder: Path, missing: Sequence[str], measured: dict[str, xr.Dataset] | None = None
) -> Path:
    """Write the page, the Markdown and the pictures of a talk into a folder, and return the page's path.

    Parameters
    ----------
    talk, results, missing
        The talk, the results that there are, and names of those that were not made.
    folder, measured
        Output folder; errors of real captures, by the key of their sample.
    """
    measured = {} if measured is None else measured
    slides = slides_of(talk, results, measured)
    images = folder / "images"
    images.mkdir(parents=True, exist_ok=True)
    frames = {sensor_key(name): results.get(f"opening_{sensor_key(name)}") for name in talk.file.opening_sensors}
    shown_frames = {name: frame for name, frame in frames.items() if frame is not None}
    words = f"What {listed(list(shown_frames))} see of the artefact: rendered images of the projected light"
    opening = _drawn(images, "opening", opening_figure(shown_frames), words) if shown_frames else None
    pictures = [[_drawn(images, name, *shown) for name, shown in slide.pictures.items()] for slide in slides]
    intro = _intro(talk, measured)
    content = {
        "title": TITLE,
        "source": "simulated, and captures" if measured else "simulated",
        "intro": intro,
        "missing": _missing(missing),
        "opening": None if opening is None else opening.shown(),
        "slides": [
            {
                "title": slide.title,
                "missing": _missing(slide.missing),
                "parts": [
                    {
                        "picture": None if picture is None else picture.shown(),
                        "claims": [{**asdict(claim), "colour": COLOURS[claim.verdict]} for claim in claims],
                    }
                    for picture, claims in _parts(slide, drawn)
                ],
            }
            for slide, drawn in zip(slides, pictures, strict=True)
        ],
    }
    command = f"mitsim study talk {talk.path.as_posix()} -o runs/talk --kept"
    write_text(folder / "the-talk.md", _markdown(command, slides, pictures, opening, intro, missing))
    return write_page(folder / "talk.html", "talk.html.j2", content)


def _parts(slide: Slide, drawn: Sequence[_Picture]) -> list[tuple[_Picture | None, list[Claim]]]:
    """Return the pictures of a slide, each with the claims that it alone shows, and last all other claims."""
    parts: list[tuple[_Picture | None, list[Claim]]] = [
        (picture, [claim for claim in slide.claims if claim.picture == name])
        for name, picture in zip(slide.pictures, drawn, strict=True)
    ]
    return [*parts, (None, [claim for claim in slide.claims if claim.picture not in slide.pictures])]


def _intro(talk: Talk, measured: dict[str, xr.Dataset]) -> list[str]:
    lines = [
        "Every figure of the talk “Task Specific Viewpoint Optimisation” (Kinnell and Justham, Hamburg 2018), made "
        "again by simulation, beside the quoted claim of its slide.",
        f"{len(talk.views)} views of {talk.sensor.name} before the talk’s artefact are compared, in "
        f"{len(talk.file.samples)} finishes. The true error of a view is that of {talk.file.trials} virtual "
        "measurements with all unknowns drawn anew.",
    ]
    if measured:
        lines.append(f"The errors of {listed(sorted(measured))} are those of real captures.")
    return lines


def _missing(names: Sequence[str]) -> str:
    unique = list(dict.fromkeys(names))
    return listed(unique) if len(unique) <= 8 else f"{listed(unique[:8])} and {len(unique) - 8} more"


def _drawn(images: Path, name: str, figure: Figure, alt: str) -> _Picture:
    path = write_png(figure, images / f"talk_{name}.png", _DPI, _COLOURS)
    with Image.open(path) as image:
        width, height = (round(side * _SHOWN_DPI / _DPI) for side in image.size)
    return _Picture(path, alt, width, height)


def _markdown(
    command: str,
    slides: Sequence[Slide],
    pictures: Sequence[Sequence[_Picture]],
    opening: _Picture | None,
    intro: Sequence[str],
    missing: Sequence[str],
) -> str:
    lines = [f"# {TITLE}", "", *(line for part in intro for line in (part, ""))]
    lines += [
        f"`{command}` draws this page from the kept results in a minute; without `--kept` it makes missing ones. "
        "`--measured FOLDER` puts the errors of real captures in the place of simulated ones.",
        "",
    ]
    if missing:
        lines += [f"Not made yet: {_missing(missing)}.", ""]
    made = [f"<!-- made by: {command}; takes 60 s -->", "<!-- made by: as above -->"]
    first = True

    def picture(image: _Picture) -> list[str]:
        nonlocal first
        comment, first = made[0 if first else 1], False
        return [comment, f"![{image.alt}](images/{image.path.name})", ""]

    if opening is not None:
        lines += picture(opening)
    for number, (slide, drawn) in enumerate(zip(slides, pictures, strict=True), 1):
        lines += [f"## {number}. {slide.title}", ""]
        if slide.missing:
            lines += [f"Not made yet: {_missing(slide.missing)}.", ""]
        for image, claims in _parts(slide, drawn):
            lines += [] if image is None else picture(image)
            for claim in claims:
                text = f"**{claim.verdict.capitalize()}.** {claim.found}{' ' if claim.why else ''}{claim.why}"
                lines += [f"> {html.escape(claim.words, quote=False)}", "", html.escape(text, quote=False), ""]
    lines += ["## Every claim with its figure", ""]
    lines += ["| slide | claim of the talk | figure | verdict |", "|---|---|---|---|"]
    for number, slide in enumerate(slides, 1):
        for claim in slide.claims:
            row = (str(number), claim.words, claim.figure, claim.verdict)
            lines.append(f"| {' | '.join(html.escape(cell, quote=False).replace('|', '&#124;') for cell in row)} |")
    return "\n".join(lines).rstrip() + "\n"
