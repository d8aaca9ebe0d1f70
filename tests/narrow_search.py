"""Sensors with two cameras that search a part of their range, for surfaces of which the depth is known."""

from __future__ import annotations

from dataclasses import replace

from mitsim.sensor.preset import Sensor


def narrow_search(sensor: Sensor, near_mm: float, far_mm: float) -> Sensor:
    """Return the sensor with another range of depths: the time of its matcher grows with the disparities in it."""
    assert sensor.matcher is not None
    return replace(sensor, matcher=sensor.matcher.model_copy(update={"near_mm": near_mm, "far_mm": far_mm}))
