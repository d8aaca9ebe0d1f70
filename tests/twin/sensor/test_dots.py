"""Simulated captures of dots with everything known: how often the intervals of a fit hold the truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from characterisation.files.errors import InputError
from mitsim.twin.finish.specimen import known_specimen
from mitsim.twin.sensor import specimen_simulator
from mitsim.twin.sensor.dots import DotDraws, field_misfits
from mitsim.twin.sensor.parameters import (
    BLACK_LEVEL,
    FLUX,
    FULL_WELL,
    PROJECTOR_CORNER,
    ROOM_LEVEL,
    pattern_parameters,
)
from tests.twin.sensor.small_unit import capture_of, small_fit, small_sensor, specimen, standard_errors, unit


def test_intervals_of_dots_hold_the_truth_as_often_as_they_say(monkeypatch):
    """Three units with a dozen numbers each; the long version, 100 units, is tests/benchmarks/fit_sensor_coverage.py.

    Numbers of one unit share its dots, so that 36 errors count as some 15 independent ones: their mean square is 1
    within 3 sqrt(2 / 15), and at least four of five lie in their 95 % interval. The units are rendered with 16 rays a
    pixel, the dots that they are compared with by 4: light without interreflections has no noise.
    """
    monkeypatch.setattr(specimen_simulator, "_SAMPLES", 4)
    errors = np.array([error for seed in (101, 102, 103) for error in standard_errors(seed, draws=2)[1].values()])
    assert len(errors) >= 30
    assert np.mean(errors**2) < 1 + 3 * np.sqrt(2 / 15)
    assert np.mean(np.abs(errors) < 1.96) >= 0.8


def test_a_known_room_stays_while_the_power_is_fitted():
    """The file's power is 1 W. Before, 0.750 +- 0.010 for 0.716 W, black 0.153 +- 0.006 for 0.1: the room fell too."""
    truth, sensor = unit(0), small_sensor()
    terms = [truth.room.irradiance_w_mm2 * share for share in (1.0, *truth.room.gradient, *truth.room.curvature)]
    dark = [FLUX, *pattern_parameters(sensor), PROJECTOR_CORNER, BLACK_LEVEL]
    found = small_fit(
        capture_of(truth, 0), replace(sensor, imager=truth.imager), specimen(), dark, DotDraws(2, 7), terms
    )
    assert found.with_values(found.moment_fit.values).room.irradiance_w_mm2 == pytest.approx(terms[0])
    values, spreads = found.in_file_units()
    power, black = (found.parameters.index(parameter) for parameter in (FLUX, BLACK_LEVEL))
    assert abs(1 / values[power] - 1 / truth.projector.flux) < 3 * spreads[power] < 0.2
    assert abs(values[black] - truth.projector.black_level) < 3 * spreads[black] < 0.05


def test_the_power_is_as_uncertain_as_the_full_well_of_the_file():
    """15,000 e- in the file for 17,800. Before, with the full well fixed, 0.601 +- 0.004 W for 0.716 W."""
    truth, sensor = unit(0), small_sensor()
    sensor = replace(sensor, imager=replace(sensor.imager, read_noise=truth.imager.read_noise * 15 / 17.8))
    terms = [truth.room.irradiance_w_mm2 * 15 / 17.8 * s for s in (1.0, *truth.room.gradient, *truth.room.curvature)]
    varied = [replace(FULL_WELL, held=True, spread=0.2), FLUX, *pattern_parameters(sensor), PROJECTOR_CORNER]
    varied += [BLACK_LEVEL, ROOM_LEVEL.held_within(0.01)]
    found = small_fit(capture_of(truth, 0), sensor, specimen(), varied, DotDraws(2, 7), terms)
    values, spreads = found.in_file_units()
    for parameter, true in ((FLUX, truth.projector.flux), (ROOM_LEVEL, truth.room.irradiance_w_mm2)):
        index = [one.key for one in found.parameters].index(parameter.key)
        assert abs(1 / values[index] - 1 / true) < 2 * spreads[index] < 0.8 / true


def test_the_misfit_of_a_feature_is_its_root_mean_square_over_the_patches():
    x = np.linspace(-1, 1, 5001)
    basis = np.stack([np.ones_like(x), x, 0 * x, x**2 - np.mean(x**2), 0 * x, 0 * x], axis=1)
    names = [("level", "1"), ("level", "x"), ("contrast", "xx"), ("grain", "1")]
    found = field_misfits(names, np.array([0.3, -0.4, 0.5, -0.1]), basis)
    # x has the variance 1 / 3, its square 1 / 5 - 1 / 9
    wanted = {"level": (0.09 + 0.16 / 3) ** 0.5, "contrast": 0.5 * (1 / 5 - 1 / 9) ** 0.5, "grain": 0.1}
    assert found == pytest.approx(wanted, rel=1e-3)


def test_what_an_image_shows_is_found_whatever_the_file_says():
    """Power and room are wrong by a factor in the file, and come out near the truth."""
    truth = unit(7)
    found = small_fit(capture_of(truth, 7), small_sensor(), specimen(), [FLUX], DotDraws(1, 3))
    values, spreads = found.in_file_units()
    assert found.parameters[0] is FLUX and spreads[0] > 0
    # full well, dots and corners are held at the file's, up to a third off: the power's share is what is left
    share = values[0] / found.sensor.imager.full_well / (truth.projector.flux / truth.imager.full_well)
    assert 0.5 < share < 2


def test_a_sheet_that_is_too_small_is_one_message():
    capture = capture_of(unit(1), 1)
    tiny = known_specimen(specimen().world_from_sensor, 30.0, 30.0)
    with pytest.raises(InputError, match=r"unit: specimen: found \d+ patches .* allowed: 8 or more"):
        small_fit(capture, small_sensor(), tiny, [FLUX], DotDraws())
