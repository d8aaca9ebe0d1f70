"""The plan of a live campaign, and what it does to stage and camera."""

import hashlib
import json
import sys
import tomllib
from dataclasses import replace

import numpy as np
import pytest

import mitsim
from characterisation.coupon.patches import measure_patches
from characterisation.files.documents import validate
from characterisation.files.errors import InputError
from mitsim.capture.devices.device_error import DeviceError
from mitsim.capture.simulated.rendering import Rendering
from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.cli.devices import mount
from mitsim.decoding.cloud import sensor_geometry
from mitsim.maps.campaign import live as live_module
from mitsim.maps.campaign.acquire import coupon_cloud, in_turn, measured
from mitsim.maps.campaign.campaign_file import CampaignFile
from mitsim.maps.campaign.live import live_source, place_by_place, plan_live
from mitsim.maps.campaign.plan import MEASUREMENT_VERSION, plan_campaign
from mitsim.maps.campaign.run import run_campaign
from mitsim.maps.campaign.stage_pose import write_stage_calibration
from mitsim.sensor.preset import load_sensor
from tests.capture.devices.emulated_port import emulated
from tests.capture.devices.nxlib_standin import StandInCamera, counted_frames, installed, small_node
from tests.maps.campaign.emulated_rig import SCENE, known_fit
from tests.maps.campaign.known_clouds import known_source, smooth
from tests.maps.campaign.test_live_campaign import CAMPAIGN

nxlib = pytest.importorskip("nxlib", reason="pip install ensenso-nxlib: live Ensenso cameras")

SERIAL = "150358"


@pytest.fixture
def written(tmp_path):
    """Make a live campaign's file; a keyword with dots changes what stands there, None takes it out."""
    write_stage_calibration(tmp_path / "stage_calibration.json", known_fit(), ["pan", "tilt"])

    def make(changes=()):
        text = CAMPAIGN.format(scene=SCENE.as_posix(), serial=SERIAL, port="/dev/ttyUSB0")
        table = tomllib.loads(text)
        for path, value in dict(changes).items():
            *way, last = path.split(".")
            inner = table
            for step in way:
                inner = inner[step]
            inner.pop(last, None)
            if value is not None:
                inner[last] = value
        return tmp_path / "campaign.toml", validate("campaign.toml", table, CampaignFile)

    return make


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"device": None}, "device"),
        ({"stage": None}, "stage"),
        ({"stage.connection": None}, "stage"),
        ({"stage.calibration": None}, "stage"),
        ({"device.settings.exposure_s": None}, "device.settings.exposure_s"),
        ({"distances_mm": [400.0, 500.0]}, "distances_mm"),
        ({"distances_mm": [600.0]}, "distances_mm"),
        ({"stage.calibration": ["stage_calibration.json"] * 2}, "stage.calibration"),
        ({"coupon_px": 100.0}, "coupon_px"),
        ({"samples": [{"scene": SCENE.as_posix(), "spread": True}]}, "samples.0.spread"),
    ],
)
def test_a_live_campaign_that_cannot_be_run_is_told_before_anything_is_opened(written, n10, changes, field):
    with pytest.raises(InputError) as caught:
        plan_live(*written(changes), n10)
    assert caught.value.field == field


def test_a_sensor_of_another_kind_is_refused(written):
    with pytest.raises(InputError, match="technology: found time_of_flight; allowed: active_stereo"):
        plan_live(*written(), load_sensor("kinect-v2"))


def test_distance_and_axes_are_those_that_were_calibrated(written, n10):
    live = plan_live(*written(), n10)
    fit = known_fit()
    assert live.campaign.distances == (float(f"{np.linalg.norm(fit.zero_pose[:3, 3]):.4g}"),)
    (stage,) = live.stages.values()
    assert live.campaign.stages == (stage,)
    assert np.allclose(np.linalg.norm([axis.direction for axis in stage.axes], axis=1), 1)
    assert 0 < np.degrees(np.arccos(stage.axes[0].direction[1])) < 2  # not quite [0, 1, 0]
    assert live.campaign.file.keep_images
    assert live.campaign.exposure_rule == "fixed at 0.004 s on the ensenso camera"


def test_nothing_is_simulated_in_the_place_of_a_device(written, n10):
    with pytest.raises(InputError, match="only campaigns and validations of maps take captures with a device"):
        plan_campaign(*written(), n10)


