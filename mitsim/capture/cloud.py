"""From a capture to its cloud, whatever took it: choose the decoder and its settings, then decode."""

from __future__ import annotations

from characterisation.point_cloud import PointCloud
from mitsim.capture.capture import Capture
from mitsim.decode.stereo import StereoGeometry, decode_stereo
from mitsim.errors import InputError
from mitsim.sensor.matcher import MatcherSettings
from mitsim.sensor.preset import load_sensor, presets

#: searched where neither a preset nor the recording says how near and far the sensor looks [mm]
DEFAULT_RANGE_MM = (300.0, 2000.0)


def matcher_settings(capture: Capture, sensor: str | None = None) -> MatcherSettings:
    """Settings to decode a capture with: of ``sensor`` if given, else of the preset of its name, else its own range."""
    if sensor is not None:
        return load_sensor(sensor).matcher
    if capture.sensor in presets():
        return load_sensor(capture.sensor).matcher
    near, far = (capture.settings.get(key, default) for key, default in zip(
        ("near_mm", "far_mm"), DEFAULT_RANGE_MM, strict=True))  # fmt: skip
    return MatcherSettings(near_mm=float(near), far_mm=float(far))


def capture_cloud(
    capture: Capture, settings: MatcherSettings, geometry: StereoGeometry | None = None,
    window: tuple[int, int, int, int] | None = None,
) -> PointCloud:  # fmt: skip
    """Decode a capture; ``geometry`` saves preparing its rig again, ``window`` decodes a part only."""
    if capture.technology != "active_stereo":
        raise InputError("capture", "technology", repr(capture.technology), "active_stereo")
    left, right = (stack[0] for stack in list(capture.images.values())[:2])
    return decode_stereo(
        left, right, geometry or capture.rig, settings, sensor=capture.sensor, source=capture.source,
        full_scale=2**capture.bits - 1, window=window,
    )  # fmt: skip
