"""Compare measurements drawn from a map with rendered ones, for the same views in the same worlds.

Signal chain: kept rendered trials of a case (:mod:`tests.proofs.case_trials`) -> the same trials drawn from the
map -> errors of both over the predicted uncertainty of screening -> quantiles Q of their sizes for each kind of sensor
-> effects outside the map, sqrt(Q_rendered^2 - Q_drawn^2), in ascending order -> 95 % intervals that drawn measurements
would state, with and without them -> share of the rendered errors inside.

Quantiles are subtracted like standard deviations. This is exact for normal errors, and close for errors of similar
distributions. All cases of a kind have equal weight. Open cases are judged by the quantiles of the *other* open cases
of their kind.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from characterisation.words.progress import say, track
from mitsim.study.session import Session
from mitsim.study.virtual.beyond_map import CODED, FLIGHT, MATCHED, BeyondMap, Sizes, drawn_sizes, kind_of
from mitsim.study.virtual.mapped import MappedMeasurements
from mitsim.study.virtual.race import Job
from mitsim.study.virtual.world import BEYOND
from tests.proofs.case_trials import days, trials_by_kind
from tests.proofs.part_cases import PartCase

Floats = NDArray[np.float64]

#: levels of the quantiles
LEVELS = (*(round(0.05 * k, 2) for k in range(1, 20)), 0.975, 0.99)

#: number of errors drawn from each case for the quantiles of its kind, and resamples of the bootstrap
_DRAWN_PER_CASE, _RESAMPLES = 2000, 200

#: draws per drawn measurement for an interval
_DRAWS = 200

#: smallest number of worlds in which a view has both values
_LEAST_WORLDS = 4


@dataclass(frozen=True)
class ComparedCase:
    """Errors (measurement, view, world) of a case, ``drawn`` from the map and ``rendered``, NaN without a value.

    ``predicted`` (measurement, view) is the standard uncertainty of screening, NaN for an impossible view.
    """

    case: PartCase
    sensor: str
    kind: str
    measurements: tuple[str, ...]
    drawn: Floats
    rendered: Floats
    predicted: Floats

    def sizes(self, errors: Floats) -> Floats:
        """Return sizes (n,) of errors over predicted uncertainty, where both kinds have values."""
        known = np.isfinite(self.drawn) & np.isfinite(self.rendered)
        known &= known.sum(axis=-1, keepdims=True) >= _LEAST_WORLDS
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = np.abs(errors) / self.predicted[..., None]
        return np.asarray(ratio[known & np.isfinite(ratio)])


def compare_case(case: PartCase, folder: Path, views: int, worlds: int) -> ComparedCase | None:
    """Draw trials of a case's first views from the map; None without kept rendered trials."""
    study = case.open()
    truth = trials_by_kind(case, study, folder)["truth"]
    some, trials = study.views[:views], days(worlds)
    if any(set(trials) - set(truth.trials.known(view.number)) for view in some):
        say(f"{case.name}: skipped, since some of its rendered trials are missing")
        return None
    study = replace(study, candidates=replace(study.candidates, views=some))
    scores, _ = Session(study).screen()
    unknowns = replace(truth.unknowns, varied=tuple(group for group in truth.unknowns.varied if group != BEYOND))
    runner = MappedMeasurements(study, unknowns)
    names = tuple(study.task.measurements)
    drawn = np.full((len(names), len(some), worlds), np.nan)
    jobs = [Job(view, trial) for view in some for trial in trials]
    for job, outcome in track(runner.run(jobs), case.name, len(jobs)):
        drawn[:, some.index(job.view), job.trial.day] = [outcome.errors[name] for name in names]
    rendered = np.stack([truth.trials.errors(view.number, trials) for view in some], axis=1)
    predicted = scores["predicted_uncertainty"].sel(measurement=list(names)).transpose("measurement", "view").values
    return ComparedCase(case, study.sensor.name, kind_of(study.sensor), names, drawn, rendered, predicted)


def fitted_sizes(cases: Sequence[ComparedCase], seed: int = 0, resamples: int = _RESAMPLES) -> Sizes:
    """Return the sizes of effects outside the map for one kind of sensor, with 95 % intervals over the cases.

    Raises
    ------
    ValueError
        If no view of the cases has both rendered and drawn values.
    """
    pairs, rng = _pairs(cases), np.random.default_rng(seed)
    best = _beyond(pairs, rng)
    again = np.array(
        [_beyond([pairs[i] for i in rng.integers(0, len(pairs), len(pairs))], rng) for _ in range(resamples)]
    )
    low, high = np.quantile(again, [0.025, 0.975], axis=0)
    return Sizes.model_validate(
        {"levels": list(LEVELS), "size": _rounded(best), "low": _rounded(low), "high": _rounded(high)}
    )


def beyond_quantiles(cases: Sequence[ComparedCase], seed: int = 0) -> Floats:
    """Return quantiles (level,) at :data:`LEVELS` of effects outside the map for one kind of sensor, without intervals.

    Raises
    ------
    ValueError
        If no view of the cases has both rendered and drawn values.
    """
    return np.array(_rounded(_beyond(_pairs(cases), np.random.default_rng(seed))))


