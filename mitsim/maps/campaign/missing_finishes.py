"""Complete a map for the finishes of a scene: characterise missing finishes now, if that is allowed.

Signal chain: map of a sensor, scene -> finishes missing in the map -> those in the cache are read -> the user is asked
about the others, with the expected time -> a quick campaign for each (:mod:`mitsim.maps.campaign.one_finish`) at the
map's distances around the views -> one map.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from characterisation.files.errors import InputError
from characterisation.maps.joined import with_samples
from characterisation.maps.light import Light
from characterisation.maps.performance_map import PerformanceMap
from characterisation.maps.samples import Samples
from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.maps.campaign.finish_cache import cache_folder, expected_seconds, keep_rate, kept_finish, made_finish
from mitsim.maps.campaign.one_finish import OneFinish, largest_incidence_deg
from mitsim.running.numbers import time_in_words
from mitsim.running.progress import say
from mitsim.scene.load import Scene
from mitsim.scene.materials import Finish
from mitsim.sensor.preset import Sensor

#: answers a question with yes or no
Ask = Callable[[str], bool]


@dataclass(frozen=True)
class NeededFinishes:
    """Finishes needed from a map, by shape name, for a ``sensor``, an interval of |V| [mm] and a scene."""

    sensor: Sensor
    scene: str
    finishes: dict[str, Finish]
    between: tuple[float, float]


def unknown_finishes(known: Samples, finishes: dict[str, Finish]) -> dict[str, Finish]:
    """Return the finishes that no sample matches, by shape name; each finish once."""
    out: dict[str, Finish] = {}
    seen = set[str]()
    for name, finish in finishes.items():
        key = f"{finish} {finish.light}"
        if key in seen:
            continue
        seen.add(key)
        try:
            known.representing(finish.name, finish.roughness, finish.light)
        except InputError:
            out[name] = finish
    return out


def seen_finishes(scene: Scene) -> dict[str, Finish]:
    """Return the finishes of a scene's shapes, by shape name, where there is one."""
    return {name: one for name, one in zip(scene.names, scene.finishes, strict=True) if one is not None}


def map_with_finishes(
    performance_map: PerformanceMap, needed: NeededFinishes, ask: Ask | None = None
) -> PerformanceMap:
    """Return the map with samples for all needed finishes.

    Parameters
    ----------
    performance_map
        Map of the sensor.
    needed
        Finishes of the scene, and how to characterise them.
    ask
        Answers whether finishes may be characterised now; None if nobody can answer.

    Raises
    ------
    InputError
        If a finish is missing and may not be characterised, or the map was not simulated.
    """
    missing = unknown_finishes(performance_map.known, needed.finishes)
    if not missing:
        return performance_map
    source = str(performance_map.data.attrs.get("source", ""))
    if source not in ("", "simulated"):
        name, finish = next(iter(missing.items()))
        hint = "the map comes from a device: characterise a coupon of this finish with that device"
        raise _unknown_finish_error(performance_map, needed, name, finish, hint)
    distances = distances_about(performance_map, needed.between)
    largest = largest_incidence_deg(performance_map)
    ones = {name: OneFinish(finish, needed.sensor, largest) for name, finish in missing.items()}
    kept = {(name, at): kept_finish(one, at) for name, one in ones.items() for at in distances}
    to_make = [key for key, found in kept.items() if found is None]
    if to_make:
        seconds = sum(expected_seconds(ones[name]) for name, _ in to_make)
        names = list(dict.fromkeys(name for name, _ in to_make))
        lacking = ", ".join(_in_words(ones[name].finish) for name in names)
        about = f"about {time_in_words(seconds)}"
        question = f"{needed.sensor.name}: its map lacks {lacking}; characterise now ({about})?"
        if ask is None or not ask(question):
            hint = f"add --yes to characterise it now, in {about}; the result is kept"
            raise _unknown_finish_error(performance_map, needed, names[0], missing[names[0]], hint)
        say(f"{needed.sensor.name}: characterising {lacking} in {about}; kept in {cache_folder()}")
        kept |= _characterise(ones, to_make, needed.sensor)
    found = [one for one in kept.values() if one is not None]
    joined = with_samples(performance_map, found)
    digests = sorted(str(one.data.attrs["finish_digest"]) for one in found)
    joined.data.attrs["characterised_when_asked"] = ", ".join(digests)
    return joined


def _characterise(
    ones: dict[str, OneFinish], to_make: Iterable[tuple[str, float]], sensor: Sensor
) -> dict[tuple[str, float], PerformanceMap | None]:
    simulated = SimulatedSensor(sensor)
    out: dict[tuple[str, float], PerformanceMap | None] = {}
    for name, distance in to_make:
        began = time.monotonic()
        out[name, distance] = made_finish(ones[name], simulated, distance)
        keep_rate(sensor.name, (time.monotonic() - began) / len(ones[name].turns))
    return out


def distances_about(performance_map: PerformanceMap, between: tuple[float, float]) -> list[float]:
    """Return the distances of a map [mm] that determine its values in an interval of |V|.

    These are the distances in the interval and the next one beyond each end.
    """
    known = performance_map.data["distance"].values.astype(float)
    low = max(int(np.searchsorted(known, between[0], "right")) - 1, 0)
    high = min(int(np.searchsorted(known, between[1], "left")), len(known) - 1)
    return [float(one) for one in known[low : max(high, low) + 1]]


def _unknown_finish_error(
    performance_map: PerformanceMap, needed: NeededFinishes, name: str, finish: Finish, hint: str
) -> InputError:
    allowed = f"a finish in the map of {needed.sensor.name}: {performance_map.known.in_words()}"
    return InputError(needed.scene, f"shape {name!r}", f"the finish {_in_words(finish)}", allowed, hint)


def _in_words(finish: Finish) -> str:
    light = finish.light
    return str(finish) if light is None or light.as_made else f"{finish} ({light.in_words()})"


def samples_of(labelled: Iterable[tuple[str, float, Light | None]], where: str) -> Samples:
    """Return the samples that a campaign will make: finish, Ra [um] and optical numbers of each."""
    rows = list(labelled)
    return Samples([row[0] for row in rows], np.array([row[1] for row in rows], float), [row[2] for row in rows], where)
