"""Write ``sheet.pdf``, one sheet of A4 for a quotation or an inspection plan, from the same data as the page.

Signal chain: folder of a run or of a comparison of sensors -> picture, result in words, pose, exposures, table of
verdicts, excluded influences, versions and digests -> one page of PDF by matplotlib, which needs no browser.
"""

from __future__ import annotations

import hashlib
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

from matplotlib.backends.backend_pdf import FigureCanvasPdf
from matplotlib.figure import Figure

from characterisation.files.atomic_io import atomic_write
from characterisation.plots.style import INK, MUTED, drawing
from mitsim.report.first_screen import FirstScreen, Tone, of_choice, of_run
from mitsim.report.placement_figure import draw_placement
from mitsim.report.pose_texts import angles_in_words, origin_text, pose_of_view
from mitsim.report.statement_section import exposed_in_words
from mitsim.running.numbers import listed, rounded, two_digits
from mitsim.study.choice_document import CHOICE, ChoiceDocument, PoseEntry, read_choice
from mitsim.study.run_folder import Run, read_run
from mitsim.study.scene_geometry import SceneGeometry, read_scene_geometry
from mitsim.study.statement_file import read_statement

#: an A4 page, and its margins [in]
_WIDTH, _HEIGHT, _MARGIN = 8.27, 11.69, 0.65

#: heights [in] of a line of text, a row of the table and the picture
_LINE, _ROW, _PICTURE = 0.165, 0.2, 3.55

#: colour of the result by its tone
_COLOURS: dict[Tone, str] = {"good": "#00694e", "plain": INK, "warn": "#7a5600", "bad": "#a84a00"}

#: characters in a line of small text, and largest number of rows in a table
_ACROSS, _MOST_ROWS = 112, 16


@dataclass(frozen=True)
class Sheet:
    """Content of the sheet: ``facts`` as (name, text); ``missing`` influences that are not included."""

    title: str
    first: FirstScreen
    facts: Sequence[tuple[str, str]]
    missing: Sequence[str]
    versions: str


def write_sheet(folder: str | Path) -> Path:
    """Write ``sheet.pdf`` atomically into the folder of a finished run or comparison, and return its path.

    Raises
    ------
    InputError
        If a file is missing or damaged; the message names the file.
    """
    folder = Path(folder)
    geometry, choice = read_scene_geometry(folder), read_choice(folder)
    sheet = _of_run(read_run(folder), geometry) if choice is None else _of_choice(choice, geometry, folder)
    figure = sheet_figure(sheet, geometry)
    FigureCanvasPdf(figure)
    out = BytesIO()
    with drawing():
        figure.savefig(out, format="pdf", facecolor="white", metadata={"Title": sheet.title, "CreationDate": None})
    path = folder / "sheet.pdf"
    with atomic_write(path) as file:
        file.write_bytes(out.getvalue())
    return path


def sheet_figure(sheet: Sheet, geometry: SceneGeometry | None) -> Figure:
    """Return the sheet as an A4 figure."""
    with drawing():
        figure = Figure((_WIDTH, _HEIGHT))
        down = _Column(figure)
        down.write(sheet.title, size=15, weight="bold", line=0.3)
        down.write(
            sheet.first.words,
            size=10.5,
            weight="bold",
            across=86,
            colour=_COLOURS[sheet.first.tone],
            line=0.19,
        )
        if geometry is not None and len(geometry.corners) and sheet.first.poses:
            # one cell of this grid holds the picture
            heights = [_HEIGHT - down.place, _PICTURE, down.place - _PICTURE]
            rows = figure.add_gridspec(3, 1, height_ratios=heights, left=0, right=1, top=1, bottom=0, hspace=0)
            draw_placement(figure.add_subfigure(rows[1]), geometry, sheet.first.poses, sheet.first.verdicts)
            down.place -= _PICTURE + 0.1
        _table(down, sheet.first)
        for name, text in sheet.facts:
            down.fact(name, text)
        if sheet.missing:
            down.fact("Not included", listed(list(sheet.missing)))
        down.fact("Made with", sheet.versions)
        down.place = 0.35
        down.put(_MARGIN, "Simulated: no real sensor has measured this part.", fontsize=7.5, color=MUTED, va="baseline")
    return figure


class _Column:
    """Column of text that grows down the page; ``place`` [in] above the lower edge."""

    def __init__(self, figure: Figure) -> None:
        self.figure, self.place = figure, _HEIGHT - _MARGIN

    def put(self, left: float, text: str, **style: Any) -> None:
        """Write one line at a distance [in] from the left edge."""
        style.setdefault("fontsize", 8.5)
        style.setdefault("va", "top")
        self.figure.text(left / _WIDTH, self.place / _HEIGHT, text, **style)

    def write(
        self,
        text: str,
        *,
        size: float = 8.5,
        weight: str = "normal",
        colour: str = INK,
        left: float = _MARGIN,
        across: int = _ACROSS,
        line: float = _LINE,
    ) -> None:
        """Write wrapped lines, and move down by each."""
        for one in textwrap.wrap(text, across) or [""]:
            self.put(left, one, fontsize=size, fontweight=weight, color=colour)
            self.place -= line

    def fact(self, name: str, text: str) -> None:
        self.place -= 0.05
        self.put(_MARGIN, name, color=MUTED)
        self.write(text, left=_MARGIN + 1.2, across=_ACROSS - 22)


