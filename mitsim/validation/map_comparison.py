"""Measurements that are drawn from a map, compared with rendered ones of the same views in the same worlds.

Signal chain: kept trials of a case (:mod:`mitsim.validation.case_trials`), rendered -> the same trials drawn from the
map -> errors of both over the uncertainty that screening predicts -> of each kind of sensor the quantiles Q of their
sizes -> what is beyond the map, sqrt(Q_rendered^2 - Q_drawn^2), in ascending order -> 95 % intervals that the drawn
measurements would state, with it and without -> share of the rendered errors inside.

Quantiles subtract like standard deviations: it is exact for normal errors, and close for others that are alike in form.
All cases of a kind weigh alike. Open cases are judged by what the *other* open cases of their kind say.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsim.prediction import Predictor
from mitsim.progress import say, track
from mitsim.reconstruction.cloud import sensor_geometry
from mitsim.validation.case_trials import benches, days
from mitsim.validation.part_cases import PartCase
from mitsim.virtual.beyond_map import CODED, FLIGHT, MATCHED, BeyondMap, Sizes, drawn_sizes, kind_of
from mitsim.virtual.mapped import MappedMeasurements
from mitsim.virtual.race import Job
from mitsim.virtual.screening import screen
from mitsim.virtual.world import BEYOND

Floats = NDArray[np.float64]

#: quantiles that are kept
LEVELS = (*(round(0.05 * k, 2) for k in range(1, 20)), 0.975, 0.99)

#: errors that each case lends to the quantiles of its kind, and resamples of the bootstrap
_LENT, _RESAMPLES = 2000, 200

#: draws that an interval is made from, for each drawn measurement
_DRAWS = 200

#: worlds in which a view has to give a value both ways
_LEAST_WORLDS = 4


@dataclass(frozen=True)
class ComparedCase:
    """Errors (measurement, view, world) of a case, ``drawn`` from the map and ``rendered``, NaN without a value.

    ``predicted`` (measurement, view) standard uncertainty of the screening, NaN where it calls a view impossible.
    """

    case: PartCase
    sensor: str
    kind: str
    measurements: tuple[str, ...]
    drawn: Floats
    rendered: Floats
    predicted: Floats

    def sizes(self, errors: Floats) -> Floats:
        """Sizes (n,) of errors over what was predicted, where both ways give values."""
        known = np.isfinite(self.drawn) & np.isfinite(self.rendered)
        known &= known.sum(axis=-1, keepdims=True) >= _LEAST_WORLDS
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = np.abs(errors) / self.predicted[..., None]
        return np.asarray(ratio[known & np.isfinite(ratio)])


def compare_case(case: PartCase, folder: Path, views: int, worlds: int) -> ComparedCase | None:
    """Draw trials of a case's first views from the map; None where it has no kept trials that are rendered."""
    study = case.open()
    bench = benches(case, study, folder)["truth"]
    some, trials = study.views[:views], days(worlds)
    if any(set(trials) - set(bench.trials.known(view.number)) for view in some):
        say(f"{case.name}: left out, its rendered trials are not all there")
        return None
    study = replace(study, candidates=replace(study.candidates, views=some))
    assert study.performance_map is not None
    scores, _ = screen(study, Predictor.of_sensor(study.sensor, sensor_geometry(study.sensor)), study.performance_map)
    unknowns = replace(bench.unknowns, varied=tuple(group for group in bench.unknowns.varied if group != BEYOND))
    maker = MappedMeasurements(study, unknowns)
    names = tuple(study.task.measurements)
    drawn = np.full((len(names), len(some), worlds), np.nan)
    jobs = [Job(view, trial) for view in some for trial in trials]
    for job, errors in track(maker.run(maker.in_order(jobs)), case.name, len(jobs)):
        drawn[:, some.index(job.view), job.trial.day] = [errors[name] for name in names]
    rendered = np.stack([bench.trials.errors(view.number, trials) for view in some], axis=1)
    predicted = scores["predicted_uncertainty"].sel(measurement=list(names)).transpose("measurement", "view").values
    return ComparedCase(case, study.sensor.name, kind_of(study.sensor), names, drawn, rendered, predicted)


