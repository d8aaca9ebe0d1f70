"""A campaign from the command line with an emulated stage and an emulated camera, killed in the middle."""

import json
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from mitsim.capture.folder import read_capture
from mitsim.maps.campaign.stage_pose import write_stage_calibration
from tests.capture.devices.emulator_process import start_emulator
from tests.maps.campaign.emulated_rig import SCENE, SERIAL, known_fit
from tests.quick_process import QuickProcess

pytest.importorskip("nxlib", reason="pip install ensenso-nxlib: live Ensenso cameras")
pytest.importorskip("serial", reason="pip install pyserial: stages")
pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="pseudo-terminals")

CAMPAIGN = """
orientations = [{{ up_to_deg = 36, subdivisions = 1 }}]
samples = [{{ scene = "{scene}" }}]

[device]
kind = "ensenso"
serial = "{serial}"
settings = {{ exposure_s = 0.004, maps = false }}

[stage]
calibration = "stage_calibration.json"
axes = [
    {{ name = "pan", direction = [0, 1, 0], limits_deg = [-60, 60] }},
    {{ name = "tilt", direction = [1, 0, 0], limits_deg = [-40, 25] }},
]

[stage.connection]
kind = "ptu"
port = "{port}"
settle_s = 0.02
speed_deg_s = 140
axes = [
    {{ name = "pan", channel = "P", limits_deg = [-60, 60] }},
    {{ name = "tilt", channel = "T", limits_deg = [-40, 30] }},
]
"""


@pytest.fixture
def rig(tmp_path):
    """An emulated stage, a campaign for it, and a way to run that."""
    stage = start_emulator(tmp_path / "stage", "ptu")
    file = tmp_path / "campaign.toml"
    file.write_text(CAMPAIGN.format(scene=SCENE.as_posix(), serial=SERIAL, port=stage.port))
    write_stage_calibration(tmp_path / "stage_calibration.json", known_fit(), ["pan", "tilt"])
    script = Path(__file__).with_name("emulated_rig.py")

    def start(folder):
        return QuickProcess(script, stage.journal_file, "map", "make", file, "-o", tmp_path / folder)

    yield stage, start
    stage.end()


def kept(folder):
    return sorted((folder / "coupons").glob("*/[+-]*"))


def test_a_live_campaign_that_is_killed_goes_on_and_ends_in_the_same_map(rig, tmp_path):
    stage, start = rig
    running = start("killed")
    deadline = time.monotonic() + 120
    while len(kept(tmp_path / "killed")) < 2 and running.running and time.monotonic() < deadline:
        time.sleep(0.02)
    running.kill()
    before = kept(tmp_path / "killed")
    assert before
    times = {shot: (shot / "shot.json").stat().st_mtime_ns for shot in before}
    homed = len(stage.journal("homed"))
    told = {}
    for folder in ("killed", "whole"):
        code, told[folder] = start(folder).wait()
        assert code == 0, told[folder]
        assert "orientations are beyond the stage" in told[folder]
    assert len(stage.journal("homed")) == homed + 2
    assert stage.stands()
    assert times == {shot: (shot / "shot.json").stat().st_mtime_ns for shot in before}  # not taken again
    for name in ("map.nc", "samples.nc", "unreachable.csv"):
        assert (tmp_path / "killed" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes(), name

    # the pose is that of the angles read back, not of those asked for
    fit = known_fit()
    for shot in kept(tmp_path / "whole"):
        capture = read_capture(shot / "capture")
        assert (capture.source, capture.sensor) == ("emulator", "ensenso-n10")
        turned = capture.settings["stage"]
        assert 0 < np.abs(np.subtract(turned["asked_deg"], turned["read_deg"])).max() < 0.0514 / 2 + 1e-3
        pose = fit.poses(np.radians([turned["read_deg"]]))[0]
        assert np.allclose(capture.world_from_sensor.inverse().matrix(), pose, atol=1e-9)
        # that of the plan, to the half step of both axes
        name = [float(shot.name[:7]), float(shot.name[7:])]
        ray = fit.zero_pose[:3, 3] / np.linalg.norm(fit.zero_pose[:3, 3])
        view = np.stack([np.cross([0, 1, 0], ray), [0, -1, 0], -ray])
        assert np.allclose((view @ pose[:3, 2])[:2], name, atol=0.01)

    data = xr.load_dataset(tmp_path / "whole/map.nc")
    assert data.attrs["source"] == "emulator"
    assert data.attrs["exposure_rule"] == "fixed at 0.004 s on the ensenso camera"
    assert data.attrs["captures"] == len(kept(tmp_path / "whole"))
    assert json.loads(data.attrs["campaign"])["device"]["serial"] == SERIAL
    # matt white is recovered whole, at 1 sample a pixel and 500 mm, if the pose is right
    assert xr.load_dataset(tmp_path / "whole/samples.nc")["recovered_fraction"].mean() > 0.99
