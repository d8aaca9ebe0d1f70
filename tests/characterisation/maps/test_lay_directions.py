"""Maps of a finish with a lay: between its directions, periodic, turned with the marks, and on disk."""

from __future__ import annotations

import math

import numpy as np
import pytest
import xarray as xr

from characterisation.files.errors import InputError
from characterisation.lambert_projection import inverse_lambert_projection
from characterisation.maps.joined import mean_over, with_directions, with_samples
from characterisation.maps.lay import LAY_FIELDS, lay_angle_deg, mirror_direction, tangent_at, turned
from characterisation.maps.light import Light, light_variables
from characterisation.maps.map_file import SCHEMA_VERSION
from characterisation.maps.performance_map import PerformanceMap
from characterisation.maps.tables import FIELDS

AXIS = np.linspace(-1.2, 1.2, 121)
AHEAD = np.array([0.0, 0.0, 1.0])
TURNS_DEG = (0.0, 45.0, 90.0, 135.0)
NODES = ("sample", "distance", "b", "a")
TURNED = Light("metal", 0.9, 0.05, 0.013, 0.097, 0.5, math.nan, math.nan, 0.9, as_made=False)
FINISH = ("aluminium/turned", 0.8)


def one_direction(fraction, sigma, light: Light | None = TURNED, distances=(400.0, 600.0)) -> PerformanceMap:
    """A map of one sample whose F and sigma are functions of N, (..., 3)."""
    a, b = np.meshgrid(AXIS, AXIS)
    normals = inverse_lambert_projection(np.stack([a, b], axis=-1))
    f, s = (np.broadcast_to(of(normals), (1, len(distances), *a.shape)) for of in (fraction, sigma))
    values = f, s, np.full(f.shape, 0.01), 0.02 * s
    data = xr.Dataset(
        {name: (NODES, one) for name, one in zip(FIELDS, values, strict=False)},
        {
            "finish": ("sample", [FINISH[0]]),
            "roughness": ("sample", [FINISH[1]]),
            "distance": list(distances),
            "a": AXIS,
            "b": AXIS,
        },
        {"name": "with a lay", "schema_version": SCHEMA_VERSION},
    )
    for name in FIELDS[4:]:
        data[name] = (NODES, np.full(f.shape, np.nan))
    for name, low in (("false_fraction", 0.0), ("patches", 9.0)):
        data[name] = (NODES, np.full(f.shape, low))
    return PerformanceMap(data.assign(light_variables([light])))


def of_a_lay(fraction, sigma) -> PerformanceMap:
    """The map of four directions of functions of N and of the lay angle [rad]."""
    made = [
        one_direction(lambda n, k=k: fraction(n, math.radians(k)), lambda n, k=k: sigma(n, math.radians(k)))
        for k in TURNS_DEG
    ]
    return with_directions(mean_over(made), made, (0.0, 0.0))


def query(performance_map: PerformanceMap, normals: np.ndarray, lay_deg, distance: float = 500.0):
    """Query at lay angles about the view ray; None for no direction, and NaN where there is none."""
    tangents = None
    if lay_deg is not None:
        angles = np.broadcast_to(lay_deg, len(normals))
        tangents = np.array([tangent_at(n, angle, AHEAD) for n, angle in zip(normals, angles, strict=True)])
    return performance_map.query(*FINISH, np.full(len(normals), distance), normals, TURNED, tangents)


def some_normals(rng: np.random.Generator, count: int) -> np.ndarray:
    place = rng.uniform(-0.6, 0.6, (count, 2))
    return inverse_lambert_projection(place)


def line_of_light(normals: np.ndarray, psi: float) -> np.ndarray:
    """F around the line across the marks, which turns with them about the view ray."""
    slope = normals[..., 0] * math.cos(psi) + normals[..., 1] * math.sin(psi)
    return 0.3 + 0.6 * np.exp(-((slope / 0.15) ** 2))


def test_a_line_of_light_that_turns_with_the_marks_is_found_between_the_directions(rng):
    known = of_a_lay(line_of_light, lambda n, psi: np.exp(-2 - line_of_light(n, psi)))
    normals, psi = some_normals(rng, 400), rng.uniform(0, 180, 400)
    true = np.array([line_of_light(n, math.radians(p)) for n, p in zip(normals, psi, strict=True)])
    found = query(known, normals, psi)
    assert np.abs(found.fraction - true).max() < 0.003  # the grid of nodes
    assert np.abs(np.log(found.sigma) + 2 + true).max() < 0.003
    mean = query(known, normals, None)
    assert np.sqrt(np.mean((mean.fraction - true) ** 2)) > 0.1


