"""Virtual measurements of a set of views: every view rendered in one drawn world, the clouds joined and measured.

Signal chain: day -> world (calibration, finish, light, temperature and place of the part common to all views of the
set; noise and speckle fresh in each) -> a cloud of each view -> pose of each view as it is told, with the error that it
is known with -> points of every feature in the part's frame -> joined as they are, or by best fit of each view to those
before it -> measured -> error of every measurement -> the same statement as of one view.

A set of one view is measured as any view is. Joined points have no one viewpoint, and are fitted by their orthogonal
distances (:func:`characterisation.tasks.measuring.measure_points`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from characterisation.features.best_fit import best_fit, motion_matrix
from characterisation.features.fits import belonging
from characterisation.features.robust_fit import FitError
from characterisation.point_cloud import PointCloud
from characterisation.scores.joining import pose_covariance
from characterisation.scores.view_sets import ViewSet
from characterisation.statements.decision import tolerance_of
from characterisation.statements.statement import Statement, statement
from characterisation.tasks.measuring import measure, measure_points
from characterisation.whole_files import json_values, written_whole
from mitsim.progress import track
from mitsim.study import MINIMUM_POINTS, SetTable, Study
from mitsim.text_table import aligned
from mitsim.views import View
from mitsim.virtual.planned import with_exposure
from mitsim.virtual.rendered import RenderedMeasurements
from mitsim.virtual.stated import digits
from mitsim.virtual.trials import TrialFolder
from mitsim.virtual.world import Trial

Floats = NDArray[np.float64]

#: first day of the worlds of sets: neither those of races nor those of statements
_FIRST_DAY = 1 << 21

#: seeds the streams of errors of told poses, apart from those of the groups of unknowns
_POSE_STREAM = 31


@dataclass(frozen=True)
class _Seen:
    """One view of a day: ``points`` (n, 3) [mm] of each feature, part frame as the view's pose is told."""

    points: dict[str, Floats]
    told: Floats
    cloud: PointCloud


class JoinedMeasurements:
    """A set of views of one part, ready for any number of virtual measurements of all of them together."""

    def __init__(self, here: RenderedMeasurements, views: Sequence[View], table: SetTable) -> None:
        self.here, self.views, self.table = here, list(views), table
        self.centre = np.asarray(here.study.scene.centre, float)
        self.known = pose_covariance(*table.pose_known)

    def run(self, days: Iterable[int]) -> Iterable[tuple[int, dict[str, float]]]:
        """Errors of every measurement, NaN where it has no value, day by day; those of one finish after one another."""
        draw = self.here.unknowns.draw
        order = sorted(days, key=lambda day: draw(Trial(day)).finish)
        for _, some in groupby(order, key=lambda day: draw(Trial(day)).finish):
            row = list(some)
            seen = [{day: self._seen(view, k, day) for day in row} for k, view in enumerate(self.views)]
            for day in row:
                yield day, self._measured([one[day] for one in seen], day)

    def _seen(self, view: View, place: int, day: int) -> _Seen:
        """What one view of a day sees: its ``place`` in the set is the number of its capture."""
        here, first = self.here, self.here.unknowns.draw(Trial(day))
        world = replace(here.unknowns.draw(Trial(day, place)), placed=first.placed, told=first.told)
        cloud, told = here.cloud_of(view, world)
        motion = motion_matrix(self._pose_error(place, day), self.centre) @ told.matrix()
        points = {}
        for name in here.study.task.shapes:
            some = cloud.of_feature(name)
            nominal = here.study.task.features[name].nominal(told.inverse().matrix())
            kept = some[belonging(some, nominal, cloud.grid.origin)] if len(some) else some
            points[name] = kept @ motion[:3, :3].T + motion[:3, 3]
        return _Seen(points, told.matrix(), cloud)

    def _pose_error(self, place: int, day: int) -> Floats:
        """Motion [w (rad), t (mm)] by which a view is told to stand elsewhere."""
        rng = np.random.default_rng(np.random.SeedSequence([self.here.unknowns.seed, _POSE_STREAM, day, place]))
        return np.asarray(np.sqrt(np.diag(self.known)) * rng.standard_normal(6))

    def _measured(self, seen: Sequence[_Seen], day: int) -> dict[str, float]:
        task = self.here.study.task
        if len(seen) == 1:
            motion = np.linalg.inv(seen[0].told)
            found = measure(seen[0].cloud, task, motion, MINIMUM_POINTS, False)
        else:
            try:
                points = self._joined(seen, day)
            except FitError:
                return dict.fromkeys(task.measurements, math.nan)
            found = measure_points(points, task, MINIMUM_POINTS, False)
        return {name: float(one.error) for name, one in found.items()}

    def _joined(self, seen: Sequence[_Seen], day: int) -> dict[str, Floats]:
        """Points of every feature of all views together."""
        names = list(seen[0].points)
        joined = dict(seen[0].points)
        for one in seen[1:]:
            motion = np.eye(4)
            if self.table.joining == "best_fit":
                position, angle = self.table.pose_known
                radius = max(float(np.linalg.norm(corner - self.centre)) for corner in self.here.corners)
                reach = 3 * math.sqrt(2) * (position + math.radians(angle) * radius)
                motion = best_fit(
                    np.concatenate([one.points[name] for name in names]),
                    np.concatenate([joined[name] for name in names]), self.centre, 2 * self.known, reach, day,
                )  # fmt: skip
            for name in names:
                moved = one.points[name] @ motion[:3, :3].T + motion[:3, 3]
                joined[name] = np.concatenate([joined[name], moved])
        return joined


