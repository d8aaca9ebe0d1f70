"""The picture of the part with its sensor: what hides what, colours of verdicts, labels that do not touch."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from characterisation.plots.labels import cut, spread
from characterisation.plots.part_pictures import depth_buffer
from mitsim.report.placement_figure import draw_placement, face_verdicts, placement_figure
from mitsim.study.scene_geometry import SceneGeometry, read_scene_geometry
from tests.report.conftest import write_scene_geometry


def test_the_nearer_triangle_hides_the_farther():
    square = np.array([[[0, 0], [9, 0], [0, 9]], [[0, 0], [9, 0], [0, 9]]], float)
    index, depth = depth_buffer(square, np.array([[1.0, 1, 1], [0.0, 3, 0]]), (10, 10))
    assert index[0, 0] == 0 and index[0, 8] == 1 and index[9, 9] == -1
    assert depth[0, 6] == pytest.approx(2.0)  # 3 x 6 / 9, over the 1 of the other


def test_a_face_has_the_worst_verdict_that_rests_on_it():
    found = face_verdicts({"a": (["plane", "pin"], "fits"), "b": (["pin"], "undecidable"), "c": (["pin"], "fits")})
    assert found == {"plane": "fits", "pin": "undecidable"}


@pytest.mark.parametrize("azimuth_deg", [-126, -54, 54])
def test_the_picture_shows_a_measured_face_that_the_sensor_sees_at_a_slant(azimuth_deg):
    """From one side of the sensor the measured front of a wall was hidden by the wall itself."""
    wall = trimesh.creation.box((80, 8, 50))
    sensor_side = -1 if azimuth_deg < 0 else 1
    geometry = SceneGeometry(
        corners=wall.triangles,
        names=("rest", "front"),
        shape=(wall.face_normals[:, 1] * sensor_side > 0.5).astype(int),
        centres=np.zeros((2, 3)),
        rays=np.array([[[-0.3, -0.2, 0.93], [0.3, -0.2, 0.93], [0.3, 0.2, 0.93], [-0.3, 0.2, 0.93]]] * 2),
        reach=(400.0, 700.0),
    )
    c, s = np.cos(np.radians(azimuth_deg)), np.sin(np.radians(azimuth_deg))
    pose = np.eye(4)
    pose[:3] = [[-s, 0, -c, 600 * c], [c, 0, -s, 600 * s], [0, -1, 0, 0]]
    figure = placement_figure(geometry, [("view 1", pose)], {"front": "fits"})
    red, green, _, shown = np.moveaxis(np.asarray(figure.axes[1].images[0].get_array()), -1, 0)
    assert (green > red + 0.1).sum() > 0.5 * (shown > 0).sum()


def test_labels_stand_apart_and_are_moved_least():
    wanted = [0.0, 0.1, 5.0, 5.2, 5.3]
    heights = spread(wanted, 1.0)
    assert np.diff(heights).min() >= 1.0 - 1e-12
    assert heights[:2] == pytest.approx([-0.45, 0.55]) and np.mean(heights[2:]) == pytest.approx(np.mean(wanted[2:]))
    assert spread([1.0, 3.0], 1.0) == [1.0, 3.0]


@pytest.mark.parametrize("stacked", [False, True])
@pytest.mark.parametrize(("height", "name"), [(1.0, "{}"), (4.0, "bore_24mm_front_right_{}")])
def test_no_writing_of_the_picture_overlaps_other_writing_or_leaves_it(tmp_path, height, name, stacked):
    write_scene_geometry(tmp_path)
    geometry = read_scene_geometry(tmp_path)
    names = tuple(name.format(one) for one in geometry.names)
    geometry = replace(geometry, corners=geometry.corners * [1, 1, height], names=names)
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[2, 3] = 500.0
    aside = pose @ np.array([[1, 0, 0, -300.0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    poses = [("view 3", pose), ("view 1234", aside)]
    geometry = replace(geometry, camera="left camera")
    figure = placement_figure(geometry, poses, dict.fromkeys(geometry.names, "no tolerance"), stacked)
    drawn = FigureCanvasAgg(figure).get_renderer()
    FigureCanvasAgg(figure).draw()
    texts = [one for axes in figure.axes for one in axes.texts] + list(figure.legends[0].get_texts())
    boxes = [one.get_window_extent(drawn) for one in texts if one.get_text()]
    assert len(boxes) >= 6
    inside = figure.bbox.padded(0.5)
    assert all(inside.x0 <= one.x0 and one.x1 <= inside.x1 for one in boxes), boxes
    assert all(inside.y0 <= one.y0 and one.y1 <= inside.y1 for one in boxes), boxes
    assert not [(a, b) for k, a in enumerate(boxes) for b in boxes[:k] if a.overlaps(b)]


@pytest.mark.parametrize("stacked", [False, True])
@pytest.mark.parametrize("elevation_deg", [20, 58, 75])
def test_the_name_of_a_view_lies_within_the_picture(tmp_path, elevation_deg, stacked):
    """It is above the sensor, at the top of the picture, where it was cut in half in narrow windows."""
    write_scene_geometry(tmp_path)
    c, s = np.cos(np.radians(elevation_deg)), np.sin(np.radians(elevation_deg))
    pose = np.eye(4)
    pose[:3] = [[-1, 0, 0, 0], [0, s, -c, 620 * c], [0, -c, -s, 620 * s]]
    figure = placement_figure(read_scene_geometry(tmp_path), [("view 28", pose)], {}, stacked)
    drawn = FigureCanvasAgg(figure).get_renderer()
    (box,) = (one.get_window_extent(drawn) for one in figure.axes[0].texts)
    assert box.y1 <= figure.bbox.y1 and box.x0 >= 0


@pytest.mark.parametrize("height", [1.3, 1.58, 3.4])
def test_the_legend_of_a_small_picture_touches_no_part_of_it(tmp_path, height):
    """On a sheet of many rows the picture is 1.3 in high, and its legend lay over the part and its sensor."""
    write_scene_geometry(tmp_path)
    geometry = read_scene_geometry(tmp_path)
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[2, 3] = 500.0
    figure = Figure((7.27, height))
    draw_placement(figure, geometry, [("view 3", pose)], dict.fromkeys(geometry.names, "fits"))
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    legend = figure.legends[0].get_window_extent(canvas.get_renderer())
    boxes = [
        one.get_window_extent(canvas.get_renderer())
        for axes in figure.axes
        for one in (*axes.images, *axes.lines, *axes.patches, *axes.texts)
    ]
    assert len(boxes) > 10 and min(box.y0 for box in boxes) >= legend.y1


def test_the_axes_of_the_part_keep_their_size_in_a_low_picture(tmp_path):
    """On a full sheet the heads of x and y ran into one another, beside names that overlapped."""
    write_scene_geometry(tmp_path)
    geometry = read_scene_geometry(tmp_path)
    pose, spreads = np.diag([1.0, -1.0, -1.0, 1.0]), []
    pose[2, 3] = 500.0
    for height in (1.4, 3.4):
        figure = Figure((7.27, height))
        draw_placement(figure, geometry, [("view 3", pose)], dict.fromkeys(geometry.names, "fits"))
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        names = [one for axes in figure.axes for one in axes.texts if one.get_text() in "xyz" and one.get_text()]
        boxes = [one.get_window_extent(canvas.get_renderer()) for one in names]
        spreads.append([box.x0 - boxes[0].x0 for box in boxes] + [box.y0 - boxes[0].y0 for box in boxes])
    assert len(names) == 3 and np.abs(np.subtract(*spreads)).max() < 1.0
    assert max(spreads[0]) - min(spreads[0]) > 15


def test_of_many_triangles_each_pixel_shows_the_nearest():
    rng = np.random.default_rng(7)
    corners = rng.uniform(-5, [35, 25], (60, 1, 2)) + rng.normal(0, 6, (60, 3, 2))
    depth = rng.normal(size=(60, 1)) + np.zeros((60, 3))
    index, nearest = depth_buffer(corners, depth, (30, 20))
    for y in range(20):
        for x in range(30):
            edges = np.roll(corners, -1, axis=1) - corners
            to = [x, y] - corners
            sides = edges[..., 0] * to[..., 1] - edges[..., 1] * to[..., 0]
            inside = (sides >= 0).all(axis=1) | (sides <= 0).all(axis=1)
            expected = int(np.argmax(np.where(inside, depth[:, 0], -np.inf))) if inside.any() else -1
            assert index[y, x] == expected
            assert nearest[y, x] == pytest.approx(depth[expected, 0] if inside.any() else -np.inf)


def test_long_names_keep_the_ends_that_tell_them_apart():
    names = ["bore_35mm_front_left", "bore_35mm_front_right", "bore_35mm_back_left", "bore_35mm_back_right", "top"]
    short = [cut(name, 16) for name in names]
    assert len(set(short)) == len(names) and max(map(len, short)) == 16 and short[-1] == "top"
    assert cut("chamfer_30deg_bottom_front_3", 16) == "chamfer_…front_3"
