"""Complete a map for the finishes of a scene: characterise missing finishes now, or let the nearest sample stand in.

Signal chain: map of a sensor, scene -> finishes missing in the map -> those in the cache are read -> the user is asked
about the others, with the expected time -> a quick campaign for each (:mod:`mitsim.maps.campaign.one_finish`) at the
map's distances around the views -> one map.

A study whose virtual measurements are rendered needs the map for screening alone. Then, without an answer, the
optically nearest sample of the map stands in for a missing finish (:mod:`characterisation.maps.nearest`). It always
does for faces that are not measured.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from characterisation.files.errors import InputError
from characterisation.maps.joined import with_samples
from characterisation.maps.nearest import Nearest, nearest_sample, standing_for
from characterisation.maps.performance_map import PerformanceMap
from characterisation.maps.samples import Samples
from characterisation.words.numbers import time_in_words
from characterisation.words.progress import say
from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.maps.campaign.finish_cache import cache_folder, expected_seconds, keep_rate, kept_finish, made_finish
from mitsim.maps.campaign.one_finish import OneFinish, largest_incidence_deg
from mitsim.scene.coupons import Sample
from mitsim.scene.load import Scene
from mitsim.scene.materials import Finish
from mitsim.sensor.sensor import Sensor

#: answers a question with yes or no
Ask = Callable[[str], bool]


@dataclass(frozen=True)
class NeededFinishes:
    """Finishes needed from a map, by shape name, for a ``sensor``, an interval of |V| [mm] and a scene.

    ``measured`` are the shapes whose finish matters; None for all. ``screening``: whether the map serves for screening
    alone, so that the nearest sample may stand in.
    """

    sensor: Sensor
    scene: str
    finishes: dict[str, Finish]
    between: tuple[float, float]
    measured: frozenset[str] | None = None
    screening: bool = False


def unknown_finishes(samples: Samples, finishes: dict[str, Finish]) -> dict[str, Finish]:
    """Return the finishes that no sample matches, by shape name; each finish once."""
    out: dict[str, Finish] = {}
    seen = set[str]()
    for name, finish in finishes.items():
        key = f"{finish} {finish.light}"
        if key in seen:
            continue
        seen.add(key)
        try:
            samples.representing(finish.name, finish.roughness, finish.light)
        except InputError:
            out[name] = finish
    return out


def seen_finishes(scene: Scene) -> dict[str, Finish]:
    """Return the finishes of a scene's shapes, by shape name, where there is one."""
    return {name: finish for name, finish in zip(scene.names, scene.finishes, strict=True) if finish is not None}


def map_with_finishes(
    performance_map: PerformanceMap, needed: NeededFinishes, ask: Ask | None = None
) -> PerformanceMap:
    """Return the map of the sensor with samples for all finishes of the scene that are ``needed``.

    ``ask`` answers whether finishes may be characterised now; None if nobody can answer. Raises InputError if a finish
    is missing and may not be characterised, or the map was not simulated; not if the map serves for screening alone.
    """
    unmeasured = {name for name in needed.finishes if needed.measured is not None and name not in needed.measured}
    measured = {name: finish for name, finish in needed.finishes.items() if name not in unmeasured}
    missing = unknown_finishes(performance_map.known, measured)
    completed = _characterised(performance_map, needed, missing, ask) if missing else performance_map
    unseen = unknown_finishes(completed.known, {name: needed.finishes[name] for name in unmeasured})
    return with_nearest(completed, unseen)[0] if unseen else completed


def with_nearest(
    performance_map: PerformanceMap, missing: dict[str, Finish]
) -> tuple[PerformanceMap, dict[str, Nearest]]:
    """Return a map in which the optically nearest sample stands in for each missing finish, and these samples by name.

    A finish of unknown optical properties, or a map without them, has none: it stays missing.
    """
    nearest_by_name, maps = dict[str, Nearest](), list[PerformanceMap]()
    for name, finish in missing.items():
        nearest = None if finish.light is None else nearest_sample(performance_map, finish.light)
        if nearest is not None and finish.light is not None:
            nearest_by_name[name] = nearest
            maps.append(standing_for(performance_map, nearest, finish.name, finish.roughness, finish.light))
    if not maps:
        return performance_map, {}
    return with_samples(performance_map, maps), nearest_by_name


