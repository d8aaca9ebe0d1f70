"""Return what the trials of a statement drew, as numbers on which their errors can be regressed.

Signal chain: number of trials -> trials, of which some repeat a day -> numbers that each group of unknowns drew, and
the seeds of groups that drew only a seed -> :func:`characterisation.statements.budget.budget`.

Those numbers that a user could find out have names (:func:`named_numbers`), for
:func:`characterisation.statements.size_dependence.size_dependence`.

Every draw is known: it follows from the trial alone (:mod:`mitsim.study.virtual.world`). The numbers are those behind
the draw, of mean 0 and variance 1; of a decoder, its settings, which the budget standardises. Effects of calibration
and pose are small, and linear in them. The errors may also depend on the squares of the numbers of finish, light and
temperature.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from characterisation.files.arrays import Floats
from characterisation.statements.budget import INTERACTION
from characterisation.statements.size_dependence import DrawnNumber
from mitsim.study import Study
from mitsim.study.virtual.coat import coat_numbers
from mitsim.study.virtual.drawn_decoder import decoder_numbers, drawn_decoder
from mitsim.study.virtual.drawn_finish import finish_numbers
from mitsim.study.virtual.mapped import drawn_spread
from mitsim.study.virtual.world import (
    FRESH,
    KEEPS_SEED,
    STATEMENT_DAYS,
    Trial,
    Unknowns,
    seed_day,
)

Ints = NDArray[np.int64]

#: days of a statement, then the trial that captures the first of them again
_DAYS = 4

#: groups whose numbers act through their squares, too
_CURVED = ("finish", "light", "temperature")

#: least eigenvalue of a correlation matrix, over the mean, whose direction counts as drawn
_LEAST_EIGENVALUE = 1e-9


def statement_trials(count: int) -> list[Trial]:
    """Return the trials of a statement; fewer are the first of more.

    After every four days, the first of them is captured again. This tells what differs between captures of a day.
    """
    positions = (divmod(k, _DAYS + 1) for k in range(count))
    return [
        Trial(STATEMENT_DAYS + _DAYS * row + (column if column < _DAYS else 0), column // _DAYS)
        for row, column in positions
    ]


def related(trials: Sequence[Trial]) -> Ints:
    """Return numbers (n,) that are equal for trials that have draws in common."""
    return np.array([trial.day // 2 for trial in trials], np.int64)


def seeds(trials: Sequence[Trial], groups: Sequence[str]) -> dict[str, Ints]:
    """Return, for each of the groups that draw only a seed, the day (n,) whose seed each trial has.

    The last is ``interaction``, with the day itself: what the captures of a day have in common.
    """
    of_groups = {
        group: np.array([seed_day(group, trial.day) for trial in trials]) for group in groups if group in KEEPS_SEED
    }
    return of_groups | {INTERACTION: np.array([trial.day for trial in trials])}


def drawn_numbers(
    study: Study, unknowns: Unknowns, source: str, trials: Sequence[Trial], groups: Sequence[str]
) -> dict[str, Floats]:
    """Return the numbers (n, p) that each of the groups drew in trials, and squares of some.

    - ``study``, ``unknowns``: the study, and its unknowns prepared for drawing.
    - ``source``: how trials are made: ``render`` or ``map``.
    - ``trials``: the n trials.
    - ``groups``: groups of unknowns. Those that draw only a seed are not in the result.
    """
    out = {}
    for group in groups:
        if group in KEEPS_SEED or group == "noise":
            continue
        numbers: dict[Trial, Floats] = {}
        for trial in trials:
            drawn_trial = trial if group in FRESH else Trial(trial.day)
            if drawn_trial not in numbers:
                numbers[drawn_trial] = _numbers(study, unknowns, source, group, drawn_trial)
        rows = np.array([numbers[trial if group in FRESH else Trial(trial.day)] for trial in trials])
        out[group] = np.hstack([rows, (rows**2 - 1) / np.sqrt(2)]) if group in _CURVED else rows
    return out


def named_numbers(
    study: Study, unknowns: Unknowns, trials: Sequence[Trial], groups: Sequence[str]
) -> list[DrawnNumber]:
    """Return what a user could find out of rendered trials, by the ``groups`` drawn: finishes, decoder and light."""
    values: dict[tuple[str, str, str], list[float]] = {}
    for trial in trials:
        drawn = unknowns.draw(trial)
        if "finish" in groups:
            for finish in _finish_ids(study):
                for name, value in finish_numbers(unknowns, drawn.finish, finish).items():
                    if name != "lay_direction":  # no order
                        values.setdefault(("finish", name, finish), []).append(value)
        if "decoder" in groups:
            settings = drawn_decoder(study.sensor, unknowns.table.decoder, drawn.decoder)
            for name, value in decoder_numbers(settings).items():
                values.setdefault(("decoder", name, ""), []).append(value)
        if "light" in groups:
            for name, value in (("room", drawn.room), ("power", drawn.power)):
                values.setdefault(("light", name, ""), []).append(value)
    return [DrawnNumber(*key, np.array(row)) for key, row in values.items()]


def _finish_ids(study: Study) -> list[str]:
    """Return the ids of the BSDFs whose finish can be drawn."""
    scene = study.scene
    return sorted({shape.bsdf().id() for shape, finish in zip(scene.shapes, scene.finishes, strict=True) if finish})


def _numbers(study: Study, unknowns: Unknowns, source: str, group: str, trial: Trial) -> Floats:
    """Return the numbers (p,) that a group drew in a trial."""
    stream, table = unknowns.stream(group, trial), unknowns.table
    if group == "calibration":
        values = np.linalg.eigvalsh(unknowns.calibration.correlation)
        return stream.standard_normal(len(values))[values > _LEAST_EIGENVALUE]
    if group == "temperature":
        sizes = np.array([table.temperature.sensor_kelvin, table.temperature.part_kelvin])
        return stream.standard_normal(2)[sizes > 0]
    if group == "light":
        light = table.light
        sizes = np.array([light.illuminance * (light.room_factor - 1), light.power_relative, light.exposure_relative])
        normal = stream.standard_normal(2)
        return np.array([*normal, np.sqrt(3) * stream.uniform(-1, 1)])[sizes > 0]
    if group == "pose":
        pose = table.pose
        sizes = np.repeat([pose.placement_deg, pose.placement_mm, pose.told_deg, pose.told_mm], 3)
        return stream.standard_normal(12)[sizes > 0]
    drawn = unknowns.draw(trial)
    if group == "coat":
        return coat_numbers(drawn.coat)
    if group == "decoder":
        return np.array(list(decoder_numbers(drawn_decoder(study.sensor, table.decoder, drawn.decoder)).values()))
    if source == "map":
        return drawn_spread(study, unknowns, drawn.finish)
    return np.array(
        [value for finish in _finish_ids(study) for value in _finish(finish_numbers(unknowns, drawn.finish, finish))]
    )


def _finish(numbers: Mapping[str, float]) -> list[float]:
    """Return the numbers of a finish; a direction of the lay, which has no sign, is cosine and sine of its double."""
    out = [value for name, value in numbers.items() if name != "lay_direction"]
    if "lay_direction" in numbers:
        double = 2 * np.pi * float(ndtr(numbers["lay_direction"]))
        out += [np.sqrt(2) * np.cos(double), np.sqrt(2) * np.sin(double)]
    return out
