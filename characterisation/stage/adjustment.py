"""Adjust observations that are correlated in blocks and depend on control variables with errors, by least squares.

Signal chain: residuals of n captures, m each, with their covariances, and their derivatives by the parameters and by
the angles of the captures -> whitened -> Gauss-Newton -> model and covariance.

The errors of the angles are propagated into the covariance of the residuals, C + B diag(sigma^2) B^T with the
derivatives B by the angles. To first order this equals estimating an error of every angle (the Gauss-Helmert model;
Koch, *Parameter Estimation and Hypothesis Testing in Linear Models*, 1999, section 3.4).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from characterisation.files.errors import InputError

Floats = NDArray[np.float64]
Model = TypeVar("Model")

#: largest number of steps of the least squares; few are needed
MOST_STEPS = 50

#: the steps end when they change no parameter by more than this share of its standard deviation
CONVERGED = 1e-6

#: a step is halved if it increases chi^2 by more than this share. Near the end, rounding and weights that depend on the
#: model may increase it slightly
WORSE = 1e-3

#: a parameter is undetermined where the smallest singular value is below this share of the largest
UNDETERMINED = 1e-7


def adjusted(
    start: Model,
    linearised: Callable[[Model], tuple[Floats, Floats, Floats]],
    moved: Callable[[Model, Floats], Model],
    variances: Floats,
    angle_std: ArrayLike,
) -> tuple[Model, Floats, float, int]:
    """Fit a model by weighted least squares with Gauss-Newton, halving steps that do not reduce chi^2.

    Parameters
    ----------
    start
        A model close enough to converge from.
    linearised
        Returns residuals (n, m), their derivatives (n, m, p) by the parameters of a small change of a model, and (n, m,
        k) by the angles.
    moved
        Returns a model changed by parameters (p,).
    variances
        Covariance (n, m, m) of the observations of each capture.
    angle_std
        Standard deviation of the angles, one or (k,) [rad].

    Returns
    -------
    tuple
        The model, the covariance (J^T W J)^-1 (p, p) of its parameters, chi^2, and the degrees of freedom.

    Raises
    ------
    InputError
        If the captures leave a parameter undetermined.
    """
    model = start
    white, jacobian = whitened(*linearised(model), variances, angle_std)
    for _ in range(MOST_STEPS):
        scale, across, singular, along = _decomposed(jacobian)
        step = -(along.T @ (across.T @ white.ravel() / singular)) / scale
        if np.abs(step * scale).max() < CONVERGED:
            break
        before, share = (white**2).sum(), 1.0
        while True:
            tried = moved(model, share * step)
            white, jacobian = whitened(*linearised(tried), variances, angle_std)
            if (white**2).sum() <= before * (1 + WORSE) or share < 1e-4:
                break
            share /= 2
        model = tried
    scale, _, singular, along = _decomposed(jacobian)
    covariance = (along.T / singular**2) @ along / np.outer(scale, scale)
    return model, np.asarray(covariance), float((white**2).sum()), white.size - len(scale)


def whitened(
    residuals: Floats, jacobian: Floats, by_angles: Floats, variances: Floats, angle_std: ArrayLike
) -> tuple[Floats, Floats]:
    """Return residuals (n, m) and derivatives (n, m, p) in units of their noise, uncorrelated.

    Parameters
    ----------
    residuals, jacobian, by_angles
        (n, m), (n, m, p) and (n, m, k).
    variances
        (n, m, m) of the observations.
    angle_std
        [rad], one or (k,).
    """
    spread = by_angles * np.broadcast_to(np.asarray(angle_std, float), by_angles.shape[2:])
    root = np.linalg.cholesky(variances + spread @ spread.swapaxes(1, 2))
    white = np.linalg.solve(root, np.concatenate([residuals[..., None], jacobian], axis=2))
    return np.asarray(white[..., 0]), np.asarray(white[..., 1:])


def _decomposed(jacobian: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Return the norms of the columns of (n, m, p), and the singular value decomposition of the scaled columns."""
    flat = jacobian.reshape(-1, jacobian.shape[2])
    scale = np.linalg.norm(flat, axis=0)
    across, singular, along = np.linalg.svd(flat / np.where(scale > 0, scale, 1.0), full_matrices=False)
    if flat.shape[0] <= flat.shape[1] or not singular[-1] > UNDETERMINED * singular[0]:
        allowed = "captures that turn every axis, alone and together"
        found = f"{len(jacobian)} captures that leave a parameter undetermined"
        raise InputError("stage calibration", "captures", found, allowed, "calibration_angles gives a plan")
    return scale, across, singular, along
