"""The DepthAI driver: what needs no device runs on the real package; a pipeline of a device on a fake that records."""

import json
import os
import sys
from datetime import timedelta
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from characterisation.files.documents import validate
from characterisation.files.errors import InputError, MissingEnvironmentError
from mitsim.capture.devices.depthai_camera import (
    DepthaiCamera,
    DepthaiShot,
    aligned_frames,
    depthai,
    disparity_of,
    fault_of,
    frame_settings,
    pixels,
    stereo_pipeline,
)
from mitsim.capture.devices.depthai_settings import SIZES, DepthaiSettings, configuration, configure
from mitsim.capture.devices.device_error import DeviceError
from mitsim.capture.devices.maker_captures import depthai_capture, depthai_rig
from mitsim.capture.folder import read_capture, write_capture
from mitsim.sensor.camera import Camera
from mitsim.sensor.transforms import Transform

pytest.importorskip("depthai", reason="pip install depthai: live DepthAI cameras")
dai = depthai()

FOLDER = Path(os.environ.get("MITSIM_REAL_DATA") or Path(__file__).resolve().parents[3].parent / "shared" / "real")


def grey_frame(image, number=0):
    """Make an ``ImgFrame`` of a grey image."""
    frame = dai.ImgFrame()
    frame.setCvFrame(image, dai.ImgFrame.Type.GRAY8)
    frame.setSequenceNum(number)
    return frame


# on the real package


def test_every_filter_is_off_and_recorded():
    config = dai.StereoDepthConfig()
    before = configuration(config)
    assert before["filters"]["holeFilling"] and before["filters"]["adaptiveMedianFilter"]  # the maker's defaults
    config.postProcessing.bilateralSigmaValue = 3
    config.postProcessing.spatialFilter.enable = True
    configure(config, DepthaiSettings(subpixel_bits=4, left_right_threshold=7, confidence_threshold=20), dai)
    told = configuration(config)
    assert set(told["filters"].values()) == {False}
    assert (told["median_filter"], told["bilateral_sigma"], told["decimation"]) == ("MEDIAN_OFF", 0, 1)
    assert (told["subpixel_bits"], told["left_right_threshold"], told["confidence_threshold"]) == (4, 7, 20)
    assert json.loads(json.dumps(told)) == told


def test_a_grey_image_goes_through_a_frame_unchanged(rng):
    image = rng.integers(0, 256, (48, 64), np.uint8)
    frame = grey_frame(image, number=7)
    assert np.array_equal(pixels(frame), image)
    assert frame.getSequenceNum() == 7


def test_raw_disparities_become_pixels_and_zero_is_missing(rng):
    raw = rng.integers(0, 3041, (40, 50)).astype(np.uint16)
    raw[3, :9] = 0
    frame = dai.ImgFrame()
    frame.setCvFrame(raw, dai.ImgFrame.Type.RAW16)
    disparity = disparity_of(pixels(frame), 5)
    assert disparity.dtype == np.float32
    assert np.isnan(disparity[3, :9]).all()
    assert np.array_equal(disparity[raw > 0], raw[raw > 0] / 32)


def test_a_coloured_frame_is_refused():
    frame = dai.ImgFrame()
    frame.setCvFrame(np.zeros((8, 8, 3), np.uint8), dai.ImgFrame.Type.BGR888i)
    with pytest.raises(DeviceError, match="a grey image of 8 or 16 bits"):
        pixels(frame)


def test_what_a_frame_says_of_itself_is_kept():
    frame = grey_frame(np.zeros((4, 4), np.uint8), number=12)
    told = frame_settings(frame)
    assert told["sequence_number"] == 12
    assert told["exposure_s"] == 0.0
    assert json.loads(json.dumps(told)) == told


def queue_of(numbers):
    queue = dai.MessageQueue("test", 30, False)
    for number in numbers:
        queue.send(grey_frame(np.full((2, 2), number % 256, np.uint8), number))
    return queue


