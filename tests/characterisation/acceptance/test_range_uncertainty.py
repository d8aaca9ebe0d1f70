"""The uncertainty of a range is the scatter of repeated captures of the same form."""

import numpy as np
import pytest

from characterisation.acceptance.range_uncertainty import flatness_uncertainty, form_error_uncertainty
from characterisation.acceptance.vdi_2634 import flatness_error, probing_error

SIGMA, CAPTURES = 0.05, 60


def plate(bend, rng):
    x, y = rng.uniform(-50, 50, (2, 2000))
    return np.column_stack([x, y, 600 + bend * (x / 50) ** 2 + SIGMA * rng.standard_normal(len(x))])


def ball(oval, rng):
    direction = rng.standard_normal((2000, 3))
    direction[:, 2] = -np.abs(direction[:, 2])
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    radius = 20 + oval * direction[:, 0] ** 3 + SIGMA * rng.standard_normal(len(direction))
    return direction * radius[:, None]


@pytest.mark.parametrize("bend", [0.0, 0.1, 2.0])
def test_flatness_scatters_by_its_uncertainty(bend):
    """A scatter of 60 captures is known to 9 %, four drawn ones of 100 to 4 %; the ends of a bent plate are quieter."""
    rng = np.random.default_rng(1)
    captures = [plate(bend, rng) for _ in range(CAPTURES)]
    scatter = np.std([flatness_error(one) for one in captures], ddof=1)
    stated = np.mean([flatness_uncertainty(one) for one in captures[:4]])
    assert stated == pytest.approx(scatter, rel=0.39)


@pytest.mark.parametrize("oval", [0.0, 0.5])
def test_the_form_error_of_a_ball_scatters_by_its_uncertainty(oval):
    rng = np.random.default_rng(2)
    captures = [ball(oval, rng) for _ in range(CAPTURES)]
    scatter = np.std([probing_error(one, 40.0).form for one in captures], ddof=1)
    stated = [form_error_uncertainty(one, probing_error(one, 40.0).centre) for one in captures[:4]]
    assert np.mean(stated) == pytest.approx(scatter, rel=0.39)


def test_the_extremes_of_a_few_points_have_no_uncertainty():
    points = plate(0.0, np.random.default_rng(3))
    assert np.isnan(flatness_uncertainty(points[:900]))  # two are rejected
    assert flatness_uncertainty(points) == flatness_uncertainty(points)


def test_no_points_have_no_uncertainty():
    none = np.full((5, 3), np.nan)
    assert np.isnan(flatness_uncertainty(none)) and np.isnan(flatness_uncertainty(none[:0]))
    assert np.isnan(form_error_uncertainty(none, (0, 0, 0)))
