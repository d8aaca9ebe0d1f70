"""Surfaces drawn out over edges: on images whose answer is known, and on rendered pillars."""

import math

import numpy as np
import pytest

from characterisation.point_cloud import Status
from mitsim.capture.cloud import capture_cloud, sensor_geometry
from mitsim.capture.simulate import SimulatedSensor
from mitsim.predict import Predictor
from mitsim.predict.fattening import ACROSS, AWAY, FIRST_PX, TOWARD, drawn_out
from mitsim.scene.backend import activate, mi
from mitsim.scene.load import scene_from_dict
from mitsim.sensor.frames import look_at
from mitsim.sensor.preset import load_sensor

SLOPE = -0.7  # [mm/px], a face that comes nearer toward the left


def before_a_plate(width=60, height=40, edge=30, far=600.0):
    """A face left of a column, sloped, with a plate behind it."""
    column = np.arange(width)
    distance = np.where(column < edge, 500.0 - SLOPE * (column - edge), far)
    shape = np.where(column < edge, 0, 1)
    return np.tile(distance, (height, 1)), np.tile(shape, (height, 1))


def expected(width=60, edge=30, table=TOWARD):
    out = np.zeros(width)
    for number, delta in enumerate(table):
        out[edge - FIRST_PX - number] = delta * SLOPE
    return out


def test_a_slanted_face_takes_the_depth_of_what_lies_farther_in():
    distance, shape = before_a_plate()
    assert drawn_out(distance, shape) == pytest.approx(np.tile(expected(), (40, 1)))
    left = distance[:, ::-1], shape[:, ::-1]
    assert drawn_out(*left) == pytest.approx(np.tile(expected(table=AWAY)[::-1], (40, 1)))
    assert drawn_out(*left, second_eye=-1) == pytest.approx(np.tile(expected()[::-1], (40, 1)))
    assert drawn_out(distance.T, shape.T) == pytest.approx(np.tile(expected(table=ACROSS), (40, 1)).T)
    assert drawn_out(distance.T, shape.T, epipolar_axis=0) == pytest.approx(np.tile(expected(), (40, 1)).T)


@pytest.mark.parametrize("step", [2, 3, 5])
def test_thinned_grids_have_the_mean_over_what_a_step_covers(step):
    distance, shape = before_a_plate(width=120, edge=60)
    thinned = drawn_out(distance[::step, ::step], shape[::step, ::step], step)[0]
    whole = expected(120, 60)
    # all that lies 4 px and more from the edge: the same in sum, for as many pixels as each ray stands for
    steps = math.ceil((FIRST_PX - 1) / step)
    first = thinned[: 60 // step - steps].sum() * step
    assert first == pytest.approx(whole[: 60 - steps * step].sum())
    assert (thinned <= 0).all()


def test_nothing_is_drawn_out_where_nothing_lies_farther_behind():
    distance, shape = before_a_plate()
    assert not drawn_out(distance, np.where(shape == 1, -1, shape)).any()  # before nothing
    assert not drawn_out(np.where(shape == 1, 502.0, distance), shape).any()  # a step of 2 mm
    assert not drawn_out(np.where(shape == 1, 300.0, distance), shape).any()  # the other is in front
    assert not drawn_out(distance, np.zeros_like(shape)).any()  # one shape: its own folds are left out
    level = np.where(shape == 0, 500.0, distance)
    assert not drawn_out(level, shape).any()  # a face that is met squarely has no depth to take


def test_rendered_pillars_before_a_plate_come_out_as_said():
    """Limbs of pillars 4 to 6 px from the plate behind, means in mm; poses on which nothing was read off."""
    sensor = load_sensor("ensenso-n10")
    activate()
    geometry = sensor_geometry(sensor)
    predictor = Predictor.of_sensor(sensor, geometry)
    simulated = SimulatedSensor(sensor)
    white, rng = {"type": "matt_white"}, np.random.default_rng(11)
    off, said = [], []
    for number in range(12):
        radius = rng.uniform(12, 24)
        plate = mi.ScalarTransform4f().translate([0.0, 0.0, -2.5 * radius]).scale(110.0)
        scene = scene_from_dict({
            "pillar": {"type": "cylinder", "radius": radius, "p0": [0.0, -35, 0], "p1": [0.0, 35, 0], "bsdf": white},
            "plate": {"type": "rectangle", "to_world": plate, "bsdf": white},
        }, sensor.wavelength_nm)  # fmt: skip
        # the pillar across the baseline: edges are met along the epipolar lines
        pose = look_at([rng.uniform(-150, 150), rng.uniform(-150, 150), 460], [0, 0, 0], [rng.uniform(-0.3, 0.3), 1, 0])
        cloud = capture_cloud(simulated.capture(scene, pose, seed=number, samples=16), sensor.settings, geometry)
        surfaces = predictor.surfaces(scene, pose)
        ideal = predictor.ideal(surfaces)
        pillar = scene.names.index("pillar")
        shape = surfaces.shape
        away = np.zeros(shape.shape, bool)
        for reach in (4, 5, 6):
            for turn in (reach, -reach):
                away |= (np.roll(shape, turn, axis=1) != pillar) & (np.roll(shape, turn // reach * 3, axis=1) == pillar)
        labels = predictor.labels(scene, pose, surfaces)
        use = (away & (labels == pillar)).reshape(-1)[ideal.pixel] & (ideal.status == Status.VALID)
        found = cloud.points.reshape(-1, 3)[ideal.pixel].astype(float)
        residual = ((found - predictor.grid.origin) * ideal.ray).sum(1) - ideal.distance
        use &= np.isfinite(residual) & (np.abs(residual) < 4)
        moved = predictor.displaced(scene, pose, ideal)
        off.append(residual[use].mean())
        said.append(moved[use].mean())
    off, said = np.array(off), np.array(said)
    error = (off - said).std(ddof=1) / math.sqrt(len(off))
    assert off.mean() < -0.4  # [mm]
    assert abs((off - said).mean()) < 2.5 * error
    assert 2.5 * error < 0.4 * abs(off.mean())  # or the line above says little