def _table(down: _Column, first: FirstScreen) -> None:
    if first.tolerances:
        head = ["Measurement", "Verdict", "Standard u", "Needed", "Tolerance", "Accepted readings"]
    else:
        head = ["Measurement", "Nominal", "Standard u", "No value"]
    lefts = [0.0, 2.05, 3.2, 4.05, 4.8, 5.6]
    down.place -= 0.05
    rows = [
        [
            row.name if len(row.name) <= 28 else f"{row.name[:27]}…",
            *(
                (row.verdict, row.uncertainty, row.needed, row.tolerance, row.accepted)
                if first.tolerances
                else (row.nominal, row.uncertainty, row.without_value)
            ),
        ]
        for row in first.rows
    ]
    for number, cells in enumerate([head, *rows[:_MOST_ROWS]]):
        for left, text in zip(lefts, cells, strict=False):
            weight = "bold" if number and first.tolerances and left == lefts[1] else "normal"
            down.put(_MARGIN + left, text, color=INK if number else MUTED, fontweight=weight)
        if number and first.tolerances:
            down.put(_MARGIN + lefts[1] - 0.14, "●", fontsize=8, color=first.rows[number - 1].colour)
        down.place -= _ROW
    if len(rows) > _MOST_ROWS:
        down.write(f"and {len(rows) - _MOST_ROWS} more: see the page", colour=MUTED)
    down.place -= 0.08


def _of_run(run: Run, geometry: SceneGeometry | None) -> Sheet:
    first, document = of_run(run, geometry), run.statement
    facts = [("Part", run.about.scene)]
    missing = list[str]()
    if document is not None:
        pose = pose_of_view(run, document.view)
        facts.append(("Pose", f"{_placed(pose)}; {_origin(pose)}; the full pose is in statement.json"))
        facts.append(("Calibration", document.calibration))
        missing = [one.name for one in document.influences if not one.included]
    if "round" in run.about.lay.values():
        missing.append("direction of machining marks")
    planned = "" if document is None else exposed_in_words(document.exposure)
    facts.append(("Exposure", f"{planned} (in place of the sensor’s own)" if planned else run.about.exposure_rule))
    rules = sorted({one.decision.rule for one in document.measurements.values() if one.decision} if document else ())
    facts += [("Decision rule", "; ".join(rules))] if rules else []
    versions = f"mitsim {run.about.mitsim}, seed {run.about.seed}; {_digests(run.folder, ('statement.json', 'map.nc'))}"
    return Sheet(f"{run.about.sensor} measures {Path(run.about.scene).stem}", first, facts, missing, versions)


def _of_choice(choice: ChoiceDocument, geometry: SceneGeometry | None, folder: Path) -> Sheet:
    first = of_choice(choice, geometry)
    best = next((one for one in choice.sensors if one.measurements), None)
    facts = [("Part", choice.scene)]
    missing = list[str]()
    if best is not None:
        for pose in best.poses:
            facts.append(("Pose", f"{_placed(pose)}, {rounded(pose.standoff_mm)} mm away; {_origin(pose)}"))
        if best.capture is not None:
            times = listed([two_digits(1e3 * one) for one in best.capture.exposures_s])
            facts.append(("Exposures", f"{best.capture.images} images of {times} ms each"))
        statement = read_statement(folder / best.name / "statement.json")
        missing = [] if statement is None else [one.name for one in statement.influences if not one.included]
    others = [
        f"{one.name} ({one.fits}, worst {'–' if one.ratio is None else two_digits(one.ratio)}"
        + (f", {one.possible_in_words})" if one.impossible else ")")
        for one in choice.sensors
        if one is not best and one.status == "stated"
    ]
    facts += [("Also measured", listed(others) + ": tolerances that fit, and the largest demand")] if others else []
    rules = sorted({one.rule for one in choice.measurements.values() if one.rule})
    facts += [("Decision rule", "; ".join(rules))] if rules else []
    digest = f"; map {best.map_digest}" if best is not None and best.map_digest else ""
    versions = f"mitsim {choice.mitsim}, seed {choice.seed}; {_digests(folder, (CHOICE,))}{digest}"
    title = f"{'No sensor' if best is None else best.name} measures {Path(choice.scene).stem}"
    return Sheet(title, first, facts, missing, versions)


def _placed(pose: PoseEntry) -> str:
    return f"view {pose.view}: {angles_in_words(pose)}"


def _origin(pose: PoseEntry) -> str:
    return f"the sensor’s origin at ({origin_text(pose, 1)}) mm in the part’s frame"


def _digests(folder: Path, names: Sequence[str]) -> str:
    """Return the first sixteen hexadecimal digits of the SHA-256 of files."""
    there = [folder / name for name in names if (folder / name).exists()]
    return "; ".join(f"{one.name} {hashlib.sha256(one.read_bytes()).hexdigest()[:16]}" for one in there)
