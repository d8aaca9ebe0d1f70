"""A statement far below the accuracy that the maker publishes says so."""

from __future__ import annotations

from dataclasses import replace

import pytest

from characterisation.tasks.task_file import Measurement
from mitsim.sensor.preset import load_sensor
from mitsim.study.maker_accuracy import below_the_maker, maker_sigma


def measurement(kind: str, nominal: float, unit: str = "mm") -> Measurement:
    return Measurement.model_validate({"kind": kind, "features": ["a"], "nominal": nominal, "unit": unit})


def test_an_error_of_lengths_scales_with_the_length_and_says_nothing_of_zones_and_angles() -> None:
    sensor = load_sensor("zivid-2-m70")
    assert sensor.published_lengths is not None
    relative = sensor.published_lengths.one_sigma(700)
    assert maker_sigma(sensor, measurement("radius", 20.0), 700) == pytest.approx(20 * relative)
    assert maker_sigma(sensor, measurement("flatness", 0.0), 700) is None
    assert maker_sigma(sensor, measurement("cone_angle", 30.0, "deg"), 700) is None
    assert maker_sigma(sensor, measurement("radius", 20.0), 5000) is None  # beyond the maker's table


def test_one_figure_holds_for_every_measurement_in_mm() -> None:
    sensor = load_sensor("photoneo-phoxi-s")
    assert sensor.published_accuracy is not None
    figure = sensor.published_accuracy.sigma_mm
    assert maker_sigma(sensor, measurement("flatness", 0.0), 442) == figure
    assert maker_sigma(replace(sensor, published_accuracy=None), measurement("radius", 20.0), 442) is None


def test_a_sentence_names_what_is_below_a_tenth_and_what_is_left_out() -> None:
    rows = [("radius", 0.0024, 0.05), ("distance", 0.006, 0.05), ("angle", 0.001, None), ("lost", None, 0.05)]
    [sentence] = below_the_maker(rows, "form of the part; vibration", "photoneo-phoxi-s")
    assert sentence.startswith("radius (0.0024 of 0.050 mm) is stated below a tenth")
    assert "form of the part; vibration" in sentence and "distance" not in sentence and "lost" not in sentence
    assert not below_the_maker(rows[1:], "", "photoneo-phoxi-s")
