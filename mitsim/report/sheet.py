"""Write ``sheet.pdf``, a statement of measurement uncertainty on one A4 sheet, ready to sign.

Signal chain: folder of a run or of a comparison of sensors -> declaration (:mod:`mitsim.report.declaration`) and
picture of the part in the colours of its verdicts -> pages of PDF by matplotlib, which needs no browser. A task whose
rows do not fit on one page continues on the next.
"""

from __future__ import annotations

from collections.abc import Sequence
from io import BytesIO
from pathlib import Path

from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure

from characterisation.files.atomic_io import atomic_write
from characterisation.plots.style import INK, MUTED, drawing
from mitsim.report.declaration import Declaration, DeclaredRow, read_declaration
from mitsim.report.first_screen import FirstScreen, Tone
from mitsim.report.placement_figure import draw_placement
from mitsim.report.sheet_layout import ACROSS, HEIGHT, LINE, MARGIN, Columns, Page, text_width, wrapped
from mitsim.running.numbers import NONE
from mitsim.study.scene_geometry import SceneGeometry, read_scene_geometry

#: smallest and largest height of the picture [in]
_PICTURE = (1.58, 3.4)

#: height of the lines to sign [in]
_SIGNATURE = 0.95

#: height of the last line of a page [in]
_FOOT = 0.22

#: what only the user knows, to be written by hand
_TO_FILL_IN = (
    ("Part: drawing number and revision", "Sensor: serial number, date of its calibration", "Valid until"),
    ("Place and date", "Name, organisation", "Signature"),
)

#: size of small text [pt]
_SMALL = 6.5

#: sizes of facts [pt], of which the largest that gives one page is used
_FACTS = (7.2, 6.6, 6.0)

#: distance of the text of facts from the margin [in]
_FACT_LEFT = 1.15

#: size of the result in words [pt]
_RESULT = 9.5

#: largest number of its lines
_RESULT_LINES = 4

#: colour of the result by its tone
_COLOURS: dict[Tone, str] = {"good": "#00694e", "plain": INK, "warn": "#7a5600", "bad": "#a84a00"}

#: heads of the table, in lines
_HEADS = (
    ("Measurement",),
    ("Tolerance",),
    ("Bias",),
    ("u",),
    ("U (95 %)",),
    ("k",),
    ("95 % interval", "of the error"),
    ("N",),
    ("Without", "value"),
    ("Accepted", "readings"),
    ("Verdict",),
)


def write_sheet(folder: str | Path) -> Path:
    """Write ``sheet.pdf`` atomically into the folder of a finished run or comparison, and return its path.

    Raises
    ------
    InputError
        If a file is missing or damaged; the message names the file.
    """
    folder = Path(folder)
    geometry = read_scene_geometry(folder)
    declaration = read_declaration(folder, geometry)
    out = BytesIO()
    with drawing(), PdfPages(out, metadata={"Title": declaration.title, "CreationDate": None}) as pages:
        for figure in sheet_figures(declaration, geometry):
            pages.savefig(figure, facecolor="white")
    path = folder / "sheet.pdf"
    with atomic_write(path) as file:
        file.write_bytes(out.getvalue())
    return path


