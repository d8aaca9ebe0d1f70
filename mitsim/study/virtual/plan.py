"""Set up the virtual measurements of a study, and compute the digest of everything that determines a trial.

Signal chain: study and its unknowns (:mod:`mitsim.study.virtual.study_unknowns`) -> object that makes measurements ->
digest.
"""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import canonicalize

import numpy as np

from characterisation.files.errors import InputError
from characterisation.tasks.folded import folded_values
from characterisation.words.version import __version__
from mitsim.capture.simulated.indirect_light import IndirectLight, KeptSettings
from mitsim.capture.simulated.rendering import Rendering
from mitsim.scene.xml_check import named_digests
from mitsim.sensor.decoder_settings import DecoderSettings
from mitsim.sensor.matcher import MatcherSettings
from mitsim.sensor.modulation import TimeOfFlightSettings
from mitsim.sensor.sensor import Sensor
from mitsim.sensor.sensor_text import sensor_checksum
from mitsim.study import Study
from mitsim.study.virtual.drawn_decoder import decoder_is_drawn
from mitsim.study.virtual.mapped import MappedMeasurements
from mitsim.study.virtual.rendered import RenderedMeasurements
from mitsim.study.virtual.world import BEYOND, Unknowns

#: part of the digest of a trial; increased if the same draw gives a different measurement
TRIAL_VERSION = 13

#: the same of a study whose faces have a form
FORM_VERSION = 2

#: keys of a task that concern the verdict, not the measurement; the form that a tolerance gives is among the unknowns
_NO_PART_OF_A_TRIAL: Any = {"decision": True, "measurements": {"__all__": {"decision", "tolerance"}}}

#: standard deviation of the smoothing of interreflections [px], see mitsim/capture/simulated/indirect_light.py
_SMOOTHING_PX = 1.5

#: pixels that see the part, of which more have fewer paths each and a wider filter: a part that fills an image of two
#: million took 22 s to trace with all paths. The two pillars in a Zivid's image are 0.2 million
_MOST_PIXELS = 400_000

#: paths of interreflections that all trials of a view share, for matchers, whose images are few and coarse. Render
#: noise 0.26 to 0.86 of the sensor's (N10) on the two pillars of bare metal: tests/benchmarks/kept_paths.py. Trials
#: with 16 times as many paths differ from one another as much as from these
_KEPT_MATCHER = KeptSettings(49, 4.0, 40, _SMOOTHING_PX, _MOST_PIXELS)

#: the same for fringes, with more of them: their noise is common to all trials of a view. A filter of 2.5 px, as once,
#: blurs the fringes that metal mirrors: the axis of a bare cone (Zivid) was 0.59 deg off in the median of seven worlds,
#: with 1.5 px 0.41, and 0.33 with light rendered anew: tests/benchmarks/drawn_noise.py
_KEPT = KeptSettings(64, 4.0, 32, _SMOOTHING_PX, _MOST_PIXELS)

#: the same for time of flight, whose pixels are few and wide: as many paths over all pixels, and the same noise, with a
#: narrower filter. One of 2.5 px moved the radius of a white step of the spindle by 0.5 mm, beside a u of 0.3 mm:
#: tests/study/virtual/test_smoothed_time_of_flight.py
_KEPT_TIME_OF_FLIGHT = KeptSettings(529, 4.0, 264, 0.85, 25_000)

#: light of time of flight that is rendered separately, likewise
_TIME_OF_FLIGHT = IndirectLight(49, 0.85)

#: rays per pixel of direct light for fringes. Root mean square error 0.03 (PhoXi), 0.09 (David) and 0.08 (Zivid) of the
#: sensor's noise, but for the hundredth of the pixels at edges: tests/benchmarks/direct_samples.py
_FRINGE_SAMPLES = 4

#: rays per pixel for others, whose patterns and pixels are coarse. Error 0.04 (N10), and 0.15 with 4, by the same
#: benchmark
_SAMPLES = 16


