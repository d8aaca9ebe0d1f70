"""A map answers for what it was made of, by what light sees of it, and refuses the rest."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st

from characterisation.files.errors import InputError
from characterisation.maps.joined import mean_over, with_samples
from characterisation.maps.light import NUMBERS, Light, lies_between, light_variables, lights_of, same_light
from characterisation.maps.map_file import SCHEMA_VERSION
from characterisation.maps.performance_map import PerformanceMap
from characterisation.maps.tables import FIELDS

AXIS = np.linspace(-1, 1, 21)
AHEAD = np.array([[0.0, 0.0, 1.0]])
NAN = math.nan


def light_at(roughness: float, **changes) -> Light:
    """A law of its own: what light sees of a metal of some Ra."""
    return replace(
        Light(
            "metal",
            0.87,
            0.25 * roughness,
            0.3 * roughness**0.8,
            0.3 * roughness**0.8,
            0.15,
            0.005,
            0.005,
            1.25 * roughness,
        ),
        **changes,
    )


MATT = Light("matt", 0.85, 1.0, NAN, NAN, 0.0, NAN, NAN, NAN)


def map_of(samples, distances=(400.0, 600.0), axis=AXIS, level=0.3):
    """A map of (finish, Ra, light): F rises by 0.1 from sample to sample, sigma is 0.1 mm times its number."""
    shape = (len(samples), len(distances), len(axis), len(axis))
    number = np.arange(len(samples), dtype=float)[:, None, None, None]
    values = [level + 0.1 * number, 0.1 * (number + 1), 0.01 + 0 * number, 0.002 + 0 * number, NAN, NAN]
    fields = {
        name: (("sample", "distance", "b", "a"), np.broadcast_to(value, shape).astype(float).copy())
        for name, value in zip(FIELDS, values, strict=True)
    }
    names, roughness, _ = zip(*samples, strict=True)
    coordinates = {
        "finish": ("sample", list(names)),
        "roughness": ("sample", list(roughness)),
        "distance": list(distances),
        "a": axis,
        "b": axis,
    }
    data = xr.Dataset(fields, coordinates, {"name": "known", "schema_version": SCHEMA_VERSION})
    lights = [one[2] for one in samples]
    return PerformanceMap(data.assign(light_variables(lights)) if any(lights) else data)


GROUND = [("aluminium/ground", ra, light_at(ra)) for ra in (0.1, 0.4, 0.8)]
KNOWN = map_of([("matt_white", NAN, MATT), *GROUND])


def fraction(performance_map, finish, roughness, light, distance=400.0):
    return float(performance_map.query(finish, roughness, [distance], AHEAD, light).fraction[0])


def test_what_is_the_same_to_light_is_answered_whatever_it_is_called():
    assert fraction(KNOWN, "brass/lapped", 3.0, light_at(0.4, as_made=False)) == pytest.approx(0.5, abs=1e-6)
    assert fraction(KNOWN, "matt_white", NAN, MATT) == pytest.approx(0.3, abs=1e-6)


def test_between_samples_that_are_as_made_it_answers_as_by_name():
    assert fraction(KNOWN, "aluminium/ground", 0.2, light_at(0.2)) == fraction(KNOWN, "aluminium/ground", 0.2, None)
    assert 0.4 < fraction(KNOWN, "aluminium/ground", 0.2, light_at(0.2)) < 0.5


@pytest.mark.parametrize(
    "light",
    [
        light_at(0.2, alpha_u=0.12, alpha_v=0.12, as_made=False),  # as "alpha" says, in a family's range of Ra
        light_at(0.2, alpha_u=0.02, as_made=False),  # a lay
        light_at(0.2, reflectance=0.57),  # as made by another law
        light_at(0.2, beckmann=1.0),
        light_at(0.2, kind="matt"),
    ],
)
def test_another_lobe_of_the_same_name_and_ra_is_refused(light):
    with pytest.raises(InputError, match="characterise this finish"):
        KNOWN.query("aluminium/ground", 0.2, [400.0], AHEAD, light)


def test_another_reflectance_of_a_white_is_refused_and_an_unknown_name_too():
    with pytest.raises(InputError, match=r"reflectance 0\.3"):
        KNOWN.query("matt_white", NAN, [400.0], AHEAD, replace(MATT, reflectance=0.3, as_made=False))
    with pytest.raises(InputError, match="aluminium/ground"):
        KNOWN.query("aluminium/grond", 0.2, [400.0], AHEAD, light_at(0.2, alpha_u=0.3))
    with pytest.raises(InputError, match="range"):
        KNOWN.query("aluminium/ground", 1.6, [400.0], AHEAD, light_at(1.6))


def test_a_map_that_does_not_know_light_answers_for_what_is_as_made_alone():
    former = map_of([(name, ra, None) for name, ra, _ in [("matt_white", NAN, MATT), *GROUND]])
    assert former.lights == [None] * 4
    assert fraction(former, "aluminium/ground", 0.2, light_at(0.2)) == fraction(former, "aluminium/ground", 0.2, None)
    with pytest.raises(InputError, match="characterise this finish"):
        former.query("aluminium/ground", 0.2, [400.0], AHEAD, light_at(0.2, alpha_u=0.12, as_made=False))


def test_a_sample_that_is_not_as_made_has_no_part_in_interpolation():
    odd = ("aluminium/ground", 0.2, light_at(0.2, alpha_u=0.3, alpha_v=0.3, as_made=False))
    with_odd = map_of([("matt_white", NAN, MATT), *GROUND, odd])
    for rough in (0.15, 0.25):
        assert fraction(with_odd, "aluminium/ground", rough, light_at(rough)) == fraction(
            KNOWN, "aluminium/ground", rough, light_at(rough)
        )
    assert fraction(with_odd, *odd) == pytest.approx(0.7, abs=1e-6)


def test_what_light_sees_is_kept_in_the_file(tmp_path):
    for name, compact in (("whole.nc", False), ("compact.nc", True)):
        KNOWN.save(tmp_path / name, compact)
        again = PerformanceMap.load(tmp_path / name)
        assert str(again.lights) == str(KNOWN.lights)
        assert [one.as_made for one in again.lights] == [True] * 4


lights = st.builds(
    Light, st.sampled_from(["metal", "matt"]), *[st.floats(0.3, 2.0) | st.just(NAN)] * len(NUMBERS), st.booleans()
)


@given(lights, lights, st.floats(0, 1))
def test_properties_of_same_and_between(one, other, way):
    assert same_light(one, one)
    assert lies_between(one, one, other) or one.kind != other.kind or nans(one) != nans(other)
    if one.kind == other.kind and nans(one) == nans(other):
        mixed = {name: (1 - way) * getattr(one, name) + way * getattr(other, name) for name in NUMBERS}
        assert lies_between(replace(one, **mixed), one, other)
    for factor, same in ((1.005, True), (1.05, False)):
        assert same_light(one, replace(one, reflectance=factor * one.reflectance)) == (
            same or math.isnan(one.reflectance)
        )
    data = xr.Dataset(light_variables([one, None, other]))
    assert str(lights_of(data)) == str([one, None, other])


def nans(one: Light) -> list[bool]:
    return [math.isnan(number) for number in one.numbers()]


def test_joined_samples_answer_where_they_were_characterised_and_nowhere_else():
    steel = ("carbon_steel/milled", 1.6, light_at(1.6, reflectance=0.57))
    joined = with_samples(KNOWN, [map_of([steel], (600.0,), level=0.9)])
    assert fraction(joined, *steel, distance=600.0) == pytest.approx(0.9, abs=1e-6)
    assert math.isnan(fraction(joined, *steel, distance=400.0))
    both = with_samples(KNOWN, [map_of([steel], (600.0,), level=0.9), map_of([steel], (400.0,), level=0.7)])
    assert len(both.samples) == 5
    assert 0.7 < fraction(both, *steel, distance=500.0) < 0.9
    for name, rough, light in GROUND:
        assert fraction(both, name, rough, light) == fraction(KNOWN, name, rough, light)
    with pytest.raises(InputError, match="500 mm"):
        with_samples(KNOWN, [map_of([steel], (500.0,))])


def test_samples_on_other_nodes_are_laid_on_those_of_the_map():
    axis = np.linspace(-1, 1, 11)
    steel = map_of([("carbon_steel/milled", 1.6, light_at(1.6))], (600.0,), axis)
    slope = 0.5 + 0.2 * np.add.outer(axis, 0.5 * axis)
    steel.data["recovered_fraction"][0, 0] = slope
    joined = with_samples(KNOWN, [steel]).data["recovered_fraction"].values[-1, 1]
    assert np.allclose(joined, 0.5 + 0.2 * np.add.outer(AXIS, 0.5 * AXIS), atol=1e-6)


def test_the_mean_over_directions_pools_points_and_tells_their_spread():
    steel = ("carbon_steel/milled", 1.6, light_at(1.6))
    maps = [map_of([steel], (600.0,), level=level) for level in (0.2, 0.6)]
    maps[1].data["ray_noise_std"][:] = 0.3
    mean = mean_over(maps)
    at = (0, 0, 10, 10)
    pooled = math.sqrt((0.2 * 0.1**2 + 0.6 * 0.3**2) / 0.8)
    assert mean.data["recovered_fraction"].values[at] == pytest.approx(0.4)
    assert mean.data["ray_noise_std"].values[at] == pytest.approx(pooled, rel=1e-6)
    assert mean.data["recovered_fraction_spread"].values[at] == pytest.approx(0.2)
    answer = mean.query(*steel[:2], [600.0], AHEAD, steel[2])
    assert answer.fraction[0] == pytest.approx(0.4, abs=1e-5)
    assert answer.fraction_spread[0] == pytest.approx(0.2, rel=1e-3)


@pytest.mark.parametrize("name", ["alpha_u", "mirror_v", "height_um"])
def test_narrow_lobes_differ_by_their_share_of_the_width(name):
    """0.005 and 0.0069 are lobes of other widths; shares of light that differ as little are the same to a sensor."""
    narrow = light_at(0.1, **{name: 0.005})
    assert not same_light(narrow, replace(narrow, **{name: 0.0069}))
    assert same_light(narrow, replace(narrow, **{name: 0.00504}))
    assert same_light(narrow, replace(narrow, wide_angle=narrow.wide_angle + 0.0019))