def inside(case: ComparedCase, size: ArrayLike | None, seed: int = 0) -> tuple[int, int]:
    """Return the number of rendered errors inside the 95 % intervals of the drawn ones, and that of all errors.

    A random effect outside the map, with the quantiles ``size`` (level,), is added to each drawn error; None adds
    nothing.
    """
    rng = np.random.default_rng(seed)
    count, of = 0, 0
    for drawn, rendered, predicted in zip(
        case.drawn.reshape(-1, case.drawn.shape[-1]),
        case.rendered.reshape(-1, case.rendered.shape[-1]),
        case.predicted.ravel(),
        strict=True,
    ):
        drawn, rendered = drawn[np.isfinite(drawn)], rendered[np.isfinite(rendered)]
        if min(len(drawn), len(rendered)) < _LEAST_WORLDS or not np.isfinite(predicted):
            continue
        # for a dozen drawn errors, mean and standard deviation are better known than a quantile
        some = drawn.mean() + drawn.std(ddof=1) * rng.standard_normal(_DRAWS * 10)
        if size is not None:
            some = some + predicted * drawn_sizes(rng, len(some), LEVELS, size)
        low, high = np.quantile(some, [0.025, 0.975])
        count += int(((rendered >= low) & (rendered <= high)).sum())
        of += len(rendered)
    return count, of


def judged_table(cases: Sequence[ComparedCase]) -> list[tuple[Any, ...]]:
    """Return a row for each case: part, sensor, finish, sealed, two ratios, two shares and the number of errors.

    The ratios are medians over views and measurements: rendered root mean square error over that drawn from the map,
    and over the predicted uncertainty. The shares are those inside the intervals, without and with effects outside the
    map.
    """
    rows = []
    for case in cases:
        others = [one for one in cases if one.kind == case.kind and one.case.usable_for_fitting and one is not case]
        size = beyond_quantiles(others) if others else None
        alone, of = inside(case, None)
        both = inside(case, size)[0] if size is not None else 0
        rendered, drawn = (_root_mean_square(errors) for errors in (case.rendered, case.drawn))
        ratios = [_median(rendered / under) for under in (drawn, case.predicted)]
        table = case.case.table
        rows.append(
            (
                table.part,
                case.sensor,
                table.finish,
                case.case.sealed,
                *ratios,
                alone / of if of else np.nan,
                both / of if of and size is not None else np.nan,
                of,
            )
        )
    return rows


def beyond_map_document(command: str, cases: Sequence[ComparedCase]) -> str:
    """Return the data file of all open cases as TOML.

    Raises
    ------
    ValueError
        If a kind of sensor has no open case.
    """
    opened = [one for one in cases if one.case.usable_for_fitting]
    found = {kind: fitted_sizes([one for one in opened if one.kind == kind]) for kind in (MATCHED, CODED, FLIGHT)}
    BeyondMap.model_validate({"command": command, "cases": [one.case.name for one in opened], **found})
    lines = [
        "# Sizes of errors outside the performance map, over the predicted standard uncertainty: quantiles at levels,",
        "# with 95 % intervals from a bootstrap over cases; estimated from rendered measurements of open parts.",
        f'command = "{command}"',
        "cases = [",
        *(f'  "{one.case.name}",' for one in opened),
        "]",
    ]
    for kind, sizes in found.items():
        lines += ["", f"[{kind}]", *(f"{key} = {getattr(sizes, key)}" for key in ("levels", "size", "low", "high"))]
    return "\n".join(lines) + "\n"


def _pairs(cases: Sequence[ComparedCase]) -> list[tuple[Floats, Floats]]:
    """Return the sizes of rendered and of drawn errors of each case that has both."""
    pairs = [(one.sizes(one.rendered), one.sizes(one.drawn)) for one in cases]
    pairs = [pair for pair in pairs if len(pair[0])]
    if not pairs:
        raise ValueError("no view with both rendered and drawn errors")
    return pairs


def _beyond(pairs: Sequence[tuple[Floats, Floats]], rng: np.random.Generator) -> Floats:
    pooled = [np.concatenate([rng.choice(pair[k], _DRAWN_PER_CASE) for pair in pairs]) for k in (0, 1)]
    rendered, drawn = (np.quantile(one, LEVELS) for one in pooled)
    return np.asarray(np.maximum.accumulate(np.sqrt(np.maximum(rendered**2 - drawn**2, 0.0))))


def _root_mean_square(errors: Floats) -> Floats:
    """Return root mean square errors over worlds (measurement, view); NaN for a view with too few values."""
    known = np.isfinite(errors)
    count = known.sum(axis=-1)
    square = np.where(known, errors, 0.0) ** 2
    return np.asarray(np.where(count >= _LEAST_WORLDS, np.sqrt(square.sum(axis=-1) / np.maximum(count, 1)), np.nan))


def _median(values: Floats) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else float("nan")


def _rounded(values: Floats) -> list[float]:
    return [float(f"{value:.3g}") for value in values]
