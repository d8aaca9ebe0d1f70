"""Features in windows: closed forms without noise, and uncertainties that describe the scatter with it."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from characterisation.features.fits import fit_cylinder
from characterisation.features.robust_fit import FitError
from characterisation.features.starts import cylinder_start
from characterisation.files.errors import InputError
from characterisation.region_of_interest import Roi
from characterisation.tasks.result import Result, repeatability
from characterisation.tasks.windows import WindowPlan, fit_shape, measure_windows
from mitsim.decoding.measured_document import repeatability_table
from tests.seen_shapes import GRID, cloud_of, cylinder, plane, sphere

#: left half a plane, right half one that leans by 30 deg against it; below them a ball and a pin
LEFT, RIGHT = (Roi(5, 5, 85, 60), Roi(110, 5, 85, 60))
LEAN = np.deg2rad(30)


def corner():
    flat, leaning = plane([0, 0, 500], [0, 0, -1]), plane([0, 0, 480], [np.sin(LEAN), 0, -np.cos(LEAN)])
    return np.where(np.arange(GRID.width) < 100, flat, leaning)


def by_name(results):
    return {one.name: one for one in results}


def test_planes_without_noise_are_as_they_were_made():
    plan = WindowPlan({"a": ("plane", LEFT), "b": ("plane", RIGHT)}, [("angle", "a", "b")])
    found = by_name(measure_windows(cloud_of(corner()), plan))
    assert found["a-b angle"].value == pytest.approx(30.0, abs=1e-4)
    assert found["a flatness"].value < 1e-3
    assert found["a noise"].value < 1e-4
    # the middle of the window's rays meets z = 500
    rays = GRID.rays()[5:65, 5:90].reshape(-1, 3)
    middle = (rays / rays[:, 2:]).mean(axis=0)
    assert found["a distance"].value == pytest.approx(500 * np.linalg.norm(middle), abs=1e-3)
    assert (found["a noise"].points, found["a noise"].points_given) == (60 * 85, 60 * 85)


def test_the_distance_of_parallel_planes_is_their_offset():
    flat = np.where(np.arange(GRID.width) < 100, plane([0, 0, 500], [0, 0.2, -1]), plane([0, 0, 520], [0, 0.2, -1]))
    plan = WindowPlan({"a": ("plane", LEFT), "b": ("plane", RIGHT)}, [("distance", "a", "b")])
    found = by_name(measure_windows(cloud_of(flat), plan))["a-b distance"]
    assert found.value == pytest.approx(20 / np.sqrt(1.04), abs=1e-3)


def test_planes_and_axes_that_lean_have_no_one_distance():
    """Before, planes at 30 deg had a distance, with an uncertainty of micrometres."""
    plan = WindowPlan({"a": ("plane", LEFT), "b": ("plane", RIGHT)}, [("distance", "a", "b")])
    found = by_name(measure_windows(cloud_of(corner()), plan))["a-b distance"]
    assert not found.possible
    assert "30 deg apart" in found.reason


def test_balls_and_pins_without_noise_are_as_they_were_made():
    ball, pin = sphere([-30, 0, 450], 20), cylinder([40, 0, 470], [0.1, 1, 0.05], 15)
    cloud = cloud_of(np.where(np.arange(GRID.width) < 100, ball, pin))
    whole = Roi(0, 0, 100, 160), Roi(100, 0, 100, 160)
    found = by_name(measure_windows(cloud, WindowPlan({"ball": ("sphere", whole[0]), "pin": ("cylinder", whole[1])})))
    assert found["ball diameter"].value == pytest.approx(40, abs=1e-3)
    assert found["ball distance"].value == pytest.approx(np.hypot(30, 450), abs=1e-3)
    assert found["pin diameter"].value == pytest.approx(30, abs=1e-3)
    assert found["pin cylindricity"].value < 1e-3


@pytest.fixture(scope="module")
def trials():
    """Sixty clouds of a corner, and of a ball, with noise of 0.2 mm along the rays."""
    rng = np.random.default_rng(24)
    small = Roi(30, 20, 40, 40), Roi(120, 20, 40, 40)
    plan = WindowPlan({"a": ("plane", small[0]), "b": ("plane", small[1])}, [("angle", "a", "b")])
    ball = WindowPlan({"ball": ("sphere", Roi(60, 45, 80, 70))})
    return [
        measure_windows(cloud_of(corner(), 0.2, rng), plan)
        + measure_windows(cloud_of(sphere([0, 0, 450], 20), 0.2, rng), ball)
        for _ in range(60)
    ]


@pytest.mark.parametrize("name", ["a distance", "a noise", "a-b angle", "ball diameter", "ball distance"])
def test_the_uncertainty_is_the_scatter_of_independent_noise(trials, name):
    """Over 60 trials s / sigma lies within 1 +- 3 / sqrt(2 * 59), and the mean within 4 standard errors."""
    truth = {"a noise": 0.2, "a-b angle": 30.0, "ball diameter": 40.0, "ball distance": 450.0}
    values = np.array([by_name(one)[name].value for one in trials])
    stated = np.sqrt(np.mean([by_name(one)[name].uncertainty ** 2 for one in trials]))
    assert abs(values.std(ddof=1) / stated - 1) < 3 / np.sqrt(2 * 59)
    if name in truth:
        # without the fit's own removal of points beyond 4 sigma: 6 in 10 000, 0.1 % of sigma
        assert abs(values.mean() - truth[name]) < 4 * stated / np.sqrt(60) + (1e-3 * 0.2 if name == "a noise" else 0)


def test_the_point_of_a_short_axis_slides_along_it_as_its_uncertainty_says(rng):
    """The middle of the points lies a radius beside the axis, so an axis that tilts moves its nearest point."""
    pin, window, runs = cylinder([0, 0, 470], [0, 1, 0], 15), Roi(85, 70, 30, 20), 100
    plan = WindowPlan({"pin": ("cylinder", window)})
    along = [by_name(measure_windows(cloud_of(pin, 0.05, rng), plan))["pin axis point y"] for _ in range(runs)]
    stated = np.sqrt(np.mean([one.uncertainty**2 for one in along]))
    assert stated == pytest.approx(np.std([one.value for one in along], ddof=1), rel=4 / np.sqrt(2 * runs))


@pytest.mark.parametrize("direction", [(1, 0, -1), (1, -1, 0), (0, 1, -1), (1, -1, 1)])
def test_an_axis_between_two_coordinate_axes_keeps_its_sense(direction, rng):
    """Noise decides which of two components is the larger one; clouds of one pin still have one direction."""
    pin, plan = cylinder([0, 0, 470], direction, 15), WindowPlan({"pin": ("cylinder", Roi(85, 70, 30, 20))})
    axes = []
    for _ in range(8):
        results = by_name(measure_windows(cloud_of(pin, 0.05, rng), plan))
        axes.append([results[f"pin axis {letter}"].value for letter in "xyz"])
    expected = np.array(direction) / np.linalg.norm(direction)
    assert np.abs(axes - expected).max() < 0.02


def test_repeatability_is_mean_and_standard_deviation_over_clouds(trials):
    over = {one.name: one for one in repeatability(trials)}
    values = [by_name(one)["ball diameter"].value for one in trials]
    assert over["ball diameter"].count == over["ball diameter"].cloud_count == 60
    assert over["ball diameter"].mean == pytest.approx(np.mean(values))
    assert over["ball diameter"].deviation == pytest.approx(np.std(values, ddof=1))


def test_the_uncertainty_of_repeats_is_the_root_mean_square_of_those_of_the_fits():
    (over,) = repeatability([[Result("a", "mm", 1.0, 0.3, "fit")], [Result("a", "mm", 2.0, 0.4, "fit")]])
    assert over.uncertainty == pytest.approx(np.sqrt(0.125))
    assert "u (rms of fits)" in repeatability_table([over])


def test_a_window_that_shows_something_else_has_no_value_and_says_so(rng):
    cloud = cloud_of(np.where(rng.random((160, 200)) < 0.3, corner(), rng.uniform(300, 900, (160, 200))))
    found = measure_windows(cloud, WindowPlan({"a": ("plane", LEFT)}))
    assert not any(one.possible for one in found)
    assert "does the window show one plane?" in found[0].reason
    assert repeatability([found])[0].count == 0


@pytest.mark.parametrize("height", [0.0, 1.0])
def test_a_face_seen_from_within_it_is_called_grazing(height, rng):
    """A plate in the frame of its part, whose origin lies in its face or 1 mm below it: beyond 6 mm, over 80 deg."""
    points = np.column_stack([rng.uniform(0, 100, (4000, 2)), height + rng.normal(0, 0.02, 4000)])
    with pytest.raises(FitError, match=r"points are seen at grazing incidence from the sensor, the origin"):
        fit_shape(points, "plane", np.zeros(3))


def test_points_that_are_all_false_have_no_value(rng):
    """Distances at random over a range, as false matches have: before, a plane of 23 mm noise, +- 0.1 mm."""
    cloud = cloud_of(rng.uniform(370, 450, (160, 200)))
    for result in measure_windows(cloud, WindowPlan({"wall": ("plane", None)})):
        assert not result.possible
        assert "% of their distance" in result.reason


def test_a_window_outside_the_grid_is_refused():
    with pytest.raises(InputError, match="within 200 x 160 pixels"):
        measure_windows(cloud_of(corner()), WindowPlan({"a": ("plane", Roi(150, 5, 80, 60))}))


def test_pairs_that_cannot_be_measured_are_refused():
    features = {"a": ("plane", LEFT), "ball": ("sphere", RIGHT)}
    with pytest.raises(InputError, match=r"a \(plane\) and ball \(sphere\).*planes and cylinders"):
        WindowPlan(features, [("angle", "a", "ball")]).check()
    with pytest.raises(InputError, match="did you mean 'ball'"):
        WindowPlan(features, [("distance", "a", "bal")]).check()
    for kind, name in (("angle", "a"), ("distance", "a"), ("distance", "ball")):
        with pytest.raises(InputError, match=f"--{kind}: found {name},{name}; allowed: two different features"):
            WindowPlan(features, [(kind, name, name)]).check()


BALL = sphere([0, 0, 450], 20), plane([0, 0, 470], [0, 0.3, -1])
ROD = cylinder([0, 0, 470], [1, 0.1, 0.05], 15), plane([0, 0, 490], [0, 0.3, -1])
PIN = cylinder([0, 0, 470], [0, 1, 0.2], 15), plane([0, 30, 470], [0, 1, 0.2])


@pytest.mark.parametrize(
    ("shape", "seen", "diameter", "margin"),
    [("sphere", BALL, 40, 0), ("sphere", BALL, 40, 2), ("cylinder", ROD, 30, 0), ("cylinder", PIN, 30, 3)],
)
def test_a_window_about_a_ball_or_a_rod_shows_what_is_behind_it(shape, seen, diameter, margin):
    """Corners of the window made a ball of 50 mm one of 63 mm, and the end of a pin's plate one of 1100 mm."""
    front, behind = seen
    cloud = cloud_of(np.fmin(front, behind), 0.02, np.random.default_rng(1))
    on_it = front < np.where(np.isnan(behind), np.inf, behind)
    rows, columns = np.nonzero(on_it)
    left, top = max(columns.min() - margin, 0), max(rows.min() - margin, 0)
    right, bottom = columns.max() + 1 + margin, rows.max() + 1 + margin
    window = Roi(left, top, min(right, GRID.width) - left, min(bottom, GRID.height) - top)
    assert np.mean(on_it[window.slices]) < 0.95
    found = by_name(measure_windows(cloud, WindowPlan({"it": (shape, window)})))
    value = found["it diameter"]
    assert value.value == pytest.approx(diameter, abs=6 * value.uncertainty)
    assert found["it noise"].value == pytest.approx(0.02, rel=0.2)


