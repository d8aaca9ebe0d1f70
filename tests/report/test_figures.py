"""Pictures: that they show what they should, by what was drawn rather than by pixels."""

import math

import matplotlib
import numpy as np
import pytest

from characterisation.plots.discs import noise_limits
from characterisation.point_cloud import Status
from characterisation.region_of_interest import Roi
from mitsim.report import figures
from mitsim.report.agreement import agreement
from mitsim.report.cloud_figures import REASONS, camera_images, shrink
from mitsim.report.style import as_svg
from mitsim.report.view_figures import agreement_figure, uncertainty_figure, uncertainty_limits, view_places
from mitsim.sensor.png import decode_png
from mitsim.study.run_folder import read_run
from tests.report.conftest import MEASUREMENTS, cloud


@pytest.fixture(scope="module")
def run(run_folder):
    return read_run(run_folder)


def test_map_figures_are_written_as_png(run, tmp_path):
    before = dict(matplotlib.rcParams)
    paths = figures.write_map_figures(run.performance_map, tmp_path / "new")
    assert [p.name for p in paths] == ["map_fraction.png", "map_noise.png"]
    assert all(p.read_bytes().startswith(b"\x89PNG") for p in paths)
    assert sorted(p.name for p in (tmp_path / "new").iterdir()) == ["map_fraction.png", "map_noise.png"]
    assert dict(matplotlib.rcParams) == before  # no state is left behind


def test_all_discs_share_one_scale_and_the_shiny_stand_right(run):
    figure = figures.fraction_figure(run.performance_map)
    images = [axes.images[0] for axes in figure.axes if axes.images]
    assert len(images) == 4  # two samples, two distances
    assert {image.get_clim() for image in images} == {(0.0, 1.0)}
    assert [axes.get_title() for axes in figure.axes[:2]] == ["matt white", "steel/ground\nRa 0.4 µm"]
    noise = [axes.images[0] for axes in figures.noise_figure(run.performance_map).axes if axes.images]
    assert {image.get_clim() for image in noise} == {noise_limits(run.performance_map.data["ray_noise_std"].values)}


def test_limits_of_noise_are_the_percentiles_said(run):
    data = run.performance_map.data.copy(deep=True)
    flat = np.linspace(0.1, 1.1, data["ray_noise_std"].size)
    data["ray_noise_std"].values = flat.reshape(data["ray_noise_std"].shape)
    low, high = noise_limits(data["ray_noise_std"].values)
    assert (low, high) == pytest.approx((0.1 + 0.02, 0.1 + 0.95))
    data["ray_noise_std"].values[:] = 0.3
    low, high = noise_limits(data["ray_noise_std"].values)
    assert low < 0.3 < high


def test_zenith_is_the_middle_and_the_horizon_a_ring(run):
    places = view_places(run.scores)
    np.testing.assert_allclose(np.linalg.norm(places[:6], axis=1), 2 * math.sin(math.radians(15)))
    np.testing.assert_allclose(places[6], [2 * math.sin(math.radians(35)), 0], atol=1e-12)
    assert places[7, 1] > 0  # counter-clockwise as seen from above


def test_colours_of_u_run_from_the_least_to_the_best_of_the_worst_tenth():
    low, high = uncertainty_limits(np.random.default_rng(1).permutation(np.arange(1.0, 101.0)))
    assert (low, high) == (1.0, 91.0)  # of 100 values, 90 lie below the tenth-worst
    low, high = uncertainty_limits(np.full(3, 0.5))
    assert low < 0.5 < high
    assert uncertainty_limits(np.empty(0)) == (0.1, 1.0)


def coloured(discs):
    """What is drawn with colours of a scale."""
    drawn = [one for axes in discs for one in axes.collections]
    return [one for one in drawn if one.get_array() is not None and one.get_array().size]


