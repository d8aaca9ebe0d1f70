"""Summarise images of dots on a flat specimen by features of patches, and their variation over the field.

Signal chain: grey levels of the specimen's pixels -> local mean and deviation, crossings of the mean, differences of
neighbours, finest detail in the dark and in the bright half -> logarithms of seven features of every patch -> least
squares on 1, x, y, xx, xy, yy over the field -> coefficients, and their covariance from the residuals of the patches.

A patch is several run lengths of the pattern wide, so patches count as independent. The covariance of coefficients k, l
of features f, g is (B^T B)^-1_kl S_fg, with B the basis at the patches and S the covariance of the residuals: the
multivariate linear model (Mardia, Kent & Bibby, Multivariate Analysis, 1979, section 6.2).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from characterisation.files.arrays import Floats
from characterisation.region_of_interest import Roi
from mitsim.sensor.camera import Camera
from mitsim.twin.compare.specimen_patches import patch_corners
from mitsim.twin.finish.fine_detail import finest_detail

#: names of the features of a patch
FIGURES = ("level", "contrast", "crossings", "sharpness", "noise in the dark half", "noise in the bright half", "grain")

#: terms of their variation over the field
TERMS = ("1", "x", "y", "xx", "xy", "yy")

#: least number of patches for terms other than the constant: four for each
FEWEST_FOR_TERMS = 24

#: least share of a patch that shows the specimen; chosen
_LEAST_SHARE = 0.8

#: least value of a feature ahead of its logarithm
_LEAST = 1e-3


@dataclass(frozen=True)
class FieldFigures:
    """Coefficients (6, 7) of :data:`TERMS` by :data:`FIGURES`, and their ``covariance`` (42, 42), row by row.

    With too few patches, coefficients other than the constant are NaN with zero variance.
    """

    coefficients: Floats
    covariance: Floats

    def of(self, names: list[tuple[str, str]]) -> tuple[Floats, Floats]:
        """Return coefficients (n,) and covariance (n, n) of pairs of feature and term."""
        at = [TERMS.index(term) * len(FIGURES) + FIGURES.index(figure) for figure, term in names]
        return self.coefficients.reshape(-1)[at], self.covariance[np.ix_(at, at)]


@dataclass(frozen=True)
class SpecimenField:
    """Pixels of a camera's image window ``roi`` that show the specimen, divided into patches."""

    roi: Roi
    mask: NDArray[np.bool_]  # (h, w) pixels of the specimen
    patch_px: int  # side of a patch
    corners: NDArray[np.int64]  # (P, 2) rows and columns of the patches in the window
    #: (P, 6) the :data:`TERMS` at the patch centres. x and y are slopes of the view ray from the centre of the
    #: specimen, over their largest value. All terms but the first have zero mean
    basis: Floats

    @classmethod
    def of(cls, camera: Camera, mask: NDArray[np.bool_], patch_px: int) -> SpecimenField:
        """Divide the specimen's pixels (H, W) in an image of a camera into patches with sides of ``patch_px``."""
        roi = Roi.around(mask) or Roi(0, 0, 0, 0)
        corners = np.array(patch_corners(mask, patch_px, _LEAST_SHARE), int).reshape(-1, 2)
        basis = _basis(camera, corners, patch_px)
        return cls(roi, mask[roi.slices], patch_px, corners - [roi.top, roi.left], basis)

    def patches(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return the values (P, patch_px^2) of an image's window (h, w) in every patch."""
        windows = sliding_window_view(values, (self.patch_px, self.patch_px))
        return windows[self.corners[:, 0], self.corners[:, 1]].reshape(len(self.corners), -1)


def _basis(camera: Camera, corners: NDArray[np.int64], patch_px: int) -> Floats:
    middles = corners[:, ::-1] + (patch_px - 1) / 2
    if not len(middles):
        return np.empty((0, len(TERMS)))
    slope = middles / [camera.matrix[0, 0], camera.matrix[1, 1]]
    slope = slope - (slope.min(axis=0) + slope.max(axis=0)) / 2
    x, y = (slope / max(float(np.abs(slope).max()), 1e-9)).T
    terms = np.stack([x, y, x * x, x * y, y * y], axis=1)
    return np.column_stack([np.ones(len(x)), terms - terms.mean(axis=0)])


def field_figures(levels: Floats, field: SpecimenField, window_px: int, black: float = 0.0) -> FieldFigures:
    """Return the features of the grey levels (h, w) [DN] of the field's window, from which ``black`` is subtracted.

    ``window_px`` is the side of the window of local means, several run lengths of the pattern wide.
    """
    table = patch_figures(np.asarray(levels, float) - black, field, window_px)
    basis = field.basis if len(table) >= FEWEST_FOR_TERMS else field.basis[:, :1]
    inverse = np.linalg.inv(basis.T @ basis)
    solution = inverse @ basis.T @ table
    residual = table - basis @ solution
    spread = residual.T @ residual / max(len(table) - basis.shape[1], 1)
    coefficients = np.full((len(TERMS), len(FIGURES)), np.nan)
    coefficients[: len(solution)] = solution
    whole = np.zeros((len(TERMS), len(TERMS)))
    whole[: len(solution), : len(solution)] = inverse
    return FieldFigures(coefficients, np.kron(whole, spread))


def patch_figures(image: Floats, field: SpecimenField, window_px: int) -> Floats:
    """Return the logarithms (P, 7) of the features of every patch."""
    mean = uniform_filter(image, window_px)
    deviation = np.sqrt(np.maximum(uniform_filter(image**2, window_px) - mean**2, 0.0))
    crossing = np.zeros(image.shape)
    crossing[:, 1:] = (image[:, 1:] > mean[:, 1:]) != (image[:, :-1] > mean[:, :-1])
    along, down = np.zeros(image.shape), np.zeros(image.shape)
    along[:, 1:], down[1:] = np.diff(image, axis=1) ** 2, np.diff(image, axis=0) ** 2
    fine, near = finest_detail(image), uniform_filter(image, 5)
    grain = np.zeros(image.shape)
    grain[:, 1:] += fine[:, 1:] * fine[:, :-1]
    grain[1:] += fine[1:] * fine[:-1]
    inside = field.patches(field.mask)

    def mean_of(values: Floats, where: NDArray[np.bool_] = inside) -> Floats:
        # no pixel is brighter than the median of a patch that is saturated for the larger part: no detail there
        return np.asarray(np.where(where, values, 0.0).sum(axis=1) / np.maximum(where.sum(axis=1), 1))

    level, spread, near, fine = (field.patches(values) for values in (mean, deviation, near, fine))
    rising, count = np.sort(np.where(inside, near, np.inf), axis=1), inside.sum(axis=1, keepdims=True)
    beside = np.concatenate([(count - 1) // 2, count // 2], axis=1)
    bright = near > np.take_along_axis(rising, beside, axis=1).mean(axis=1, keepdims=True)  # than the median
    amounts = np.abs(fine)
    out = np.stack(
        [
            mean_of(level),
            mean_of(spread / np.maximum(level, 1.0)),
            mean_of(field.patches(crossing)),
            mean_of(field.patches(along + down)) / np.maximum(2 * mean_of(spread**2), _LEAST),
            mean_of(amounts, inside & ~bright),
            mean_of(amounts, inside & bright),
            # 1 plus the correlation of neighbours; it is -0.8 for white noise after these weights
            1.0 + mean_of(field.patches(grain)) / (2 * np.maximum(mean_of(fine**2), _LEAST)),
        ],
        axis=1,
    )
    return np.asarray(np.log(np.maximum(out, _LEAST)))
