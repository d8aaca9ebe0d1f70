"""Check a recorded calibration against itself: two halves of its poses must agree within their covariances.

Signal chain: poses of a board -> every second pose, and the others -> a calibration of each half -> difference d of the
parameters and its covariance C, from the noise of both and from what the board's errors do to each -> chi squared d^T
C^-1 d -> factor on the standard uncertainties of the calibration of all poses, or an error.

A covariance follows from the residuals. It does not contain errors of the model: a lens that the polynomial does not
describe, a board that is not what it seems, poses so much alike that such errors turn into a wrong focal length. These
show as a difference of halves. The factor is Birge's ratio sqrt(chi^2 / p) (R. T. Birge, Phys. Rev. 40, 1932, 207), or
that by which the worst parameter exceeds its limit, if that is more.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2, norm

from characterisation.files.arrays import Floats
from characterisation.files.errors import InputError
from mitsim.sensor.rig_parameters import parameter_differences
from mitsim.study.calibration.recorded import (
    LEAST_POSES,
    RecordedCalibration,
    RecordedCorners,
    calibrate_recorded,
    largest_tilt,
    tilt_hint,
)

#: probability with which halves of a right calibration count as different
_RISK = 0.01

#: largest factor on the standard uncertainties; *assumed*. Beyond, the model is wrong, and a factor cannot repair it
MOST_WIDENED = 3.0


@dataclass(frozen=True)
class CheckedCalibration:
    """A calibration whose halves were compared.

    - ``calibration`` of all poses; its covariance is multiplied by the square of ``factor``.
    - ``factor``, at least 1; NaN if there are too few poses for two halves.
    - ``worst``: the parameter of which the halves differ most, and ``worst_sigma``, that difference in standard
      uncertainties of it, before the factor.
    - ``tilt_deg``: largest angle between two normals of the board.
    """

    calibration: RecordedCalibration
    factor: float
    worst: str
    worst_sigma: float
    tilt_deg: float


def calibrate_checked(corners: RecordedCorners, source: str, where: str = "boards") -> CheckedCalibration:
    """Calibrate a rig from recorded corners, and widen its covariance until two halves of the poses agree within it.

    ``source`` is the text of the covariance's file, and ``where`` the name of the recordings in an error.

    Raises
    ------
    InputError
        If there are too few poses, the adjustment does not converge, or the halves differ by more than a factor of
        :data:`MOST_WIDENED` explains.
    """
    boards = corners.boards
    whole = calibrate_recorded(corners, source)
    tilt = largest_tilt(whole.poses)
    if len(boards) < 2 * LEAST_POSES:
        return CheckedCalibration(whole, math.nan, "", math.nan, tilt)
    halves = [calibrate_recorded(replace(corners, boards=boards[first::2]), source) for first in (0, 1)]
    difference, covariance = _difference(*halves)
    sigma = np.sqrt(np.diag(covariance))
    standard = np.divide(difference, sigma, out=np.zeros_like(difference), where=sigma > 0)
    count = len(standard)
    square = float(standard @ np.linalg.pinv(covariance / np.outer(sigma, sigma), 1e-6, hermitian=True) @ standard)
    factor = math.sqrt(square / count) if square > chi2.ppf(1 - _RISK, count) else 1.0
    worst = int(np.argmax(np.abs(standard)))
    limit = float(norm.ppf(1 - _RISK / 2 / count))
    factor = max(factor, abs(float(standard[worst])) / limit, 1.0)
    name = whole.covariance.names[worst]
    if factor > MOST_WIDENED:
        raise InputError(
            where,
            name,
            f"two halves of the {len(boards)} poses that differ by {abs(standard[worst]):.1f} standard uncertainties",
            f"{limit * MOST_WIDENED:.1f} or less: the covariance of this calibration cannot be believed",
            tilt_hint(whole.poses)
            or "check the geometry of the board and the order of its corners, and cover the images of all cameras",
        )
    widened = replace(
        whole.covariance,
        covariance=whole.covariance.covariance * factor**2,
        details=dict(whole.covariance.details) | {"widened_by_halves": factor},
    )
    return CheckedCalibration(replace(whole, covariance=widened), factor, name, float(standard[worst]), tilt)


def _difference(calibration: RecordedCalibration, other: RecordedCalibration) -> tuple[Floats, Floats]:
    """Return the difference (p,) of two calibrations with one board, and its covariance (p, p)."""
    names = calibration.covariance.names
    shared = calibration.board_effect - other.board_effect
    noise = (half.covariance.covariance - half.board_effect @ half.board_effect.T for half in (calibration, other))
    return np.asarray(parameter_differences(calibration.rig, other.rig, names)), sum(noise) + shared @ shared.T


def in_words(checked: CheckedCalibration) -> str:
    """Return a sentence about the comparison of halves."""
    if math.isnan(checked.factor):
        return f"halves not compared: fewer than {2 * LEAST_POSES} poses"
    agree = f"two halves of the poses agree within {abs(checked.worst_sigma):.1f} standard uncertainties"
    if checked.factor == 1.0:
        return agree
    return (
        f"two halves of the poses differ by {abs(checked.worst_sigma):.1f} standard uncertainties of {checked.worst}: "
        f"all standard uncertainties are multiplied by {checked.factor:.2f}"
    )
