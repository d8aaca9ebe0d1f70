"""A map that answers for every finish of a scene: what it does not know is characterised now, if that is allowed.

Signal chain: map of a sensor, scene -> finishes that the map does not know -> those that were characterised before are
taken from the cache -> for the others the user is asked, with the time that it takes -> a quick campaign of each
(:mod:`mitsim.campaign.one_finish`) at the map's distances about the views -> one map.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from characterisation.maps.joined import with_samples
from characterisation.maps.light import Light, light_variables
from characterisation.maps.performance_map import PerformanceMap
from characterisation.maps.samples import Samples
from mitsim.campaign.finish_cache import cache_folder, expected_seconds, keep_rate, kept_finish, made_finish
from mitsim.campaign.one_finish import OneFinish, largest_incidence_deg
from mitsim.errors import InputError
from mitsim.progress import say
from mitsim.scene.load import Scene
from mitsim.scene.materials import Finish
from mitsim.sensor.preset import Sensor
from mitsim.simulation.simulate import SimulatedSensor
from mitsim.surface.seen import as_made

#: answers a question with yes or no
Ask = Callable[[str], bool]

#: parameters of a coupon's scene that leave its finish as made
_PLAIN = {"metal", "process", "Ra", "half_size"}


@dataclass(frozen=True)
class Wanted:
    """Finishes wanted of a map: of which ``sensor``, by the name of a shape, between which |V| [mm]; in which scene."""

    sensor: Sensor
    scene: str
    finishes: dict[str, Finish]
    between: tuple[float, float]


def with_lights(performance_map: PerformanceMap) -> PerformanceMap:
    """A map that says what light sees of its samples; for one that does not, by what it was made of.

    Its samples are then as made, unless its campaign gave a coupon more than metal, process and Ra: of that one it is
    not known.
    """
    data = performance_map.data
    if any(performance_map.lights):
        return performance_map
    wavelength = data.attrs.get("wavelength_nm")
    if wavelength is None:
        return performance_map
    lights: list[Light | None] = [
        None if said_more else as_made(finish, roughness, float(wavelength))
        for (finish, roughness), said_more in zip(performance_map.samples, _said_more(performance_map), strict=True)
    ]
    return PerformanceMap(data.assign(light_variables(lights)))


def _said_more(performance_map: PerformanceMap) -> list[bool]:
    """Whether a campaign may have given the coupon of each sample more than metal, process and Ra."""
    try:
        samples = json.loads(str(performance_map.data.attrs.get("campaign", "{}"))).get("samples", [])
        given = [set(one.get("parameters", {})) for one in samples]
        roughness = [one.get("parameters", {}).get("Ra") for one in samples]
    except (ValueError, AttributeError, TypeError):
        return [False] * len(performance_map.samples)
    unusual = [str(ra) for keys, ra in zip(given, roughness, strict=True) if keys - _PLAIN]
    anywhere = any(keys - _PLAIN and "Ra" not in keys for keys in given)
    return [anywhere or any(_is(ra, rough) for ra in unusual) for _, rough in performance_map.samples]


def _is(written: str, roughness: float) -> bool:
    try:
        return abs(float(written) / roughness - 1) < 1e-6
    except (ValueError, ZeroDivisionError):
        return False


def unknown_finishes(known: Samples, finishes: dict[str, Finish]) -> dict[str, Finish]:
    """Finishes that samples do not answer for, by the name of a shape; each once."""
    out: dict[str, Finish] = {}
    seen = set[str]()
    for name, finish in finishes.items():
        key = f"{finish} {finish.light}"
        if key in seen:
            continue
        seen.add(key)
        try:
            known.answering(finish.name, finish.roughness, finish.light)
        except InputError:
            out[name] = finish
    return out


def seen_finishes(scene: Scene) -> dict[str, Finish]:
    """Finishes of a scene's shapes that have one, by the names of the shapes."""
    return {name: one for name, one in zip(scene.names, scene.finishes, strict=True) if one is not None}


def answering_map(performance_map: PerformanceMap, wanted: Wanted, ask: Ask | None = None) -> PerformanceMap:
    """The map with samples for all finishes that are wanted of it.

    Parameters
    ----------
    ask
        Answers whether finishes may be characterised now; None where nobody can be asked.

    Raises
    ------
    InputError
        If a finish is not known and may not be characterised, or the map was not simulated.
    """
    missing = unknown_finishes(performance_map.known, wanted.finishes)
    if not missing:
        return performance_map
    source = str(performance_map.data.attrs.get("source", ""))
    if source not in ("", "simulated"):
        name, finish = next(iter(missing.items()))
        raise _refused(
            performance_map,
            wanted,
            name,
            finish,
            "the map is of captures by a device: characterise a coupon of this finish with it",
        )
    distances = distances_about(performance_map, wanted.between)
    largest = largest_incidence_deg(performance_map)
    ones = {name: OneFinish(finish, wanted.sensor, largest) for name, finish in missing.items()}
    kept = {(name, at): kept_finish(one, at) for name, one in ones.items() for at in distances}
    to_make = [key for key, found in kept.items() if found is None]
    if to_make:
        seconds = sum(expected_seconds(ones[name]) for name, _ in to_make)
        names = list(dict.fromkeys(name for name, _ in to_make))
        told = ", ".join(_in_words(ones[name].finish) for name in names)
        question = f"{wanted.sensor.name}: its map does not know {told}; characterise now (about {_minutes(seconds)})?"
        if ask is None or not ask(question):
            raise _refused(
                performance_map,
                wanted,
                names[0],
                missing[names[0]],
                f"with --yes it is characterised now, in about {_minutes(seconds)}, and kept for the next time",
            )
        say(
            f"{wanted.sensor.name}: {told} is characterised now, in about {_minutes(seconds)}; kept in {cache_folder()}"
        )
        kept |= _made(ones, to_make, wanted.sensor)
    for one in ones.values():
        if len(one.turns) > 1:
            say(f"{one.finish}: has a lay; the map holds the mean over its directions, virtual measurements know it")
    found = [one for one in kept.values() if one is not None]
    joined = with_samples(performance_map, found)
    digests = sorted(str(one.data.attrs["finish_digest"]) for one in found)
    joined.data.attrs["characterised_when_asked"] = ", ".join(digests)
    return joined


def _made(
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
    """Distances of a map [mm] that answer for all |V| in an interval: those in it and the next beyond each end."""
    known = performance_map.data["distance"].values.astype(float)
    low = max(int(np.searchsorted(known, between[0], "right")) - 1, 0)
    high = min(int(np.searchsorted(known, between[1], "left")), len(known) - 1)
    return [float(one) for one in known[low : max(high, low) + 1]]


def _refused(performance_map: PerformanceMap, wanted: Wanted, name: str, finish: Finish, hint: str) -> InputError:
    allowed = f"what the map of {wanted.sensor.name} knows: {performance_map.known.told()}"
    return InputError(wanted.scene, f"shape {name!r}", f"the finish {_in_words(finish)}", allowed, hint)


def _in_words(finish: Finish) -> str:
    light = finish.light
    return str(finish) if light is None or light.as_made else f"{finish} ({light.in_words()})"


def _minutes(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 100 else f"{seconds / 60:.0f} min"


def samples_of(labelled: Iterable[tuple[str, float, Light | None]], where: str) -> Samples:
    """Samples that a campaign will make: finish, Ra [um] and what light sees of each."""
    rows = list(labelled)
    return Samples([row[0] for row in rows], np.array([row[1] for row in rows], float), [row[2] for row in rows], where)