@given(
    kept=st.lists(st.sets(st.integers(0, 20)), min_size=1, max_size=3),
    common=st.integers(0, 20),
    first=st.integers(0, 20),
)
def test_frames_of_one_number_are_found_whatever_was_lost(kept, common, first):
    """Real queues; the answer is the least number from ``first`` on that all of them hold, if there is one."""
    shared = [sorted(numbers | {common}) for numbers in kept]
    queues = {str(index): queue_of(numbers) for index, numbers in enumerate(shared)}
    both = [number for number in set.intersection(*map(set, shared)) if number >= first]
    if not both:
        with pytest.raises(DeviceError, match="no frame of"):
            aligned_frames(queues, 0.002, "test", first)
        return
    frames = aligned_frames(queues, 1.0, "test", first)
    assert {frame.getSequenceNum() for frame in frames.values()} == {min(both)}


def test_frames_that_do_not_come_are_told_in_time():
    with pytest.raises(DeviceError, match=r"no frame of right within 0\.05 s.*cable") as caught:
        aligned_frames({"left": queue_of([1]), "right": queue_of([])}, 0.05, "camera depthai")
    assert caught.value.where == "camera depthai"


def handler_of(left, right, size):
    """The package's own calibration of a pair, in cm as devices have it."""
    handler = dai.CalibrationHandler()
    right_from_left = right.sensor_from_camera.inverse() @ left.sensor_from_camera
    sockets = (dai.CameraBoardSocket.CAM_B, dai.CameraBoardSocket.CAM_C)
    for socket, camera in zip(sockets, (left, right), strict=True):
        handler.setCameraIntrinsics(socket, camera.matrix.tolist(), *size)
        handler.setDistortionCoefficients(socket, camera.distortion.tolist())
        handler.setCameraType(socket, getattr(dai.CameraModel, camera.model.capitalize()))
    centimetres = (right_from_left.translation / 10).tolist()
    handler.setCameraExtrinsics(*sockets, right_from_left.rotation.tolist(), centimetres, [-7.5, 0, 0])
    handler.setStereoLeft(sockets[0], np.eye(3).tolist())
    handler.setStereoRight(sockets[1], np.eye(3).tolist())
    return handler.eepromToJson()


def pair(model="perspective"):
    matrix = np.array([[860.0, 0, 644.0], [0, 861.0, 398.0], [0, 0, 1]])
    bent = [0.1, -0.2, 1e-3, -1e-3, 0.05, *[0.0] * 9] if model == "perspective" else [0.1, -0.02, 0.003, 1e-4]
    place = Transform.from_degrees([0.3, -0.4, 0.2], [75.4, -1.2, 0.5])
    left = Camera(matrix, np.array(bent), 1280, 800, model=model)
    return left, Camera(matrix + np.diag([2.0, 2.0, 0]), np.array(bent), 1280, 800, place, model)


@pytest.mark.parametrize("model", ["perspective", "fisheye"])
def test_the_calibration_of_a_device_is_a_rig_in_mm_as_calibrated(model):
    left, right = pair(model)
    rig = depthai_rig(handler_of(left, right, (1280, 800)), (1280, 800))
    for made, known in zip(rig.cameras.values(), (left, right), strict=True):
        assert made.model == known.model
        # the package keeps single precision: 6e-8 of 860 px, and of 754 mm / 10
        assert np.allclose(made.matrix, known.matrix, rtol=2e-7)
        assert np.allclose(made.distortion, known.distortion, rtol=2e-7)
        assert np.allclose(made.sensor_from_camera.matrix(), known.sensor_from_camera.matrix(), atol=2e-5)


