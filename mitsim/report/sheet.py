"""Write ``sheet.pdf``, a statement of measurement uncertainty on one A4 sheet, ready to sign.

Signal chain: folder of a run or of a comparison of sensors -> declaration (:mod:`mitsim.report.declaration`) and
picture of the part in the colours of its verdicts -> pages of PDF by matplotlib, which needs no browser. A table that
does not fit on one page continues on the next, as do notes and facts; the lines to sign follow.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path

from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure

from characterisation.files.atomic_io import atomic_write
from characterisation.plots.style import INK, MUTED, drawing
from characterisation.words.numbers import NONE
from mitsim.report.declaration import Declaration, DeclaredRow, read_declaration
from mitsim.report.first_screen import FirstScreen, Tone
from mitsim.report.placement_figure import draw_placement
from mitsim.report.sheet_layout import ACROSS, FOOT, GAP, HEIGHT, LINE, MARGIN, Columns, Page, text_width, wrapped
from mitsim.study.scene_geometry import SceneGeometry, read_scene_geometry

# Sizes of this page are chosen, not fitted.

#: largest height of the picture [in]
_PICTURE = 3.4

#: height of the lines to sign [in]
_SIGNATURE = 0.9

#: head of a sheet with a statement, and without one, which has no lines to sign
_STATEMENT = "Statement of measurement uncertainty by virtual measurements"
_PREDICTION = "Prediction by screening. Not a statement of measurement uncertainty"

#: facts that only the user knows, to be written by hand
_TO_FILL_IN = (
    ("Part: drawing number and revision", "Sensor: serial number, date of its calibration", "Valid until"),
    ("Place and date", "Name, organisation", "Signature"),
)

#: size of small text [pt]
_SMALL = 6.5

#: distance of the text of facts from the margin, over its size [in / pt]
_FACT_LEFT = 0.14

#: distance between facts, and between rows of the table [in]
_FACT_GAP = 0.015
_ROW_GAP = 0.025

#: size of the result in words [pt]
_RESULT = 9.5

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


@dataclass(frozen=True)
class _Layout:
    """Largest size of the ``table`` and of ``facts`` [pt], ``lines`` of the result, least ``picture`` [in]."""

    table: float
    facts: float
    lines: int
    picture: float


#: layouts, of which the first that gives one page is used, else the first of all
_LAYOUTS = (
    _Layout(8.0, 7.2, 4, 1.58),
    _Layout(8.0, 6.6, 4, 1.58),
    _Layout(8.0, 6.0, 4, 1.58),
    _Layout(7.0, 6.0, 2, 1.3),
    _Layout(6.5, 6.0, 2, 1.3),
)


def write_sheet(folder: str | Path) -> Path:
    """Write ``sheet.pdf`` atomically into the folder of a finished run or comparison, and return its path.

    Raises InputError if a file is missing or damaged; the message names the file.
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
        shown = geometry is not None and len(geometry.corners) and declaration.first.poses
        names = [declaration.marked(row.result.name) for row in declaration.rows]
        of_rows = zip(declaration.rows, names, strict=True)
        rows = [replace(row, result=replace(row.result, name=name)) for row, name in of_rows]
        for layout in (*_LAYOUTS, _LAYOUTS[0]):
            page, columns = Page(), Columns([_cells(row) for row in rows], _HEADS, layout.table)
            _head(page, declaration, layout.lines)
            above = layout.picture if shown else 0.0
            below = _SIGNATURE + _facts_height(declaration, layout.facts)
            if whole := above + _table_height(rows, columns) + below <= page.room:
                break
        pages, foot = [page], below if whole else 0.0
        here = _taken(rows, page.room - above - foot, columns)
        if shown:
            assert geometry is not None
            height = max(above, min(_PICTURE, page.room - _table_height(here, columns) - foot))
            _picture(page.figure, [HEIGHT - page.place, height, page.place - height], declaration, geometry)
            page.place -= height
        _table(page, here, columns)

        def continued() -> Page:
            pages.append(Page())
            pages[-1].write(f"{declaration.title}, continued", 11, weight="bold")
            pages[-1].place -= 0.1
            return pages[-1]

        while rows:
            page = continued()
            _table(page, _taken(rows, page.room, columns) or [rows.pop(0)], columns)
        if below > page.room:
            page = continued()
        last = _facts(page, declaration, layout.facts, continued)
        if declaration.stated:
            _sign(last)
        for number, sheet_page in enumerate(pages, 1):
            _foot(sheet_page, number, len(pages))
    return [sheet_page.figure for sheet_page in pages]


