"""Fitted surfaces, circles and edge points: a shape with the covariance of its fit."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from characterisation.features.figures import Circle, EdgePoint
from characterisation.features.surfaces import Cone, Cylinder, Plane, Sphere, Surface

Array = NDArray[np.float64]


@dataclass(frozen=True)
class FitQuality:
    """Quality of a fit, after the fields of its shape.

    ``covariance`` (p, p) is that of the parameters of a small change of the shape. ``residual_std`` [mm] has ``count -
    p`` degrees of freedom, and is along the rays if a viewpoint was given. ``count`` is the number of points used.
    """

    covariance: Array
    residual_std: float
    count: int


@dataclass(frozen=True)
class PlaneFit(FitQuality, Plane):
    """Fitted plane; ``point`` is the foot of the used points' centroid, ``normal`` faces the viewpoint."""


@dataclass(frozen=True)
class CylinderFit(FitQuality, Cylinder):
    """Fitted cylinder.

    ``point`` is the axis' point nearest the used points' centroid; ``axis`` has the sense of the initial axis.
    """


@dataclass(frozen=True)
class SphereFit(FitQuality, Sphere):
    """Fitted sphere."""


@dataclass(frozen=True)
class ConeFit(FitQuality, Cone):
    """Fitted cone; ``point`` is the axis' point nearest the used points' centroid."""


@dataclass(frozen=True)
class CircleFit(FitQuality, Circle):
    """Fitted circle; its covariance is that of the edge alone, since its plane has its own."""


@dataclass(frozen=True)
class EdgePointFit(FitQuality, EdgePoint):
    """Fitted point of an edge; its covariance is that of the edge alone, since its plane has its own."""


Fit = PlaneFit | CylinderFit | SphereFit | ConeFit | CircleFit | EdgePointFit

_FITS: dict[type[Any], type[Fit]] = {
    Plane: PlaneFit,
    Cylinder: CylinderFit,
    Sphere: SphereFit,
    Cone: ConeFit,
    Circle: CircleFit,
    EdgePoint: EdgePointFit,
}


def with_covariance(
    shape: Surface | Circle | EdgePoint, covariance: ArrayLike, residual_std: float = np.nan, count: int = 0
) -> Fit:
    """Return a shape, fitted or nominal, with the covariance (p, p) of its parameters, for predicted uncertainties.

    Raises ValueError if the covariance does not have the shape (p, p).

    Parameters
    ----------
    shape
        Geometry, fitted or nominal.
    covariance
        (p, p) of the parameters of a small change.
    residual_std
        [mm].
    count
        Number of points used.
    """
    matrix = np.asarray(covariance, float)
    if matrix.shape != (shape.parameter_count,) * 2:
        raise ValueError(f"covariance is {matrix.shape}, a {shape.kind} has {shape.parameter_count} parameters")
    plain = next(fit_class for fit_class in _FITS if isinstance(shape, fit_class))
    geometry = {field.name: getattr(shape, field.name) for field in fields(plain)}
    return _FITS[plain](**geometry, covariance=matrix, residual_std=residual_std, count=count)