def fitted_sizes(cases: Sequence[ComparedCase], seed: int = 0, resamples: int = _RESAMPLES) -> Sizes:
    """Sizes of what is beyond the map in some cases of one kind of sensor, with 95 % intervals over the cases.

    Raises
    ------
    ValueError
        If no view of the cases gave values both ways.
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
    """Quantiles (level,) at :data:`LEVELS` of what is beyond the map in some cases of one kind, without intervals.

    Raises
    ------
    ValueError
        If no view of the cases gave values both ways.
    """
    return np.array(_rounded(_beyond(_pairs(cases), np.random.default_rng(seed))))


def inside(case: ComparedCase, size: ArrayLike | None, seed: int = 0) -> tuple[int, int]:
    """How many rendered errors lie inside the 95 % intervals that the drawn ones state, and of how many.

    Of what is beyond the map, with the quantiles ``size`` (level,), a draw is added to each; None for what the map
    alone would state.
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
        # of a dozen drawn errors the mean and standard deviation are known better than a quantile
        some = drawn.mean() + drawn.std(ddof=1) * rng.standard_normal(_DRAWS * 10)
        if size is not None:
            some = some + predicted * drawn_sizes(rng, len(some), LEVELS, size)
        low, high = np.quantile(some, [0.025, 0.975])
        count += int(((rendered >= low) & (rendered <= high)).sum())
        of += len(rendered)
    return count, of


def judged_table(cases: Sequence[ComparedCase]) -> list[tuple[Any, ...]]:
    """Rows (part, sensor, finish, sealed, ratio of the map, of the screening, inside without and with, of).

    Ratios are medians over views and measurements of the rendered root-mean-square error over that which the map draws,
    and over the predicted uncertainty.
    """
    rows = []
    for case in cases:
        others = [one for one in cases if one.kind == case.kind and one.case.lends and one is not case]
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
    """The data file of all open cases, as TOML.

    Raises
    ------
    ValueError
        If a kind of sensor has no open case.
    """
    opened = [one for one in cases if one.case.lends]
    found = {kind: fitted_sizes([one for one in opened if one.kind == kind]) for kind in (MATCHED, CODED, FLIGHT)}
    BeyondMap.model_validate({"command": command, "cases": [one.case.name for one in opened], **found})
    lines = [
        "# Sizes of error that a performance map does not know, over the predicted standard uncertainty: quantiles at",
        "# levels, with their 95 % intervals by a bootstrap over cases; read off rendered measurements of open parts.",
        f'command = "{command}"',
        "cases = [",
        *(f'  "{one.case.name}",' for one in opened),
        "]",
    ]
    for kind, sizes in found.items():
        lines += ["", f"[{kind}]", *(f"{key} = {getattr(sizes, key)}" for key in ("levels", "size", "low", "high"))]
    return "\n".join(lines) + "\n"


def _pairs(cases: Sequence[ComparedCase]) -> list[tuple[Floats, Floats]]:
    """Sizes of the rendered and of the drawn errors of each case that has any."""
    pairs = [(one.sizes(one.rendered), one.sizes(one.drawn)) for one in cases]
    pairs = [pair for pair in pairs if len(pair[0])]
    if not pairs:
        raise ValueError("no errors, rendered and drawn")
    return pairs


def _beyond(pairs: Sequence[tuple[Floats, Floats]], rng: np.random.Generator) -> Floats:
    lent = [np.concatenate([rng.choice(pair[k], _LENT) for pair in pairs]) for k in (0, 1)]
    rendered, drawn = (np.quantile(one, LEVELS) for one in lent)
    return np.asarray(np.maximum.accumulate(np.sqrt(np.maximum(rendered**2 - drawn**2, 0.0))))


def _root_mean_square(errors: Floats) -> Floats:
    """Over worlds (measurement, view); NaN where a view has too few values."""
    known = np.isfinite(errors)
    count = known.sum(axis=-1)
    square = np.where(known, errors, 0.0) ** 2
    return np.asarray(np.where(count >= _LEAST_WORLDS, np.sqrt(square.sum(axis=-1) / np.maximum(count, 1)), np.nan))


def _median(values: Floats) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else float("nan")


def _rounded(values: Floats) -> list[float]:
    return [float(f"{value:.3g}") for value in values]
