"""Sensor against sensor: what is drawn is what the maps say, on one scale."""

import math

import numpy as np
import pytest

from characterisation.files.errors import InputError
from characterisation.maps.performance_map import PerformanceMap
from characterisation.maps.shipped import map_path
from mitsim.report.map_comparison import (
    check_distance,
    common_samples,
    comparison_figure,
    nearest_distance,
    strip_figure,
)
from mitsim.report.style import write_png


@pytest.fixture(scope="module")
def maps():
    return [PerformanceMap.load(map_path(name)) for name in ("ensenso-n10", "photoneo-phoxi-s")]


def test_samples_run_from_matt_to_shiny(maps):
    samples = common_samples(maps)
    assert next(name for name, _ in samples) == "matt_white" and math.isnan(samples[0][1])
    assert [roughness for _, roughness in samples[1:]] == [0.74, 0.46, 0.37, 0.09]


def test_a_distance_that_a_map_does_not_cover_is_refused_with_the_ranges(maps):
    near = max(float(one.data["distance"].values[0]) for one in maps)
    far = min(float(one.data["distance"].values[-1]) for one in maps)
    check_distance(maps, near)
    check_distance(maps, far)
    with pytest.raises(InputError, match=f"{far:g}"):
        check_distance(maps, far + 1)


def test_a_row_for_each_map_at_the_nearest_distance_on_one_scale(maps, tmp_path):
    assert nearest_distance(maps[0], 620) == 2 and nearest_distance(maps[1], 620) == 1
    figure = comparison_figure(maps, "noise", 620)
    pictures = [axes for axes in figure.axes if axes.images]
    assert len(pictures) == 10
    norms = {(axes.images[0].norm.vmin, axes.images[0].norm.vmax) for axes in pictures}
    assert len(norms) == 1
    shown = pictures[0].images[0].get_array()
    index = [name for name, _ in maps[0].samples].index("matt_white")
    expected = maps[0].data["ray_noise_std"].values[index, 2]
    np.testing.assert_array_equal(np.ma.filled(shown, np.nan), expected)
    assert "ensenso-n10\n635 mm" in [axes.get_ylabel() for axes in pictures]
    assert write_png(figure, tmp_path / "noise.png", dpi=40).stat().st_size > 10_000


def test_the_strip_is_what_the_maps_answer(maps):
    figure = strip_figure(maps)
    top = figure.axes[0]  # matt white
    assert len(top.lines) == 6
    distance, fraction = top.lines[0].get_data()
    normal = np.tile([0.0, 0.0, 1.0], (len(distance), 1))
    np.testing.assert_array_equal(fraction, maps[0].query("matt_white", math.nan, distance, normal).fraction)


def test_a_map_without_any_noise_is_drawn(maps, tmp_path):
    data = maps[0].data.copy(deep=True)
    data["ray_noise_std"] = data["ray_noise_std"] * np.nan
    silent = PerformanceMap(data)
    for figure in (comparison_figure([silent], "noise"), strip_figure([silent])):
        assert write_png(figure, tmp_path / "a.png", dpi=40).stat().st_size > 1000
