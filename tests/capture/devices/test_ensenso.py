"""The live Ensenso driver: the unmodified package ensenso-nxlib on a stand-in for the maker's library."""

import copy
import ctypes
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from characterisation.files.errors import InputError, MissingEnvironmentError
from mitsim.capture.devices.device_error import DeviceError
from mitsim.capture.devices.ensenso import EnsensoSettings, open_ensenso
from mitsim.capture.devices.maker_captures import device_table, ensenso_capture, points_in_left_camera
from mitsim.capture.folder import read_capture, write_capture
from tests.capture.devices.nxlib_standin import NO_STRIP, StandInCamera, counted_frames, installed, small_node

nxlib = pytest.importorskip("nxlib", reason="pip install ensenso-nxlib: live Ensenso cameras")

LINK = {"Target": "Workspace", "Rotation": {"Angle": 1.6, "Axis": [0.0, 0.6, -0.8]}, "Translation": [7.0, -41.0, 542.0]}


@pytest.fixture
def camera(monkeypatch):
    camera = StandInCamera(small_node(), counted_frames)
    camera.library = installed(monkeypatch, camera)
    yield camera
    assert not camera.library.initialised  # every test ends with a library that was given back
    nxlib.api._nxlib.reset()


def shot_of(settings=None):
    with open_ensenso("150358", settings or EnsensoSettings()) as live:
        return live.take()


def test_settings_are_parameters_of_the_tree():
    wanted = EnsensoSettings(exposure_s=0.002, gain=2.0, flex_view=4, parameters={"DisparityMap/Scaling": 0.5}).wanted()
    assert wanted == {
        "Capture/Projector": True,
        "Capture/FrontLight": False,
        "Capture/FlexView": 4,
        "Capture/AutoExposure": False,
        "Capture/Exposure": 2.0,
        "Capture/AutoGain": False,
        "Capture/Gain": 2.0,
        "DisparityMap/Scaling": 0.5,
    }


@pytest.mark.parametrize("frames", [0, 2, 8])
def test_the_images_are_those_of_the_camera_with_all_flexview_frames(camera, frames):
    shot = shot_of(EnsensoSettings(flex_view=frames))
    left, right = counted_frames({**camera.node, "Parameters": {"Capture": {"FlexView": frames}}})
    assert np.array_equal(shot.images["left"], left)
    assert np.array_equal(shot.images["right"], right)
    assert shot.images["left"].shape == (frames or 1, 120, 160)
    assert shot.source == "emulator"


def test_images_of_sixteen_bits_are_unsigned(camera):
    bright = np.full((1, 120, 160), 60_000, np.uint16)
    camera.shoot = lambda node: (bright.view(np.int16), bright.view(np.int16))
    capture = ensenso_capture(shot_of()).capture
    assert capture.images["left"].dtype == np.uint16
    assert (capture.images["left"] == 60_000).all()
    assert capture.bits == 16


def test_disparity_and_points_are_those_of_the_plane_and_missing_is_nan(camera):
    shot = shot_of()
    strip = np.zeros(160, bool)
    strip[NO_STRIP] = True
    assert (np.isnan(shot.disparity) == strip).all()
    assert (np.isnan(shot.points).any(axis=2) == strip).all()
    seen = shot.points[:, ~strip]
    # half of a sixteenth of a pixel: dZ = Z^2 / (f B) / 32, and Z stays under 560 mm
    assert np.abs(seen[..., 2] - 500 - 0.1 * seen[..., 0]).max() < 560**2 / (192 * 100) / 32 * 1.05


def test_a_link_is_taken_off_told_and_put_back(camera):
    without = shot_of()
    camera.node["Link"] = copy.deepcopy(LINK)
    linked = shot_of()
    assert np.array_equal(linked.points, without.points, equal_nan=True)
    assert linked.node["Link"] == LINK
    assert camera.node["Link"] == LINK
    settings = ensenso_capture(linked).capture.settings
    assert settings["link_target"] == "Workspace"
    assert settings["link_translation_mm"] == LINK["Translation"]


def test_a_link_that_does_not_come_off_is_told(camera):
    camera.node["Link"], camera.stuck_link = copy.deepcopy(LINK), True
    with pytest.raises(DeviceError, match="a Link that cannot be removed"):
        shot_of()


def stands(node):
    return copy.deepcopy({key: node[key] for key in ("Parameters", "Link", "Status")})