def _taken(rows: list[DeclaredRow], room: float, columns: Columns) -> list[DeclaredRow]:
    """Take the first rows of which a table fits into some room [in] out of a list, and return them."""
    count = next((k for k in range(len(rows), 0, -1) if _table_height(rows[:k], columns) <= room), 0)
    taken, rows[:] = rows[:count], rows[count:]
    return taken


def _picture(figure: Figure, heights: Sequence[float], declaration: Declaration, geometry: SceneGeometry) -> None:
    """Draw the part and its sensor between the margins; ``heights`` are those above, of and below the picture."""
    whole = {"left": 0, "right": 1, "top": 1, "bottom": 0, "hspace": 0, "wspace": 0}
    cells = figure.add_gridspec(3, 3, height_ratios=heights, width_ratios=[MARGIN, ACROSS, MARGIN], **whole)
    draw_placement(figure.add_subfigure(cells[1, 1]), geometry, declaration.first.poses, declaration.first.verdicts)


def _head(page: Page, declaration: Declaration, lines: int) -> None:
    page.put(0, _STATEMENT if declaration.stated else _PREDICTION, 8.5, MUTED)
    right = f"{declaration.date}" + (f"   No. {declaration.number}" if declaration.number else "")
    page.put(ACROSS - text_width(right, 8.5), right, 8.5, MUTED)
    page.place -= 0.22
    page.write(declaration.title, 15, weight="bold")
    page.place -= 0.03
    page.write(_result(declaration.first, lines), _RESULT, _COLOURS[declaration.first.tone], "bold")
    page.place -= 0.1


def _result(first: FirstScreen, lines: int) -> str:
    """Return the result in at most some lines, if its summary fits: the reasons that do not are in the table."""
    for kept in range(len(first.reasons), -1, -1):
        text = first.words(kept)
        if len(wrapped(text, _RESULT, ACROSS, "bold")) <= lines:
            break
    return text


def _cells(row: DeclaredRow) -> list[str]:
    result, tolerance = row.result, "none" if row.result.tolerance == NONE else row.result.tolerance
    numbers = [row.bias, result.uncertainty, row.expanded, row.factor, row.interval, row.trials]
    return [result.name, tolerance, *numbers, result.without_value, result.accepted, f"● {result.verdict}"]


def _about(row: DeclaredRow) -> str:
    nominal = row.result.nominal
    return ", ".join(filter(None, [row.result.about, "" if nominal == NONE else f"nominal {nominal}"]))


def _name_lines(row: DeclaredRow, columns: Columns) -> tuple[list[str], list[str], bool]:
    """Return the lines of a row's name and of its description, and whether they stand on one line."""
    across = ACROSS if columns.above else columns.widths[0]
    names = wrapped(row.result.name, columns.size, across, "bold")
    wide = text_width(row.result.name, columns.size, "bold") + GAP + text_width(_about(row), _small(columns))
    return names, wrapped(_about(row), _small(columns), ACROSS), columns.above and wide <= ACROSS


def _row_height(row: DeclaredRow, columns: Columns) -> float:
    names, about, beside = _name_lines(row, columns)
    lines = (len(names) + columns.above) * columns.size + (0 if beside else len(about)) * _small(columns)
    return lines * LINE + _ROW_GAP


def _table_height(rows: Sequence[DeclaredRow], columns: Columns) -> float:
    return _head_height(columns) + sum(_row_height(row, columns) for row in rows)


def _small(columns: Columns) -> float:
    return min(_SMALL, columns.size - 0.5)


def _head_height(columns: Columns) -> float:
    return 2 * columns.size * LINE + 0.1


