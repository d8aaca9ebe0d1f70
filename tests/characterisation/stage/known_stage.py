"""Stages whose axes are known: how far a calibration is from them."""

from __future__ import annotations

import numpy as np

from characterisation.features.vectors import tangents


def unit(vector):
    return np.asarray(vector, float) / np.linalg.norm(vector)


def axes_error(true, fitted):
    """The true axes in the parameters of the fitted ones."""
    out = []
    for direction, point, a, p in zip(true.directions, true.points, fitted.directions, fitted.points, strict=True):
        basis = tangents(a)
        # where the true line meets the plane across the fitted one
        foot = point + ((p - point) @ a) / (direction @ a) * direction
        out += [*basis @ direction / (direction @ a), *basis @ (foot - p)]
    return np.array(out)
