"""Residuals of a map: captures without a sigma, and none at all."""

import numpy as np
import pytest

from characterisation.coupon.patch_table import Overall
from characterisation.files.errors import InputError
from characterisation.maps.validation import Pair, residual_table


def pair(measured, predicted):
    values = [Overall(0.9, 0.01, sigma, 0.001) for sigma in (measured, predicted)]
    return Pair("matt_white", np.nan, 500.0, 0.0, *values, np.array([0.1, -0.1]), np.array([0.1, -0.1]))


def test_a_capture_whose_points_all_have_one_depth_has_no_sigma():
    table = residual_table([pair(0.1, 0.11), pair(0.0, 0.1), pair(0.1, 0.0)])
    assert table["sigma_captures"].item() == 1
    assert table["one_sided"].item() == 2
    assert table["sigma_residual"].item() == pytest.approx(0.1)


def test_no_captures_are_refused():
    with pytest.raises(InputError, match="pairs"):
        residual_table([])
