"""Make the first screen of a page: picture of the part with its sensor, the result in one line, a short table.

Signal chain: statement of a run, or the table of several sensors -> verdict of every measurement -> each face of the
part coloured by the worst verdict of its measurements -> picture, its caption with the pose, and rows as texts
(:mod:`mitsim.report.first_rows`). The report, the comparison of sensors and the sheet for a quotation all use it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal

import xarray as xr
from numpy.typing import ArrayLike

from characterisation.plots.statements import GROUPS
from characterisation.statements.budget import largest_line
from characterisation.statements.verdict_words import (
    NAMED,
    OFTEN,
    Judged,
    Reason,
    divided,
    fits_all,
    in_words,
    losses_in_words,
    result_reasons,
)
from characterisation.tasks.covariance import LEAST_CHANCE
from characterisation.words.numbers import NONE, count, how_many, or_nan, with_degree_signs
from mitsim.report.first_rows import ResultRow, RowValues, measured_words
from mitsim.report.page_pictures import placement_picture
from mitsim.report.placement_figure import face_verdicts
from mitsim.report.pose_texts import limit_words, pose_of_view, pose_words
from mitsim.report.set_words import with_sets
from mitsim.report.style import Picture
from mitsim.study.choice_document import TIME_OVER, ChoiceDocument, SensorEntry, judged
from mitsim.study.choose.table import best_reasons
from mitsim.study.remedies.entries import remedies_in_words
from mitsim.study.run_folder import Run
from mitsim.study.scene_geometry import SceneGeometry
from mitsim.study.statement_file import StatedMeasurement, StatementDocument
from mitsim.views.no_view import TOGETHER, apart_in_words

#: good: every tolerance fits; plain: there are no tolerances; warn: values are missing, or a verdict is open; bad: a
#: tolerance does not fit, or a set of views exceeds a limit
Tone = Literal["good", "plain", "warn", "bad"]
Poses = list[tuple[str, ArrayLike]]


@dataclass(frozen=True)
class FirstScreen:
    """Content of the first screen: the ``reasons`` of the result, its ``tone``, rows and picture.

    The picture has the ``poses`` (label, part_from_sensor), the ``verdicts`` by feature, and a ``caption``. ``trials``
    is the largest number of virtual measurements behind a row. ``remedies`` are changes with which the other
    measurements fit, ``doubts`` are reasons to check the statement.
    """

    reasons: Sequence[Reason]
    tone: Tone
    rows: list[ResultRow] = field(default_factory=list)
    geometry: SceneGeometry | None = None
    poses: Poses = field(default_factory=list)
    verdicts: dict[str, str] = field(default_factory=dict)
    caption: str = ""
    trials: int = 0
    remedies: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()

    @cached_property
    def picture(self) -> Picture | None:
        """Return the picture, drawn at the first use: a sheet and the files of a run need none."""
        return placement_picture(self.geometry, self.poses, self.verdicts, self.caption)

    def words(self, kept: int | None = None) -> str:
        """Return the result in words, by default with all its reasons."""
        return with_degree_signs(in_words(self.reasons, kept))

    def _brief(self) -> list[tuple[Reason, str]]:
        """Return every reason with its words in the headline, which has as many names as :func:`named`; "" for none.

        Of more reasons that name measurements, it has the first only.
        """
        many_reasons = sum(bool(reason.names) for reason in self.reasons) > NAMED + 1
        shown, left = divided(self.reasons, 1 if many_reasons else None)
        many = sum(len(reason.names) for reason in shown) > NAMED + 1
        said = [(reason, reason.counted if many else reason.words) for reason in shown]
        return said + [(reason, "") for reason in left]

    @property
    def headline(self) -> str:
        """Return the result in a few words; :attr:`folded` has the reasons that it shortens or leaves out."""
        brief = self._brief()
        more = len({name for reason, words in brief if not words for name in reason.names})
        said = [words for _, words in brief if words] + [f"and {more} more"] * bool(more)
        return with_degree_signs("; ".join(said))

    @property
    def folded(self) -> list[str]:
        """Return the reasons that the headline shortens or leaves out, with all their names."""
        return [with_degree_signs(reason.in_full) for reason, words in self._brief() if words != reason.in_full]

    @property
    def named(self) -> int:
        """Return the number of measurements that these reasons name."""
        return len({name for reason, words in self._brief() if words != reason.in_full for name in reason.names})

    @property
    def tolerances(self) -> bool:
        """Return whether a measurement has a tolerance."""
        return any(row.tolerance != NONE for row in self.rows)

    @property
    def open(self) -> bool:
        """Return whether a measurement is not decided."""
        return any(row.verdict == "not decided" for row in self.rows)

    @property
    def limited(self) -> bool:
        """Return whether a row states the limit of the view."""
        return any(row.limited for row in self.rows)

    @property
    def share_limit(self) -> str:
        """Return the largest share of the tolerance that fits, if it is the same for all rows; otherwise empty."""
        limits = {row.share_limit for row in self.rows if row.tolerance != NONE and row.share != NONE}
        return limits.pop() if len(limits) == 1 else ""


#: values of a measurement, and of its decision, that documents and rows hold by the same names
_MEASURED = ("verdict", "bias", "without_value")
_DECIDED = ("needed", "demand", "demand_interval", "accepted", "false_accept")


def tone_of(results: Sequence[Judged]) -> Tone:
    """Return the tone of the results of one view: see :data:`Tone`."""
    if not fits_all(results):
        return "bad"
    if any(result.without_value >= OFTEN or result.verdict == "not decided" for result in results):
        return "warn"
    return "good" if any(result.verdict == "fits" for result in results) else "plain"


def of_run(run: Run, geometry: SceneGeometry | None) -> FirstScreen:
    """Return the first screen of the report of a run."""
    document = run.statement
    if document is None:
        return _without_statement(run, geometry)
    results = [_judged(name, measurement) for name, measurement in document.measurements.items()]
    view_scores = run.scores.sel(view=document.view)
    asked = {
        name: (run.about.measurements[name].shapes, measurement.verdict)
        for name, measurement in document.measurements.items()
    }
    result = with_sets(result_reasons(results), fits_all(results), run.about.view_sets)
    first, *reasons = result.reasons
    return FirstScreen(
        [Reason(first.says[:1].upper() + first.says[1:]), *reasons],
        tone_of(results) if result.good else "bad",
        [_run_row(run, view_scores, name, measurement) for name, measurement in document.measurements.items()],
        geometry,
        [(f"view {document.view}", view_scores["world_from_sensor"].values)],
        face_verdicts(asked),
        _caption(run, document.view),
        max((measurement.trials for measurement in document.measurements.values()), default=0),
        tuple(with_degree_signs(line) for line in remedies_in_words(run.about.remedies)),
        (*document.doubts(), *filter(None, [_apart(run, document)])),
    )


def _without_statement(run: Run, geometry: SceneGeometry | None) -> FirstScreen:
    """Return the first screen of a run that states no uncertainty: its leading view so far, or that there is none."""
    about, leader = run.about, run.about.leader
    if leader is None:
        reasons = with_sets([Reason("No view can make the measurements")], False, about.view_sets).reasons
        return FirstScreen(reasons, "bad")
    scores = run.scores.sel(view=leader)
    rows = [
        RowValues(
            name=name,
            about=measured_words(measurement.kind, measurement.features),
            unit=measurement.unit,
            verdict="no tolerance" if measurement.tolerance is None else "not decided",
            nominal=measurement.nominal,
            tolerance=measurement.tolerance,
            bias=None,
            uncertainty=float(scores["measured_risk"].sel(measurement=name)),
            without_value=math.nan,
        ).texts()
        for name, measurement in about.measurements.items()
    ]
    asked = {name: (measurement.shapes, "not decided") for name, measurement in about.measurements.items()}
    made = f"and {how_many(about.race_trials, 'virtual measurement')}" if about.race_trials else "alone"
    return FirstScreen(
        [Reason(f"View {leader} leads so far, by the performance map {made}; no uncertainty is stated yet")],
        "warn",
        rows,
        geometry,
        [(f"view {leader}", scores["world_from_sensor"].values)],
        face_verdicts(asked),
        _caption(run, leader),
        about.race_trials,
        doubts=(f"Standard uncertainties are expected by the performance map {made}, and include the bias",),
    )


def _apart(run: Run, document: StatementDocument) -> str:
    """Say that no single view makes all measurements, unless a set is asked for; the map may wrongly exclude a view."""
    made = all(1 - measurement.without_value >= LEAST_CHANCE for measurement in document.measurements.values())
    apart = "" if made or run.about.view_sets else apart_in_words(run.scores)
    return apart and f"By the map, {apart}. {TOGETHER}"


def _caption(run: Run, view: int) -> str:
    best = f"the best of {count(run.scores.sizes['view'])} views for all measurements together"
    return f"{run.about.sensor} in view {view}, {best}: {pose_words(pose_of_view(run, view))}"


def of_choice(
    choice: ChoiceDocument, geometry: SceneGeometry | None, statement: StatementDocument | None = None
) -> FirstScreen:
    """Return the first screen of the page that compares sensors, which shows the best one and its ``statement``."""
    best, reasons = choice.best, best_reasons(choice.sensors, choice.measurements)
    if best is None:
        return FirstScreen(reasons, "bad")
    asked = {name: (choice.measurements[name].features, cell.verdict) for name, cell in best.measurements.items()}
    of = sum(sensor.status != "excluded" for sensor in choice.sensors)
    caption = f"{best.name}, the best of {how_many(of, 'sensor')}"
    if best.possible_in_words:
        caption += f" ({best.possible_in_words})"
    if best.poses:
        caption += f", in view {best.poses[0].view}: {pose_words(best.poses[0])}"
    results = judged(best)
    made = [result for result in results if math.isfinite(result.uncertainty)]
    lost = losses_in_words(made) if made and all(result.verdict == "no tolerance" for result in results) else ""
    return FirstScreen(
        [*reasons, *map(Reason, filter(None, [lost]))],
        tone_of(results),
        sensor_rows(choice, best),
        geometry,
        [(f"view {pose.view}", pose.world_from_sensor) for pose in best.poses],
        face_verdicts(asked),
        caption,
        max((cell.trials for cell in best.measurements.values()), default=0),
        doubts=(
            *filter(None, [best.roughness_in_words]),
            *_others_fit_more(choice, best),
            *(statement.doubts() if statement else ()),
        ),
    )


def _others_fit_more(choice: ChoiceDocument, best: SensorEntry) -> Iterator[str]:
    """Yield a sentence on each sensor that fits more tolerances than the best, or may and was not measured."""
    yield from choice.fit_more
    for sensor in choice.sensors:
        if best.status == "stated" and sensor.status == "screened" and sensor.expected_fits > best.fits:
            advice = "allow more minutes" if sensor.why == TIME_OVER else f"to measure it, compare {sensor.name} alone"
            yield (
                f"{sensor.name} was not measured ({sensor.why}), but is expected to fit {sensor.expected_fits} of "
                f"{choice.toleranced} tolerances: {advice}"
            )


def sensor_rows(choice: ChoiceDocument, sensor_entry: SensorEntry) -> list[ResultRow]:
    """Return a sensor's rows, which name another view than the first; screening gives no readings and no losses."""
    shown = [pose.view for pose in sensor_entry.poses[:1]]
    return [
        RowValues(
            name=name,
            about=measured_words(asked.kind, asked.features)
            + (f", from view {cell.view}" if cell.view not in (None, *shown) else ""),
            unit=asked.unit,
            nominal=asked.nominal,
            tolerance=asked.tolerance,
            uncertainty=cell.uncertainty,
            share=cell.share_of_tolerance,
            rule=asked.rule,
            **_same_names(cell, _MEASURED) | ({} if cell.trials else {"without_value": math.nan}),
            **_same_names(cell, _DECIDED),
            stated=sensor_entry.status == "stated",
        ).texts()
        for name, cell in sensor_entry.measurements.items()
        for asked in (choice.measurements[name],)
    ]


