"""List the quantities in which a simulated capture is compared with a real one.

Each quantity is a function of the patches of one capture and of drawn patches: it returns one value for each draw, so
that the bootstrap of :mod:`mitsim.twin.compare.compare_captures` needs no loop over draws. The margins are
*assumed* to be acceptable to a user of a simulator: a factor 1.15 for noise, contrast and lengths, and those in
:data:`QUANTITIES` for the others.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from characterisation.coupon.residual_field import Autocorrelation
from characterisation.files.arrays import Floats
from characterisation.point_cloud import Status
from mitsim.twin.compare.plain_image import median_level
from mitsim.twin.compare.specimen_patches import SpecimenPatches

Picked = NDArray[np.intp]
Figure = Callable[[SpecimenPatches, Picked], Floats]


@dataclass(frozen=True)
class Quantity:
    """A quantity ``of`` the image or the cloud: ``figure`` (D,) of drawn patches (D, P) of a capture, NaN if unknown.

    ``factor``, or ``margin`` [unit], is the acceptable difference between real and simulated. ``needs_pattern``: the
    quantity is not comparable if only one capture has a pattern.
    """

    name: str
    unit: str
    of: Literal["image", "cloud"]
    figure: Figure
    factor: float = 1.0
    margin: float = 0.0
    needs_pattern: bool = True


def _quantile(values: Floats, share: float) -> Floats:
    """Return the quantile of the known values along the last axis, linearly interpolated; NaN if there are none."""
    ordered, counts = np.sort(values, axis=-1), np.isfinite(values).sum(axis=-1)
    at = share * np.maximum(counts - 1, 0)
    low = np.floor(at).astype(int)
    high = np.minimum(low + 1, np.maximum(counts - 1, 0))
    below, above = (np.take_along_axis(ordered, index[..., None], -1)[..., 0] for index in (low, high))
    return np.where(counts > 0, below + (at - low) * (above - below), np.nan)


def _sums(values: Floats | csr_array, picked: Picked) -> Floats:
    """Return sums (D, ...) of values (P, ...) over the drawn patches (D, P)."""
    times = np.stack([np.bincount(draw, minlength=values.shape[0]) for draw in picked]).astype(float)
    return np.asarray((times @ values.reshape((values.shape[0], -1))).reshape((len(picked), *values.shape[1:])))


def _median(name: str) -> Figure:
    return lambda patches, picked: _quantile(getattr(patches, name)[picked], 0.5)


def _level(patches: SpecimenPatches, picked: Picked) -> Floats:
    return np.array([median_level(counts) for counts in _sums(patches.levels, picked)])


def _spread(patches: SpecimenPatches, picked: Picked) -> Floats:
    return _quantile(patches.sigma[picked], 0.75) - _quantile(patches.sigma[picked], 0.25)


def _run(patches: SpecimenPatches, picked: Picked) -> Floats:
    changes = _sums(patches.crossings, picked)
    return np.where(changes > 0, _sums(patches.pixels, picked) / np.maximum(changes, 1), np.nan)


def _share(status: Status) -> Figure:
    def figure(patches: SpecimenPatches, picked: Picked) -> Floats:
        counts = _sums(patches.status, picked)
        return np.asarray(counts[:, status] / counts.sum(axis=-1))

    return figure


def _recovered(patches: SpecimenPatches, picked: Picked) -> Floats:
    return np.asarray(_sums(patches.recovered, picked) / _sums(patches.status, picked).sum(axis=-1))


def _false(patches: SpecimenPatches, picked: Picked) -> Floats:
    return _share(Status.VALID)(patches, picked) - _recovered(patches, picked)


def _correlation_length(patches: SpecimenPatches, picked: Picked) -> Floats:
    products, pairs = _sums(patches.products, picked), _sums(patches.pairs, picked)
    middle = products.shape[1] // 2
    lengths = np.full(len(picked), np.nan)
    for index in np.flatnonzero(pairs[:, middle, middle] > 0):
        with np.errstate(divide="ignore", invalid="ignore"):
            covariance = np.where(pairs[index] > 0, products[index] / pairs[index], np.nan)
            lengths[index] = Autocorrelation(covariance / covariance[middle, middle], pairs[index]).length()
    return lengths


#: acceptable ratio of noise, contrast and lengths; *assumed*
NOISE_FACTOR = 1.15

#: acceptable difference of shares; *assumed*
_SHARE_MARGIN = 0.02

QUANTITIES = (
    Quantity("median grey level", "DN", "image", _level, factor=1.05, needs_pattern=False),
    Quantity("finest detail", "DN", "image", _median("finest"), factor=NOISE_FACTOR, needs_pattern=False),
    Quantity("contrast", "1", "image", _median("contrast"), factor=NOISE_FACTOR),
    Quantity("run length", "px", "image", _run, factor=NOISE_FACTOR),
    Quantity("F", "1", "cloud", _recovered, margin=_SHARE_MARGIN),
    Quantity("sigma, median", "mm", "cloud", _median("sigma"), factor=NOISE_FACTOR),
    Quantity("sigma, interquartile range", "mm", "cloud", _spread, factor=1.5),
    Quantity("sigma in disparity", "px", "cloud", _median("sigma_px"), factor=NOISE_FACTOR),
    Quantity("correlation length", "px", "cloud", _correlation_length, factor=NOISE_FACTOR),
    Quantity("distance", "mm", "cloud", _median("distance"), factor=1.002),
    Quantity("vertical error", "px", "cloud", _median("row_error"), margin=0.05),
    *(
        Quantity(f"share {status.name.lower()}", "1", "cloud", _share(status), margin=_SHARE_MARGIN)
        for status in Status
        if status is not Status.VALID
    ),
    Quantity("share false", "1", "cloud", _false, margin=_SHARE_MARGIN),
)
