"""Sensors that search or show less than a preset does, for tests that need no more."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import numpy as np

from mitsim.sensor.camera import Camera
from mitsim.sensor.drift import Drift
from mitsim.sensor.preset import load_sensor
from mitsim.sensor.preset_covariance import preset_covariance
from mitsim.sensor.rig_covariance import write_rig_covariance
from mitsim.sensor.sensor import Sensor


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


def coarse_sensor(name: str, step: int, folder: Path) -> Path:
    """Write a preset with pixels of ``step`` x ``step`` times the area into a folder, and return its sensor file.

    It keeps its name, so the map of the preset serves it, and its exposure. Projected dots grow with the pixels. The
    covariance of its calibration is that of the preset in larger pixels.
    """
    preset = (files("mitsim.sensor") / "presets" / f"{name}.toml").read_text(encoding="utf-8")
    parts = re.split(r"(?m)^(?=\[)", preset)
    calibration = folder / f"{name}-calibration.toml"
    if not any(part.startswith("[unknowns.calibration]") for part in parts):
        parts.append("[unknowns.calibration]\n")
    sensor = folder / f"{name}.toml"
    sensor.write_text("\n".join(_coarse(part, step, calibration) for part in parts), encoding="utf-8")
    known = preset_covariance(load_sensor(name), Drift.none())
    cameras = load_sensor(sensor).rig.cameras
    eye_and_kind = [one.split(".", 1) for one in known.names]
    in_pixels = [eye in cameras and kind.startswith(("focal", "principal")) for eye, kind in eye_and_kind]
    scale = np.where(in_pixels, 1 / step, 1.0)
    coarse = replace(known, covariance=known.covariance * np.outer(scale, scale))
    write_rig_covariance(calibration, coarse, load_sensor(sensor).rig)
    return sensor


def _coarse(part: str, step: int, calibration: Path) -> str:
    """Return a table of a sensor file with lengths in pixels of the cameras divided by ``step``."""
    if part.startswith("[unknowns.calibration]"):
        return f'{part}covariance = "{calibration.name}"\n'
    if part.startswith("[pattern]"):
        return re.sub(r"(?m)^(run_length_px = )([\d.]+)", lambda found: found[1] + str(step * float(found[2])), part)
    if not part.startswith("[cameras."):
        return part
    part = re.sub(r"(?m)^((?:width|height) = )(\d+)", lambda found: found[1] + str(int(found[2]) // step), part)
    part = _each(part, "focal_px", lambda value: value / step)
    return _each(part, "principal_px", lambda value: (value + 0.5) / step - 0.5)  # pixel centres lie at integers


def _each(part: str, key: str, change: Callable[[float], float]) -> str:
    def written(found: re.Match[str]) -> str:
        return found[1] + ", ".join(f"{change(float(value)):.9g}" for value in found[2].split(","))

    return re.sub(rf"(?m)^({key} = \[)([^\]]*)", written, part)
