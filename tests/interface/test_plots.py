"""``plot()`` of captures, clouds, maps, statements and scenes: what is drawn, by the artists in the axes."""

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.colors import to_rgb

import characterisation
import mitsim as ms
from characterisation.plots.clouds import REASONS
from characterisation.plots.labels import round_length
from characterisation.plots.style import VERMILION
from characterisation.point_cloud import PointCloud, Status, ViewGrid
from characterisation.statements.budget import BudgetLine
from characterisation.statements.statement import Statements, statement
from mitsim.capture.capture import Capture


@pytest.fixture
def tilted() -> PointCloud:
    """A plane z = 500 + x / 10 before a pinhole, with a row of saturated and half a row of shadowed pixels."""
    grid = ViewGrid(fx=50, fy=50, cx=19.5, cy=14.5, width=40, height=30)
    rays = grid.rays()
    normal = np.array([0.1, 0, -1]) / np.hypot(0.1, 1)
    points = (rays * (normal @ [0, 0, 500] / (rays @ normal))[..., None]).astype(np.float32)
    status = np.zeros((30, 40), np.uint8)
    status[3], status[7, :20] = Status.SATURATED, Status.SHADOWED
    points[status != 0] = np.nan
    return PointCloud(points, status, grid, sensor="my camera", source="device")


def texts(legend) -> list[str]:
    return [one.get_text() for one in legend.get_texts()]


def test_a_cloud_is_drawn_on_its_pixels_with_the_reasons_of_the_rest(tilted):
    axes = tilted.plot()
    reasons, depth = axes.images
    np.testing.assert_array_equal(depth.get_array().mask, ~tilted.valid)
    np.testing.assert_allclose(depth.get_array().compressed(), tilted.points[tilted.valid][:, 2])
    low, high = depth.get_clim()
    np.testing.assert_allclose((low, high), np.percentile(tilted.points[tilted.valid][:, 2], (2, 98)), rtol=1e-6)
    assert depth.get_extent() == [-0.5, 39.5, 29.5, -0.5] == reasons.get_extent()  # pixel centres at integers
    # the colour that a missing pixel gets is that of its status
    rgba = reasons.to_rgba(reasons.get_array())
    for row, status in ((3, Status.SATURATED), (7, Status.SHADOWED)):
        np.testing.assert_allclose(rgba[row, 0, :3], to_rgb(REASONS[status.name][1]))
    # the most frequent reason first: 40 and 20 of 1200 pixels
    assert texts(axes.get_legend()) == ["saturated: 3.3 %", "in the projector's shadow: 1.7 %"]
    assert axes.get_title() == "my camera, device: 1140 points of 1200 pixels"
    assert axes.child_axes[0].get_ylabel() == "depth z, sensor frame [mm]"


def test_a_complete_cloud_has_no_legend(tilted):
    whole = ViewGrid(fx=50, fy=50, cx=0, cy=0, width=2, height=2)
    cloud = PointCloud(np.full((2, 2, 3), 5, np.float32), np.zeros((2, 2), np.uint8), whole, "one", "device")
    assert cloud.plot().get_legend() is None


def test_residuals_of_the_own_plane_are_nothing_and_of_another_have_a_sign(tilted):
    own = characterisation.fit_plane(tilted.points[tilted.valid], viewpoint=(0, 0, 0))
    shown = tilted.plot(plane=own).images[1]
    assert np.abs(shown.get_array()).max() < 1e-3  # float32 at 500 mm
    low, high = shown.get_clim()
    assert low == -high

    class Nearer:
        point, normal = own.point - 2 * own.normal, own.normal

    axes = tilted.plot(plane=Nearer())
    np.testing.assert_allclose(axes.images[1].get_array().compressed(), 2.0, atol=1e-3)
    assert axes.child_axes[0].get_ylabel() == "distance from the plane [mm]"


def test_axes_of_the_caller_are_used_and_no_state_is_left(tilted):
    before = dict(matplotlib.rcParams)
    _, (left, right) = plt.subplots(1, 2)
    assert tilted.plot(right) is right
    assert len(right.images) == 2 and not left.images
    assert dict(matplotlib.rcParams) == before
    with pytest.raises(ms.InputError, match="plot: ax: found str; allowed: 1 of matplotlib's Axes"):
        tilted.plot("right")
    with pytest.raises(ms.InputError, match="found 2 axes"):
        tilted.plot([left, right])


@pytest.fixture
def bright(workplace) -> Capture:
    """A capture whose left image has 5 % saturated pixels."""
    capture = ms.read_capture("capture")
    left = capture.images["left"].copy()
    left[0, :12] = 255
    return Capture(**{**vars(capture), "images": {**capture.images, "left": left}})