#: factor by which the race of a matcher has fewer paths of interreflections: most of its views get one or two trials,
#: and tracing all paths of a view takes as long as six to ten trials. With this factor, errors of trials change by 0.02
#: to 0.41 of their root mean square; the root mean square of 12 trials is 0.7 to 1.46 of that with all paths, median
#: 1.0: tests/benchmarks/race_paths.py
_FEWER_OF_MATCHER_IN_RACE = 4

#: the same for fringes and time of flight, which have more. Against a quarter of the paths of statements, the smallest
#: errors, of the angle between pillars, change by 0.3 to 0.8 of their root mean square: by the same benchmark
_FEWER_IN_RACE = 16

#: the same for the change of a study that a remedy tries, which ten trials can exclude: tracing all paths of a view
#: takes as long as fifty (Zivid, PhoXi). Chosen: the number of paths that statements had before
_FEWER_IN_CHANGES = 4


def rendering_of(study: Study) -> Rendering:
    """Return the settings for rendering the virtual measurements of a study.

    See Also
    --------
    race_rendering : those of its race
    """
    table = study.file.measure
    samples = _FRINGE_SAMPLES if isinstance(study.sensor.settings, DecoderSettings) else _SAMPLES
    indirect, kept = IndirectLight(16, _SMOOTHING_PX), _KEPT
    if isinstance(study.sensor.settings, MatcherSettings):
        indirect, kept = IndirectLight(4, _SMOOTHING_PX), _KEPT_MATCHER
    elif isinstance(study.sensor.settings, TimeOfFlightSettings):
        indirect, kept = _TIME_OF_FLIGHT, _KEPT_TIME_OF_FLIGHT
    return Rendering(table.samples_per_pixel or samples, table.light_path_depth, indirect, kept)


def race_rendering(study: Study) -> Rendering:
    """Return the settings for rendering the race of a study, with fewer paths of interreflections."""
    is_matcher = isinstance(study.sensor.settings, MatcherSettings)
    return _with_fewer(rendering_of(study), _FEWER_OF_MATCHER_IN_RACE if is_matcher else _FEWER_IN_RACE)


def change_rendering(study: Study) -> Rendering:
    """Return the settings for rendering a change; matchers have the few paths of their statements."""
    is_matcher = isinstance(study.sensor.settings, MatcherSettings)
    return _with_fewer(rendering_of(study), 1 if is_matcher else _FEWER_IN_CHANGES)


