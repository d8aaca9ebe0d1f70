"""A process prepares a sensor and a coupon once, and never mistakes either for another one."""

import re
import shutil
from dataclasses import replace

import numpy as np
import pytest

from characterisation.files.errors import InputError
from mitsim.capture.simulated import render
from mitsim.maps.campaign.campaign_file import CampaignFile
from mitsim.maps.campaign.orders import order_of, prepared_sensor
from mitsim.maps.campaign.plan import plan_campaign
from mitsim.scene.surface.scatter import Deviation
from mitsim.sensor.sensor_file import MisalignmentTable, RoomTable


def changes(sensor):
    nudged = np.nextafter(sensor.rig.reference.matrix, np.inf)
    camera = replace(sensor.rig.reference, matrix=nudged)
    name = next(iter(sensor.rig.cameras))
    return {
        "smoothing": {"imager": replace(sensor.imager, smoothing_px=0.7)},
        "room": {"room": RoomTable(irradiance_w_mm2=1e-7)},
        "misalignment": {"misalignment": MisalignmentTable(row_mrad=1.0)},
        "notes": {"notes": ("another",)},
        "last digit": {"rig": replace(sensor.rig, cameras={**sensor.rig.cameras, name: camera})},
    }


@pytest.mark.parametrize("change", ["smoothing", "room", "misalignment", "notes", "last digit"])
def test_a_sensor_that_differs_anywhere_is_prepared_anew(n10, change):
    ((key, value),) = changes(n10)[change].items()
    other = replace(n10, **{key: value})
    for prepare in (prepared_sensor, render.simulated_sensor):
        kept, anew = (getattr(prepare(sensor).sensor, key) for sensor in (n10, other))
        assert (kept, anew) == (getattr(n10, key), value) and kept != anew


def test_an_equal_sensor_is_prepared_once(n10):
    prepared = prepared_sensor(n10)
    assert prepared_sensor(replace(n10)) is prepared
    assert render.simulated_sensor(n10) is render.simulated_sensor(replace(n10))


def test_a_worker_loads_a_coupon_again_whose_scene_was_changed(n10, scenes, tmp_path):
    shutil.copytree(scenes / "coupon", tmp_path / "coupon")
    scene = tmp_path / "coupon/coupon.xml"
    text = scene.read_text()
    table = {"distances_mm": [500], "orientations": [{"up_to_deg": 60, "subdivisions": 0}]}
    file = CampaignFile.model_validate({**table, "samples": [{"scene": "coupon.xml"}]})
    orders = []
    for roughness in ("0.37", "0.74"):
        scene.write_text(re.sub(r'(name="Ra" value=)"[0-9.]+"', rf'\1"{roughness}"', text))
        plan = plan_campaign(tmp_path / "coupon/campaign.toml", file, n10)
        orders.append(order_of(plan.shot(plan.series[0], np.array([0.0, 0.0, 1.0])), plan))
        assert str(orders[-1].shot().series.sample.roughness) == roughness
    with pytest.raises(InputError, match="another content"):
        replace(orders[0], recipe=orders[0].recipe.moved(Deviation(alpha=1.0))).shot()
