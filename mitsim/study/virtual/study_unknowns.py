"""Prepare the unknowns of a study for drawing.

Signal chain: study -> covariance of the calibration with the drift since then, thermal expansion of the part ->
:class:`~mitsim.study.virtual.world.Unknowns`.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from characterisation.files.errors import InputError, nearest
from characterisation.words.progress import say
from mitsim.sensor.camera import Rig
from mitsim.sensor.drift import Drift
from mitsim.sensor.preset import presets
from mitsim.sensor.preset_covariance import preset_covariance, with_drift
from mitsim.sensor.rig_covariance import RigCovariance, read_rig_covariance
from mitsim.sensor.sensor import Sensor
from mitsim.sensor.unknowns import CalibrationUnknowns, FormUnknowns, TemperatureUnknowns
from mitsim.study import Study
from mitsim.study.calibration.virtual_calibration import calibrate
from mitsim.study.virtual.coat import coated_shapes
from mitsim.study.virtual.drawn_decoder import check_decoder
from mitsim.study.virtual.form import drawn_form
from mitsim.study.virtual.world import GROUPS, Unknowns, warmed

#: linear expansion near 20 C [1/K], by the metal of a finish (CRC Handbook of Chemistry and Physics; AISI 304)
EXPANSION_PER_KELVIN = {
    "aluminium": 23.1e-6,
    "copper": 16.5e-6,
    "brass": 19e-6,
    "stainless_steel": 17.3e-6,
    "carbon_steel": 11.8e-6,
    "chromium": 4.9e-6,
    "nickel": 13.4e-6,
}

#: thermal expansion of a part whose finish names no metal [1/K]: between steel and aluminium
_USUAL_EXPANSION = 17e-6


def study_unknowns(study: Study, varied: tuple[str, ...] = GROUPS) -> Unknowns:
    """Prepare the unknowns of a study for drawing.

    Raises InputError if a file is missing or belongs to another sensor, if a feature with a form deviation or a
    measured finish is not in the scene, or if a decoder can be drawn that OpenCV's costs do not hold.
    """
    table, sensor = study.unknowns, study.sensor
    for name in table.form.features:
        if name not in study.scene.names:
            allowed = ", ".join(study.scene.names)
            raise InputError(study.path, f"unknowns.form.features.{name}", "no shape of the scene", allowed)
    table = table.model_copy(update={"form": FormUnknowns(features=drawn_form(study.task, table.form.features))})
    finishes = sorted({shape.bsdf().id() for shape in study.scene.shapes})
    for name in table.finish.measured:
        if name not in finishes:
            field = f"unknowns.finish.measured.{name}"
            raise InputError(study.path, field, "no bsdf of the scene", ", ".join(finishes), nearest(name, finishes))
    check_decoder(sensor, table.decoder, study.path)
    if study.file.sprayed:  # the measured finish is under the spray
        table = table.model_copy(update={"finish": table.finish.model_copy(update={"measured": {}})})
    folder = study.path.parent
    if not coated_shapes(study.scene, table.coat):
        varied = tuple(group for group in varied if group != "coat")
    return Unknowns(
        table,
        sensor.rig,
        calibration_covariance(sensor, table.calibration, folder),
        sensor.wavelength_nm,
        _expansion(study),
        np.asarray(study.scene.centre, float),
        study.file.seed,
        varied,
    )


def calibration_covariance(sensor: Sensor, table: CalibrationUnknowns, folder: Path) -> RigCovariance:
    """Return the covariance of a sensor's calibration, with the drift since then, both scaled as the table says."""
    covariance = _unscaled_covariance(sensor, table, folder)
    if table.scale == 1:
        return covariance
    return replace(
        covariance,
        covariance=table.scale**2 * covariance.covariance,
        source=f"{table.scale:g} times {covariance.source}",
    )


def with_temperature(covariance: RigCovariance, rig: Rig, table: TemperatureUnknowns) -> RigCovariance:
    """Return a covariance plus that of the sensor's temperature, which changes the eyes with errors as trials draw."""
    errors_of = {name.partition(".")[0] for name in covariance.names}
    changes = zip(*warmed(rig, table, table.sensor_kelvin), strict=True)
    step = {name: float(value) for name, value in changes if name.partition(".")[0] in errors_of}
    return covariance.plus([(1.0, step)], f"temperature of the sensor {table.sensor_kelvin:g} K")


def _unscaled_covariance(sensor: Sensor, table: CalibrationUnknowns, folder: Path) -> RigCovariance:
    if table.covariance is not None:
        return with_drift(read_rig_covariance(folder / table.covariance, sensor.rig), sensor, table.drift())
    if sensor.name in presets():
        try:
            return preset_covariance(sensor, table.drift())
        except InputError:
            pass  # a user's sensor with the name of a preset, but another rig
    say(f"{sensor.name}: no covariance of its calibration is given; it is simulated (see mitsim calibrate)")
    simulated = replace(calibrate(sensor, drift=Drift.none()).covariance, simulated=True)
    return with_drift(simulated, sensor, table.drift())


def _expansion(study: Study) -> float:
    """Return the linear expansion of the part [1/K], the median over the finishes of its features, under any spray."""
    expansion = study.unknowns.temperature.expansion_per_kelvin
    if expansion is not None:
        return expansion
    finishes = [study.scene.finishes[study.scene.names.index(name)] for name in study.task.shapes]
    metals = [(finish.under or finish.name).partition("/")[0] for finish in finishes if finish is not None]
    expansions = [EXPANSION_PER_KELVIN.get(metal, _USUAL_EXPANSION) for metal in metals] or [_USUAL_EXPANSION]
    return float(np.median(expansions))
