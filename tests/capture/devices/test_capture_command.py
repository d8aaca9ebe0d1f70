"""``mitsim capture``, as a user calls it, with a camera of the stand-in library."""

import sys

import numpy as np
import pytest

from mitsim.capture.folder import read_capture
from mitsim.cli.program import main
from tests.capture.devices.nxlib_standin import StandInCamera, counted_frames, installed, small_node

nxlib = pytest.importorskip("nxlib", reason="pip install ensenso-nxlib: live Ensenso cameras")


@pytest.fixture
def camera(monkeypatch):
    camera = StandInCamera(small_node(), counted_frames)
    camera.library = installed(monkeypatch, camera)
    yield camera
    assert not camera.library.initialised
    nxlib.api._nxlib.reset()


@pytest.fixture
def mitsim(monkeypatch, capsys):
    """Run the command line; its exit code and what it says on stdout and stderr."""

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["mitsim", *map(str, arguments)])
        with pytest.raises(SystemExit) as end:
            main()
        out = capsys.readouterr()
        return end.value.code or 0, out.out, out.err

    return run


def test_captures_are_folders_and_a_second_run_goes_on(camera, mitsim, tmp_path):
    settings = tmp_path / "settings.toml"
    settings.write_text("exposure_s = 0.002\nflex_view = 3\n[parameters]\n'DisparityMap/Scaling' = 1\n")
    call = ("capture", "--device", "ensenso:150358", "--settings", settings, "-o", tmp_path / "out")
    code, out, err = mitsim(*call, "--repeats", 2)
    assert code == 0, err
    code, again, err = mitsim(*call)
    assert code == 0, err
    folders = [*out.splitlines(), *again.splitlines()]
    assert folders == [str(tmp_path / "out" / name) for name in ("0000", "0001", "0002")]
    for folder in folders:
        capture = read_capture(folder)
        assert capture.source == "emulator"
        assert capture.decoding.exposure_s == 0.002
        assert capture.images["left"].shape == (3, 120, 160)
        assert (tmp_path / "out/0000/vendor/150358_calib.json").is_file()


def test_what_was_taken_before_an_error_or_ctrl_c_is_kept(camera, mitsim, tmp_path, monkeypatch):
    camera.lose_after = 2
    code, out, err = mitsim("capture", "--device", "ensenso:150358", "--repeats", 9, "-o", tmp_path)
    assert code == 3
    assert "mitsim: camera 150358: capture: found incompletely transferred images" in err
    assert [read_capture(folder).serial for folder in out.splitlines()] == ["150358"] * 2
    camera.lose_after, camera.log = None, []  # plugged in again, it stands as at the beginning
    camera.node.update(small_node())
    from mitsim.capture.devices.ensenso import EnsensoCamera

    images = EnsensoCamera._images

    def pressed(self):
        if camera.log.count("Capture") == 2:
            raise KeyboardInterrupt
        return images(self)

    monkeypatch.setattr(EnsensoCamera, "_images", pressed)
    code, out, err = mitsim("capture", "--device", "ensenso:150358", "--repeats", 9, "-o", tmp_path)
    assert code == 130
    assert out.splitlines() == [str(tmp_path / "0002")]
    assert {path.name for path in tmp_path.iterdir()} == {"0000", "0001", "0002"}
    assert camera.node["Parameters"]["Capture"]["FrontLight"] is True


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--device", "kinect:1"], "--device: found 'kinect:1'; allowed: ensenso:SERIAL, depthai or depthai:ID"),
        (["--device", "ensenso"], "--device: found 'ensenso'"),
        (["--device", "ensenso:../x"], "serial: found '../x'"),
    ],
)
def test_a_camera_of_no_known_make_is_refused(mitsim, tmp_path, arguments, words):
    code, _, err = mitsim("capture", *arguments, "-o", tmp_path)
    assert code == 2
    assert words in err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("exposure_ms = 2", "exposure_ms: found an unknown key"),
        ("exposure_s = -1", "exposure_s: found -1"),
        ("flex_view = 99", "flex_view: found 99"),
    ],
)
def test_settings_that_a_camera_does_not_have_are_refused(mitsim, tmp_path, text, words):
    settings = tmp_path / "settings.toml"
    settings.write_text(text)
    code, _, err = mitsim("capture", "--device", "ensenso:1", "--settings", settings, "-o", tmp_path / "out")
    assert code == 2
    assert words in err
    assert not (tmp_path / "out").exists()


def test_a_capture_of_the_stand_in_is_decoded_like_any_other(camera, mitsim, tmp_path):
    noise = np.random.default_rng(3).integers(0, 255, (1, 120, 160), np.uint8)
    camera.shoot = lambda node: (noise, np.roll(noise, -5, axis=2))
    code, _, err = mitsim("capture", "--device", "ensenso:150358", "-o", tmp_path)
    assert code == 0, err
    code, out, err = mitsim("decode", tmp_path / "0000", "-o", tmp_path / "cloud.ply")
    assert code == 0, err
    assert "valid\t" in out