@pytest.mark.parametrize("step", [-10.0, -3.0, 3.0, 10.0])
def test_a_step_in_a_third_of_a_window_does_not_turn_the_plane(step):
    """A step of 10 mm turned the plane by 5 deg, with all points on it and a noise of 3 mm for 0.02 mm."""
    low, high = plane([0, 0, 500], [0, 0, -1]), plane([0, 0, 500 + step], [0, 0, -1])
    seen = np.where(np.arange(GRID.width) < 0.3 * GRID.width, high, low)
    found = by_name(measure_windows(cloud_of(seen, 0.02, np.random.default_rng(1)), WindowPlan({"a": ("plane", None)})))
    assert abs(found["a normal x"].value) < 6 * found["a normal x"].uncertainty
    assert found["a noise"].value == pytest.approx(0.02, rel=0.1)


@settings(max_examples=30)
@given(
    lean=st.floats(-0.9, 0.9),
    roll=st.floats(0, np.pi),
    radius=st.floats(8, 60),
    distance=st.floats(350, 700),
    seed=st.integers(0, 1000),
)
def test_a_cylinder_is_found_without_its_nominal_geometry(lean, roll, radius, distance, seed):
    axis = np.array([np.cos(roll) * np.cos(lean), np.sin(roll) * np.cos(lean), np.sin(lean)])
    seen = cloud_of(cylinder([0, 0, distance], axis, radius), 0.05, np.random.default_rng(seed))
    points = seen.points[40:120:2, 50:150:2][seen.valid[40:120:2, 50:150:2]].astype(float)
    fit = fit_cylinder(points, cylinder_start(points), np.zeros(3))
    assert abs(fit.axis @ axis) > np.cos(np.deg2rad(2))
    assert abs(fit.radius - radius) < 6 * np.sqrt(fit.covariance[4, 4]) + 0.01


