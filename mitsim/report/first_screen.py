"""Make the first screen of a page: picture of the part with its sensor, the result in one line, a short table.

Signal chain: statement of a run, or the table of several sensors -> verdict of every measurement -> each face of the
part coloured by the worst verdict of its measurements -> picture and rows as texts. The report, the comparison of
sensors and the sheet for a quotation all use it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from markupsafe import Markup
from numpy.typing import ArrayLike

from characterisation.statements.verdict_words import Judged, fits_all, result_in_words
from mitsim.report.choice_document import ChoiceDocument, SensorEntry
from mitsim.report.numbers import MINUS, NONE, percent, quantity
from mitsim.report.placement_figure import VERDICTS, face_verdicts, placement_figure
from mitsim.report.run_folder import Run
from mitsim.report.scene_geometry import SceneGeometry
from mitsim.report.set_words import with_sets
from mitsim.report.style import Picture, as_svg


@dataclass(frozen=True)
class Row:
    """One measurement in the short table, as texts; ``colour`` of its verdict; ``good`` is None without a tolerance."""

    name: str
    uncertainty: str
    needed: str
    share: str
    tolerance: str
    accepted: str
    false_accept: str
    verdict: str
    colour: str


@dataclass(frozen=True)
class FirstScreen:
    """Content of the first screen: the result in ``words``, rows and picture.

    ``good`` is true unless a measurement is known not to fit its tolerance, or a set of views to miss a limit. The
    picture shows ``poses`` (label, part_from_sensor) and ``verdicts`` by feature.
    """

    words: str
    good: bool
    rows: list[Row]
    picture: Picture | None
    poses: list[tuple[str, ArrayLike]]
    verdicts: dict[str, str]


def of_run(run: Run, geometry: SceneGeometry | None) -> FirstScreen:
    """Return the first screen of the report of a run."""
    document = run.statement
    if document is None:
        words = with_sets("no view can make the measurements", False, run.about.view_sets).words
        return FirstScreen(words, False, [], None, [], {})
    judged, rows = list[Judged](), list[Row]()
    for name, one in document.measurements.items():
        decision = one.decision
        needed = None if decision is None else decision.needed
        judged.append(
            Judged(
                name,
                one.unit,
                one.verdict,
                _or_nan(one.standard_uncertainty),
                _or_nan(needed),
                decision is not None and decision.fits_corrected,
                one.without_value,
            )
        )
        rows.append(
            RowValues(
                name,
                one.unit,
                one.verdict,
                one.standard_uncertainty,
                needed,
                one.tolerance,
                one.share_of_tolerance,
                None if decision is None else decision.accepted,
                None if decision is None else decision.false_accept,
            ).texts()
        )
    asked = {
        name: (run.about.measurements[name].features, one.verdict)
        for name, one in document.measurements.items()
        if name in run.about.measurements
    }
    pose = run.scores["world_from_sensor"].sel(view=document.view).values
    poses: list[tuple[str, ArrayLike]] = [(f"view {document.view}", pose)]
    verdicts = face_verdicts(asked)
    result = with_sets(result_in_words(judged), fits_all(judged), run.about.view_sets)
    caption = f"{run.about.sensor} at view {document.view}, to scale; on the right the part from the same side."
    return FirstScreen(result.words, result.good, rows, _picture(geometry, poses, verdicts, caption), poses, verdicts)


def of_choice(choice: ChoiceDocument, geometry: SceneGeometry | None) -> FirstScreen:
    """Return the first screen of the page that compares sensors, which shows the best one."""
    best = next((one for one in choice.sensors if one.status != "excluded" and one.measurements), None)
    if best is None:
        return FirstScreen(choice.words, False, [], None, [], {})
    rows = sensor_rows(choice, best)
    verdicts = face_verdicts(
        {name: (choice.measurements[name].features, cell.verdict) for name, cell in best.measurements.items()}
    )
    poses: list[tuple[str, ArrayLike]] = [(f"view {one.view}", one.world_from_sensor) for one in best.poses]
    good = all(cell.verdict in ("fits", "no tolerance") for cell in best.measurements.values())
    of = sum(one.status != "excluded" for one in choice.sensors)
    caption = f"{best.name}, the best of {of} sensors, to scale; on the right the part from the same side."
    return FirstScreen(choice.words, good, rows, _picture(geometry, poses, verdicts, caption), poses, verdicts)


def sensor_rows(choice: ChoiceDocument, one: SensorEntry) -> list[Row]:
    """Return the rows for the measurements of one sensor."""
    return [
        RowValues(
            name,
            choice.measurements[name].unit,
            cell.verdict,
            cell.uncertainty,
            cell.needed,
            choice.measurements[name].tolerance_size,
            cell.share_of_tolerance,
            cell.accepted,
            cell.false_accept,
        ).texts()
        for name, cell in one.measurements.items()
    ]


@dataclass(frozen=True)
class RowValues:
    """Values of one measurement, in ``unit``; None where a value is not known or there is no tolerance.

    ``share`` of the tolerance that the uncertainty takes; ``accepted`` lowest and highest reading.
    """

    name: str
    unit: str
    verdict: str
    uncertainty: float | None
    needed: float | None
    tolerance: float | None
    share: float | None
    accepted: tuple[float | None, float] | None
    false_accept: float | None

    def texts(self) -> Row:
        """Return the row of the table, as texts."""
        return Row(
            self.name,
            _quantity(self.uncertainty, self.unit),
            _quantity(self.needed, self.unit),
            NONE if self.share is None else percent(self.share),
            _quantity(self.tolerance, self.unit),
            accepted_words(self.accepted, self.unit, self.tolerance),
            NONE if self.false_accept is None else percent(self.false_accept),
            self.verdict,
            VERDICTS.get(self.verdict, "#9a9fa8"),
        )


def accepted_words(accepted: tuple[float | None, float] | None, unit: str, tolerance: float | None) -> str:
    """Format the readings that are accepted: ``19.82 to 20.18 mm``, ``up to 0.13 mm``, ``none``; a dash without
    tolerance.
    """
    if tolerance is None:
        return NONE
    if accepted is None:
        return "none"
    digits = max(0, 2 - math.floor(math.log10(tolerance)))
    low, high = accepted
    symbol = "°" if unit == "deg" else f"\N{NO-BREAK SPACE}{unit}"
    text = f"up to {high:.{digits}f}" if low is None else f"{low:.{digits}f} to {high:.{digits}f}"
    return text.replace("-", MINUS) + symbol


def _picture(
    geometry: SceneGeometry | None, poses: Sequence[tuple[str, ArrayLike]], verdicts: dict[str, str], caption: str
) -> Picture | None:
    if geometry is None or not len(geometry.corners) or not poses:
        return None
    by_verdict: dict[str, Any] = {}
    for name, verdict in verdicts.items():
        by_verdict.setdefault(verdict, []).append(name)
    faces = (f"{verdict}: {', '.join(names)}" for verdict, names in by_verdict.items())
    alt = "The part and the sensor. " + "; ".join(faces)
    return Picture(Markup(as_svg(placement_figure(geometry, poses, verdicts), alt)), caption)


def _quantity(value: float | None, unit: str) -> str:
    return NONE if value is None else quantity(value, unit)


def _or_nan(value: float | None) -> float:
    return math.nan if value is None else value
