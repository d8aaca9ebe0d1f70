"""A feature of a few pixels is predicted from all of its pixels, not from the few of them that a thinned grid has."""

import math

import numpy as np

from characterisation.maps.performance_map import PerformanceMap
from characterisation.tasks.task_file import Task
from mitsim.decoding.cloud import sensor_geometry
from mitsim.maps.prediction import Predictor
from mitsim.maps.use import performance_map
from mitsim.scene.load import load_scene
from mitsim.sensor.preset import load_sensor
from mitsim.views import ViewsTable, candidate_views
from mitsim.views.view_scores import RAYS, score_candidates

RADIUS, CENTRE = 3.0, np.array([31.0, -17.0, 8.0])

SCENE = f"""
<scene version="3.0.0">
    <bsdf type="matt_white" id="white"/>
    <shape type="rectangle" id="plate">
        <transform name="to_world"><scale x="90" y="60"/></transform><ref id="white"/>
    </shape>
    <shape type="sphere" id="ball">
        <point name="center" x="{CENTRE[0]}" y="{CENTRE[1]}" z="{CENTRE[2]}"/>
        <float name="radius" value="{RADIUS}"/><ref id="white"/>
    </shape>
</scene>"""

TASK = Task.model_validate(
    {
        "features": {"ball": {"kind": "sphere", "point_mm": CENTRE.tolist(), "radius_mm": RADIUS}},
        "measurements": {"radius": {"kind": "radius", "features": ["ball"], "nominal": RADIUS, "unit": "mm"}},
    }
)


def test_a_ball_of_a_few_hundred_pixels_is_predicted_from_all_of_them(tmp_path):
    """Points and u of the radius from each view, against least squares over every pixel of the sensor.

    Before, every eighth pixel of every eighth row gave 2 to 7 rays of the ball: u was up to a hundred times as large.
    """
    sensor = load_sensor("photoneo-phoxi-s")
    data = performance_map(sensor.name).data.drop_vars(["noise_area", "persistent_share", "bias_share"])
    independent = PerformanceMap(data)
    (tmp_path / "ball.xml").write_text(SCENE)
    scene = load_scene(tmp_path / "ball.xml", sensor.wavelength_nm)
    predictor = Predictor.of_sensor(sensor, sensor_geometry(sensor))
    assert predictor.thinned_to(RAYS).step == 8
    table = ViewsTable(subdivisions=0, rolls_deg=[0.0, 50.0], lowest_elevation_deg=20)
    views = candidate_views(table, sensor, [440.0], np.zeros(3), np.zeros((0, 3, 3))).views
    scores, _ = score_candidates(scene, TASK, views, predictor, independent, 100)
    truth = [least_squares(sensor, predictor, independent, view.world_from_sensor) for view in views]
    count, u = np.transpose(truth)
    assert count.min() > 100 and len(views) == 12
    np.testing.assert_allclose(scores["n"].sel(feature="ball"), count, rtol=0.01)
    np.testing.assert_allclose(scores["predicted_uncertainty"].sel(measurement="radius"), u, rtol=0.02)
    np.testing.assert_array_equal(scores["uncertainty_rank"].values[0].argsort(), u.argsort())


def least_squares(sensor, predictor, independent, pose):
    """Return the expected points of the ball, and the standard uncertainty of its radius, from every pixel."""
    grid, rig = predictor.grid, sensor.measuring_rig
    centre, rays = pose.inverse().points(CENTRE) - grid.origin, grid.rays()
    along = rays @ centre
    inside = along**2 - centre @ centre + RADIUS**2
    hit, margin = inside > 0, predictor.edge_margin_px
    row, column = np.nonzero(hit)
    within = np.ones(len(row), bool)
    for down in range(-margin, margin + 1):
        for right in range(-margin, margin + 1):
            within &= hit[row + down, column + right]
    row, column = row[within], column[within]
    ray, distance = rays[row, column], along[row, column] - np.sqrt(inside[row, column])
    normal = (ray * distance[:, None] - centre) / RADIUS
    to_light = rig.projector.centre - grid.origin - ray * distance[:, None]
    lit = (normal * to_light).sum(1) > 0  # a ball shades nothing of itself but its back
    ray, distance, normal = ray[lit], distance[lit], normal[lit]
    x = rig.baseline_direction - ray * (ray @ rig.baseline_direction)[:, None]
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    frame = np.stack([x, np.cross(-ray, x), -ray], axis=1)
    answer = independent.query("matt_white", math.nan, distance, np.einsum("nij,nj->ni", frame, normal))
    known = np.isfinite(answer.fraction) & np.isfinite(answer.sigma) & (answer.fraction > 0)
    share, sigma = answer.fraction[known], answer.sigma[known]
    cosine = -(ray * normal).sum(1)[known]
    g = np.column_stack([normal[known], np.ones(known.sum())]) / cosine[:, None]
    inverse = np.linalg.inv((g * share[:, None]).T @ g)
    covariance = inverse @ (g * (share * sigma**2)[:, None]).T @ g @ inverse
    return share.sum(), math.sqrt(covariance[3, 3])