def test_between_directions_f_and_ln_sigma_are_linear_in_the_angle_and_errors_are_combined():
    def wave(normals, psi):
        return np.full(normals.shape[:-1], 0.5 + 0.3 * math.cos(2 * psi))

    known = of_a_lay(wave, lambda n, psi: np.exp(-3 + wave(n, psi)))
    psi = np.array([0.0, 22.5, 45.0, 60.0, 90.0, 112.5, 135.0, 157.5])
    expected = 0.5 + 0.3 * np.interp(psi % 180, [0, 45, 90, 135, 180], [1, 0, -1, 0, 1])
    found = query(known, np.repeat([[0.0, 0.0, 1.0]], len(psi), axis=0), psi, 400.0)
    assert found.fraction == pytest.approx(expected, abs=1e-5)
    assert np.log(found.sigma) == pytest.approx(-3 + expected, abs=1e-5)
    assert found.fraction_error[[0, 1]] == pytest.approx([0.01, 0.01 / math.sqrt(2)], rel=1e-3)
    assert found.sigma_error[2] == pytest.approx(0.02 * found.sigma[2], rel=1e-3)
    assert np.isnan(found.fraction_spread).all()


def test_the_angle_is_periodic_and_without_one_the_mean_answers(rng):
    known = of_a_lay(line_of_light, lambda n, psi: np.exp(-2 - line_of_light(n, psi)))
    normals, psi = some_normals(rng, 50), rng.uniform(0, 180, 50)
    found = query(known, normals, psi)
    for turns in (-180.0, 180.0, 540.0):
        assert query(known, normals, psi + turns).fraction == pytest.approx(found.fraction, abs=1e-6)
    ends = [query(known, normals, near).fraction for near in (179.9999, 1e-4)]
    assert ends[0] == pytest.approx(ends[1], abs=1e-4)
    unknown = query(known, normals, np.where(np.arange(50) < 25, psi, np.nan))
    mean = query(known, normals, None)
    assert np.array_equal(unknown.fraction[:25], found.fraction[:25])
    assert np.array_equal(unknown.fraction[25:], mean.fraction[25:])
    assert np.isfinite(mean.fraction_spread).all()


def test_turning_the_part_by_90_deg_about_its_normal_swaps_along_and_across(rng):
    known = of_a_lay(line_of_light, lambda n, psi: np.exp(-2 - line_of_light(n, psi)))
    tilted = np.array([[math.sin(0.4), 0.0, math.cos(0.4)]])
    along = np.array([[math.cos(0.4), 0.0, -math.sin(0.4)]])
    angles = [lay_angle_deg(tilted, one, AHEAD) for one in (along, np.cross(tilted, along))]
    assert angles == pytest.approx([0.0, 90.0], abs=1e-9)
    f = [query(known, tilted, one).fraction[0] for one in angles]
    assert f == pytest.approx([line_of_light(tilted[0], 0.0), 0.9], abs=0.003)
    assert f[1] > f[0] + 0.3


def test_a_direction_turned_about_the_mirror_direction_turns_its_lay_angle(rng):
    normals = some_normals(rng, 100)
    mirror = mirror_direction(np.linspace(300.0, 900.0, 100), (60.0, -20.0))
    assert np.linalg.norm(mirror, axis=1) == pytest.approx(1.0)
    assert mirror[0, :2] / mirror[0, 2] == pytest.approx([0.2, -20 / 300])
    tangents = tangent_at(normals, 70.0, mirror)
    assert np.abs(np.sum(tangents * normals, axis=1)).max() < 1e-12
    assert lay_angle_deg(normals, -3.0 * tangents, mirror) == pytest.approx(70.0)  # length and sign do not matter
    by = rng.uniform(-90, 90, 100)
    after = lay_angle_deg(turned(normals, by, mirror), turned(tangents, by, mirror), mirror)
    assert np.abs((after - 70.0 - by + 90) % 180 - 90).max() < 1e-9
    assert turned(mirror, by, mirror) == pytest.approx(mirror)


def test_the_line_of_light_turns_about_the_mirror_direction(rng):
    mirror = mirror_direction(np.array(400.0), (60.0, 0.0))

    def around(normals, psi):
        """The line through the mirror direction, across marks at an angle about it."""
        slope = np.sum(tangent_at(mirror, math.degrees(psi), mirror) * normals, axis=-1)
        return 0.3 + 0.6 * np.exp(-((slope / 0.15) ** 2))

    known = of_a_lay(around, lambda n, psi: np.exp(-2 - around(n, psi)))
    normals, psi = some_normals(rng, 200), rng.uniform(0, 180, 200)
    tangents = np.array([tangent_at(n, angle, mirror) for n, angle in zip(normals, psi, strict=True)])
    true = np.array([around(n, math.radians(p)) for n, p in zip(normals, psi, strict=True)])
    off = []
    for x in (60.0, 0.0):
        moved = PerformanceMap(known.data.assign_coords(lay_mirror_x=x))
        found = moved.query(*FINISH, np.full(200, 400.0), normals, TURNED, tangents)
        off.append(np.abs(found.fraction - true).max())
    assert off[0] < 0.003 < 0.1 < off[1]