@pytest.mark.parametrize(("size", "centre"), [((640, 400), (322.0, 199.0)), ((1280, 720), (644.0, 358.0))])
def test_a_smaller_image_is_binned_or_cropped_as_the_device_does_it(size, centre):
    left, right = pair()
    rig = depthai_rig(handler_of(left, right, (1280, 800)), size)
    assert np.allclose(rig.reference.matrix[:2, 2], centre, rtol=1e-6)
    assert (rig.reference.width, rig.reference.height) == size


@pytest.mark.parametrize("calibration", [{}, {"version": 7}, {"cameraData": []}])
def test_a_device_that_is_not_calibrated_is_told(calibration):
    with pytest.raises(DeviceError, match=r"read its calibration: found .*(nothing|no cameras).*calibrate the device"):
        depthai_rig(calibration, (1280, 800))


@pytest.mark.real
@pytest.mark.parametrize("size", [(1280, 800), (640, 400), (1280, 720)])
def test_recorded_calibrations_are_those_of_the_makers_own_reader(size):
    """K at the size, distortion, model, and the calibrated baseline, which is up to 25 % off the designed one."""
    files = sorted(FOLDER.glob("oak/eeprom/*.json"))
    if not files:
        pytest.skip(f"no recordings in {FOLDER}: set MITSIM_REAL_DATA, see docs/how-to/real-captures.md")
    for file in files:
        handler, rig = dai.CalibrationHandler(str(file)), depthai_rig(json.loads(file.read_text()), size)
        sockets = (handler.getStereoLeftCameraId(), handler.getStereoRightCameraId())
        for camera, socket in zip(rig.cameras.values(), sockets, strict=True):
            assert np.allclose(camera.matrix, handler.getCameraIntrinsics(socket, *size), rtol=1e-6), file.name
            known = handler.getDistortionCoefficients(socket)[: len(camera.distortion)]
            assert np.allclose(camera.distortion, known, rtol=1e-6), file.name
            assert (camera.model == "fisheye") == (handler.getDistortionModel(socket) == dai.CameraModel.Fisheye)
        baseline = np.linalg.norm(rig.cameras["right"].centre)
        assert np.isclose(baseline, 10 * handler.getBaselineDistance(useSpecTranslation=False), rtol=1e-6), file.name
        assert rig.baseline_direction[0] > 0.99, file.name


def test_without_a_device_it_is_told(monkeypatch):
    monkeypatch.setenv("DEPTHAI_SEARCH_TIMEOUT", "200")  # ms; by default it looks for ten seconds
    with pytest.raises(DeviceError, match=r"no such camera.*None is connected.*udev"):
        DepthaiCamera(DepthaiSettings(), "", dai)


def test_without_the_package_it_is_told_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "depthai", None)
    with pytest.raises(MissingEnvironmentError, match=r"pip install 'mitsim\[depthai\]'"):
        depthai()


@pytest.mark.parametrize(
    ("said", "words"),
    [
        ("No available devices", "no such camera"),
        ("Failed to connect: X_LINK_DEVICE_ALREADY_IN_USE", "in use.*Close the other program"),
        ("Insufficient permissions", "permission denied.*udev"),
        ("Communication exception - X_LINK_ERROR", "the camera disconnected or failed"),
    ],
)
def test_what_the_package_complains_of_is_told_with_what_to_do(said, words):
    with pytest.raises(DeviceError, match=words):
        raise fault_of(RuntimeError(said), dai, "camera depthai", "open")
    other = KeyboardInterrupt()
    assert fault_of(other, dai, "camera depthai", "open") is other


def test_a_shot_is_a_capture_that_comes_back_from_its_folder(rng, tmp_path):
    left, right = pair()
    images = {name: rng.integers(0, 256, (800, 1280), np.uint8) for name in ("left", "right")}
    disparity = np.full((800, 1280), 40.5, np.float32)
    disparity[:, :10] = np.nan
    calibration = handler_of(left, right, (1280, 800))
    shot = DepthaiShot(images, disparity, calibration, {"exposure_s": 0.004}, "OAK-D-PRO", "1844301")
    taken = depthai_capture(shot)
    read = read_capture(write_capture(taken.capture, tmp_path / "one", vendor=taken.originals))
    assert (read.sensor, read.serial, read.source, read.bits) == ("OAK-D-PRO", "1844301", "device", 8)
    assert np.array_equal(read.images["right"][0], images["right"])
    assert np.array_equal(read.derived["disparity"], disparity, equal_nan=True)
    assert json.loads((tmp_path / "one/vendor/calibration.json").read_text()) == calibration


