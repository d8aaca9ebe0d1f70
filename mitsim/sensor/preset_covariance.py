"""Read the covariances of the presets, virtual calibrations made by ``mitsim calibrate``, and add drift to any."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

from characterisation.files.errors import InputError
from mitsim.sensor.drift import Drift, drift_modes
from mitsim.sensor.rig_covariance import RigCovariance, read_rig_covariance
from mitsim.sensor.rig_parameters import PATH_NAMES, parameter_names
from mitsim.sensor.sensor import Sensor


def preset_covariance(sensor: Sensor, drift: Drift | None = None) -> RigCovariance:
    """Return the covariance of a preset's virtual calibration, plus drift since then.

    ``drift`` None is the default :class:`Drift`; :meth:`Drift.none` adds nothing. Raises InputError if mitsim has no
    calibration of this sensor, or the sensor's rig differs from that of the preset.
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


def with_drift(covariance: RigCovariance, sensor: Sensor, drift: Drift) -> RigCovariance:
    """Return the covariance of a calibration plus that of drift; the source names both.

    All eyes that measure drift, and those with a parameter in the covariance. Parameters that drift and are not in the
    covariance come last.
    """
    drifting = {name.rpartition(".")[0] for name in covariance.names} | set(sensor.measuring_eyes)
    possible = [name for name in parameter_names(sensor.rig) if name.rpartition(".")[0] in drifting]
    if sensor.technology == "time_of_flight":
        possible += PATH_NAMES
    modes = [
        (mode.sigma**2, {name: value for name, value in mode.step.items() if value != 0})
        for mode in drift_modes(sensor.rig, tuple(possible), drift)
        if mode.sigma > 0
    ]
    described = ", ".join(f"{name} {value:g}" for name, value in drift.numbers().items())
    return covariance.plus(modes, f"drift: {described}")