def _characterised(
    performance_map: PerformanceMap, needed: NeededFinishes, missing: dict[str, Finish], ask: Ask | None
) -> PerformanceMap:
    """Return the map with samples of missing finishes, characterised or of the cache; or with their nearest samples."""
    source = str(performance_map.data.attrs.get("source", ""))
    if source not in ("", "simulated"):
        name, finish = next(iter(missing.items()))
        hint = "the map comes from a device: characterise a coupon of this finish with that device"
        raise _unknown_finish_error(performance_map, needed, name, finish, hint)
    distances = distances_about(performance_map, needed.between)
    largest = largest_incidence_deg(performance_map)
    ones = {name: OneFinish(finish, needed.sensor, largest) for name, finish in missing.items()}
    kept = {(name, at): kept_finish(one_finish, at) for name, one_finish in ones.items() for at in distances}
    to_make = [key for key, kept_map in kept.items() if kept_map is None]
    if to_make:
        seconds = sum(expected_seconds(ones[name]) for name, _ in to_make)
        names = list(dict.fromkeys(name for name, _ in to_make))
        lacking = ", ".join(_in_words(ones[name].finish) for name in names)
        about = f"about {time_in_words(seconds)}"
        otherwise = " Without it, the nearest sample serves the screening." if needed.screening else ""
        question = f"{needed.sensor.name}: its map lacks {lacking}; characterise now ({about})?{otherwise}"
        if ask is None or not ask(question):
            standing, nearest = with_nearest(performance_map, missing) if needed.screening else (performance_map, {})
            if len(nearest) == len(missing):
                for name, standing_in in nearest.items():
                    say(_standing_in_words(performance_map, needed, missing[name], standing_in, about))
                return standing
            hint = f"add --yes to characterise it now, in {about}; the result is kept"
            raise _unknown_finish_error(performance_map, needed, names[0], missing[names[0]], hint)
        say(f"{needed.sensor.name}: characterising {lacking} in {about}; kept in {cache_folder()}")
        kept |= _characterise(ones, to_make, needed.sensor)
    kept_maps = [kept_map for kept_map in kept.values() if kept_map is not None]
    joined = with_samples(performance_map, kept_maps)
    digests = sorted(str(kept_map.data.attrs["finish_digest"]) for kept_map in kept_maps)
    joined.data.attrs["characterised_when_asked"] = ", ".join(digests)
    return joined


def _standing_in_words(
    performance_map: PerformanceMap, needed: NeededFinishes, finish: Finish, nearest: Nearest, about: str
) -> str:
    name, roughness = performance_map.samples[nearest.sample]
    sample = name if math.isnan(roughness) else f"{name} Ra {roughness:g} um"
    return (
        f"{needed.sensor.name}: its map lacks {_in_words(finish)}. Views are screened with the optically nearest "
        f"sample, {sample}: F may be off by {nearest.fraction_error:.2f}, sigma by {100 * nearest.sigma_error:.0f} %. "
        f"Virtual measurements render the finish itself; --yes characterises it, in {about}"
    )


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
    """Return the map's distances [mm] in an interval of |V|, and the next one beyond each end: they determine it."""
    distances = performance_map.data["distance"].values.astype(float)
    low = max(int(np.searchsorted(distances, between[0], "right")) - 1, 0)
    high = min(int(np.searchsorted(distances, between[1], "left")), len(distances) - 1)
    return [float(distance) for distance in distances[low : max(high, low) + 1]]


def _unknown_finish_error(
    performance_map: PerformanceMap, needed: NeededFinishes, name: str, finish: Finish, hint: str
) -> InputError:
    allowed = f"a finish in the map of {needed.sensor.name}: {performance_map.known.in_words()}"
    return InputError(needed.scene, f"shape {name!r}", f"the finish {_in_words(finish)}", allowed, hint)


def _in_words(finish: Finish) -> str:
    light = finish.light
    return str(finish) if light is None or light.as_made else f"{finish} ({light.in_words()})"


def samples_of(coupons: Sequence[Sample]) -> Samples:
    """Return the samples of the map that a campaign will make of its coupons."""
    names, roughness = [coupon.finish for coupon in coupons], np.array([coupon.roughness for coupon in coupons], float)
    return Samples(names, roughness, [coupon.light for coupon in coupons], "the campaign")
