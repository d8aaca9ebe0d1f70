"""What makes the virtual measurements of a study, and the digest of all that decides one.

Signal chain: study and its unknowns (:mod:`mitsim.virtual.study_unknowns`) -> maker -> digest of all that decides a
trial.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from mitsim.campaign.plan import sensor_checksum
from mitsim.errors import InputError
from mitsim.sensor.matcher import MatcherSettings
from mitsim.simulation.indirect_light import IndirectLight
from mitsim.simulation.rendering import Rendering
from mitsim.study import RaceTable, Study
from mitsim.version import __version__
from mitsim.virtual.mapped import MappedMeasurements
from mitsim.virtual.race import RaceRules
from mitsim.virtual.rendered import RenderedMeasurements
from mitsim.virtual.world import BEYOND, Unknowns

#: part of the digest of a trial: raised when the same world would give another measurement
TRIAL_VERSION = 2

#: keys of a task that say how results are judged, not what is measured
_NO_PART_OF_A_TRIAL: Any = {"decision": True, "measurements": {"__all__": {"decision"}}}

#: standard deviation of the smoothing of light by way of other surfaces [px], see simulation/indirect_light.py
_SMOOTHING_PX = 1.5


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
        raise InputError(
            study.path, "measure.by", "'map' with a campaign", "a map that was made before", "set characterisation.map"
        )
    if given is not None:
        return given
    return "map" if known is not None and known.data.attrs.get("source") not in (None, "", "simulated") else "render"


def measurements_of(study: Study, unknowns: Unknowns, apart: bool = False) -> RenderedMeasurements | MappedMeasurements:
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
        "version": TRIAL_VERSION,
        "mitsim": __version__,
        "source": source,
        "sensor": sensor_checksum(study.sensor),
        "unknowns": unknowns.table.model_dump(mode="json"),
        "varied": _varied(unknowns, source),
        "seed": unknowns.seed,
        "covariance": hashlib.sha256(unknowns.calibration.covariance.tobytes()).hexdigest(),
        "expansion": unknowns.expansion,
        "scene": Path(study.scene.where).read_text(encoding="utf-8"),
        "parameters": file.parameters,
        "task": study.task.model_dump(mode="json", exclude=_NO_PART_OF_A_TRIAL),
        "rendering": asdict(rendering_of(study)),
        "views": hashlib.sha256(
            np.array([v.world_from_sensor.matrix().round(9) for v in study.views]).tobytes()
        ).hexdigest(),
    }
    if apart or not unknowns.pooled:
        told["apart"] = [apart, unknowns.pooled]
    if source == "map":
        assert study.performance_map is not None
        told["map"] = hashlib.sha256(repr(study.performance_map.data.attrs).encode()).hexdigest()
    return hashlib.sha256(json.dumps(told, sort_keys=True, default=str).encode()).hexdigest()[:16]


def _varied(unknowns: Unknowns, source: str) -> list[str]:
    """Groups that a trial depends on: what is beyond the map is none of a rendered one."""
    return [group for group in unknowns.varied if group != BEYOND or source == "map"]
