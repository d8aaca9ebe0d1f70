"""Clouds from one kernel against the same from the ray-cast truth and the map's own answers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import maximum_filter, minimum_filter

from characterisation.files.errors import InputError
from characterisation.maps.performance_map import PerformanceMap
from characterisation.maps.shipped import shipped_maps
from characterisation.point_cloud import Status
from mitsim.decoding.cloud import sensor_geometry
from mitsim.maps.prediction import CharacterisedScene, Predictor, performance
from mitsim.scene.load import Scene, load_scene, scene_from_dict
from mitsim.sensor.preset import load_sensor
from mitsim.sensor.transforms import look_at

POSES = (
    look_at([0, -400, 300], [0, 0, 20], [0, 0, 1]),
    look_at([150, -350, 300], [40, 0, 20], [0, 0, 1], 35),
    look_at([60, -120, 90], [0, 0, 20], [0, 0, 1]),
    look_at([-500, 300, 420], [-260, 60, 0], [0, 0, 1]),
)


def map_of(name: str) -> PerformanceMap:
    return PerformanceMap.load(shipped_maps()[name])


@pytest.fixture(scope="module")
def predictors() -> dict[str, Predictor]:
    out = {}
    for name in ("ensenso-n10", "kinect-v2"):
        sensor = load_sensor(name)
        out[name] = Predictor.of_sensor(sensor, sensor_geometry(sensor))
    return out


@pytest.fixture(scope="module")
def part(scenes: Path) -> Scene:
    return load_scene(scenes / "two_pillars/two_pillars.xml", 850)


@pytest.fixture(scope="module")
def pieces() -> Scene:
    """One-sided faces, turned away and toward, a ball, and a face whose finish nobody knows, over a large plate."""
    from mitsim.scene.backend import mi

    at = mi.ScalarTransform4f()
    matt = {"type": "matt_white"}
    one_sided = {"type": "diffuse"}
    return scene_from_dict(
        {
            "plate": {"type": "rectangle", "to_world": at.scale([600, 500, 1]), "bsdf": matt},
            "ball": {"type": "sphere", "radius": 45.0, "center": [60, 20, 60], "bsdf": matt},
            "roof": {
                "type": "rectangle",
                "bsdf": matt,
                "to_world": at.translate([-80, 0, 90]).rotate([0, 1, 0], 40).scale([40, 60, 1]),
            },
            "away": {
                "type": "rectangle",
                "bsdf": one_sided,
                "to_world": at.translate([0, -120, 40]).rotate([1, 0, 0], 200).scale([30, 30, 1]),
            },
            "stock": {"type": "disk", "bsdf": one_sided, "to_world": at.translate([0, 120, 40]).scale(50)},
        },
        850,
    )


@pytest.mark.parametrize("number", range(len(POSES)))
@pytest.mark.parametrize(
    ("sensor", "what"), [("ensenso-n10", "part"), ("ensenso-n10", "pieces"), ("kinect-v2", "part")]
)
def test_a_view_from_one_kernel_is_that_of_the_reference(predictors, sensor, what, number, request):
    predictor, scene, pose = predictors[sensor], request.getfixturevalue(what), POSES[number]
    performance_map = map_of(sensor)
    surfaces = predictor.surfaces(scene, pose)
    ideal = predictor.ideal(surfaces)
    expected = performance(ideal, scene, performance_map)
    predicted = predictor.look_up(CharacterisedScene(scene, performance_map), pose, normals=True)
    seen, size = predicted.seen, predictor.seen.shape

    def whole(image: np.ndarray, missing: float) -> np.ndarray:
        out = np.full(size, missing, image.dtype)
        out[seen.roi.slices] = image
        return out.reshape(-1)

    status = np.full(size, Status.NO_SURFACE, np.uint8)
    status.reshape(-1)[ideal.pixel] = ideal.status
    assert np.array_equal(whole(seen.status, Status.NO_SURFACE), status.reshape(-1))
    assert np.array_equal(whole(seen.shape, -1), surfaces.shape.reshape(-1))
    assert np.array_equal(predicted.labels, predictor.labels(scene, pose, surfaces))
    valid = ideal.status == Status.VALID
    at = ideal.pixel[valid]
    if len(at):
        assert np.allclose(whole(seen.distance, np.nan)[at], ideal.distance[valid], rtol=1e-6)
        normal = np.stack([whole(one, np.nan)[at] for one in seen.normal], axis=-1)
        assert np.abs(normal - ideal.normal[valid]).max() < 1e-5
    for got, reference, absolute in zip((seen.fraction, seen.sigma), expected, (1e-5, 0.0), strict=True):
        got, reference = whole(got, np.nan)[at], reference[valid]
        assert np.array_equal(np.isnan(got), np.isnan(reference))
        assert np.allclose(got, reference, rtol=2e-5, atol=absolute, equal_nan=True)


@pytest.mark.parametrize("sensor", ["ensenso-n10", "kinect-v2"])
@pytest.mark.parametrize("number", range(len(POSES)))
def test_a_window_has_every_pixel_that_shows_a_shape_alone(predictors, part, sensor, number):
    predictor, alone = predictors[sensor], part.only("pillar1")
    predicted = predictor.look_up(CharacterisedScene(alone, map_of(sensor)), POSES[number])
    met = predictor.surfaces(alone, POSES[number]).shape
    window = predicted.seen.roi
    assert window.width * window.height < (1.0 if number == 2 else 0.2) * met.size
    out = np.full(met.shape, -1)
    out[window.slices] = predicted.seen.shape
    assert np.array_equal(out, met)
    assert number == 3 or (met >= 0).sum() > 1000


def test_of_these_views_some_show_what_others_do_not(predictors, part, pieces):
    """The comparison above is of something: every status, and points that the map does not know."""
    predictor, performance_map = predictors["ensenso-n10"], map_of("ensenso-n10")
    found, known = set(), []
    for scene in (part, pieces):
        characterised = CharacterisedScene(scene, performance_map)
        for pose in POSES:
            seen = predictor.look_up(characterised, pose).seen
            found |= set(np.unique(seen.status).tolist())
            known += [np.isfinite(seen.sigma).sum(), ((seen.status == Status.VALID) & np.isnan(seen.sigma)).sum()]
    assert found == {Status.VALID, Status.NO_SURFACE, Status.HIDDEN, Status.SHADOWED}
    assert sum(known[::2]) > 100_000
    assert sum(known[1::2]) > 10_000


def test_noise_and_loss_of_the_fast_way_are_those_of_the_map(predictors, part):
    predictor, performance_map = predictors["ensenso-n10"], map_of("ensenso-n10")
    characterised = CharacterisedScene(part, performance_map)
    surfaces = predictor.surfaces(part, POSES[0])
    ideal = predictor.ideal(surfaces)
    fraction, sigma = (values.ravel() for values in performance(ideal, part, performance_map))
    cloud = predictor.predict(characterised, POSES[0], np.random.default_rng(5))
    assert cloud.source == "predicted"
    assert np.array_equal(cloud.valid, cloud.status == Status.VALID)
    valid = cloud.valid.ravel()[ideal.pixel]
    # each point is a draw with its own F
    expected, variance = np.nansum(fraction), np.nansum(fraction * (1 - fraction))
    assert abs(valid.sum() - expected) < 4 * np.sqrt(variance)
    error = np.linalg.norm(cloud.points.reshape(-1, 3)[ideal.pixel[valid]], axis=1) - ideal.distance[valid]
    score = error / sigma[valid]
    assert abs(score.mean()) < 4 / np.sqrt(valid.sum())
    assert abs(score.std() - 1) < 4 / np.sqrt(2 * valid.sum())
    assert np.allclose(cloud.sigma.ravel()[ideal.pixel[valid]], sigma[valid], rtol=2e-5)
    again = predictor.predict(characterised, POSES[0], np.random.default_rng(5))
    assert np.array_equal(again.points, cloud.points, equal_nan=True)


def test_a_face_that_the_map_does_not_know_is_told_where_it_is_seen(predictors, scenes):
    predictor, performance_map = predictors["ensenso-n10"], map_of("ensenso-n10")
    rough_plate = load_scene(scenes / "two_pillars/two_pillars.xml", 850, {"plane_Ra": "9"})
    characterised = CharacterisedScene(rough_plate, performance_map)
    with pytest.raises(InputError, match="9 um"):
        predictor.look_up(characterised, POSES[0])
    aside = look_at([0, -400, 300], [0, -4000, 300], [0, 0, 1])
    assert not np.isfinite(predictor.look_up(characterised, aside).seen.fraction).any()


@pytest.mark.parametrize("margin", [1, 3, 5, 8])
def test_labels_keep_away_from_edges_as_a_square_of_the_margin_does(predictors, part, margin):
    predictor = predictors["ensenso-n10"]
    own = Predictor(predictor.rig, predictor.grid, predictor.seen, predictor.sensor, margin)
    surfaces = own.surfaces(part, POSES[2])
    alike = _alike(surfaces.shape, margin)
    labels = own.labels(part, POSES[2], surfaces)
    assert np.array_equal(labels, np.where(alike, surfaces.shape, -1))
    assert 0 < (labels >= 0).sum() < (surfaces.shape >= 0).sum()


@pytest.mark.parametrize(("margin", "step"), [(3, 7), (3, 2), (5, 4), (8, 4)])
@pytest.mark.parametrize("number", range(len(POSES)))
def test_labels_of_a_thinned_grid_are_those_of_all_its_pixels(predictors, part, number, margin, step):
    """Of a square's border eight pixels are looked at, so that a corner of another shape may be missed."""
    predictor, pose = predictors["ensenso-n10"], POSES[number]
    every = Predictor(predictor.rig, predictor.grid, predictor.seen, predictor.sensor, margin)
    few, first = every.thinned(step), step // 2
    expected = every.labels(part, pose, every.surfaces(part, pose))[first::step, first::step]
    surfaces = few.surfaces(part, pose)
    labels = few.labels(part, pose, surfaces)
    assert (labels != expected).sum() <= 2e-3 * (expected >= 0).sum()
    assert ((labels == surfaces.shape) | (labels < 0)).all()
    beside = (labels >= 0) & ~_alike(surfaces.shape, 1)
    assert (beside.sum() > 20) == (margin < step)  # found by looking again: 7 px from an edge 3 px are kept
    characterised = CharacterisedScene(part, map_of("ensenso-n10"))
    assert np.array_equal(few.look_up(characterised, pose).labels, labels)


def _alike(shape: np.ndarray, margin: int) -> np.ndarray:
    size = 2 * margin + 1
    return np.asarray(minimum_filter(shape, size) == maximum_filter(shape, size))