def _table(page: Page, rows: Sequence[DeclaredRow], columns: Columns) -> None:
    if not rows:
        return
    top = page.place
    for left, head in zip(columns.lefts, columns.heads, strict=True):
        page.place = top
        for line in head:
            page.put(left, line, columns.size, MUTED)
            page.place -= columns.size * LINE
    page.place = top - _head_height(columns) + 0.06
    page.rule(MUTED)
    page.place -= 0.04
    for row in rows:
        top = page.place
        if not columns.above:
            _write_values(page, row, columns)
        _write_name(page, row, columns)
        if columns.above:
            _write_values(page, row, columns)
        page.place = top - _row_height(row, columns)


def _write_name(page: Page, row: DeclaredRow, columns: Columns) -> None:
    names, _, beside = _name_lines(row, columns)
    for line in names:
        page.put(0, line, columns.size, weight="bold")
        page.place -= columns.size * LINE * (not beside)
    if beside:
        page.put(text_width(row.result.name, columns.size, "bold") + GAP, _about(row), _small(columns), MUTED)
        page.place -= columns.size * LINE
    else:
        page.write(_about(row), _small(columns), MUTED)


def _write_values(page: Page, row: DeclaredRow, columns: Columns) -> None:
    verdict = columns.lefts[-1]
    for left, text in zip(columns.lefts[1:-1], _cells(row)[1:-1], strict=True):
        page.put(left, text, columns.size)
    page.put(verdict, "●", columns.size, row.result.colour)
    page.put(verdict + text_width("● ", columns.size, "bold"), row.result.verdict, columns.size, weight="bold")


def _notes(declaration: Declaration) -> list[str]:
    """Return the notes on all rows, and those on some rows as one."""
    of_some = "   ".join(note.marked for note in declaration.notes if note.mark)
    return [*(note.words for note in declaration.notes if not note.mark), *filter(None, [of_some])]


def _facts_height(declaration: Declaration, size: float) -> float:
    small = min(size, _SMALL)
    lines = sum(len(wrapped(text, size, ACROSS - size * _FACT_LEFT)) for _, text in declaration.facts)
    notes = sum(len(wrapped(note, small, ACROSS)) for note in _notes(declaration))
    return lines * size * LINE + _FACT_GAP * len(declaration.facts) + notes * small * LINE + 0.11


def _facts(page: Page, declaration: Declaration, size: float, continued: Callable[[], Page]) -> Page:
    """Write notes and facts, on ``continued`` pages where one has no room, and return the page to sign."""

    def write(text: str, size: float, colour: str = INK, name: str = "", left: float = 0.0) -> None:
        nonlocal page
        for number, line in enumerate(wrapped(text, size, ACROSS - left)):
            if page.room < size * LINE:
                page = continued()
            if name and number == 0:
                page.put(0, name, size, MUTED)
            page.put(left, line, size, colour)
            page.place -= size * LINE

    page.place -= 0.05
    for note in _notes(declaration):
        write(note, min(size, _SMALL), MUTED)
    page.place -= 0.06
    for name, text in declaration.facts:
        if text:
            write(text, size, name=name, left=size * _FACT_LEFT)
            page.place -= _FACT_GAP
    return page if page.room > _SIGNATURE - 1e-6 else continued()


def _sign(page: Page) -> None:
    """Draw the lines to fill in and to sign above the foot of a page."""
    third = ACROSS / 3
    for above, names in enumerate(reversed(_TO_FILL_IN)):
        page.place = MARGIN + FOOT + 0.2 + above * 0.42
        for number, name in enumerate(names):
            left = number * third
            page.rule(MUTED, left, left + third - (0.2 if number < 2 else 0))
            page.place -= 0.03
            page.put(left, name, _SMALL, MUTED)
            page.place += 0.03


def _foot(page: Page, number: int, of: int) -> None:
    page.place = MARGIN
    words = "Simulated, not traceable: no real sensor has measured this part."
    page.put(0, f"{words} Verdicts are about the measurement, not about a part.", _SMALL, MUTED)
    right = f"Page {number} of {of}"
    page.put(ACROSS - text_width(right, _SMALL), right, _SMALL, MUTED)
