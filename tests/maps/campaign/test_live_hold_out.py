"""A map held against captures of a live sensor: the shipped map of the simulated N10, and an emulated N10."""

import tomllib

import numpy as np
import pytest

from characterisation.files.documents import validate
from characterisation.files.errors import InputError
from characterisation.maps.performance_map import PerformanceMap
from characterisation.maps.shipped import map_path
from mitsim.cli.devices import mount
from mitsim.maps.campaign import live as live_module
from mitsim.maps.campaign.campaign_file import CampaignFile
from mitsim.maps.campaign.hold_out import compared, held_out_live, held_out_shots
from mitsim.maps.campaign.live import live_source
from mitsim.maps.campaign.orders import PreparedSensor
from mitsim.maps.campaign.stage_pose import write_stage_calibration
from tests.capture.devices.emulated_port import emulated
from tests.capture.devices.nxlib_standin import installed
from tests.maps.campaign.emulated_rig import SCENE, SERIAL, known_fit, rendering_camera
from tests.maps.campaign.test_live_campaign import CAMPAIGN

nxlib = pytest.importorskip("nxlib", reason="pip install ensenso-nxlib: live Ensenso cameras")


@pytest.fixture
def file(tmp_path):
    write_stage_calibration(tmp_path / "stage_calibration.json", known_fit(), ["pan", "tilt"])
    text = CAMPAIGN.format(scene=SCENE.as_posix(), serial=SERIAL, port="emulated")
    return validate("campaign.toml", tomllib.loads(text), CampaignFile)


@pytest.fixture(scope="module")
def shipped():
    return PerformanceMap.load(map_path("ensenso-n10"))


def test_the_shipped_map_predicts_what_an_emulated_device_shows(file, tmp_path, n10, shipped, monkeypatch):
    stage, port = emulated("ptu")
    monkeypatch.setattr(live_module, "open_stage", lambda connection: stage)
    camera = rendering_camera(lambda: [round(port.device.axes[name].at(port.time)) for name in "PT"])
    library = installed(monkeypatch, camera)
    live = held_out_live(tmp_path / "campaign.toml", file, n10, shipped)
    shots = held_out_shots(live.campaign, 3, seed=4)
    prepared = PreparedSensor(live.campaign.sensor)
    with live_source(live, mount) as take:
        pairs = [compared(shot, prepared, shipped, take, 1) for shot in shots]
    assert not library.initialised and not port.open
    nxlib.api._nxlib.reset()
    assert len(pairs) == 3
    for pair in pairs:
        # matt white at under 36 deg: nothing is lost
        assert pair.measured.fraction > 0.99 and pair.predicted.fraction > 0.99
        # a map's residual of sigma may be 5 % (docs/how-to/characterise.md); four standard errors of the two join it
        error = np.hypot(pair.measured.sigma_error, pair.predicted.sigma_error)
        assert abs(pair.measured.sigma - pair.predicted.sigma) < 0.05 * pair.predicted.sigma + 4 * error


def test_normals_that_the_stage_cannot_show_are_not_asked_for(file, tmp_path, n10, shipped):
    live = held_out_live(tmp_path / "campaign.toml", file, n10, shipped)
    shots = held_out_shots(live.campaign, 200, seed=1)
    assert len(shots) == 200
    normals = np.array([shot.normal for shot in shots])
    assert live.campaign.reachable(normals).all()
    # tilt ends at 25 deg on one side and at the rim of the cap, 36 deg, on the other
    tilts = np.degrees(np.arcsin(normals[:, 1]))
    assert (tilts.min() > -26 and tilts.max() > 30) or (tilts.max() < 26 and tilts.min() < -30)


def test_a_map_that_ends_before_the_stages_distance_is_refused(file, tmp_path, n10, shipped):
    far = shipped.data.sel(distance=shipped.data["distance"] > 520)
    with pytest.raises(
        InputError, match=r"stage\.calibration: found 500 mm; allowed: a place within .*calibrate the stage there"
    ):
        held_out_live(tmp_path / "campaign.toml", file, n10, PerformanceMap(far))
    with pytest.raises(InputError, match="map: sensor"):
        other = shipped.data.assign_attrs(sensor="another")
        held_out_live(tmp_path / "campaign.toml", file, n10, PerformanceMap(other))
