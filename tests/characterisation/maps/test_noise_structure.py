"""Noise area and persistent share as a map answers them."""

import numpy as np
import pytest
import xarray as xr

from characterisation.files.errors import InputError
from characterisation.maps.noise_structure import noise_structure
from characterisation.maps.performance_map import PerformanceMap

AXIS = np.linspace(-1, 1, 9)
TOWARD = np.array([[0.0, 0.0, 1.0]])


def known_map(area: list[list[float]], share: list[list[float]]) -> PerformanceMap:
    """Ra 0.1 and 0.4 at 400 and 800 mm, the same for all normals."""
    dims = ("sample", "distance", "b", "a")
    full = np.ones((2, 2, 9, 9))
    fields = {
        "recovered_fraction": full,
        "ray_noise_std": full,
        "noise_area": np.array(area)[..., None, None] * full,
        "persistent_share": np.array(share)[..., None, None] * full,
    }
    return PerformanceMap(
        xr.Dataset(
            {name: (dims, values) for name, values in fields.items()},
            {
                "finish": ("sample", ["ground", "ground"]),
                "roughness": ("sample", [0.1, 0.4]),
                "distance": ("distance", [400.0, 800.0]),
                "a": ("a", AXIS),
                "b": ("b", AXIS),
            },
        )
    )


def test_the_area_follows_a_power_of_distance_and_roughness() -> None:
    known = known_map([[10.0, 40.0], [20.0, 80.0]], [[0.1, 0.3], [0.2, 0.4]])
    for distance, roughness, area, share in (
        (400, 0.1, 10, 0.1),
        (800, 0.4, 80, 0.4),
        (np.sqrt(400 * 800), 0.1, 20, 0.2),
        (400, 0.2, 10 * np.sqrt(2), 0.15),
    ):
        found = noise_structure(known, "ground", roughness, distance, TOWARD)
        assert found.area[0] == pytest.approx(area, rel=1e-6)
        assert found.persistent_share[0] == pytest.approx(share, rel=1e-6)


def test_a_bias_keeps_its_sign() -> None:
    data = known_map([[1.0] * 2] * 2, [[0.0] * 2] * 2).data
    bias = np.array([[-0.1, 0.3], [-0.3, 0.1]])[..., None, None] * np.ones((2, 2, 9, 9))
    known = PerformanceMap(data.assign(bias_share=(("sample", "distance", "b", "a"), bias)))
    found = noise_structure(known, "ground", 0.1, [400.0, np.sqrt(400 * 800), 800.0], np.repeat(TOWARD, 3, axis=0))
    assert found.bias_share == pytest.approx([-0.1, 0.1, 0.3], abs=1e-8)


def test_a_knot_that_knows_answers_for_one_that_does_not() -> None:
    known = known_map([[10.0, np.nan], [np.nan, np.nan]], [[0.1, np.nan], [np.nan, np.nan]])
    found = noise_structure(known, "ground", 0.3, [400.0, 790.0], np.repeat(TOWARD, 2, axis=0))
    assert found.area == pytest.approx([10.0, 10.0]) and found.persistent_share == pytest.approx([0.1, 0.1])
    nothing = known_map([[np.nan] * 2] * 2, [[np.nan] * 2] * 2)
    assert np.isnan(noise_structure(nothing, "ground", 0.3, 500.0, TOWARD).area).all()


def test_a_map_made_before_says_nothing_and_an_unknown_surface_is_refused() -> None:
    known = known_map([[1.0] * 2] * 2, [[0.0] * 2] * 2)
    with pytest.raises(InputError, match="Ra"):
        noise_structure(known, "ground", 0.8, 500.0, TOWARD)
    known.data = known.data.drop_vars(["noise_area", "persistent_share"])
    assert np.isnan(noise_structure(known, "ground", 0.3, 500.0, TOWARD).persistent_share).all()
