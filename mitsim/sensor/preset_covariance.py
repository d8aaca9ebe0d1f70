"""Read the covariances of the presets: virtual calibrations made by ``mitsim calibrate``."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

from characterisation.files.errors import InputError
from mitsim.sensor.drift import Drift, with_drift
from mitsim.sensor.rig_covariance import RigCovariance, read_rig_covariance
from mitsim.sensor.sensor import Sensor


def preset_covariance(sensor: Sensor, drift: Drift | None = None) -> RigCovariance:
    """Return the covariance of a preset's virtual calibration, plus drift since then.

    ``drift`` None is the default :class:`Drift`; :meth:`Drift.none` adds nothing.

    Raises
    ------
    InputError
        If mitsim has no calibration of this sensor, or the sensor's rig differs from that of the preset.
    """
    path = Path(str(files("mitsim.sensor") / "presets" / "calibrations" / f"{sensor.name}.toml"))
    if not path.is_file():
        names = sorted(file.stem for file in path.parent.glob("*.toml"))
        hint = f"make one: mitsim calibrate {sensor.name}.toml -o {sensor.name}-calibration.toml"
        raise InputError(
            "sensor", "name", repr(sensor.name), f"a sensor that comes calibrated: {', '.join(names)}", hint
        )
    covariance = read_rig_covariance(path, sensor.rig)
    return with_drift(covariance, sensor, Drift() if drift is None else drift)
