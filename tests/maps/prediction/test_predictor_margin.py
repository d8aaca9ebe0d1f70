"""How near to an edge a pixel may be to belong to a feature, and the pixels of a region."""

import numpy as np
import pytest

from characterisation.point_cloud import Status
from characterisation.region_of_interest import Roi
from mitsim.decoding.cloud import sensor_geometry
from mitsim.maps.prediction import EDGE_MARGIN_PX, CharacterisedScene, Predictor
from mitsim.maps.use import performance_map
from mitsim.scene.load import load_scene
from mitsim.scene.ray_casting.raycast import PixelRays, shapes_met
from mitsim.sensor.preset import load_sensor
from mitsim.sensor.transforms import look_at
from mitsim.views.view_scores import MATT_WHITE


@pytest.mark.parametrize("name", ["ensenso-n10", "realsense-d435"])
def test_no_block_of_a_pixel_that_belongs_to_a_feature_sees_another(scenes, name):
    sensor = load_sensor(name)
    predictor = Predictor.of_sensor(sensor, sensor_geometry(sensor))
    scene = load_scene(scenes / "two_pillars/two_pillars.xml", sensor.wavelength_nm)
    pose = look_at([0, -400, 300], [0, 0, 20], [0, 0, 1])
    surfaces = predictor.surfaces(scene, pose)
    labels = predictor.labels(scene, pose, surfaces)
    reach = sensor.settings.block_size // 2
    assert predictor.edge_margin_px == max(EDGE_MARGIN_PX, reach + 1)
    height, width = labels.shape
    row, column = np.nonzero(labels >= 0)
    inside = (row >= reach) & (column >= reach) & (row < height - reach) & (column < width - reach)
    row, column = row[inside], column[inside]
    assert len(row) > 500  # enough to tell
    for down in range(-reach, reach + 1):
        for right in range(-reach, reach + 1):
            assert (surfaces.shape[row + down, column + right] == labels[row, column]).all()


def test_a_thinned_grid_looks_up_the_pixels_that_its_own_rays_see(scenes):
    sensor = load_sensor("zivid-2-m70")
    scene = load_scene(scenes / "two_pillars/sprayed_pillars.xml", sensor.wavelength_nm).only("plane")
    characterised = CharacterisedScene(scene, performance_map("zivid-2-m70"), MATT_WHITE)
    thinned = Predictor.of_sensor(sensor, sensor_geometry(sensor)).thinned(7)
    pose = look_at([0, -277, 585], [0, 0, 0], [0, 0, 1])
    ideal = thinned.ideal(thinned.surfaces(scene, pose))
    assert not thinned.seen.all()  # the reference camera lacks some pixels of the grid
    seen = thinned.look_up(characterised, pose).seen
    assert (seen.status == Status.VALID).sum() == (ideal.status == Status.VALID).sum() > 1000


@pytest.mark.parametrize("step", [1, 3])
@pytest.mark.parametrize("target", [[0, 0, 20], [90, 40, 20]])
def test_labels_of_decoded_points_are_those_of_the_whole_image(scenes, target, step):
    """Also where the part reaches beyond the image."""
    sensor = load_sensor("ensenso-n10")
    predictor = Predictor.of_sensor(sensor, sensor_geometry(sensor))
    predictor = predictor if step == 1 else predictor.thinned(step)
    scene = load_scene(scenes / "two_pillars/two_pillars.xml", sensor.wavelength_nm)
    pose = look_at([0, -300, 200], target, [0, 0, 1])
    labels = predictor.quick_labels(scene, pose)
    assert (labels >= 0).any(axis=1).sum() > 50 and (labels < 0).mean() > 0.2
    np.testing.assert_array_equal(labels, predictor.labels(scene, pose, predictor.surfaces(scene, pose)))


def test_rays_of_a_region_meet_what_they_meet_in_the_whole_image(scenes):
    sensor = load_sensor("ensenso-n10")
    scene = load_scene(scenes / "two_pillars/two_pillars.xml", sensor.wavelength_nm)
    rays, roi = PixelRays.of_camera(next(iter(sensor.rig.cameras.values()))), Roi(301, 172, 113, 87)
    pose = look_at([0, -400, 300], [0, 0, 20], [0, 0, 1])
    whole = shapes_met(scene, rays, pose)[roi.slices]
    assert len(np.unique(whole)) > 2
    np.testing.assert_array_equal(shapes_met(scene, rays.within(roi), pose), whole)