@given(size=st.tuples(st.integers(1, 4000), st.integers(1, 4000)))
def test_only_sizes_that_a_device_makes_are_taken(size):
    if size in SIZES:
        assert validate("test", {"size_px": size}, DepthaiSettings).size_px == size
        return
    with pytest.raises(InputError, match="size_px"):
        validate("test", {"size_px": size}, DepthaiSettings)


def test_an_exposure_longer_than_a_frame_is_refused():
    with pytest.raises(InputError, match="within the frame time"):
        validate("test", {"exposure_s": 0.2, "frames_per_second": 10}, DepthaiSettings)


# on a fake that records: a pipeline of a device cannot be made without one


class Recorder:
    """A fake of the package's device side: it records calls by name, and its queues give real frames."""

    def __init__(self, calls, name="", laser=True):
        self._calls, self._name, self._laser = calls, name, laser

    def __getattr__(self, name):
        if name.startswith("_"):
            raise AttributeError(name)
        return Recorder(self._calls, f"{self._name}.{name}".lstrip("."), self._laser)

    def __call__(self, *arguments, **keywords):
        self._calls.append((self._name, arguments, keywords))
        last = self._name.rpartition(".")[2]
        if last in ("setIrLaserDotProjectorIntensity", "setIrFloodLightIntensity"):
            return self._laser
        return FakeQueue() if last == "createOutputQueue" else Recorder(self._calls, self._name, self._laser)


class FakeQueue:
    """Frames without end, numbered; the real thing is tested above."""

    def __init__(self):
        self.number = 0

    def get(self, timeout: timedelta):
        self.number += 1
        frame = dai.ImgFrame()
        frame.setCvFrame(np.full((800, 1280), self.number, np.uint16), dai.ImgFrame.Type.RAW16)
        frame.setSequenceNum(self.number)
        return frame

    def tryGetAll(self):  # noqa: N802
        return [self.get(timedelta(0)) for _ in range(3)]


class FakePackage:
    """The real package, but for its device, pipeline and stereo node."""

    def __init__(self, laser=True):
        self.calls = []
        recorder = Recorder(self.calls, laser=laser)
        self.config = dai.StereoDepthConfig()
        left, right = pair()
        self.calibration = handler_of(left, right, (1280, 800))
        package = self

        class Device:
            def __init__(self, *info):
                package.calls.append(("Device", info, {}))

            def __getattr__(self, name):
                return getattr(recorder.device, name)

            def readCalibration(self):  # noqa: N802
                return dai.CalibrationHandler.fromJson(package.calibration)

            def getDeviceName(self):  # noqa: N802
                return "OAK-D-PRO"

            def getDeviceId(self):  # noqa: N802
                return "1844301"

        class Stereo:
            def __init__(self):
                self.initialConfig = package.config

            def __getattr__(self, name):
                return getattr(recorder.stereo, name)

            def build(self, *arguments, **keywords):
                package.calls.append(("stereo.build", arguments, keywords))
                return self

        class Pipeline:
            def __init__(self, device):
                pass

            def __getattr__(self, name):
                return getattr(recorder.pipeline, name)

            def create(self, kind):
                return Stereo() if kind is dai.node.StereoDepth else recorder.camera

        self.Device, self.Pipeline = Device, Pipeline

    def __getattr__(self, name):
        return getattr(dai, name)

    def last(self, name):
        return next(arguments for called, arguments, _ in reversed(self.calls) if called == name)