@pytest.mark.parametrize("scatter", ["along the rays", "before it"])
@pytest.mark.parametrize("shape", ["cylinder", "sphere"])
def test_a_small_arc_among_false_points_has_the_u_of_its_own_points(shape, scatter, rng):
    """Of 40 deg seen, 35 % false points are left out: u is that of the others alone, and covers the radius."""
    off, noise, true, stated, alone = [], 0.2, 20.0, [], []
    for _ in range(6):
        turn = rng.uniform(-np.pi / 9, np.pi / 9, 4000)
        along, roll = rng.uniform(-30, 30, 4000), rng.uniform(0, np.pi, 4000)
        side, depth = true * np.sin(turn), 500 - true * np.cos(turn)
        x, y = (side, along) if shape == "cylinder" else (side * np.cos(roll), side * np.sin(roll))
        points = np.column_stack([x, y, depth])
        rays = points / np.linalg.norm(points, axis=1, keepdims=True)
        false = np.arange(4000) < 1400
        points = points + np.where(false, rng.uniform(-50, 50, 4000), noise * rng.standard_normal(4000))[:, None] * rays
        if scatter == "before it":
            points[false, 2] = rng.uniform(470, 500, 1400)
        fit, without = (fit_shape(chosen, shape, np.zeros(3)) for chosen in (points, points[~false]))
        off.append((fit.radius - true) / np.sqrt(fit.covariance[-1, -1]))
        stated.append(fit.covariance[-1, -1])
        alone.append(without.covariance[-1, -1])
    assert np.mean(stated) == pytest.approx(np.mean(alone), rel=0.45)
    assert np.sqrt(np.mean(np.square(off))) < 2.5


@pytest.mark.parametrize("centre", [(0.0, 0.0, 500.0), (3.0, 2.0, 1.0)])
def test_a_rod_scanned_all_round_keeps_both_sides(centre, rng):
    turn, noise = rng.uniform(0, 2 * np.pi, 4000), rng.normal(0, 0.05, 4000)
    round_it = np.column_stack([(20 + noise) * np.cos(turn), rng.uniform(-30, 30, 4000), (20 + noise) * np.sin(turn)])
    fit = fit_shape(round_it + centre, "cylinder", np.zeros(3))
    assert fit.count > 0.8 * 4000
    assert fit.radius == pytest.approx(20, abs=0.01)