def test_saturated_pixels_are_marked_in_their_own_camera_alone(bright):
    left, right = bright.plot()
    assert (left.get_title(), right.get_title()) == ("left: small, simulated", "right: small, simulated")
    grey, marks = left.images
    np.testing.assert_array_equal(grey.get_array(), bright.images["left"][0])
    np.testing.assert_array_equal(~np.ma.getmaskarray(marks.get_array()), bright.images["left"][0] == 255)
    np.testing.assert_allclose(marks.to_rgba(marks.get_array())[0, 0, :3], to_rgb(VERMILION))
    assert texts(left.get_legend()) == ["saturated, 255 DN: 5.0\N{NO-BREAK SPACE}% of the pixels"]
    assert len(right.images) == 1 and right.get_legend() is None
    assert grey.get_clim() == right.images[0].get_clim()


def test_one_camera_and_one_image_of_several(bright):
    stack = np.stack([bright.images["right"][0], bright.images["right"][0] // 2])
    several = Capture(**{**vars(bright), "images": {"left": stack, "right": stack}})
    (axes,) = several.plot(camera="right", image=-1)
    assert axes.get_title() == "right, image 2 of 2: small, simulated"
    np.testing.assert_array_equal(axes.images[0].get_array(), stack[1])
    with pytest.raises(ms.InputError, match="image: found 2; allowed: 0 to 1"):
        several.plot(image=2)
    with pytest.raises(ms.InputError, match="camera: found 'middle'; allowed: left, right"):
        several.plot(camera="middle")


def test_a_capture_without_images_shows_the_map_of_the_device(bright):
    depth = np.full((240, 320), np.nan, np.float32)
    depth[100:140] = 400
    mapped = Capture(**{**vars(bright), "images": {}, "derived": {"depth": depth}})
    (axes,) = mapped.plot()
    assert axes.images[0].get_array().count() == 40 * 320
    assert axes.child_axes[0].get_ylabel() == "depth [mm]"
    with pytest.raises(ms.InputError, match="at least one image or map"):
        Capture(**{**vars(bright), "images": {}}).plot()


def test_a_map_is_drawn_as_it_is_queried():
    one = ms.performance_map("ensenso-n10")
    of_f, of_sigma = one.plot(finish="aluminium/ground", roughness=0.5, distance=550)
    assert of_f.get_title() == of_sigma.get_title() == "aluminium/ground, Ra 0.5 µm at 550 mm"
    shown, axis = of_f.images[0], one.data["a"].values
    assert shown.get_clim() == (0, 1)
    # the pixel of a node lies at the node: its row is b, its column a
    row, column = len(axis) // 2 + 5, len(axis) // 2 - 9
    left, right, bottom, _ = shown.get_extent()
    step = (right - left) / len(axis)
    np.testing.assert_allclose((left + (column + 0.5) * step, bottom + (row + 0.5) * step), (axis[column], axis[row]))
    normal = characterisation.lambert_projection.inverse_lambert_projection(np.array([[axis[column], axis[row]]]))
    answer = one.query("aluminium/ground", 0.5, 550, normal)
    np.testing.assert_allclose(shown.get_array()[row, column], answer.fraction[0])
    np.testing.assert_allclose(of_sigma.images[0].get_array()[row, column], answer.sigma[0])
    # sigma has one scale for the whole map
    assert of_sigma.images[0].get_clim() == one.plot(finish="matt_white")[1].images[0].get_clim()


def test_a_map_draws_its_first_sample_at_mid_range_and_refuses_what_it_does_not_know():
    one = ms.performance_map("ensenso-n10")
    assert one.plot()[0].get_title() == "aluminium/ground, Ra 0.09 µm at 504 mm"
    assert one.plot(finish="matt_white")[0].get_title() == "matt white at 504 mm"
    for wrong in ({"finish": "gold"}, {"finish": "aluminium/ground", "roughness": 5.0}, {"distance": 3000.0}):
        with pytest.raises(ms.InputError):
            one.plot(**wrong)


def stated() -> Statements:
    rng = np.random.default_rng(1)
    lines = tuple(
        BudgetLine(group, share, 0, 1, share, (0.0, 1.0), group != "pose")
        for group, share in (("noise", 0.7), ("pose", 0.3))
    )
    return Statements(
        [
            statement("distance", "mm", rng.normal(0.1, 0.05, 200), budget=lines),
            statement("angle", "deg", rng.normal(0, 0.3, 200)),
            statement("radius", "mm", rng.normal(0, 0.02, 200), budget=lines[:1]),
            statement("lost", "deg", np.full(5, np.nan)),
        ]
    )


def test_statements_are_rows_of_the_panel_of_their_unit():
    every = stated()
    grid = every.plot()
    assert grid.shape == (2, 2)
    lengths, angles = grid[:, 0]
    assert [label.get_text().splitlines()[0] for label in lengths.get_yticklabels()] == ["distance", "radius"]
    assert [label.get_text().splitlines()[0] for label in angles.get_yticklabels()] == ["angle", "lost"]
    assert lengths.get_xlabel() == "measured − true [mm]" and angles.get_xlabel() == "measured − true [deg]"
    assert [text.get_text() for text in angles.texts] == ["no value"]
    drawn = {tuple(line.get_xdata()) for line in lengths.lines}
    for one in (every[0], every[2]):
        assert one.interval in drawn
        assert (one.bias - one.standard_uncertainty, one.bias + one.standard_uncertainty) in drawn
    top, bottom = lengths.get_ylim()[::-1]
    assert top < 0 < 1 < bottom  # the first measurement is at the top


def test_budgets_add_up_from_left_to_right():
    budget = stated().plot()[0, 1]
    bars = [(round(bar.get_y() + bar.get_height() / 2), bar.get_x(), bar.get_width()) for bar in budget.patches]
    of_distance = sorted((x, width) for y, x, width in bars if y == 0 and width > 0)
    np.testing.assert_allclose(of_distance, [(0, 30), (30, 70)])  # the order of the groups, not of the shares
    np.testing.assert_allclose([(x, w) for y, x, w in bars if y == 1 and w > 0], [(0, 70)])
    (legend,) = budget.figure.legends
    assert texts(legend) == ["place and pose of the part", "noise and speckle"]


def test_a_single_statement_and_axes_of_the_caller():
    every = stated()
    assert every[0].plot().shape == (1, 2)
    assert every[1].plot().shape == (1, 1)  # it has no budget
    _, both = plt.subplots(2)
    assert every.plot(both).shape == (2, 1)
    with pytest.raises(ms.InputError, match="found 1 axes; allowed: 2"):
        every.plot(both[0])
    with pytest.raises(ms.InputError, match="at least one"):
        Statements().plot()


@pytest.fixture
def pillars(workplace):
    return ms.load_scene("two_pillars.xml", ms.load_sensor("small.toml"))


def test_every_visible_shape_has_its_name_at_a_place_on_it(pillars):
    axes = pillars.plot()
    names = [text.get_text() for text in axes.texts if text.get_text() in pillars.names]
    assert sorted(names) == sorted(pillars.names)
    assert axes.get_title() == f"{len(pillars.names)} shapes, from the front and above"
    # the dots are the places that the names stand for: none lies on the background
    image = axes.images[0]
    left, right, bottom, top = image.get_extent()
    rows, columns = image.get_array().shape[:2]
    dots = [line.get_xydata()[0] for line in axes.lines if line.get_marker() == "o"]
    assert len(dots) == len(pillars.names)
    for x, y in dots:
        pixel = image.get_array()[int((y - bottom) / (top - bottom) * rows), int((x - left) / (right - left) * columns)]
        assert pixel[3] == 1
    assert axes.get_xlim()[0] < left and right < axes.get_xlim()[1]


def test_from_above_the_picture_is_the_plan_of_the_part_to_scale(pillars):
    axes = pillars.plot(pose=ms.look_at((0, 0, 500), up=(0, 1, 0)))
    image = axes.images[0]
    shown = image.get_array()[..., 3] > 0
    left, right, _, _ = image.get_extent()
    step = (right - left) / shown.shape[1]
    size = pillars.bounds[1] - pillars.bounds[0]
    np.testing.assert_allclose(shown.any(axis=0).sum() * step, size[0], atol=2 * step)
    np.testing.assert_allclose(shown.any(axis=1).sum() * step, size[1], atol=2 * step)
    # x of the part is to the right, y up
    both = {text.get_text(): text for text in axes.texts}
    (x_right, x_up), (y_right, y_up) = both["x"].get_position(), both["y"].get_position()
    assert x_right > y_right and y_up > x_up
    bar = next(line for line in axes.lines if line.get_linewidth() == 2.2)
    length = float(np.ptp(bar.get_xdata()))
    assert both[f"{length:g} mm"] and length == round_length(length)
    assert axes.get_aspect() == 1


def test_a_pose_that_is_no_motion_is_refused(pillars):
    with pytest.raises(ms.InputError):
        pillars.plot(pose=np.diag([1, 1, -1, 1]))
