"""A recorded Ensenso N10, served by the stand-in library to the unmodified package as if it were connected."""

import json
import os
import zipfile
from pathlib import Path

import numpy as np
import pytest

from mitsim.capture.calibration import calibration_table
from mitsim.capture.devices.device_error import DeviceError
from mitsim.capture.devices.ensenso import EnsensoSettings, open_ensenso
from mitsim.capture.devices.maker_captures import ensenso_capture
from mitsim.capture.recordings.ensenso import read_ensenso
from mitsim.sensor.png import decode_png
from tests.capture.devices.nxlib_standin import StandInCamera, installed

nxlib = pytest.importorskip("nxlib", reason="pip install ensenso-nxlib: live Ensenso cameras")

FOLDER = Path(os.environ.get("MITSIM_REAL_DATA") or Path(__file__).resolve().parents[3].parent / "shared" / "real")
RECORDING = FOLDER / "ensenso/locate_multiple_patterns/camera.zip"


@pytest.fixture
def recorded(monkeypatch):
    """The camera of the recording, with the parameters that its file leaves out and an N10 has."""
    if not RECORDING.is_file():
        pytest.skip(f"no recordings in {FOLDER}: set MITSIM_REAL_DATA, see docs/how-to/real-captures.md")
    with zipfile.ZipFile(RECORDING) as archive:
        files = {name.rpartition("_")[2]: archive.read(name) for name in archive.namelist()}
    node = json.loads(files["calib.json"].decode("utf-8-sig"))
    node["Status"] |= {"Open": False, "Available": True}
    node["Parameters"]["Capture"] |= {"Projector": False, "FrontLight": False, "AutoExposure": True, "Exposure": 3.0}
    images = [decode_png(files[f"{side}.png"], side)[None] for side in ("left", "right")]
    camera = StandInCamera(node, lambda node: images)
    yield camera, installed(monkeypatch, camera), images
    nxlib.api._nxlib.reset()


@pytest.mark.real
def test_the_live_camera_gives_what_its_file_camera_holds(recorded):
    camera, _, images = recorded
    with open_ensenso("150358", EnsensoSettings(exposure_s=0.004)) as live:
        capture = ensenso_capture(live.take()).capture
    told = read_ensenso(RECORDING)
    assert calibration_table(capture.rig) == calibration_table(told.rig)
    assert np.array_equal(capture.images["left"], images[0])
    assert np.array_equal(capture.images["right"], told.images["right"])
    assert (capture.sensor, capture.serial, capture.source) == ("N10-304-18", "150358", "emulator")
    assert capture.decoding.exposure_s == 0.004
    assert camera.node["Parameters"]["Capture"]["Exposure"] == 3.0


@pytest.mark.real
def test_an_n10_has_no_flexview(recorded):
    """Its node reads 0, and it is a stand-in that lets itself be set: the count of frames tells."""
    with open_ensenso("150358", EnsensoSettings(projector=False)) as live:
        assert live.take().images["left"].shape[0] == 1


@pytest.mark.real
def test_a_recording_that_is_lost_midway_keeps_what_was_taken(recorded, tmp_path, capsys):
    from mitsim.capture.folder import read_capture
    from mitsim.cli.devices import capture

    camera, _, images = recorded
    camera.lose_after = 2
    with pytest.raises(DeviceError, match="incompletely transferred"):
        capture(tmp_path / "taken", "ensenso:150358", None, 5)
    kept = sorted(path for path in (tmp_path / "taken").iterdir() if not path.name.startswith("."))
    assert [folder.name for folder in kept] == ["0000", "0001"]
    assert capsys.readouterr().out.splitlines() == [str(folder) for folder in kept]
    assert np.array_equal(read_capture(kept[1]).images["left"], images[0])
