"""What virtual measurements of a study need: its unknowns, what makes the measurements, and the digest of both.

Signal chain: study -> covariance of the calibration, expansion of the part -> :class:`~mitsim.virtual.world.Unknowns`
-> maker -> digest of all that decides a trial.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

import mitsim
from mitsim.calibration.virtual_calibration import calibrate
from mitsim.campaign.plan import sensor_checksum
from mitsim.capture.indirect_light import IndirectLight
from mitsim.errors import InputError
from mitsim.progress import say
from mitsim.sensor.drift import Drift, with_drift
from mitsim.sensor.matcher import MatcherSettings
from mitsim.sensor.preset import Sensor, presets
from mitsim.sensor.preset_covariance import preset_covariance
from mitsim.sensor.rig_covariance import RigCovariance, read_rig_covariance
from mitsim.sensor.unknowns import CalibrationUnknowns
from mitsim.study import RaceTable, Study
from mitsim.virtual.mapped import MappedMeasurements
from mitsim.virtual.race import RaceRules
from mitsim.virtual.rendered import RenderedMeasurements, Rendering
from mitsim.virtual.world import GROUPS, Unknowns

#: part of the digest of a trial: raised when the same world would give another measurement
TRIAL_VERSION = 2

#: keys of a task that say how results are judged, not what is measured
_NO_PART_OF_A_TRIAL: Any = {"decision": True, "measurements": {"__all__": {"decision"}}}

#: linear expansion near 20 C [1/K], by the metal of a finish (CRC Handbook of Chemistry and Physics; steel: unalloyed)
EXPANSION_PER_KELVIN = {
    "aluminium": 23.1e-6, "steel": 11.8e-6, "iron": 11.8e-6, "copper": 16.5e-6, "brass": 19e-6, "chromium": 4.9e-6,
    "nickel": 13.4e-6, "titanium": 8.6e-6, "gold": 14.2e-6, "silver": 18.9e-6, "tungsten": 4.5e-6,
}  # fmt: skip

#: expansion of a part whose finish names no metal [1/K]: between steel and aluminium
_USUAL_EXPANSION = 17e-6

#: standard deviation of the smoothing of light by way of other surfaces [px], see capture/indirect_light.py
_SMOOTHING_PX = 1.5


def study_unknowns(study: Study, varied: tuple[str, ...] = GROUPS) -> Unknowns:
    """Prepare the unknowns of a study for drawing.

    Raises
    ------
    InputError
        If a file that it names is not there or does not belong, or a feature has a form but is none of the task's.
    """
    table, sensor = study.unknowns, study.sensor
    for name in table.form.features:
        if name not in study.task.shapes:
            allowed = ", ".join(study.task.shapes)
            raise InputError(study.path, f"unknowns.form.features.{name}", "no shape of the task", allowed)
    here = study.path.parent
    return Unknowns(
        table, sensor.rig, calibration_covariance(sensor, table.calibration, here), sensor.wavelength_nm,
        _expansion(study), np.asarray(study.scene.centre, float), study.file.seed, varied,
    )  # fmt: skip


def calibration_covariance(sensor: Sensor, table: CalibrationUnknowns, here: Path) -> RigCovariance:
    """Covariance of a sensor's calibration, with the drift since."""
    if table.covariance is not None:
        return with_drift(read_rig_covariance(here / table.covariance, sensor.rig), sensor.rig, table.drift())
    if sensor.name in presets():
        try:
            return preset_covariance(sensor, table.drift())
        except InputError:
            pass  # a sensor of a preset's name with a rig of its own
    say(f"{sensor.name}: no covariance of its calibration is given; it is calibrated virtually (mitsim calibrate)")
    return with_drift(calibrate(sensor, drift=Drift.none()).covariance, sensor.rig, table.drift())