def test_a_small_u_is_bright_and_the_best_view_is_ringed(run):
    figure = uncertainty_figure(run.scores, MEASUREMENTS[1], "mm", run.checked, 4)
    here = run.scores.sel(measurement=MEASUREMENTS[1])
    discs = [axes for axes in figure.axes if axes.get_title().startswith("roll")]
    points = coloured(discs)
    shown = np.concatenate([one.get_array() for one in points])
    u = here["predicted_uncertainty"].values[here["uncertainty_possible"].values]
    assert sorted(shown) == pytest.approx(sorted(u)) and len(u) == 11
    for one in points:
        brightness = one.to_rgba(np.sort(u))[:, :3].sum(axis=1)
        assert (np.diff(brightness) <= 1e-9).all() and brightness[0] > 2 * brightness[-1]
        assert (np.diff(one.get_array()) < 0).all()  # the best is drawn last
    bar = next(axes for axes in figure.axes if axes not in discs)
    assert bar.get_xlabel() == "predicted standard uncertainty u [mm]" and bar.get_xscale() == "log"
    ring = next(one for axes in discs for one in axes.collections if one.get_linewidth()[0] == 2.0)
    np.testing.assert_allclose(ring.get_offsets(), view_places(run.scores)[4:5])


def test_a_measurement_that_no_view_can_make_is_all_crosses(run):
    scores = run.scores.copy(deep=True)
    scores["uncertainty_possible"][:] = False
    figure = uncertainty_figure(scores, MEASUREMENTS[0], "deg", run.checked, None)
    discs = [axes for axes in figure.axes if axes.get_title().startswith("roll")]
    assert not [
        one for axes in discs for one in axes.collections if one.get_array() is not None and one.get_array().size
    ]
    as_svg(figure, "drawn")


def test_views_that_failed_are_drawn_at_the_top_edge(run):
    found = agreement(run.scores, run.checks, MEASUREMENTS[0])
    left, right = agreement_figure(found, "deg").axes
    for axes, values in ((left, found.uncertainty), (right, found.score)):
        crosses = next(line for line in axes.lines if line.get_marker() == "X")
        assert crosses.get_xdata() == pytest.approx([values[-1]])
        assert crosses.get_ydata()[0] > np.nanmax(found.most)
    assert left.get_ylabel() == "|true error| [deg]" and "n = 2\n1 without a value" in left.get_title()
    assert left.get_xlabel().startswith("predicted standard uncertainty u") and right.get_xlabel().startswith(
        "view score"
    )


def test_camera_images_keep_their_order_of_brightness(run):
    capture = run.capture(4)
    uris, words = camera_images(capture)
    assert list(uris) == ["left", "right"] and "of 255 DN" in words
    import base64

    shown = decode_png(base64.b64decode(uris["left"].split(",")[1]), "left")
    raw = capture.images["left"][0]
    order = np.argsort(raw, axis=None)
    assert (np.diff(shown.ravel()[order].astype(int)) >= 0).all() and shown.max() > 250


def test_shrinking_keeps_the_mean():
    image = np.random.default_rng(1).integers(0, 255, (10, 1700)).astype(np.uint8)
    small = shrink(image)
    assert small.shape == (3, 566)
    assert small.mean() == pytest.approx(image[:9, :1698].mean())


def test_a_region_around_the_part_ends_with_the_image():
    there = cloud("predicted", 1).status != Status.NO_SURFACE
    assert Roi.around(there, 2).slices == (slice(3, 22), slice(6, 30))
    assert Roi.around(there, 100) == Roi.whole(there.shape[1], there.shape[0])
    assert Roi.around(there & False, 2) is None


def test_every_status_has_words_and_a_colour_of_its_own():
    assert set(REASONS) == set(Status)
    assert len({colour for _, colour in REASONS.values()}) == len(Status)


def test_svg_is_the_same_every_time_and_its_alt_is_escaped(run):
    one, two = (as_svg(figures.fraction_figure(run.performance_map), 'a "b" <c>') for _ in range(2))
    assert one == two
    assert 'aria-label="a &quot;b&quot; &lt;c&gt;"' in one
    assert "var(--ink)" in one and "<metadata" not in one and "<!--" not in one
