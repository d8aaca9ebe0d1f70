"""Where the code of what a face mirrors is met: by the projector's own model, with surfaces met in closed form."""

import numpy as np
import pytest

from mitsim.capture.cloud import sensor_geometry
from mitsim.predict import Predictor
from mitsim.predict.mirrored_code import FINER, FOUND, LEAST_SCATTERED, SCATTERED, Mirrored, mirrored_code, read_off
from mitsim.scene.backend import activate
from mitsim.scene.load import scene_from_dict
from mitsim.sensor.frames import look_at
from mitsim.sensor.preset import load_sensor

WALL = 40.0
WHITE = {"type": "matt_white"}


@pytest.fixture(scope="module")
def corner():
    """A floor z = 0 and a wall y = 40 mm seen by a fringe projector: sensor, predictor, points, their depths s'."""
    activate()
    from mitsim.scene.backend import mi

    sensor = load_sensor("david-sls-3")
    predictor = Predictor.of_sensor(sensor, sensor_geometry(sensor)).thinned_to(20_000)[0]
    place = mi.ScalarTransform4f().look_at([0, WALL, 0], [0, 0, 0], [0, 0, 1]) @ mi.ScalarTransform4f().scale(500)
    scene = scene_from_dict(
        {"floor": {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(500), "bsdf": WHITE},
         "wall": {"type": "rectangle", "to_world": place, "bsdf": WHITE}}, sensor.wavelength_nm,
    )  # fmt: skip
    pose = look_at([60, -400, 300], [0, 0, 0], [0, 0, 1], 30)
    whole = predictor.surfaces(scene, pose)
    ideal = predictor.ideal(whole)
    found = mirrored_code(predictor, predictor.footprint.second, scene, pose, whole, ideal)
    assert found.finer == pytest.approx(1)
    return sensor, scene, pose, ideal, found.depth


@pytest.mark.parametrize(("name", "across", "at", "along"), [("floor", 2, WALL, 1), ("wall", 1, 0.0, 2)])
def test_a_point_has_the_column_of_what_it_mirrors(corner, name, across, at, along):
    sensor, scene, pose, ideal, depth = corner
    mine = (ideal.shape == scene.names.index(name)) & np.isfinite(depth)
    assert mine.sum() > 500
    point, ray = pose.points(ideal.point[mine]), ideal.ray[mine] @ pose.rotation.T
    mirrored = ray * np.where(np.arange(3) == across, -1, 1)
    other = point + ((at - point[:, along]) / mirrored[:, along])[:, None] * mirrored
    moved = point + depth[mine][:, None] * ray
    back = pose.inverse()
    optics = sensor.projector.optics
    column = [optics.project(back.points(where))[:, 0] for where in (moved, other)]
    assert column[0] == pytest.approx(column[1], abs=0.01)  # px; normals are single precision
    assert np.abs(depth[mine]).max() > 10


def test_nothing_is_met_where_nothing_is_mirrored(corner):
    _, scene, pose, ideal, depth = corner
    point, ray = pose.points(ideal.point), ideal.ray @ pose.rotation.T
    # from the floor mirrored away from the wall
    away = (ideal.shape == scene.names.index("floor")) & (ray[:, 1] < 0)
    assert np.isnan(depth[away]).all()
    assert np.isfinite(depth[(ideal.shape == scene.names.index("wall")) & (np.abs(point).max(axis=1) < 100)]).all()


def test_the_stronger_code_wins_and_only_where_there_is_another():
    kept, fraction = np.array([1.0, 0.5, 0.3, 0.3, 0.0]), np.array([1.0, 1.0, 1.0, 1.0, 0.9])
    mirrored = Mirrored(np.array([-20.0, -20.0, -20.0, np.nan, 30.0]), np.ones(5))
    found = read_off(mirrored, np.full(5, 0.2), kept, fraction)
    assert found.kept == pytest.approx([1.0, 0.5, 0, 0.3, 0])
    assert found.blinded == pytest.approx([0, 0, 0.7 * FOUND, 0, FOUND])
    assert found.displaced == pytest.approx([0.2, 0.2, -20, 0.2, 30])
    scattered = np.hypot(SCATTERED * np.array([20.0, 30.0]), LEAST_SCATTERED)
    assert found.scattered == pytest.approx([0, 0, scattered[0], 0, scattered[1]])


def test_a_smooth_plate_shows_a_code_though_the_map_says_that_nothing_comes_back():
    """And a pillar does so only as far as points of it come back at all."""
    fraction, finer = np.array([0.0, 0.0, np.nan, 0.4]), np.array([1.0, 2 * FINER, 1.0, 2 * FINER])
    found = read_off(Mirrored(np.full(4, 5.0), finer), np.zeros(4), np.full(4, 0.2), fraction)
    assert found.blinded == pytest.approx([0.8 * FOUND, 0, 0.8 * FOUND, 0.8 * FOUND * 0.4])
    assert found.displaced == pytest.approx([5, 0, 5, 5])


def test_a_pillar_shows_smaller_what_it_mirrors():
    """A cylinder of radius r before a wall at the length L: a plane mirror's image, divided by 1 + 2 kappa L / cos."""
    activate()
    from mitsim.scene.backend import mi

    sensor = load_sensor("david-sls-3")
    predictor = Predictor.of_sensor(sensor, sensor_geometry(sensor)).thinned_to(20_000)[0]
    at = mi.ScalarTransform4f()
    scene = scene_from_dict(
        {"pillar": {"type": "cylinder", "radius": 20.0, "p0": [0, -100, 0], "p1": [0, 100, 0], "bsdf": WHITE},
         "wall": {"type": "rectangle", "bsdf": WHITE,
                  "to_world": at.look_at([80, 0, 0], [0, 0, 0], [0, 1, 0]) @ at.scale(500)}}, sensor.wavelength_nm,
    )  # fmt: skip
    pose = look_at([0, 0, 500], [0, 0, 0], [0, 1, 0])
    whole = predictor.surfaces(scene, pose)
    ideal = predictor.ideal(whole)
    found = mirrored_code(predictor, predictor.footprint.second, scene, pose, whole, ideal)
    mine = (ideal.shape == scene.names.index("pillar")) & np.isfinite(found.depth)
    assert mine.sum() > 50
    point, ray = pose.points(ideal.point[mine]), ideal.ray[mine] @ pose.rotation.T
    normal = point * [1, 0, 1] / 20
    cosine = -(ray * normal).sum(axis=1)
    turned = ray + 2 * cosine[:, None] * normal
    length = (80 - point[:, 0]) / turned[:, 0]
    middle = np.abs(point[:, 1]) < 20  # where the plane of incidence is across the axis
    assert found.finer[mine][middle] == pytest.approx((1 + 2 * length / (20 * cosine))[middle], rel=0.02)
