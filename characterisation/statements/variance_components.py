"""Divide the variance of an error among groups of causes whose draws are known, from few trials.

Signal chain: errors of trials, and the numbers that each group drew for them -> covariance of the errors of two trials
by each group -> restricted maximum likelihood -> variance by each group, and the covariance of these estimates.

The error of trial i is e_i = m + sum over g of x_gi . b_g + r_i. The numbers x_gi of group g are independent and of
variance 1, and b_g are unknown. A group causes the variance v_g = |b_g|^2. A regression on many numbers fits noise
and makes v_g too large. Instead, the covariance of the errors is modelled as V = sum over g of v_g K_g, with K_g = x_g
x_g^T / p_g, and v_g is found by restricted maximum likelihood (Patterson and Thompson 1971). This is consistent for
fixed b_g and errors of any distribution, even with more numbers than trials (Dicker and Erdogdu 2016). A group that
drew only a seed has K_g = 1 for trials with the same seed, 0 for others: nested analysis of variance, as in ISO 5725-3.

One step of the iteration, v = T^-1 q with T_gh = tr(P K_g P K_h) and q_g = e^T P K_g P e, is a quadratic form e^T M_g e
that is unbiased for every distribution (MINQUE, Rao 1971). Its covariance for fixed b and normal r is
2 tr(M_g V M_h V) - 2 tr(M_g D M_h D), with D the part of V by drawn numbers. Rare large errors add to it
(:func:`_beyond_normal`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import nnls
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from characterisation.files.arrays import Floats

#: name of the component of what no other explains: independent from trial to trial
RESIDUAL = "residual"

#: about the number of trials that are decomposed at once (up to 300), since time grows with its cube
AT_ONCE = 200

#: largest number of iterations; chosen
_ITERATIONS = 60

#: change of the likelihood that ends them; chosen
_CONVERGED = 1e-6

#: least share of the residual, which keeps the covariance invertible
_LEAST = 1e-5


@dataclass(frozen=True)
class Components:
    """Shares of components in a variance.

    Parameters
    ----------
    names
        Components: groups that drew numbers, groups that share a seed, :data:`RESIDUAL`.
    shares
        (m,) shares of the variance; their sum is 1.
    errors
        (m,) standard errors of the shares.
    drawn
        (m,) whether a component is of drawn numbers.
    """

    names: tuple[str, ...]
    shares: Floats
    errors: Floats
    drawn: NDArray[np.bool_]


def components(
    errors: ArrayLike,
    numbers: Mapping[str, ArrayLike],
    seeds: Mapping[str, ArrayLike],
    directions: ArrayLike | None = None,
) -> Components:
    """Return the shares of groups of causes in the variance of errors.

    Parameters
    ----------
    errors
        (n,) of trials, without NaN, n at least 3. Trials that share a seed shall be near one another.
    numbers
        By group, (n, p) numbers drawn for the trials, independent from column to column. Constant columns are ignored.
    seeds
        By group, (n,) whole numbers: trials with the same number have the same draw. Groups whose numbers all differ,
        or equal those of an earlier group, are ignored.
    directions
        (n, q) of a value that folds: the error of a trial is the component of an error vector along its direction.
    """
    values = np.asarray(errors, float)
    count = len(values)
    parts = np.array_split(np.arange(count), max(1, round(count / AT_ONCE)))
    scale = float(values.std()) or 1.0
    along = None if directions is None else np.asarray(directions, float)
    by_group = {name: _standard(np.asarray(number, float)) for name, number in numbers.items()}
    by_group = {name: columns for name, columns in by_group.items() if columns.shape[1]}
    levels = _distinct({name: np.asarray(seed) for name, seed in seeds.items()}, parts)
    names = (*by_group, *levels, RESIDUAL)
    drawn = np.array([name in by_group for name in names])
    mean_variances = np.zeros(len(names))
    covariance = np.zeros((len(names), len(names)))
    for part in parts:
        kernels = [columns[part] @ columns[part].T / columns.shape[1] for columns in by_group.values()]
        kernels += [(level[part][:, None] == level[part]).astype(float) for level in levels.values()]
        stack = np.array([*kernels, np.eye(len(part))])
        if along is not None:
            stack *= along[part] @ along[part].T
        stack /= np.einsum("kii->k", stack)[:, None, None] / len(part)
        variances, spread = _restricted_likelihood((values[part] - values.mean()) / scale, stack, drawn)
        mean_variances += len(part) / count * variances
        covariance += (len(part) / count) ** 2 * spread
    shares = mean_variances / mean_variances.sum()
    change = (np.eye(len(names)) - shares[:, None]) / mean_variances.sum()
    return Components(names, shares, np.sqrt(np.maximum(np.diag(change @ covariance @ change.T), 0.0)), drawn)


def _standard(values: Floats) -> Floats:
    """Return the columns of (n, p) that vary, with mean 0 and variance 1."""
    deviation = values.std(axis=0, ddof=1)
    varies = deviation > 1e-12 * np.abs(values).max(axis=0, initial=0.0)
    return np.asarray((values[:, varies] - values[:, varies].mean(axis=0)) / deviation[varies])


def _distinct(seeds: Mapping[str, NDArray[np.int64]], parts: list[NDArray[np.intp]]) -> dict[str, NDArray[np.int64]]:
    """Return the groups whose shared seeds every part of the trials can tell from those of others."""
    out: dict[str, NDArray[np.int64]] = {}
    distinct: list[tuple[bytes, ...]] = [tuple(np.eye(len(part), dtype=bool).tobytes() for part in parts)]
    for name, seed in seeds.items():
        same = tuple((seed[part][:, None] == seed[part]).tobytes() for part in parts)
        if not any(a == b for other in distinct for a, b in zip(same, other, strict=True)):
            out[name] = seed
            distinct.append(same)
    return out


def _restricted_likelihood(errors: Floats, kernels: Floats, drawn: NDArray[np.bool_]) -> tuple[Floats, Floats]:
    """Return variances (m,) of kernels (m, n, n), at least 0, and the covariance of their unconstrained estimates."""
    size, count = len(kernels), len(errors)
    whole = float(errors @ errors) / (count - 1)
    least = np.zeros(size)
    least[-1] = _LEAST * whole
    variances = np.full(size, whole / size)
    state = _state(errors, kernels, variances)
    for _ in range(_ITERATIONS):
        likelihood, _, inverse, moved = state
        products = inverse @ kernels
        traces = products.reshape(size, -1) @ products.transpose(0, 2, 1).reshape(size, -1).T
        forms = np.einsum("i,kij,j->k", moved, kernels, moved)
        root = np.linalg.cholesky(traces + 1e-10 * np.trace(traces) / size * np.eye(size))
        wanted = np.maximum(nnls(root.T, np.linalg.solve(root, forms))[0], least)
        step = 1.0
        while step > 1e-3:
            nearer = variances + step * (wanted - variances)
            changed = _state(errors, kernels, nearer)
            if changed[0] >= likelihood:
                break
            step /= 2
        else:
            break
        variances, state = nearer, changed
        if changed[0] - likelihood < _CONVERGED:
            break
    _, total, inverse, moved = state
    products = inverse @ kernels
    traces = products.reshape(size, -1) @ products.transpose(0, 2, 1).reshape(size, -1).T
    forms = np.tensordot(np.linalg.pinv(traces, hermitian=True), products @ inverse, axes=1)
    of_numbers = np.tensordot(np.where(drawn, variances, 0.0), kernels, axes=1)
    remainder = total - of_numbers
    by_total, by_numbers = forms @ total, forms @ of_numbers
    covariance = 2 * sum(
        sign * (product.reshape(size, -1) @ product.transpose(0, 2, 1).reshape(size, -1).T)
        for sign, product in ((1.0, by_total), (-1.0, by_numbers))
    )
    return variances, covariance + _beyond_normal(forms, remainder, remainder @ moved, remainder @ inverse @ remainder)


def _beyond_normal(forms: Floats, remainder: Floats, residuals: Floats, spread: Floats) -> Floats:
    """Return the part of the covariance (m, m) of quadratic forms (m, n, n) that comes from errors that are not normal.

    Parameters
    ----------
    forms
        Matrices M_g of the quadratic forms.
    remainder
        Covariance S (n, n) of the part of the errors that is not drawn numbers. Trials without a covariance are
        independent.
    residuals, spread
        Estimates (n,) of that part, and their covariance (n, n), which is smaller than S.

    Notes
    -----
    Of independent groups c of trials, the products between groups have a variance that depends on second moments
    alone. Those within a group have another than normal errors: that of e_c^T M_cc e_c over the groups.
    """
    of_trial = connected_components(coo_array(remainder))[1]
    groups = int(of_trial.max()) + 1
    ratio = np.bincount(of_trial, np.diag(remainder)) / np.maximum(np.bincount(of_trial, np.diag(spread)), 1e-300)
    scaled = residuals * np.sqrt(ratio)[of_trial]
    normal = np.zeros((len(forms), len(forms)))
    excess = np.zeros((len(forms), groups))
    for group in range(groups):
        here = np.flatnonzero(of_trial == group)
        inside = forms[:, here[:, None], here]
        products = inside @ remainder[np.ix_(here, here)]
        normal += 2 * np.einsum("kij,lji->kl", products, products)
        excess[:, group] = scaled[here] @ inside @ scaled[here] - np.einsum("kii->k", products)
    return np.asarray(excess @ excess.T - normal)


def _state(errors: Floats, kernels: Floats, variances: Floats) -> tuple[float, Floats, Floats, Floats]:
    """Return the restricted log-likelihood, V (n, n), P (n, n) and P e (n,), with the mean as the only fixed effect."""
    total = np.tensordot(variances, kernels, axes=1)
    inverse = np.linalg.inv(total)
    row = inverse.sum(axis=1)
    inverse = inverse - np.outer(row, row) / row.sum()
    moved = inverse @ errors
    likelihood = -0.5 * (np.linalg.slogdet(total)[1] + math.log(row.sum()) + float(errors @ moved))
    return float(likelihood), total, inverse, moved