def _expansion(study: Study) -> float:
    """Linear expansion of the part [1/K], that of the finish that most of its features have."""
    given = study.unknowns.temperature.expansion_per_kelvin
    if given is not None:
        return given
    finishes = [study.scene.finishes[study.scene.names.index(name)] for name in study.task.shapes]
    metals = [finish.name.partition("/")[0] for finish in finishes if finish is not None]
    known = [EXPANSION_PER_KELVIN.get(metal, _USUAL_EXPANSION) for metal in metals] or [_USUAL_EXPANSION]
    return float(np.median(known))


def rendering_of(study: Study) -> Rendering:
    """How captures of a study's virtual measurements are rendered."""
    table = study.file.measure
    samples = 4 if isinstance(study.sensor.settings, MatcherSettings) else 16
    return Rendering(table.samples_per_pixel, table.light_path_depth, IndirectLight(samples, _SMOOTHING_PX))


def measured_by(study: Study) -> str:
    """``render`` or ``map``: as the study says, else what the map's own source calls for.

    Raises
    ------
    InputError
        If clouds are to be drawn from a map, and the study has none yet.
    """
    given, known = study.file.measure.by, study.performance_map
    if given == "map" and known is None:
        raise InputError(study.path, "measure.by", "'map' with a campaign", "a map that was made before",
                         "set characterisation.map")  # fmt: skip
    if given is not None:
        return given
    return "map" if known is not None and known.data.attrs.get("source") not in (None, "", "simulated") else "render"


def measurements_of(
    study: Study, unknowns: Unknowns, apart: bool = False
) -> RenderedMeasurements | MappedMeasurements:  # fmt: skip
    """Lay out a study's sensor, or its map, for virtual measurements; ``apart`` if renderings share no light."""
    if measured_by(study) == "map":
        return MappedMeasurements(study, unknowns)
    return RenderedMeasurements(study, unknowns, rendering_of(study), apart)


def race_rules(table: RaceTable, minutes: float | None = None) -> RaceRules:
    """Rules of a race; ``minutes`` in place of the table's own."""
    most = table.minutes if minutes is None else minutes
    seconds = None if most is None else 60 * most
    return RaceRules(table.shortlist, table.trials, table.margin, table.confidence, seconds)


def map_digest(study: Study) -> str:
    """Sixteen hexadecimal digits of the performance map's values; of none an empty string."""
    if study.performance_map is None:
        return ""
    digest = hashlib.sha256(repr(study.performance_map.data.attrs).encode())
    for name in sorted(map(str, study.performance_map.data.variables)):
        values = study.performance_map.data[name].values
        text = values.dtype.kind in "OU"
        digest.update(name.encode() + (repr(values.tolist()).encode() if text else values.tobytes()))
    return digest.hexdigest()[:16]


def trial_digest(study: Study, unknowns: Unknowns, source: str, apart: bool = False) -> str:
    """Sixteen hexadecimal digits of all that decides a trial."""
    file = study.file
    told = {
        "version": TRIAL_VERSION, "mitsim": mitsim.__version__, "source": source,
        "sensor": sensor_checksum(study.sensor),
        "unknowns": unknowns.table.model_dump(mode="json"), "varied": unknowns.varied, "seed": unknowns.seed,
        "covariance": hashlib.sha256(unknowns.calibration.covariance.tobytes()).hexdigest(),
        "expansion": unknowns.expansion, "scene": Path(study.scene.where).read_text(encoding="utf-8"),
        "parameters": file.parameters, "task": study.task.model_dump(mode="json", exclude=_NO_PART_OF_A_TRIAL),
        "rendering": asdict(rendering_of(study)),
        "views": hashlib.sha256(np.array([v.world_from_sensor.matrix().round(9) for v in study.views]).tobytes())
        .hexdigest(),
    }  # fmt: skip
    if apart or not unknowns.pooled:
        told["apart"] = [apart, unknowns.pooled]
    if source == "map":
        assert study.performance_map is not None
        told["map"] = hashlib.sha256(repr(study.performance_map.data.attrs).encode()).hexdigest()
    return hashlib.sha256(json.dumps(told, sort_keys=True, default=str).encode()).hexdigest()[:16]