def _with_fewer(rendering: Rendering, factor: int) -> Rendering:
    """Return a rendering with fewer kept paths."""
    kept = rendering.kept
    assert kept is not None  # of every study
    side = math.isqrt(kept.samples // factor)  # of the square of samples in a pixel
    return replace(rendering, kept=replace(kept, samples=side**2, kept=kept.kept // factor))


def measured_by(study: Study) -> str:
    """Return ``render`` or ``map``: the choice of the study, else the one that fits the source of the map.

    Raises InputError if clouds shall be drawn from a map, and the study has no map yet.
    """
    choice, performance_map = study.file.measure.by, study.performance_map
    if choice == "map" and performance_map is None:
        raise InputError(
            study.path, "measure.by", "'map' with a campaign", "a map that was made before", "set characterisation.map"
        )
    if choice is not None:
        return choice
    return (
        "map"
        if performance_map is not None and performance_map.data.attrs.get("source") not in (None, "", "simulated")
        else "render"
    )


def measurements_of(
    study: Study, unknowns: Unknowns, separate_light: bool = False, rendering: Rendering | None = None
) -> RenderedMeasurements | MappedMeasurements:
    """Prepare a study's sensor, or its map, for virtual measurements, by default rendered as for statements."""
    if measured_by(study) == "map":
        return MappedMeasurements(study, unknowns)
    return RenderedMeasurements(study, unknowns, rendering or rendering_of(study), separate_light)


def map_digest(study: Study) -> str:
    """Return sixteen hexadecimal digits of the content of the performance map, or an empty string without a map."""
    return "" if study.performance_map is None else study.performance_map.digest[:16]


def _effective(sensor: Sensor, unknowns: Unknowns) -> dict[str, Any]:
    """Return the table of unknowns without what has no effect: the path of a file, tables of which nothing is drawn."""
    table = unknowns.table.model_dump(mode="json")
    if table["calibration"]["covariance"] is not None:
        table["calibration"]["covariance"] = list(unknowns.calibration.names)
    if "coat" not in unknowns.varied:
        del table["coat"]
    if "decoder" not in unknowns.varied or not decoder_is_drawn(sensor, unknowns.table.decoder):
        del table["decoder"]
    return table


def trial_digest(
    study: Study, unknowns: Unknowns, source: str, separate_light: bool = False, rendering: Rendering | None = None
) -> str:
    """Return sixteen hexadecimal digits of everything that determines a trial.

    These are sensor, calibration, unknowns, task, views, the scene with its meshes and textures, and, for clouds drawn
    from the map, the map.

    ``study``, ``unknowns``: the study, and its unknowns prepared for drawing. ``source``: how trials are made:
    ``render`` or ``map``. ``separate_light``: whether every trial renders all of its light. ``rendering``: by default
    that of statements.
    """
    file = study.file
    content = {
        "version": TRIAL_VERSION,
        "mitsim": __version__,
        "source": source,
        "sensor": sensor_checksum(study.sensor),
        "unknowns": _effective(study.sensor, unknowns),
        # a rendered trial does not depend on effects outside the map
        "varied": [group for group in unknowns.varied if group != BEYOND or source == "map"],
        "seed": unknowns.seed,
        "covariance": unknowns.calibration.digest,
        "expansion": unknowns.expansion,
        "scene": canonicalize(Path(study.scene.where).read_text(encoding="utf-8"), strip_text=True),  # no comments
        "parameters": file.parameters,
        "task": study.task.model_dump(mode="json", exclude=_NO_PART_OF_A_TRIAL),
        "rendering": asdict(rendering or rendering_of(study)),
        "views": hashlib.sha256(
            np.array([v.world_from_sensor.matrix().round(9) for v in study.views]).tobytes()
        ).hexdigest(),
    }
    folded = folded_values(study.task)
    if folded:
        content["deviations"] = {name: folded_value.shape for name, folded_value in folded.items()}
    if named := named_digests(Path(study.scene.where), {name: str(value) for name, value in file.parameters.items()}):
        content["files"] = named
    if file.sprayed:
        content["sprayed"] = True
    if any(unknowns.table.form.features.values()):
        content["form"] = FORM_VERSION
    if source == "render" and study.sensor.technology == "time_of_flight":
        content["taps"] = 2  # of a pixel, by which exposures in a room are set
    if separate_light:
        content["apart"] = True
    if source == "map":
        content["map"] = map_digest(study)
        content["score"] = file.score.model_dump(mode="json")  # effects outside the map are multiples of a screened u
    return hashlib.sha256(json.dumps(content, sort_keys=True, default=str).encode()).hexdigest()[:16]


def study_digest(study: Study, trials: str) -> str:
    """Return thirty-two hexadecimal digits of everything that determines the results of a study.

    Studies with the same digest have the same results. No other study may use the results in a folder.
    ``trials`` is the digest of its trials (:func:`trial_digest`), which covers sensor, scene
    with its files, task, views and unknowns.
    """
    content = {
        "trials": trials,
        "file": study.file.model_dump(mode="json"),
        "task": study.task.model_dump(mode="json"),
        "series": [] if study.campaign is None else [series.name for series in study.campaign.series],
        "campaign": None if study.campaign is None else study.campaign.file.model_dump(mode="json"),
        "map": map_digest(study),
    }
    return hashlib.sha256(json.dumps(content, sort_keys=True, default=str).encode()).hexdigest()[:32]
