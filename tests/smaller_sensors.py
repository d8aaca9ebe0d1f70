"""Sensors that search or show less than a preset does, for tests that need no more."""

from __future__ import annotations

from dataclasses import replace

from mitsim.sensor.camera import Camera
from mitsim.sensor.preset import Sensor


def narrow_search(sensor: Sensor, near_mm: float, far_mm: float) -> Sensor:
    """Return a sensor with a matcher that searches another range of depths."""
    assert sensor.matcher is not None
    return replace(sensor, matcher=sensor.matcher.model_copy(update={"near_mm": near_mm, "far_mm": far_mm}))


def binned(sensor: Sensor, step: int) -> Sensor:
    """Return a sensor whose cameras have their pixels binned ``step`` x ``step``."""
    cameras = {name: camera.binned(step) for name, camera in sensor.rig.cameras.items()}
    return replace(sensor, rig=replace(sensor.rig, cameras=cameras))


def middle_part(sensor: Sensor, width: int, height: int) -> Sensor:
    """Return a sensor with the middle of its cameras' images, at most ``width`` x ``height`` pixels."""
    cameras = {name: _middle(camera, width, height) for name, camera in sensor.rig.cameras.items()}
    return replace(sensor, rig=replace(sensor.rig, cameras=cameras))


def _middle(camera: Camera, width: int, height: int) -> Camera:
    width, height = min(width, camera.width), min(height, camera.height)
    column, row = (camera.width - width) // 2, (camera.height - height) // 2
    matrix = camera.matrix - [[0, 0, column], [0, 0, row], [0, 0, 0]]
    return replace(camera, matrix=matrix, width=width, height=height)