def test_a_campaign_without_a_device_keeps_the_digests_that_it_had(planned, n10):
    """Written out as it was before there were devices: captures that users have kept stay valid."""
    from mitsim.sensor.sensor_text import written

    axes = [{"name": "pan", "direction": [0, 1, 0], "limits_deg": [-30, 30]}]
    for changes in ({}, {"stage": {"axes": axes}}):
        plan = planned(**changes)
        for series in plan.series:
            common = [mitsim.__version__, MEASUREMENT_VERSION, 1, False, 1]
            sample = series.sample
            text = [*common, written(n10), sample.origin, sample.label(), f"{series.distance:.6g}"]
            digest = hashlib.sha256(json.dumps(text).encode()).hexdigest()[:12]
            assert series.name.endswith(f"mm_{digest}")
            assert series.seed == int(digest, 16) % 2**32
        assert "device" not in plan.file.model_dump_json(exclude_defaults=True)
        assert "connection" not in plan.file.model_dump_json(exclude_defaults=True)


def test_a_live_digest_follows_what_changes_a_capture_and_nothing_else(written, n10, tmp_path):
    def name(changes=()):
        return plan_live(*written(changes), n10).campaign.series[0].name

    first = name()
    assert name({"stage.connection.port": "COM7"}) == name({"device.settings.capture_timeout_s": 9.0}) == first
    others = [name({"device.settings.exposure_s": 0.005}), name({"device.serial": "other"})]
    moved = known_fit()
    moved.axes.points[0, 0] += 0.5
    write_stage_calibration(tmp_path / "stage_calibration.json", moved, ["pan", "tilt"])
    others.append(name())
    assert len({first, *others}) == 4


@pytest.fixture
def hardware(monkeypatch):
    """A stage in a time of its own, and a camera of the stand-in library, for live campaigns."""
    camera = StandInCamera(small_node(SERIAL), counted_frames)
    camera.library = installed(monkeypatch, camera)
    stage, port = emulated("ptu")
    monkeypatch.setattr(live_module, "open_stage", lambda connection: stage)
    yield camera, stage, port
    assert not camera.library.initialised
    nxlib.api._nxlib.reset()


def shots_of(live):
    plan = live.campaign
    normals = plan.file.normals()
    return [plan.shot(plan.series[0], normal) for normal in normals[plan.reachable(normals)]]


def test_nothing_is_opened_where_everything_is_kept(written, n10, tmp_path, monkeypatch):
    live = plan_live(*written(), n10)
    run_campaign(live.campaign, known_source(smooth), tmp_path)
    whole = (tmp_path / "map.nc").read_bytes()
    monkeypatch.setattr(live_module, "open_device", lambda table: pytest.fail("opened"))
    with live_source(live, mount) as take:
        run_campaign(live.campaign, in_turn(take, live.campaign), tmp_path)
    assert (tmp_path / "map.nc").read_bytes() == whole


def test_the_pose_is_that_of_the_angles_read_back(written, n10, hardware):
    live = plan_live(*written(), n10)
    fit = known_fit()
    with live_source(live, mount) as take:
        for shot in shots_of(live):
            capture = take(shot)
            read = capture.settings["stage"]["read_deg"]
            assert read == list(hardware[1].position())
            assert read != capture.settings["stage"]["asked_deg"]
            pose = fit.poses(np.radians([read]))[0]
            assert np.allclose(capture.world_from_sensor.inverse().matrix(), pose, atol=1e-9)
            assert capture.sensor == "ensenso-n10"
            assert capture.settings["device_model"] == "StandIn-N10"
    assert not hardware[2].open  # both are given back at the end
    assert hardware[0].node["Status"]["Open"] is False


def noting(order, name, call):
    def noted():
        order.append(name)
        call()

    return noted


def interrupted(targets, deadline):
    raise KeyboardInterrupt


@pytest.mark.parametrize("error", [KeyboardInterrupt, DeviceError, "stage"])
def test_an_error_and_ctrl_c_stop_the_stage_and_leave_the_camera_as_it_was(written, n10, hardware, error, monkeypatch):
    camera, stage, port = hardware
    live = plan_live(*written(), n10)
    shots = shots_of(live)
    order = []
    for owner, name, told in ((stage, "close", "stage"), (nxlib.api, "finalize", "camera")):
        monkeypatch.setattr(owner, name, noting(order, told, getattr(owner, name)))
    with pytest.raises(DeviceError if error == "stage" else error), live_source(live, mount) as take:
        take(shots[0])
        if error is KeyboardInterrupt:
            monkeypatch.setattr(stage, "_await_rest", interrupted)  # while it turns
        elif error is DeviceError:
            camera.faults["Capture"] = "CaptureTimeout"
        else:
            port.device.faults.active.add("silence")
        take(shots[1])
    assert not port.open
    port.wait(0.1)
    assert error == "stage" or not port.device.busy(port.time)
    # after a fault of its own the camera is closed at once; else the stage is stopped first
    assert order == (["camera", "stage"] if error is DeviceError else ["stage", "camera"])
    assert camera.node["Parameters"]["Capture"]["FrontLight"] is True
    assert camera.node["Status"]["Open"] is False


