"""How near to an edge a pixel may be to belong to a feature."""

import numpy as np
import pytest

from mitsim.decoding.cloud import sensor_geometry
from mitsim.maps.prediction import EDGE_MARGIN_PX, Predictor
from mitsim.scene.load import load_scene
from mitsim.sensor.preset import load_sensor
from mitsim.sensor.transforms import look_at


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
