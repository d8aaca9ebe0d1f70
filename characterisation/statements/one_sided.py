"""Errors of trials of a value that folds at 0 or 90 deg, on a part with any deviation.

Signal chain: deviations that each trial measured on a nominal part -> the same errors added to a deviation of the
tolerance's size in a random direction, one for each trial -> error of the value there.

The value of a part with the deviation v is |v|, the size of v, and a trial measures |v + e| with its error e. The
error of the value, |v + e| - |v|, depends on |v|. On a nominal part it is |e|, never negative: such a part cannot show
how often a deviation is measured too small. At the limit of the tolerance it is nearly the component of e along v.
This is the error that decides about a part there. The direction of v is unknown, so each trial has a random direction
of its own, and the trials remain independent.

For a position in a plane with equal errors in both directions, |v + e| has a Rice distribution; in space, a noncentral
chi distribution (Rice 1945; Park 1961).

Without a tolerance, errors are stated for deviations much larger than the errors.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from characterisation.files.arrays import Floats

#: number of deviations of a part at which the value of each trial is tabulated
_STEPS = 257

#: number of trials that are tabulated at once, which limits the memory
_AT_ONCE = 16

#: ratio of a deviation without a tolerance to the largest error
_MUCH_LARGER = 1e4


@dataclass(frozen=True)
class OneSidedErrors:
    """Errors of independent trials of a value that folds, in its unit.

    Parameters
    ----------
    vectors
        Errors (n, k, m) of the deviations; NaN in trials without a value.
    directions
        Deviations (n, k, m) of the parts, of any length.
    size
        Size (...) of deviations (..., k, m).
    limit
        Size of the deviation at the limit of the tolerance; None without a tolerance.
    fold
        0: the value is the size of the deviations. 90: it is 90 deg minus the size.
    correction
        Subtracted from every value that is measured.
    """

    vectors: Floats
    directions: Floats
    size: Callable[[Floats], Floats]
    limit: float | None
    fold: float = 0.0
    correction: float = 0.0

    def __len__(self) -> int:
        return len(self.vectors)

    @property
    def deviation(self) -> float:
        """Return the size of the deviation for which errors are stated."""
        return self._large if self.limit is None else self.limit

    @cached_property
    def known(self) -> NDArray[np.bool_]:
        """Return which trials (n,) have a value."""
        return np.isfinite(self.size(self.vectors))

    def part(self, chosen: NDArray[Any]) -> OneSidedErrors:
        """Return the errors of some trials, by index or mask."""
        return replace(self, vectors=self.vectors[chosen], directions=self.directions[chosen])

    def scaled(self, factor: float) -> OneSidedErrors:
        """Return the errors multiplied by a factor."""
        return replace(self, vectors=factor * self.vectors)

    def corrected(self, bias: float) -> OneSidedErrors:
        """Return the errors after subtraction of a bias from every value."""
        return replace(self, correction=self.correction + bias)

    def at(self, deviation: float | Floats) -> Floats:
        """Return the errors (n,) of the values of parts whose deviations have a size, or a size (n,) each."""
        size = self.size(np.reshape(deviation, (-1, 1, 1)) * self._units + self.vectors)
        error = size - deviation
        return np.asarray((error if self.fold == 0 else -error) - self.correction)

    @cached_property
    def stated(self) -> Floats:
        """Return the errors (n,) at the limit of the tolerance, which a statement is about."""
        return self.at(self.deviation)

    @cached_property
    def gradients(self) -> Floats:
        """Return by how much the stated error of each trial changes with each error of the deviations, (n, k m).

        Errors of the deviations are assumed to be small against the deviation; places without a value have 0.
        """
        step = 1e-4 * self.deviation
        part = self.deviation * self._units
        out = np.zeros((len(part), part[0].size if len(part) else 0))
        for index in range(out.shape[1]):
            move = np.zeros(part.shape[1:])
            move.flat[index] = step
            out[:, index] = (self.size(part + move) - self.size(part - move)) / (2 * step)
        return np.nan_to_num(out if self.fold == 0 else -out)

    @cached_property
    def table(self) -> tuple[Floats, Floats]:
        """Return deviations (n, steps) of parts, and those (n, steps) that the trials measure of them.

        They reach to the deviations of parts that no rule accepts.
        """
        largest = self.deviation + abs(self.correction) + self.size(self.vectors)
        sizes = 2 * largest[:, None] * np.linspace(0, 1, _STEPS)
        values = [
            self.size(sizes[block, :, None, None] * self._units[block, None] + self.vectors[block, None])
            for block in (slice(first, first + _AT_ONCE) for first in range(0, len(sizes), _AT_ONCE))
        ]
        return sizes, np.concatenate(values) - (self.correction if self.fold == 0 else -self.correction)

    def accepted_parts(self, limit: float) -> tuple[Floats, Floats]:
        """Return the smallest and largest deviations (n,) of parts whose deviation each trial reads as at most a limit.

        Both are equal where there is no such part.
        """
        sizes, values = self.table
        below = values <= limit
        rows = np.arange(len(sizes))
        first, last = below.argmax(axis=1), _STEPS - 1 - below[:, ::-1].argmax(axis=1)

        def crossing(inside: NDArray[np.int64], outside: NDArray[np.int64]) -> Floats:
            low, high = values[rows, inside], values[rows, outside]
            share = np.where(high > low, (limit - low) / np.where(high > low, high - low, 1.0), 0.0)
            return np.asarray(sizes[rows, inside] + share * (sizes[rows, outside] - sizes[rows, inside]))

        low = np.where(first > 0, crossing(first, np.maximum(first - 1, 0)), 0.0)
        high = np.where(last < _STEPS - 1, crossing(last, np.minimum(last + 1, _STEPS - 1)), sizes[:, -1])
        accepting = below.any(axis=1)
        return np.where(accepting, low, 0.0), np.where(accepting, high, 0.0)

    @cached_property
    def _units(self) -> Floats:
        """Return the directions (n, k, m) with a size of 1 each, at the places that the trial has measured."""
        placed = np.where(np.isnan(self.vectors), np.nan, self.directions)
        with np.errstate(invalid="ignore"):
            return np.asarray(placed / self.size(placed)[:, None, None])

    @cached_property
    def _large(self) -> float:
        largest = self.size(self.vectors)
        return _MUCH_LARGER * float(np.nanmax(largest, initial=0.0)) or 1.0


def stated_errors(errors: Floats | OneSidedErrors) -> Floats:
    """Return the errors (n,) that a statement is about: those themselves, or at the limit of the tolerance."""
    return errors.stated if isinstance(errors, OneSidedErrors) else errors


def without_bias(errors: Floats | OneSidedErrors, bias: float) -> Any:
    """Return errors after subtraction of a bias from every value."""
    return errors.corrected(bias) if isinstance(errors, OneSidedErrors) else errors - bias