def state_set(
    study: Study, chosen: ViewSet, here: RenderedMeasurements, digest: str, folder: Path
) -> list[Statement]:  # fmt: skip
    """State every measurement from a set of views together; trials that the folder holds are not made again."""
    table = study.file.set
    assert table is not None
    told = with_exposure(digest, None, ["set", list(chosen.views), table.joining, list(table.pose_known)])
    trials = TrialFolder(folder / "set_trials", told, list(study.task.measurements))
    by_number = {view.number: view for view in study.views}
    maker = JoinedMeasurements(here, [by_number[number] for number in chosen.views], table)
    days = [_FIRST_DAY + k for k in range(table.trials)]
    missing = [day for day in days if Trial(day) not in trials.known(0)]
    for day, errors in track(maker.run(missing), "confirm the set", len(missing)):
        trials.add(0, Trial(day), errors)
    found = trials.errors(0, [Trial(day) for day in days])
    return [
        statement(name, asked.unit, found[m], tolerance_of(study.task, name))
        for m, (name, asked) in enumerate(study.task.measurements.items())
    ]


def joining_in_words(table: SetTable) -> str:
    """Like ``joined by robot: each pose to 0.3 mm and 0.03 deg``."""
    if table.joining == "exact":
        return "joined as if their poses were exact"
    position, angle = table.pose_known
    if table.joining == "best_fit":
        return f"joined by best fit, from poses known to {position:g} mm and {angle:g} deg"
    return f"joined by {table.joining}: each pose to {position:g} mm and {angle:g} deg"


def confirmed_entry(stated: Sequence[Statement]) -> dict[str, Any]:
    """What virtual measurements of the set gave, by measurement, as JSON values."""
    keys = ("unit", "trials", "without_value", "bias", "standard_uncertainty", "interval", "verdict")
    out = {}
    for one in stated:
        decision = None if one.decided is None else asdict(one.decided)
        out[one.measurement] = json_values({key: getattr(one, key) for key in keys} | {"decision": decision})
    return out


def write_set_csv(path: Path, table: SetTable, chosen: ViewSet, stated: Sequence[Statement]) -> None:
    """Limit, expected and confirmed uncertainty of every measurement: a row each."""
    expected = dict(zip(table.limits, chosen.uncertainty.tolist(), strict=True))
    lines = ["measurement,unit,limit,expected_uncertainty,trials,without_value,bias,uncertainty,low,high,verdict"]
    for one in stated:
        limit, u = table.limits.get(one.measurement), expected.get(one.measurement)
        numbers = [one.bias, one.standard_uncertainty, *one.interval]
        lines.append(",".join([
            one.measurement, one.unit, "" if limit is None else f"{limit:g}", "" if u is None else f"{u:.4g}",
            str(one.trials), f"{one.without_value:.4g}",
            *("" if not math.isfinite(number) else f"{number:.4g}" for number in numbers), one.verdict,
        ]))  # fmt: skip
    with written_whole(path) as file:
        file.write_text("\n".join(lines) + "\n", encoding="utf-8")


def set_table(table: SetTable, chosen: ViewSet, stated: Sequence[Statement]) -> str:
    """The set as a table of text: limit, expected u, and bias and u as virtual measurements of the set give them."""
    expected = dict(zip(table.limits, chosen.uncertainty.tolist(), strict=True))
    rows = [("measurement", "unit", "limit", "expected u", "bias", "u", "no value", "limit kept")]
    for one in stated:
        limit, u = table.limits.get(one.measurement), expected.get(one.measurement)
        rows.append((
            one.measurement, one.unit, "-" if limit is None else f"{limit:g}", "-" if u is None else f"{u:.2g}",
            digits(one.bias), digits(one.standard_uncertainty), f"{100 * one.without_value:.0f} %",
            "-" if limit is None else "yes" if one.root_mean_square <= limit else "no",
        ))  # fmt: skip
    return "\n".join(aligned(rows))
