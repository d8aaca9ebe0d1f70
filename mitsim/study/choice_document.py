"""Read and write ``choice.json``: which of several sensors measures best.

A cell is one measurement by one sensor. It says whether it rests on a statement (virtual measurements) or on the
screening alone.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field, model_validator

from characterisation.files.checked_files import read_json_object
from characterisation.files.documents import validate
from characterisation.files.errors import InputError
from characterisation.statements.verdict_words import Judged, fits_in_words
from characterisation.tasks.task_file import tolerance_size
from characterisation.words.numbers import or_nan, two_digits
from mitsim.study.statement_file import PartialDocument, StatementDocument, read_statement, roughness_in_words

#: name of the file in the folder
CHOICE = "choice.json"


class ComparedMeasurement(PartialDocument):
    """One measurement: its kind and tolerance as in the task, and its decision rule in words."""

    unit: str
    nominal: float
    tolerance: float | tuple[float, float] | None
    rule: str
    features: list[str]
    kind: str = ""

    @property
    def tolerance_size(self) -> float | None:
        """Return the size of the tolerance, as in the task; None without one."""
        return tolerance_size(self.kind, self.nominal, self.tolerance)


class CellEntry(PartialDocument):
    """One measurement by one sensor from ``view``, in the measurement's unit; null without a value.

    ``by`` is ``statement`` or ``screening``, or ``none`` for an impossible measurement: by virtual measurements if
    ``trials`` is above 0, otherwise by screening; ``reason`` says why. ``demand`` is the figure that the decision rule
    limits to 1. Without a tolerance it is the uncertainty relative to that of the best sensor.
    """

    by: Literal["statement", "screening", "none"] = "none"
    view: int | None = None
    uncertainty: float | None = None
    bias: float | None = None
    share_of_tolerance: float | None = None
    demand: float | None = None
    demand_interval: tuple[float | None, float | None] | None = None
    verdict: Literal["fits", "no tolerance", "not decided", "does not fit", "undecidable"] = "undecidable"
    fits_corrected: bool = False
    accepted: tuple[float | None, float] | None = None
    needed: float | None = None
    false_accept: float | None = None
    false_reject: float | None = None
    trials: int = 0
    without_value: float = 1.0
    reason: str = ""

    @property
    def why_impossible(self) -> str:
        """Return the reason why the measurement is impossible; empty if it is possible."""
        if self.by != "none":
            return ""
        count = "no virtual measurement" if self.without_value == 1 else "only one virtual measurement"
        text = f"{count} of {self.trials} gave a value" if self.trials else "by screening, no view can make it"
        return f"{text}: {self.reason}" if self.reason else text


#: reason why a sensor that may win has no virtual measurements
TIME_OVER = "time was over"

_Row = tuple[float, float, float, float]


class PoseEntry(PartialDocument):
    """Pose of the sensor: number of the view, angles [deg], |V| [mm], and the 4 x 4 matrix in the part frame."""

    view: int
    azimuth_deg: float
    elevation_deg: float
    roll_deg: float
    standoff_mm: float
    world_from_sensor: tuple[_Row, _Row, _Row, _Row]


class CaptureEntry(PartialDocument):
    """Effort of one capture: images, exposures of each [s], total exposure time [s] without readout."""

    images: int
    exposures_s: list[float]
    seconds: float


class SensorEntry(PartialDocument):
    """One sensor of the table; ``ratio`` is the largest demand of its possible measurements, null without any.

    In a task with tolerances, only measurements with a tolerance count for ``ratio``. ``status`` is ``stated`` (virtual
    measurements), ``screened`` (screening only: fewer measurements possible, far from fitting, or out of time) or
    ``excluded``; ``why`` gives the reason. ``poses`` starts with the view for all measurements. ``lacks`` says what was
    not done for lack of time.
    """

    name: str
    given: str
    status: Literal["stated", "screened", "excluded"]
    why: str
    ratio: float | None
    fits: int
    words: str
    poses: list[PoseEntry] = Field(default_factory=list)
    capture: CaptureEntry | None = None
    measurements: dict[str, CellEntry] = Field(default_factory=dict)
    map_digest: str = ""
    lacks: str = ""

    @property
    def impossible(self) -> dict[str, str]:
        """Return the reason of every impossible measurement, by name."""
        return {name: cell.why_impossible for name, cell in self.measurements.items() if cell.why_impossible}

    @property
    def roughness_in_words(self) -> str:
        """Return how much larger standard uncertainties may be, if few trials stand behind them; otherwise empty."""
        return roughness_in_words(
            min((cell.trials for cell in self.measurements.values() if cell.by == "statement"), default=0)
        )

    @property
    def possible_in_words(self) -> str:
        """Return how many of the measurements are possible; empty if all are."""
        every = len(self.measurements)
        return f"{every - len(self.impossible)} of {every} measurements possible" if self.impossible else ""

    @property
    def expected_fits(self) -> int:
        """Return the number of tolerances that are expected to fit, or do, by their demand."""
        cells = self.measurements.values()
        return sum(cell.verdict != "no tolerance" and cell.demand is not None and cell.demand <= 1 for cell in cells)

    def fits_in_words(self, toleranced: int) -> str:
        """Return how many of the tolerances fit, or are expected to, and how many of a measured sensor are open."""
        if self.status != "stated":
            return f"{self.expected_fits} of {toleranced} expected to fit"
        unsure = sum(cell.verdict == "not decided" for cell in self.measurements.values())
        return fits_in_words(self.fits, unsure, toleranced)

    def fits_in_cell(self, toleranced: int) -> str:
        """Return :meth:`fits_in_words` below a heading that says *fits*; empty without tolerances."""
        return self.fits_in_words(toleranced).removeprefix("fits ") if toleranced else ""

    @property
    def fits_all(self) -> bool:
        """Return whether all measurements are possible, and every tolerance is decided to fit."""
        verdicts = {cell.verdict for cell in self.measurements.values()}
        return not self.impossible and "fits" in verdicts and verdicts <= {"fits", "no tolerance"}


class ChoiceDocument(PartialDocument):
    """``choice.json``; ``sensors`` are sorted, best first."""

    schema_version: Literal[1]
    mitsim: str
    study: str
    scene: str
    seed: int
    words: str
    finished: bool
    seconds: float
    measurements: dict[str, ComparedMeasurement]
    sensors: list[SensorEntry]

    @property
    def best(self) -> SensorEntry | None:
        """Return the first sensor that takes part; None without any."""
        return next((sensor for sensor in self.sensors if sensor.status != "excluded" and sensor.measurements), None)

    @property
    def toleranced(self) -> int:
        """Return the number of measurements with a tolerance."""
        return sum(measurement.tolerance is not None for measurement in self.measurements.values())

    @property
    def fit_more(self) -> list[str]:
        """Return a sentence on each measured sensor that fits more tolerances than the best, and why it comes later."""
        best, out = self.best, list[str]()
        if best is None or best.status != "stated":
            return out
        for sensor in self.sensors:
            if sensor.status != "stated" or sensor.fits <= best.fits:
                continue
            why = "it can make more measurements"
            if len(sensor.impossible) <= len(best.impossible):
                mine, other = (two_digits(or_nan(entry.ratio)) for entry in (best, sensor))
                ratios = f"{mine} times its limit, that of {sensor.name} at {other}"
                why = f"its worst measurement is at {ratios} times"
            fits = "; ".join(f"{entry.name} {entry.fits_in_words(self.toleranced)}" for entry in (sensor, best))
            out.append(f"{fits}. {best.name} leads, since {why}")
        return out

    @model_validator(mode="after")
    def _of_all(self) -> ChoiceDocument:
        for sensor in self.sensors:
            if sensor.status != "excluded" and set(sensor.measurements) != set(self.measurements):
                raise ValueError(f"sensor {sensor.name} must have exactly one cell for each measurement")
        return self


def read_choice(folder: Path) -> ChoiceDocument | None:
    """Read ``choice.json`` of a folder; return None if there is none.

    Raises InputError if the file is not a valid choice document.
    """
    path = folder / CHOICE
    if not path.exists():
        return None
    return validate(path, read_json_object(path), ChoiceDocument)


def best_statement(choice: ChoiceDocument, folder: Path) -> StatementDocument | None:
    """Return the statement of the best sensor of a comparison in ``folder``; None if it was not measured virtually.

    Raises InputError if the file is not a valid statement.
    """
    best = choice.best
    return read_statement(folder / best.name / "statement.json") if best and best.status == "stated" else None


def winner_folder(folder: Path) -> Path:
    """Return the folder of the best sensor of a finished comparison; any other folder is returned as it is.

    Raises InputError if the comparison is not finished, or no sensor was measured virtually.
    """
    choice = None if (folder / "run.json").exists() else read_choice(folder)
    if choice is None:
        return folder
    if not choice.finished:
        hint = "run the same mitsim study choose again: it continues"
        raise InputError(folder / CHOICE, "finished", "false", "a finished comparison", hint)
    if not choice.sensors or choice.sensors[0].status != "stated":
        sensors, allowed = "no sensor with a statement", "a best sensor that was measured virtually"
        raise InputError(folder / CHOICE, "sensors", sensors, allowed, "give mitsim study choose more --minutes")
    return folder / choice.sensors[0].name


def judged(entry: SensorEntry) -> list[Judged]:
    """Return the verdicts of a sensor, for their summary in words."""
    return [
        Judged(
            name,
            "",
            cell.verdict,
            or_nan(cell.uncertainty),
            or_nan(cell.needed),
            cell.fits_corrected,
            cell.without_value,
            cell.trials,
        )
        for name, cell in entry.measurements.items()
    ]
