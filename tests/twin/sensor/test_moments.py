"""The method of simulated moments on models whose answer is known, and several captures put together."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from mitsim.sensor.preset import load_sensor
from mitsim.twin.sensor.defocus import modulation
from mitsim.twin.sensor.estimate import FittedKey, combined, pooled
from mitsim.twin.sensor.moments import Prior, match_moments
from mitsim.twin.sensor.parameters import room_parameters
from mitsim.twin.sensor.run import _combined_estimates
from mitsim.twin.sensor.stripes import focused
from mitsim.twin.sensor.write import _entries, fit_table

A = np.array([[1.0, 0.4], [0.2, 1.0], [0.5, -0.7]])


def wide(count, low=-np.inf):
    return Prior(
        np.zeros(count), np.full(count, 100.0), np.full(count, 0.1), np.full(count, low), np.full(count, np.inf)
    )


def test_a_linear_model_is_solved_as_weighted_least_squares_are():
    covariance = np.diag([0.01, 0.04, 0.02])
    seen = A @ [1.5, -2.0] + [0.05, -0.1, 0.02]
    found = match_moments(seen, covariance, lambda x, _: (A @ x, np.zeros((3, 3))), wide(2), draws=1)
    weight = np.linalg.inv(covariance)
    normal = A.T @ weight @ A
    np.testing.assert_allclose(found.values, np.linalg.solve(normal, A.T @ weight @ seen), rtol=1e-3)
    np.testing.assert_allclose(found.covariance, np.linalg.inv(normal), rtol=1e-3)
    assert found.determined.all() and found.freedom == 1


def test_a_bound_holds_a_parameter():
    found = match_moments(A @ [1.0, -2.0], np.eye(3) * 0.01, lambda x, _: (A @ x, np.zeros((3, 3))), wide(2, 0.0), 1)
    assert found.values[1] == 0.0


def test_a_held_parameter_enters_the_uncertainty_of_the_others():
    """Held at 0 while it is drawn from its prior, the second: before, 95 % intervals of the first held it in 62 %."""
    rng, errors = np.random.default_rng(4), []
    prior = replace(wide(2), spread=np.array([100.0, 0.5]), held=np.array([False, True]))
    for _ in range(400):
        truth, sigma = np.array([1.0, rng.normal(0.0, 0.5)]), np.array([0.1, 1.0, 2.0])
        seen = A @ truth + rng.normal(0.0, sigma)
        found = match_moments(seen, np.diag(sigma**2), lambda x, _: (A @ x, np.zeros((3, 3))), prior, draws=1)
        assert found.values[1] == 0.0 and found.determined.tolist() == [True, False]
        errors.append((found.values[0] - 1.0) / np.sqrt(found.covariance[0, 0]))
    assert 0.93 < np.mean(np.abs(errors) < 1.96) < 0.99


def test_what_no_figure_shows_is_not_told():
    found = match_moments(
        np.array([1.0]),
        np.eye(1) * 1e-4,
        lambda x, _: (x[:1], np.zeros((1, 1))),
        Prior(np.zeros(2), np.ones(2), np.full(2, 0.1), np.full(2, -9.0), np.full(2, 9.0)),
        1,
    )
    assert found.determined.tolist() == [True, False] and abs(found.values[1]) < 1e-9


def test_captures_that_differ_beyond_their_uncertainty_are_less_sure_together():
    alike, differing = combined([1.0, 1.1, 0.9], [0.2] * 3), combined([1.0, 3.0, 2.0], [0.2] * 3)
    assert alike == (pytest.approx(1.0), pytest.approx(0.2 / np.sqrt(3)))
    # DerSimonian and Laird by hand: Q = 50, tau^2 = (50 - 2) / 50 over weights of 25; 2 / 0.96^2 = 2.17 degrees of
    # freedom, between the tables' 4.30 of two and 3.18 of three
    assert differing[0] == pytest.approx(2.0)
    assert 3.18 < differing[1] * 1.96 / np.sqrt((0.04 + 0.96) / 3) < 4.3


def test_the_inverse_of_a_full_well_has_the_symmetric_interval():
    one = FittedKey("imager.full_well_e", 10_000.0, 1e-5, "e-", ("a",), "", "inverse")
    low, high = one.interval()
    assert 1 / low - 1e-4 == pytest.approx(1e-4 - 1 / high)
    other = FittedKey("imager.full_well_e", 5_000.0, 1e-4, "e-", ("b",), "", "inverse")
    (both,) = pooled([one, other])
    assert both.captures == ("a", "b") and 9_000 < both.value < 10_000


@pytest.mark.parametrize("blur", [0.3, 1.0, 2.5])
def test_modulation_of_blurred_stripes_is_that_of_stripes_that_were_blurred(blur):
    from scipy.ndimage import gaussian_filter1d

    fine = 50
    for width in (3.0, 6.0, 20.0):
        wave = np.where((np.arange(int(40 * width * fine)) // (width * fine)) % 2 == 0, 1.0, -1.0)
        seen = gaussian_filter1d(wave, blur * fine, mode="wrap")
        assert modulation(blur, np.array(width)) == pytest.approx(np.abs(seen).mean(), abs=0.01)


def test_the_assumed_interval_of_a_room_is_not_stated_as_a_fitted_one():
    """A slope of 0 within 2 either way is what was assumed before the capture."""
    key = FittedKey("room.gradient[0]", 0.1, 0.98, "1", ("a",), "dots", determined=False)
    other = replace(key, key="room.gradient[1]", uncertainty=0.1, determined=True)
    fit = SimpleNamespace(estimates=[key, other], undetermined=[])
    rows = fit_table(fit).splitlines()
    assert "not determined" in rows[2] and " to " not in rows[2] and " to " in rows[3]
    assert "standard uncertainties -, 0.10;" in _entries(fit)["room.gradient"].comment
    both = pooled([key, replace(key, uncertainty=0.1, captures=("b",), determined=True)])
    assert [one.determined for one in both] == [True]
    assert [one.determined for one in pooled([key, replace(key, captures=("b",))])] == [False]


def test_a_room_that_the_dots_do_not_tell_is_named():
    parameters = tuple(room_parameters(1.0)[:2])
    moments = SimpleNamespace(determined=np.array([True, False]))
    fit = SimpleNamespace(
        parameters=parameters,
        undetermined=(),
        moment_fit=moments,
        in_file_units=lambda: (np.array([1e-6, 0.1]), np.array([1e5, 0.9])),
    )
    sensor, imager = load_sensor("ensenso-n10"), SimpleNamespace(undetermined=())
    estimates, _ = _combined_estimates({"wall": fit}, sensor, imager, None)
    assert [one.determined for one in estimates] == [True, False]


@pytest.mark.parametrize("first", [0, 1])
def test_a_capture_that_tells_the_focus_decides_whatever_the_order(first):
    """Before, the aperture was 5 or 0 mm by the order, and two definitions of the blur were averaged."""

    def told(name, aperture, spread, blur):
        keys = {"imager.blur_px": (blur, 0.1), "projector.aperture_mm": (aperture, spread)}
        return [FittedKey(key, *pair, "", (name,), "") for key, pair in keys.items()]

    sharp = [*told("deep", 5.0, 1.0, 0.4), FittedKey("projector.focus_mm", 700.0, 9.0, "mm", ("deep",), "")]
    both = [sharp, told("flat", 0.0, 0.0, 0.9)]
    assert pooled(focused([*both[first], *both[1 - first]])) == pooled(sharp)
    assert pooled(focused(both[1])) == both[1]
