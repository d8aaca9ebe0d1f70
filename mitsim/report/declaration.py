"""Collect what an auditor reads beside the results of a statement: the declaration of ISO/TS 15530-4.

Signal chain: folder of a run, or of a comparison of sensors -> part, sensor, pose, calibration, exposures, decision
rule, influences that are varied, fixed or left out, versions and digests -> texts for :mod:`mitsim.report.sheet`.
The numbers of a measurement are those that JCGM 101:2008, 5.5 asks to report: estimate of the error, standard
uncertainty u, 95 % interval, number of trials; and U and k = U / u of JCGM 100:2008, 7.2.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from scipy.spatial.transform import Rotation

from characterisation.statements.statement import AT_THE_LIMIT, FAR_FROM_NOMINAL
from characterisation.words.numbers import NONE, count, listed, quantity, rounded, signed, two_digits
from mitsim.report.first_rows import ResultRow, bias_words
from mitsim.report.first_screen import FirstScreen, of_choice, of_run
from mitsim.report.pose_texts import angles_in_words, origin_text, pose_of_view
from mitsim.report.statement_section import (
    calibration_in_words,
    exposed_in_words,
    interval_words,
    rules_in_words,
    stated_rules,
)
from mitsim.report.unknowns_words import unknowns_in_words
from mitsim.study.choice_document import CHOICE, ChoiceDocument, PoseEntry, SensorEntry, best_statement, read_choice
from mitsim.study.run_folder import Run, read_run
from mitsim.study.scene_geometry import SceneGeometry
from mitsim.study.statement_file import InfluenceEntry, StatedMeasurement, StatementDocument, roughness_in_words

#: how the software was verified (ISO/TS 15530-4), in words; docs/explanation/validity.md, criteria 10 and 11
VERIFIED = "closed forms, examples of JCGM 101 and 106, another renderer; not by a metal part with calibrated values"

#: name of the fact about the influences that virtual measurements vary
VARIED = "Varied"

#: name of the fact about the sizes of these influences
SIZES = "Sizes (σ or range)"

#: name of the fact about the influences that are simulated without variation
FIXED = "Fixed"

#: name of the fact about the influences that are not simulated
LEFT_OUT = "Left out"

#: names of all facts about influences
INFLUENCES = (VARIED, SIZES, FIXED, LEFT_OUT)

#: hexadecimal digits of a digest that are printed
_DIGITS = 16


@dataclass(frozen=True)
class DeclaredRow:
    """One measurement as texts: the row of the first screen, and the numbers of its statement."""

    result: ResultRow
    bias: str
    expanded: str
    factor: str
    interval: str
    trials: str


@dataclass(frozen=True)
class Note:
    """``words`` on the measurements of some ``names``, which have a ``mark`` in a table; without names, on all."""

    words: str
    names: tuple[str, ...] = ()
    mark: str = ""

    @property
    def in_full(self) -> str:
        """Return the note with its names."""
        return f"{listed(list(self.names))}: {self.words}" if self.names else self.words

    @property
    def marked(self) -> str:
        """Return the note with its mark in place of its names."""
        return f"{self.mark} {self.words}".lstrip()


@dataclass(frozen=True)
class Declaration:
    """Content of a sheet; ``facts`` are (name, text). ``date`` is the day of the virtual measurements, ISO 8601."""

    title: str
    date: str
    number: str
    first: FirstScreen
    rows: list[DeclaredRow]
    facts: list[tuple[str, str]]
    notes: list[Note]

    @property
    def stated(self) -> bool:
        """Return whether there is a statement of uncertainty, which one can sign."""
        return bool(self.number)

    def marked(self, name: str) -> str:
        """Return the name of a measurement with the marks of its notes."""
        return "\N{NO-BREAK SPACE}".join([name, *(note.mark for note in self.notes if name in note.names)])


def read_declaration(folder: Path, geometry: SceneGeometry | None) -> Declaration:
    """Read the declaration of a finished run, or of a comparison of sensors.

    Raises InputError if a file is missing or damaged; the message names the file.
    """
    choice = read_choice(folder)
    return _of_run(read_run(folder), geometry) if choice is None else _of_choice(choice, geometry, folder)


def _of_run(run: Run, geometry: SceneGeometry | None) -> Declaration:
    first, document, part = of_run(run, geometry), run.statement, Path(run.about.scene).stem
    finishes = list(run.about.features.values())
    facts = [("Part", _part(run.about.scene, finishes, document)), ("Sensor", run.about.sensor)]
    if document is not None:
        facts.append(("Pose of the sensor", pose_in_full(pose_of_view(run, document.view))))
        facts += _of_statement(document, "" if document.exposure else run.about.exposure_rule)
        facts += _influences(document, bool(run.about.lay))
        facts += _rules(stated_rules(document))
    else:
        facts.append(("Made by", "screening, from a performance map: u is predicted. The same mitsim run continues"))
    digests = _digests(*(run.folder / name for name in ("statement.json", "task.json", "part.ply", "map.nc")))
    facts.append(("Made with", f"mitsim {run.about.mitsim}, seed {run.about.seed}; SHA-256 of {digests}"))
    title, date = f"{run.about.sensor} measures {part}", run.about.date or _day(run.folder / "run.json")
    return _declared(run.folder, title, date, first, document, facts)


def _of_choice(choice: ChoiceDocument, geometry: SceneGeometry | None, folder: Path) -> Declaration:
    document, best = best_statement(choice, folder), choice.best
    shown = _of_its_view(document, best)
    first = of_choice(choice, geometry, shown)
    if best is None:
        title = f"No sensor measures {Path(choice.scene).stem}"
        return _declared(folder, title, _day(folder / CHOICE), first, None, [("Part", _part(choice.scene, [], None))])
    own = folder / best.name
    about = read_run(own).about if (own / "run.json").exists() else None
    finishes = [] if about is None else list(about.features.values())
    facts = [("Part", _part(choice.scene, finishes, document)), ("Sensor", best.name)]
    facts += [("Pose of the sensor", pose_in_full(pose)) for pose in best.poses[:1]]
    for pose in best.poses[1:]:
        names = [name for name, cell in best.measurements.items() if cell.view == pose.view]
        facts.append(("Another pose", f"for {listed(names)}, {pose_in_full(pose)}"))
    exposures = ""
    if best.capture is not None:
        times = listed([two_digits(1e3 * exposure_s) for exposure_s in best.capture.exposures_s])
        exposures = f"{best.capture.images} images of {times} ms each"
    if document is not None:
        facts += _of_statement(document, exposures)
        facts += _influences(document, about is not None and bool(about.lay))
    else:
        facts.append(("Made by", "screening alone, from a performance map: no virtual measurement, no statement"))
    facts += _rules({name: measurement.rule for name, measurement in choice.measurements.items()})
    facts += _others(choice, best)
    digests = _digests(folder / CHOICE, own / "statement.json")
    maps = f"; map {best.map_digest}" if best.map_digest else ""
    facts.append(("Made with", f"mitsim {choice.mitsim}, seed {choice.seed}; SHA-256 of {digests}{maps}"))
    title = f"{best.name} measures {Path(choice.scene).stem}"
    date = (about.date if about else "") or _day(folder / CHOICE)
    return _declared(own, title, date, first, shown, facts)


def _of_its_view(document: StatementDocument | None, best: SensorEntry | None) -> StatementDocument | None:
    """Return a statement with the measurements alone that the comparison takes from its view; others have another."""
    if document is None or best is None:
        return document
    views = {name: cell.view for name, cell in best.measurements.items()}
    own = {name: one for name, one in document.measurements.items() if views.get(name) in (None, document.view)}
    return document.model_copy(update={"measurements": own})


def _declared(
    folder: Path,
    title: str,
    date: str,
    first: FirstScreen,
    document: StatementDocument | None,
    facts: list[tuple[str, str]],
) -> Declaration:
    stated: Mapping[str, StatedMeasurement] = {} if document is None else document.measurements
    rows = [_row(row, stated.get(row.name)) for row in first.rows]
    number = _digest(folder / "statement.json") if document is not None else ""
    return Declaration(title, date, number, first, rows, facts, _notes(document))


def _row(result: ResultRow, measurement: StatedMeasurement | None) -> DeclaredRow:
    if measurement is None:
        return DeclaredRow(result, result.bias, NONE, NONE, NONE, NONE)
    factor = measurement.coverage_factor
    return DeclaredRow(
        result,
        bias_words(measurement.bias, measurement.standard_uncertainty, measurement.unit),
        quantity(measurement.expanded_uncertainty, measurement.unit),
        NONE if factor is None else rounded(factor, 2),
        interval_words(measurement.interval, measurement.unit),
        count(measurement.trials),
    )


def _notes(document: StatementDocument | None) -> list[Note]:
    """Return how to read the table, and what its numbers do not say."""
    if document is None:
        return []
    words = (
        "Error = measured − true; bias = mean error over the virtual measurements, part of the error; u = standard "
        "uncertainty, standard deviation about the bias; U = larger end of the 95 % interval, from the bias; "
        "k = U / u; N = number of virtual measurements. The interval leaves 2.5 % on either side. If y is read, the "
        "true value lies between y − (upper end) and y − (lower end)."
    )
    known, rough = document.measurements, dict[str, list[str]]()
    at_limit = [name for name, one in known.items() if one.errors_of == AT_THE_LIMIT]
    far = [name for name, one in known.items() if one.errors_of == FAR_FROM_NOMINAL]
    not_settled = [name for name, one in known.items() if not one.settled and one.trials]
    for name, one in known.items():
        if few := roughness_in_words(round(one.trials * (1 - one.without_value))):
            rough.setdefault(few, []).append(name)
    of_some = [
        ("†", "errors for a part at the limit of its tolerance.", at_limit),
        ("‡", "errors for a part far from nominal.", far),
        ("*", "not settled after JCGM 101, 7.9: more virtual measurements may change a digit.", not_settled),
        *(("§" * k, f"{few}.", names) for k, (few, names) in enumerate(rough.items(), 1)),
    ]
    notes = [
        Note(text, tuple(names), mark) if len(names) < len(known) else Note(f"All: {text}")
        for mark, text, names in of_some
        if names
    ]
    return [Note(words), *notes, *(Note(f"{one}.") for one in document.doubts("the influences listed below"))]


def _part(scene: str, finishes: Sequence[str], document: StatementDocument | None) -> str:
    kinds = list(dict.fromkeys(finish.replace(" um", " µm").replace("_", " ") for finish in finishes))
    name, coat = Path(scene).name, ", sprayed on" * (document is not None and _is_sprayed(document))
    return f"{name}; finish: {listed(kinds)}{coat}" if kinds else name


def _is_sprayed(document: StatementDocument) -> bool:
    return any("spray" in influence.name for influence in document.influences if influence.included)


def pose_in_full(pose: PoseEntry) -> str:
    """Return view, angles, standoff, position [mm] and unit quaternion (x, y, z, w) of a pose in the part frame."""
    matrix = [row[:3] for row in pose.world_from_sensor[:3]]
    turn = Rotation.from_matrix(matrix).as_quat(canonical=True)
    quaternion = ", ".join(signed(f"{value + 0.0:.6f}") for value in turn)
    return (
        f"view {pose.view}: {angles_in_words(pose)}, {rounded(pose.standoff_mm)} mm away. Part from sensor: origin "
        f"({origin_text(pose, 3)}) mm, quaternion x, y, z, w ({quaternion})"
    )


def _of_statement(document: StatementDocument, exposures: str) -> list[tuple[str, str]]:
    trials = max((measurement.trials for measurement in document.measurements.values()), default=0)
    how = "rendered and decoded" if document.measured_by == "render" else "drawn from a performance map"
    exposed = exposed_in_words(document.exposure)
    made = f"{count(trials)} virtual measurement{'' if trials == 1 else 's'}"
    return [
        ("Method", f"{made}, {how}: a virtual experiment, “simulate and analyse”"),
        ("Calibration", calibration_in_words(document, sizes=False)),
        ("Exposure", exposed or exposures),
        ("Verified by", VERIFIED),
    ]


def _influences(document: StatementDocument, lay_open: bool) -> list[tuple[str, str]]:
    """Return the influences varied, fixed and left out (ISO/TS 15530-4); ``lay_open``: no known direction of marks."""
    varied = [influence for influence in document.influences if influence.included]
    fixed = [influence for influence in document.influences if not influence.included and influence.simulated]
    left_out = [influence for influence in document.influences if not influence.included and not influence.simulated]
    marks = ["direction of machining marks"] * lay_open
    missing = _names(left_out) + marks * (not document.draws_lay)
    # a map has its own finish, light and decoder; another unit has no size
    idle = {"unit", "finish", "light", "decoder"} if document.measured_by == "map" else {"unit"}
    idle |= set() if _is_sprayed(document) else {"coat"}
    drawn = {group: table for group, table in document.unknowns.items() if group not in idle}
    out = [
        (VARIED, "; ".join(_names(varied) + marks * document.draws_lay)),
        (SIZES, unknowns_in_words(drawn)),
    ]
    out += [(FIXED, "; ".join(_names(fixed)))] if fixed else []
    return [*out, (LEFT_OUT, "; ".join(missing))]


def _names(influences: Sequence[InfluenceEntry]) -> list[str]:
    return [influence.name for influence in influences]


def _rules(rules: Mapping[str, str]) -> list[tuple[str, str]]:
    words = rules_in_words(rules)
    return [("Decision rule", words)] if words else []


def _others(choice: ChoiceDocument, best: SensorEntry) -> list[tuple[str, str]]:
    asked, words = choice.toleranced, []
    for sensor in choice.sensors:
        if sensor is not best and sensor.status != "excluded":
            by = "" if sensor.status == "stated" else ", by screening alone"
            fits = sensor.fits_in_words(asked) if asked else sensor.possible_in_words or "all possible"
            words.append(f"{sensor.name} ({fits}{by})")
    return [("Also compared", ", ".join(words))] if words else []


def _digests(*paths: Path) -> str:
    """Return the names and the first digits of the SHA-256 of the files that exist."""
    return ", ".join(f"{path.name} {_digest(path)}" for path in paths if path.exists())


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()[:_DIGITS]


def _day(path: Path) -> str:
    """Return the day here on which a file was written, for folders of older versions, whose files do not say it."""
    return datetime.fromtimestamp(path.stat().st_mtime, UTC).astimezone().date().isoformat()