def _run_row(run: Run, view_scores: xr.Dataset, name: str, measurement: StatedMeasurement) -> ResultRow:
    """Return the row of a measurement of a run; ``view_scores`` are the scores of the stated view."""
    entry, decision, largest = run.about.measurements[name], measurement.decision, largest_line(measurement.budget)
    here = view_scores.sel(measurement=name)
    limited, feature = limit_words(here), str(here["limiting_feature"].values)
    points = float(view_scores["n"].sel(feature=feature)) if feature in view_scores["feature"].values else None
    return RowValues(
        name=name,
        about=measured_words(entry.kind, entry.features),
        unit=measurement.unit,
        nominal=entry.nominal,
        tolerance=measurement.tolerance if entry.tolerance is None else entry.tolerance,
        uncertainty=measurement.standard_uncertainty,
        share=measurement.share_of_tolerance,
        **_same_names(measurement, _MEASURED),
        **({} if decision is None else _same_names(decision, ("rule", *_DECIDED))),
        limited=limited,
        points=points if limited else None,
        source="" if largest is None else f"mostly {GROUPS.get(largest.group, ('', largest.group))[1]}",
    ).texts()


def _same_names(entry: object, names: Sequence[str]) -> dict[str, Any]:
    """Return the values of an entry that a row holds by the same names."""
    return {name: getattr(entry, name) for name in names}


def _judged(name: str, measurement: StatedMeasurement) -> Judged:
    decision = measurement.decision
    return Judged(
        name,
        measurement.unit,
        measurement.verdict,
        or_nan(measurement.standard_uncertainty),
        or_nan(None if decision is None else decision.needed),
        decision is not None and decision.fits_corrected,
        measurement.without_value,
        bias=or_nan(measurement.bias),
    )