def sheet_figures(declaration: Declaration, geometry: SceneGeometry | None) -> list[Figure]:
    """Return the sheet as A4 figures: one, unless the task has too many measurements for a page."""
    with drawing():
        columns = Columns([_cells(row) for row in declaration.rows], _HEADS)
        pages = [Page()]
        page = pages[0]
        _head(page, declaration)
        shown = geometry is not None and len(geometry.corners) and declaration.first.poses
        above = _PICTURE[0] if shown else 0.0
        whole = above + _head_height(columns) + sum(_row_height(row, columns) for row in declaration.rows)
        below = {size: _SIGNATURE + _FOOT + MARGIN + _facts_height(declaration, size) for size in _FACTS}
        size = next((size for size in _FACTS if whole + below[size] <= page.place), _FACTS[0])
        room = page.place - below[size] - above
        rows, taken = list(declaration.rows), _head_height(columns)
        here: list[DeclaredRow] = []
        while rows and (taken := taken + _row_height(rows[0], columns)) <= room:
            here.append(rows.pop(0))
        if shown:
            assert geometry is not None
            table = _head_height(columns) + sum(_row_height(row, columns) for row in here)
            height = min(_PICTURE[1], page.place - below[size] - table)
            grid = [HEIGHT - page.place, height, page.place - height]
            _picture(page.figure, grid, declaration, geometry)
            page.place -= height
        _table(page, here, columns)
        while rows:
            further = Page()
            pages.append(further)
            further.write(f"{declaration.title}, continued", 11, weight="bold")
            further.place -= 0.1
            count = max(1, int((further.place - MARGIN - _FOOT - 0.4) // _row_height(rows[0], columns)))
            _table(further, rows[:count], columns)
            rows = rows[count:]
        _facts(page, declaration, size)
        _sign(page)
        for number, one in enumerate(pages, 1):
            _foot(one, number, len(pages))
    return [one.figure for one in pages]


def _picture(figure: Figure, heights: Sequence[float], declaration: Declaration, geometry: SceneGeometry) -> None:
    """Draw the part and its sensor between the margins; ``heights`` are those above, of and below the picture."""
    whole = {"left": 0, "right": 1, "top": 1, "bottom": 0, "hspace": 0, "wspace": 0}
    cells = figure.add_gridspec(3, 3, height_ratios=heights, width_ratios=[MARGIN, ACROSS, MARGIN], **whole)
    draw_placement(figure.add_subfigure(cells[1, 1]), geometry, declaration.first.poses, declaration.first.verdicts)


def _head(page: Page, declaration: Declaration) -> None:
    page.put(0, "Statement of measurement uncertainty by virtual measurements", 8.5, MUTED)
    right = f"{declaration.date}" + (f"   No. {declaration.number}" if declaration.number else "")
    page.put(ACROSS - text_width(right, 8.5), right, 8.5, MUTED)
    page.place -= 0.22
    page.write(declaration.title, 15, weight="bold")
    page.place -= 0.03
    page.write(_result(declaration.first), _RESULT, _COLOURS[declaration.first.tone], "bold")
    page.place -= 0.1


def _result(first: FirstScreen) -> str:
    """Return the result in at most :data:`_RESULT_LINES` lines: the reasons that do not fit are in the table."""
    for kept in range(len(first.reasons), -1, -1):
        text = first.words(kept)
        if len(wrapped(text, _RESULT, ACROSS, "bold")) <= _RESULT_LINES:
            break
    return text


def _cells(row: DeclaredRow) -> list[str]:
    result = row.result
    known = result.tolerance != NONE
    return [
        result.name,
        result.tolerance if known else "none",
        row.bias,
        result.uncertainty,
        row.expanded,
        row.factor,
        row.interval,
        row.trials,
        result.without_value,
        result.accepted,
        f"● {result.verdict}",
    ]


def _about(row: DeclaredRow) -> str:
    nominal = row.result.nominal
    return ", ".join(filter(None, [row.result.about, "" if nominal == NONE else f"nominal {nominal}"]))


def _row_height(row: DeclaredRow, columns: Columns) -> float:
    names = wrapped(row.result.name, columns.size, columns.widths[0], "bold")
    small = _small(columns)
    return (len(names) * columns.size + len(wrapped(_about(row), small, ACROSS)) * small) * LINE + 0.05


def _small(columns: Columns) -> float:
    return min(_SMALL, columns.size - 0.5)


def _head_height(columns: Columns) -> float:
    return 2 * columns.size * LINE + 0.1


def _table(page: Page, rows: Sequence[DeclaredRow], columns: Columns) -> None:
    top = page.place
    for left, head in zip(columns.lefts, _HEADS, strict=True):
        page.place = top
        for line in head:
            page.put(left, line, columns.size, MUTED)
            page.place -= columns.size * LINE
    page.place = top - _head_height(columns) + 0.06
    page.rule(MUTED)
    page.place -= 0.04
    for row in rows:
        cells, top = _cells(row), page.place
        verdict = columns.lefts[-1]
        for left, text in zip(columns.lefts[1:-1], cells[1:-1], strict=True):
            page.put(left, text, columns.size)
        page.put(verdict, "●", columns.size, row.result.colour)
        page.put(verdict + text_width("● ", columns.size, "bold"), row.result.verdict, columns.size, weight="bold")
        page.write(row.result.name, columns.size, weight="bold", across=columns.widths[0])
        page.write(_about(row), _small(columns), MUTED)
        page.place = min(page.place, top - _row_height(row, columns))


def _facts_height(declaration: Declaration, size: float) -> float:
    small = min(size, _SMALL)
    lines = sum(len(wrapped(text, size, ACROSS - _FACT_LEFT)) for _, text in declaration.facts)
    notes = sum(len(wrapped(text, small, ACROSS)) for text in declaration.notes)
    return lines * size * LINE + 0.025 * len(declaration.facts) + notes * small * LINE + 0.16


def _facts(page: Page, declaration: Declaration, size: float) -> None:
    page.place -= 0.05
    for note in declaration.notes:
        page.write(note, min(size, _SMALL), MUTED)
    page.place -= 0.06
    for name, text in declaration.facts:
        if text:
            page.put(0, name, size, MUTED)
            page.write(text, size, left=_FACT_LEFT, across=ACROSS - _FACT_LEFT)
            page.place -= 0.025


def _sign(page: Page) -> None:
    """Draw the lines to fill in and to sign above the foot of a page."""
    third = ACROSS / 3
    for above, names in enumerate(reversed(_TO_FILL_IN)):
        page.place = MARGIN + _FOOT + 0.2 + above * 0.42
        for number, name in enumerate(names):
            left = number * third
            page.rule(MUTED, left, left + third - (0.2 if number < 2 else 0))
            page.place -= 0.03
            page.put(left, name, _SMALL, MUTED)
            page.place += 0.03


def _foot(page: Page, number: int, of: int) -> None:
    page.place = MARGIN
    words = "Simulated, not traceable: no real sensor has measured this part."
    words += " Verdicts are about the measurement, not about a part."
    page.put(0, words, _SMALL, MUTED)
    right = f"Page {number} of {of}"
    page.put(ACROSS - text_width(right, _SMALL), right, _SMALL, MUTED)
