"""A change of a study, and the study after it.

Signal chain: stated view whose measurements do not all fit -> keys of a changed study, or another view -> the same
virtual measurements under the change.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import xarray as xr

from characterisation.files.errors import InputError
from characterisation.statements.selection import PRIOR_OWN
from characterisation.statements.statement import Statement
from mitsim.running.time_limit import TimeLimit
from mitsim.study import StatementTable, Study, StudyFile, open_study
from mitsim.study.remedies.bounds import Effect, can_fit, least_uncertainty
from mitsim.study.session import Session
from mitsim.study.view_sets.confirmed_set import Search
from mitsim.study.virtual.plan import change_rendering, measured_by
from mitsim.study.virtual.race import Raced
from mitsim.study.virtual.spread_out import is_room_for_another
from mitsim.study.virtual.stated import StatedView
from mitsim.views import View

#: verdicts that ask for a change; a measurement that is not decided asks for more virtual measurements
MISSED = ("does not fit", "undecidable")

#: factor by which a ratio of uncertainties from the map may be too large: one standard deviation of its logarithm
SCREENING_FACTOR = math.exp(PRIOR_OWN)

#: states every measurement under a change, from a number of trials or those within a limit
Stating = Callable[[int, TimeLimit], list[Statement]]


@dataclass(frozen=True)
class Shortfall:
    """A stated view whose measurements do not all fit, and the other views; ``search`` finds sets by the map."""

    session: Session
    stated: StatedView
    scores: xr.Dataset
    raced: Raced
    search: Search

    @property
    def folder(self) -> Path:
        """Return the folder of the trials of changed studies."""
        return self.session.folder / "remedies"

    @property
    def study(self) -> Study:
        """Return the study."""
        return self.session.study

    @property
    def missed(self) -> dict[str, Statement]:
        """Return the statements of the measurements that do not fit, by name."""
        return missed_by(self.stated)


def missed_by(stated: StatedView) -> dict[str, Statement]:
    """Return the statements of a view's measurements that do not fit, by name."""
    return {statement.measurement: statement for statement in stated.statements if statement.verdict in MISSED}


@dataclass(frozen=True)
class Change:
    """One change of a study.

    Parameters
    ----------
    kind
        ``bias``, ``view``, ``nearer``, ``exposure``, ``repeats``, ``light``, ``calibration``, ``temperature``,
        ``views``, ``spray``, ``decoder`` or ``sensor``.
    words, keys
        The change, to follow "it would fit": ``sprayed matt white``; keys of the study's TOML file that make it, of the
        task for ``bias``.
    views, expected
        Numbers of the views that measure, of the changed study; least standard uncertainty, in its unit, of each
        measurement that can fit.
    state, release
        Makes the virtual measurements, raises :class:`InputError` if the change is impossible; frees their memory.
    captures, needs_trials
        Number of captures whose mean is taken; whether it takes virtual measurements of its own.
    """

    kind: str
    words: str
    keys: Mapping[str, Any]
    views: tuple[int, ...]
    expected: Mapping[str, float]
    state: Stating
    captures: int = 1
    release: Callable[[], None] = field(default=lambda: None)
    needs_trials: bool = True


def session_of_views(session: Session, folder: Path) -> Session:
    """Return the session of other views that a remedy tries, which have fewer light paths if a statement has many."""
    rendering = change_rendering(session.study)
    if session.renderer is None or rendering == session.renderer.rendering:
        return session
    other = Session(session.study, folder, session.workers, session.separate_light, rendering)
    other.unknowns, other.measurements = session.unknowns, session.renderer.rendered_as(rendering)
    return other


class ChangedStudy:
    """Virtual measurements of one view of a changed study, prepared at the first use."""

    def __init__(self, now: Shortfall, name: str, study: Callable[[], Study], view: Callable[[Study], View]) -> None:
        self.now, self.name, self.study, self.view = now, name, study, view
        self.session: Session | None = None

    def state(self, count: int, limit: TimeLimit) -> list[Statement]:
        """State every measurement from a number of trials, or those within a limit."""
        if self.session is None:
            if not is_room_for_another():
                self.now.session.release()
            study, workers = self.study(), self.now.session.workers
            self.session = Session(study, self.now.folder / self.name, workers, rendering=change_rendering(study))
        return self.session.state(self.view(self.session.study), StatementTable(trials=count), limit).statements

    def release(self) -> None:
        """Free the memory of the measurements."""
        if self.session is not None:
            self.session.release()


def changed_file(file: StudyFile, keys: Mapping[str, Any]) -> StudyFile:
    """Return a study's file with keys of its tables replaced."""

    def merged(old: dict[str, Any], new: Mapping[str, Any]) -> dict[str, Any]:
        both = dict(old)
        for key, value in new.items():
            nested = isinstance(value, Mapping) and isinstance(both.get(key), dict)
            both[key] = merged(both[key], value) if nested else value
        return both

    return StudyFile.model_validate(merged(file.model_dump(exclude_unset=True), keys))


def reopened(study: Study, keys: Mapping[str, Any]) -> Study:
    """Open a study with keys of its file replaced; its map is kept."""
    by_map = measured_by(study) == "map"
    opened = open_study(study.path, changed_file(study.file, keys), mapped=by_map)
    return opened if by_map else replace(opened, performance_map=study.performance_map)


def possible(now: Shortfall, effect: Effect) -> dict[str, float]:
    """Return the least uncertainty after a change, of the measurements that can fit with it."""
    least = {name: least_uncertainty(statement, effect) for name, statement in now.missed.items()}
    return {name: u for name, u in least.items() if can_fit(now.missed[name], u, effect.unbiased)}


def same_direction(study: Study, view: View) -> View:
    """Return the view of a study with direction and roll of another's view; InputError if it has none."""
    for candidate in study.views:
        if float(candidate.direction @ view.direction) > 1 - 1e-9 and math.isclose(
            candidate.roll_deg, view.roll_deg, abs_tol=1e-6
        ):
            return candidate
    raise InputError(study.path, "views", f"no view in the direction of view {view.number}", "a view there")