def test_a_map_of_directions_is_read_as_it_was_written_and_others_as_before(tmp_path, rng):
    known = of_a_lay(line_of_light, lambda n, psi: np.exp(-2 - line_of_light(n, psi)))
    plain = one_direction(lambda n: line_of_light(n, 0.0), lambda n: np.full(n.shape[:-1], 0.1))
    normals, psi = some_normals(rng, 50), rng.uniform(0, 180, 50)
    for compact in (False, True):
        known.save(tmp_path / "lay.nc", compact)
        found = query(PerformanceMap.load(tmp_path / "lay.nc"), normals, psi).fraction
        assert found == pytest.approx(query(known, normals, psi).fraction, abs=2e-3)
    plain.save(tmp_path / "plain.nc")
    old = PerformanceMap.load(tmp_path / "plain.nc")
    assert "lay" not in old.data.dims
    assert np.array_equal(query(old, normals, psi).fraction, query(old, normals, None).fraction)
    wrong = known.data.assign_coords(lay=[0.0, 30.0, 90.0, 135.0])
    PerformanceMap(wrong).save(tmp_path / "wrong.nc")
    with pytest.raises(InputError, match="equally spaced directions"):
        PerformanceMap.load(tmp_path / "wrong.nc")


def test_directions_are_joined_to_a_map_without_them_at_their_distances(rng):
    other = Light("metal", 0.5, 0.05, 0.05, 0.05, 0.5, math.nan, math.nan, 0.9)
    plain = one_direction(lambda n: np.full(n.shape[:-1], 0.7), lambda n: np.full(n.shape[:-1], 0.1), other)
    known = of_a_lay(line_of_light, lambda n, psi: np.exp(-2 - line_of_light(n, psi)))
    at_one = PerformanceMap(known.data.isel(distance=[1]))
    joined = with_samples(plain, [at_one])
    normals, psi = some_normals(rng, 50), rng.uniform(0, 180, 50)
    found = query(joined, normals, psi, 600.0)
    assert found.fraction == pytest.approx(query(known, normals, psi, 600.0).fraction, abs=1e-5)
    assert np.isnan(query(joined, normals, psi, 400.0).fraction).all()
    again = joined.query(*FINISH, np.full(50, 600.0), normals, other, np.cross(normals, [0.0, 1.0, 0.0]))
    assert again.fraction == pytest.approx(np.full(50, 0.7), abs=1e-5)
    more = with_samples(plain, [at_one, PerformanceMap(known.data.isel(distance=[0]))])
    assert len(more.samples) == 2
    assert np.isfinite(query(more, normals, psi, 400.0).fraction).all()
    assert joined.data[LAY_FIELDS[FIELDS[0]]].dims == ("sample", "lay", "distance", "b", "a")


def test_a_bias_that_differs_between_the_directions_persists():
    """Faces that lie at random have a bias of either sign: the plain mean of both was none, and nothing persisted."""
    made = []
    for number, bias in enumerate((-0.8, 0.8, -0.8, 0.8)):
        one = one_direction(lambda n: 0.5 + 0 * n[..., 0], lambda n, k=number: 0.1 * (1 + k) + 0 * n[..., 0])
        shape = one.data["recovered_fraction"].shape
        shares = {"persistent_share": np.full(shape, 0.1), "bias_share": np.full(shape, bias)}
        made.append(PerformanceMap(one.data.assign({name: (NODES, values) for name, values in shares.items()})))
    mean = mean_over(made).data
    sigma, persistent, beta = (
        mean[name].values.astype(float).ravel() for name in ("ray_noise_std", "persistent_share", "bias_share")
    )
    each = np.array([0.1, 0.2, 0.3, 0.4])
    biases = np.array([-0.8, 0.8, -0.8, 0.8]) * each
    assert sigma == pytest.approx(np.sqrt((each**2).mean()))
    assert beta * sigma == pytest.approx(biases.mean())
    assert (persistent * sigma) ** 2 == pytest.approx(np.var(biases) + ((0.1 * each) ** 2).mean())