def test_another_sample_is_asked_for_once(written, n10, hardware):
    samples = [{"scene": SCENE.as_posix()}, {"scene": SCENE.with_name("coupon.xml").as_posix()}]
    live = plan_live(*written({"samples": samples}), n10)
    plan, asked = live.campaign, []
    normals = [shot.normal for shot in shots_of(live)[:2]]
    with live_source(live, lambda *wanted: asked.append(wanted)) as take:
        for series in plan.series:
            for normal in normals:
                take(plan.shot(series, normal))
    assert asked == [(sample.label(), plan.distances[0]) for sample in plan.samples]
    assert len(asked) == 2


def farther(file, distance):
    """A calibration of the same stage put farther away."""
    fit = known_fit()
    fit.zero_pose[2, 3] += distance
    fit.axes.points[:, 2] += distance
    write_stage_calibration(file, fit, ["pan", "tilt"])


def test_a_second_place_is_a_second_distance_and_changes_nothing_at_the_first(written, n10, tmp_path, hardware):
    first = plan_live(*written(), n10)
    farther(tmp_path / "far.json", 200.0)
    both = {"stage.calibration": ["far.json", "stage_calibration.json"]}
    live = plan_live(*written(both), n10)
    plan, asked, taken = live.campaign, [], []
    assert plan.distances == (first.campaign.distances[0], 700.0)
    assert plan.series[0].name == first.campaign.series[0].name  # what was kept of the first place is kept
    assert plan_live(*written({**both, "distances_mm": [690.0, 505.0]}), n10).campaign.distances == (505.0, 690.0)
    assert plan_live(*written(both), n10, (600.0, 800.0)).campaign.distances == (700.0,)
    with pytest.raises(InputError, match="a place within 800 to 900 mm"):
        plan_live(*written(both), n10, (800.0, 900.0))

    normals = plan.file.normals()
    normals = normals[plan.reachable(normals)][:2]
    shots = [plan.shot(series, normal) for normal in normals for series in plan.series]  # to and fro
    with live_source(live, lambda *wanted: asked.append(wanted)) as take:

        def source(shots):
            for shot in shots:
                capture = take(shot)
                taken.append(float(np.linalg.norm(capture.world_from_sensor.inverse().translation)))
                yield shot, capture

        list(place_by_place(source)(shots))
    assert [distance for _, distance in asked] == [500.0, 700.0]  # moved once
    assert np.allclose(taken, [500, 500, 700, 700], atol=8)  # the axes pass the coupon by some mm


def test_where_nobody_answers_a_second_sample_is_refused(monkeypatch):
    monkeypatch.setattr(sys.stdin, "isatty", lambda: False, raising=False)
    with pytest.raises(InputError, match="without a terminal"):
        mount("brass", 500.0)


def test_a_capture_is_decoded_with_its_own_calibration(planned, n10):
    """A device whose focal length is 8 % longer than the preset's, and whose axes cross at 694 mm as the preset's do.

    The eyes see a point at 500 mm at 11.5 deg to each other, 3.2 deg of it on top of the 8.3 deg of the axes. With the
    preset's focal length these would be 3.4: the point would be 0.25 deg of 11.5, 2 % or 11 mm, too near.
    """
    cameras = {
        name: replace(camera, matrix=camera.matrix * np.array([[1.08, 1.08, 1.0]] * 2 + [[1.0, 1.0, 1.0]]))
        for name, camera in n10.rig.cameras.items()
    }
    for name, camera in cameras.items():  # the principal point stays
        camera.matrix[:2, 2] = n10.rig.cameras[name].matrix[:2, 2]
    device = SimulatedSensor(replace(n10, rig=replace(n10.rig, cameras=cameras)))
    plan = planned(distances_mm=[500], samples=[{"scene": "matt_white.xml"}])
    shot = plan.shot(plan.series[0], np.array([0.2, 0.1, np.sqrt(0.95)]))
    pose, sample = shot.sensor_from_coupon, shot.series.sample
    capture = device.capture(
        sample.scene, pose.inverse(), rendering=Rendering(samples=1), seed=1, around=sample.at(pose).corners()
    )
    geometry = sensor_geometry(n10)
    patches = measured(capture, shot, geometry, n10, False).patches
    assert patches["recovered_fraction"].mean() > 0.99
    # what is over 1 % off is not on the coupon
    coupon = sample.at(pose)
    assert measure_patches(coupon_cloud(capture, coupon, geometry, n10), coupon)["recovered_fraction"].mean() < 0.01