@pytest.mark.parametrize("end", ["close", "capture", "caller", "ctrl-c", "open"])
def test_however_it_ends_the_camera_is_left_as_it_was_found(camera, end, monkeypatch):
    camera.node["Link"] = copy.deepcopy(LINK)
    before = stands(camera.node)
    if end == "capture":
        camera.faults["Capture"] = "CaptureTimeout"
    if end == "open":
        camera.faults["Synchronize"] = "DeviceNotReady"
    expected = {"capture": DeviceError, "open": DeviceError, "caller": ZeroDivisionError, "ctrl-c": KeyboardInterrupt}

    def run():
        with open_ensenso("150358", EnsensoSettings(exposure_s=0.001, flex_view=3)) as live:
            inside = camera.node["Parameters"]["Capture"]
            assert (inside["Projector"], inside["FrontLight"], inside["Exposure"]) == (True, False, 1.0)
            assert camera.node["Link"]["Target"] == ""
            if end == "caller":
                _ = 1 / 0
            if end == "ctrl-c":
                monkeypatch.setattr(live, "_images", interrupted)
            live.take()

    if end in expected:
        with pytest.raises(expected[end]):
            run()
    else:
        run()
    assert stands(camera.node) == before


def interrupted():
    raise KeyboardInterrupt


@pytest.mark.parametrize(
    ("command", "symbol", "words"),
    [
        ("Open", "CameraNotFound", "no such camera"),
        ("Open", "NoLicense", "no licence.*ask the manufacturer"),
        ("Open", "DeviceNotReady", "in use, or not ready.*Close NxView"),
        ("Capture", "CaptureTimeout", "no images within its time.*raise capture_timeout_s"),
        ("Capture", "DeviceTimeout", "no images within its time"),
        ("Capture", "ImageTransferFailed", "incompletely transferred.*Check the cable"),
        ("Capture", "CameraNotFound", "the camera disconnected.*Check cable and power"),
        ("Capture", "NoLicense", "no licence"),
        ("ComputeDisparityMap", "NoLicense", "no licence"),
        ("ComputePointMap", "Whatever", "an error of NxLib: Whatever: as the test asked for"),
    ],
)
def test_what_nxlib_complains_of_is_told_with_what_to_do(camera, command, symbol, words):
    camera.faults[command] = symbol
    with pytest.raises(DeviceError, match=words) as caught:
        shot_of()
    assert caught.value.where == "camera 150358"
    assert symbol in str(caught.value)


def test_a_camera_that_is_not_there_is_told_with_those_that_are(camera):
    with pytest.raises(DeviceError, match=r"no such camera.*NxLib lists 150358"):
        open_ensenso("999999", EnsensoSettings())


def test_a_camera_in_use_and_one_of_another_kind_are_told(camera):
    camera.node["Status"]["Available"] = False
    with pytest.raises(DeviceError, match=r"in use, or not ready.*Close NxView"):
        open_ensenso("150358", EnsensoSettings())
    camera.node["Status"]["Available"], camera.node["Type"] = True, "Monocular"
    with pytest.raises(DeviceError, match=r"another kind of camera.*Check the serial number"):
        open_ensenso("150358", EnsensoSettings())


def test_a_camera_that_is_lost_midway_is_told_and_nothing_more_is_asked_of_it(camera):
    camera.lose_after = 1
    with open_ensenso("150358", EnsensoSettings()) as live:
        live.take()
        with pytest.raises(DeviceError, match="incompletely transferred"):
            live.take()
        count = len(camera.log)
        with pytest.raises(DeviceError, match=r"failed, at capture.*Open it again"):
            live.take()
        live.close()
    assert len(camera.log) == count
    with pytest.raises(DeviceError, match="failed, at capture"):
        live.take()


def test_a_node_that_vanishes_is_a_camera_that_has_gone(camera):
    def vanish(node):
        frames = counted_frames(node)
        del camera.library.tree["Cameras"]["150358"]
        return frames

    camera.shoot = vanish
    with pytest.raises(DeviceError, match=r"the camera disconnected.*wait until NxView lists the camera"):
        shot_of(EnsensoSettings(maps=False))


def test_what_the_camera_makes_of_a_setting_is_read_back(camera):
    camera.rounds_exposure = True
    shot_of(EnsensoSettings(exposure_s=0.00304))  # rounded to 3 ms: 1.3 % off
    with pytest.raises(DeviceError, match=r"set Capture/Exposure: found 2, read back; expected: 2\.4"):
        shot_of(EnsensoSettings(exposure_s=0.0024))