def test_the_pipeline_is_set_as_asked_for_and_knows_no_spec_baseline():
    fake = FakePackage()
    settings = DepthaiSettings(exposure_s=0.004, sensitivity_iso=400, size_px=(640, 400))
    stereo_pipeline(fake.Pipeline(None), settings, fake)
    assert fake.last("camera.build.initialControl.setManualExposure") == (4000, 400)
    assert fake.last("camera.build.requestOutput") == ((640, 400),)
    switches = ("DisparityToDepth", "Rectification", "DepthAlignment")
    assert [fake.last(f"stereo.set{switch}UseSpecTranslation") for switch in switches] == [(False,)] * 3
    assert set(configuration(fake.config)["filters"].values()) == {False}


def test_a_capture_is_of_frames_exposed_after_it_was_asked_for_and_the_light_goes_off():
    fake = FakePackage()
    with DepthaiCamera(DepthaiSettings(exposure_s=0.004, warm_up_frames=2, dot_projector=0.5), "", fake) as camera:
        assert fake.last("device.setIrLaserDotProjectorIntensity") == (0.5,)
        shot = camera.take()
        # two for warming up, three that waited, one that may have begun before
        assert shot.settings["sequence_number"] == 2 + 3 + 2
    assert fake.last("device.setIrLaserDotProjectorIntensity") == (0.0,)
    assert fake.last("pipeline.stop") == fake.last("device.close") == ()
    assert (shot.images["left"] == 7).all()
    assert (shot.disparity == 7 / 32).all()
    assert shot.settings["dot_projector"] == 0.5
    assert shot.settings["stereo"]["median_filter"] == "MEDIAN_OFF"
    assert depthai_capture(shot).capture.rig.cameras.keys() == {"left", "right"}


@pytest.mark.parametrize("late", [12, 10**9])
def test_frames_on_their_way_at_the_call_are_skipped(monkeypatch, late):
    """Before, with empty queues any next frame was taken, also one exposed before the call."""
    of_queue, past = FakeQueue.get, dai.Clock.now() - timedelta(seconds=1)

    def get(queue, timeout):
        frame = of_queue(queue, timeout)
        if frame.getSequenceNum() < late:
            frame.setTimestamp(past)
        return frame

    monkeypatch.setattr(FakeQueue, "get", get)
    monkeypatch.setattr(FakeQueue, "tryGetAll", lambda _: [])
    settings = DepthaiSettings(exposure_s=0.004, warm_up_frames=2, timeout_s=5 if late == 12 else 1)
    with DepthaiCamera(settings, "", FakePackage()) as camera:
        if late > 12:
            with pytest.raises(DeviceError, match="no frame exposed after the call within 1 s"):
                camera.take()
            return
        assert camera.take().settings["sequence_number"] == 12
        assert camera.take().settings["sequence_number"] == 14


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
def test_an_error_and_ctrl_c_switch_the_light_off(error, monkeypatch):
    fake = FakePackage()
    camera = DepthaiCamera(DepthaiSettings(warm_up_frames=0), "", fake)

    def failing(self):
        raise error("X_LINK_ERROR")

    monkeypatch.setattr(FakeQueue, "tryGetAll", failing)
    with pytest.raises(DeviceError if error is RuntimeError else error):
        camera.take()
    assert fake.last("device.setIrLaserDotProjectorIntensity") == (0.0,)
    with pytest.raises(DeviceError, match=r"failed, at capture.*Open it again"):
        camera.take()


def test_a_camera_without_a_projector_is_told():
    with pytest.raises(DeviceError, match=r"set dot_projector: found a camera without one.*Write dot_projector = 0"):
        DepthaiCamera(DepthaiSettings(), "", FakePackage(laser=False))
    with DepthaiCamera(DepthaiSettings(dot_projector=0, warm_up_frames=0), "", FakePackage(laser=False)) as camera:
        camera.take()
