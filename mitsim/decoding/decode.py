"""Decode captures, and read clouds, as programs do."""

from __future__ import annotations

import warnings
from pathlib import Path

from characterisation.point_cloud import PointCloud
from mitsim.capture.capture import Capture
from mitsim.decoding import input_clouds
from mitsim.decoding.checks.checked_cloud import checked_cloud
from mitsim.decoding.cloud import decoder_settings
from mitsim.sensor.sensor import Sensor


def decode(
    capture: Capture, sensor: Sensor | str | Path | None = None, *, range_mm: tuple[float, float] | None = None
) -> PointCloud:
    """Decode the images of a capture to a point cloud, and issue the warnings that ``mitsim decode`` prints.

    Parameters
    ----------
    capture
        From :func:`render` or :func:`read_capture`.
    sensor
        Sensor whose settings are used: loaded, the name of a preset, or the path of a sensor TOML file. By default
        those of the capture, or those of the preset that it names.
    range_mm
        Nearest and farthest depth to decode [mm], instead of the sensor's.

    Returns
    -------
    PointCloud
        Points (H, W, 3) float32 [mm] in the sensor frame, NaN where missing; ``status`` (H, W) is the reason.

    Raises
    ------
    InputError
        If the sensor is unknown or of another technology, the range is invalid, or the capture is inconsistent.

    Warns
    -----
    UserWarning
        If images, calibration or range are doubtful: one warning for each sentence.

    Examples
    --------
    >>> import mitsim as ms
    >>> cloud = ms.decode(ms.read_capture("capture"), "small.toml")
    >>> cloud.points.shape
    (240, 320, 3)
    >>> round(float(cloud.valid.mean()), 1) > 0
    True
    """
    settings, imager = decoder_settings(capture, sensor, range_mm)
    decoded = checked_cloud(capture, settings, imager, sensor=sensor)
    for text in decoded.warnings:
        warnings.warn(text, stacklevel=2)
    return decoded.cloud


def read_cloud(path: str | Path, sensor: str | None = None) -> PointCloud:
    """Read a cloud: a PLY file of mitsim, or a capture or recording, which is decoded first.

    Parameters
    ----------
    path
        A file of :func:`write_cloud` or ``mitsim decode``; a capture folder; or a recording that ``mitsim import``
        reads.
    sensor
        Decode with the settings of this preset or sensor TOML file.

    Returns
    -------
    PointCloud
        Points (H, W, 3) [mm] in the sensor frame, NaN where missing.

    Raises
    ------
    InputError
        If the file does not exist, or cannot be read or decoded.

    Examples
    --------
    >>> import mitsim as ms
    >>> cloud = ms.read_cloud("cloud.ply")
    >>> cloud.points.shape, cloud.source
    ((240, 320, 3), 'simulated')
    """
    return input_clouds.read_cloud(Path(path), sensor).cloud