def test_a_parameter_that_the_camera_lacks_is_told_unless_it_is_to_be_off(camera):
    del camera.node["Parameters"]["Capture"]["FlexView"]
    del camera.node["Parameters"]["Capture"]["FrontLight"]
    camera.shoot = lambda node: [np.zeros((1, 120, 160), np.uint8)] * 2
    shot_of()
    with pytest.raises(DeviceError, match=r"set Capture/FlexView: found no such parameter.*Leave it out"):
        shot_of(EnsensoSettings(flex_view=4))


def test_a_tree_that_counts_flexview_in_numbers_is_served_in_numbers(camera):
    camera.node["Parameters"]["Capture"]["FlexView"] = 0
    with open_ensenso("150358", EnsensoSettings()):
        assert camera.node["Parameters"]["Capture"]["FlexView"] == 0
        assert camera.node["Parameters"]["Capture"]["FlexView"] is not False


def test_without_the_sdk_it_is_told_where_to_get_it(monkeypatch, tmp_path):
    if nxlib.api._nxlib is not None:
        nxlib.api._nxlib.reset()
    monkeypatch.setenv("NXLIB_LIBRARY_PATH", str(tmp_path))
    with pytest.raises(DeviceError, match=r"no NxLib that can be loaded.*Install the Ensenso SDK"):
        open_ensenso("150358", EnsensoSettings())


def test_a_library_that_is_no_nxlib_is_told(monkeypatch):
    if nxlib.api._nxlib is not None:
        nxlib.api._nxlib.reset()
    monkeypatch.setattr(nxlib.api, "CDLL", lambda path: ctypes.CDLL(None))
    with pytest.raises(DeviceError, match=r"no NxLib that can be loaded.*nxLibInitialize"):
        open_ensenso("150358", EnsensoSettings())
    nxlib.api._nxlib.lib_object = None


def test_without_the_package_it_is_told_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "nxlib", None)
    with pytest.raises(MissingEnvironmentError, match=r"pip install 'mitsim\[ensenso\]'"):
        open_ensenso("150358", EnsensoSettings())


def test_two_sessions_in_a_row_are_served(camera):
    first, second = shot_of(), shot_of()
    assert camera.library.opened == 2
    assert np.array_equal(first.images["left"], second.images["left"])


@pytest.mark.parametrize("rectified", [True, False])
def test_a_capture_comes_back_from_its_folder_with_points_in_the_left_cameras_frame(camera, tmp_path, rectified):
    """Whichever of the two frames NxLib means: the disparity tells."""
    camera.serves_points_rectified = rectified
    shot = shot_of(EnsensoSettings(flex_view=3, exposure_s=0.002))
    taken = ensenso_capture(shot)
    assert taken.originals.keys() == {"150358_calib.json"}
    capture = read_capture(write_capture(taken.capture, tmp_path / "one", vendor=taken.originals))
    assert (capture.sensor, capture.serial, capture.source) == ("StandIn-N10", "150358", "emulator")
    assert (capture.decoding.exposure_s, capture.settings["flex_view"]) == (0.002, 3)
    assert capture.settings["projector_on"] is True
    assert np.array_equal(capture.images["right"], shot.images["right"])
    pair = capture.rig.rectification
    turned = capture.derived["points"] @ pair.rotation_left.T  # into the rectified frame
    depth = pair.depth(capture.derived["disparity"])
    seen = np.isfinite(depth)
    assert np.allclose(turned[seen][:, 2], depth[seen], rtol=1e-5)


def test_points_that_agree_in_neither_frame_are_not_taken(camera):
    shot = shot_of()
    capture = ensenso_capture(shot).capture
    pair = capture.rig.rectification
    assert points_in_left_camera(shot.points, shot.disparity, pair) is not None
    assert points_in_left_camera(shot.points + np.float32(1.0), shot.disparity, pair) is None
    assert points_in_left_camera(np.full_like(shot.points, np.nan), shot.disparity, pair) is None


@given(text=st.text(max_size=30))
def test_any_text_as_a_device_is_a_camera_or_is_refused(text):
    try:
        table = device_table(text, None)
    except InputError as error:
        assert error.where == "--device"
    else:
        assert table.kind == text.partition(":")[0]


@given(serial=st.from_regex("[A-Za-z0-9][A-Za-z0-9._-]{0,49}", fullmatch=True))
def test_a_serial_number_is_taken_as_it_is(serial):
    assert device_table(f"ensenso:{serial}", None).serial == serial
