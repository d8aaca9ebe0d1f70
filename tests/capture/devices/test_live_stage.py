"""The rules that hold for every stage, on emulated ones in a time of their own."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from characterisation.files.errors import InputError
from mitsim.capture.devices.device_error import DeviceError
from mitsim.capture.devices.serial_line import SerialLine
from mitsim.capture.devices.stage import PATIENCE, LiveStage, start_stage
from tests.capture.devices.emulated_port import EmulatedPort, device, emulated, true_angles
from tests.capture.devices.emulator_process import connection

KINDS = pytest.mark.parametrize("kind", ["ptu", "grbl"])


@KINDS
def test_it_tells_its_axes_limits_and_steps(kind):
    stage, _ = emulated(kind)
    assert stage.axes == (("pan", "tilt") if kind == "ptu" else ("turn", "pan", "tilt"))
    assert stage.limits[0] == ((-60, 60) if kind == "ptu" else (-25, 25))
    # 185.1428 seconds of arc; 80 steps in a degree, and half of that behind a gear of 2
    expected = [185.1428 / 3600] * 2 if kind == "ptu" else [1 / 80, 1 / 80, 1 / 160]
    assert np.allclose(stage.resolution, expected, rtol=1e-9)


@pytest.fixture(scope="module")
def stages():
    """Homed stages, to be moved about."""
    made = {kind: emulated(kind) for kind in ("ptu", "grbl")}
    for stage, _ in made.values():
        stage.home()
    return made


@pytest.mark.parametrize("kind", ["ptu", "grbl"])
@given(shares=st.lists(st.floats(0, 1), min_size=3, max_size=3))
def test_what_is_returned_is_where_the_stage_is_not_what_was_asked_for(kind, stages, shares):
    stage, port = stages[kind]
    asked = [low + share * (high - low) for share, (low, high) in zip(shares, stage.limits, strict=False)]
    back = stage.move(asked)
    assert np.allclose(back, true_angles(stage, port), atol=2e-3 if kind == "grbl" else 1e-9)  # GRBL says 3 decimals
    assert (np.abs(back - asked) <= np.array(stage.resolution) / 2 + 1e-3).all()
    assert np.array_equal(back, stage.position())


@KINDS
@pytest.mark.parametrize("wrong", [np.nan, np.inf, 1e9, -61.0])
def test_an_angle_beyond_the_limits_is_refused_before_anything_moves(kind, wrong):
    stage, port = emulated(kind)
    stage.home()
    before = true_angles(stage, port)
    with pytest.raises(InputError, match=r"stage: .*pan: found .* deg; allowed: -.* to .* deg. nothing was moved"):
        stage.move([0.0 if name != "pan" else wrong for name in stage.axes])
    assert true_angles(stage, port) == before
    stage.move([1.0] * len(stage.axes))  # the user's mistake is no fault of the stage


def test_a_wrong_number_of_angles_is_refused():
    stage, _ = emulated("ptu")
    with pytest.raises(InputError, match="found 3 of them; allowed: 2: pan, tilt"):
        stage.move([0, 0, 0])


@KINDS
def test_nothing_moves_before_it_is_homed(kind):
    stage, port = emulated(kind)
    for call in (lambda: stage.move([0.0] * len(stage.axes)), stage.position):
        with pytest.raises(DeviceError, match=r"a stage that has not been homed; expected: home\(\) first"):
            call()
    assert port.device.moves == 0
    stage.home()  # it was no fault
    stage.move([0.0] * len(stage.axes))


@KINDS
def test_after_a_fault_it_does_nothing_more_and_may_be_closed(kind):
    stage, port = emulated(kind, "stall@1")
    stage.home()
    with pytest.raises(DeviceError, match="stands at"):
        stage.move([10.0] * len(stage.axes))
    for call in (lambda: stage.move([0.0] * len(stage.axes)), stage.position, stage.home, stage.stop):
        with pytest.raises(DeviceError, match=r"has failed, at move.*Open the stage again and home it"):
            call()
    stage.close()
    stage.close()
    assert not port.open
    with pytest.raises(DeviceError, match="a device that has failed, at move"):
        stage.position()


@KINDS
def test_an_exception_of_the_caller_stops_the_axes_and_closes_the_port(kind):
    stage, port = emulated(kind, speed_deg_s=2)
    with pytest.raises(ZeroDivisionError), stage:
        stage.home()
        start(stage, 20.0)
        assert port.device.busy(port.time)
        _ = 1 / 0
    assert not port.device.busy(port.time)
    assert not port.open


def start(stage, angle):
    stage._controller.start([axis.device_angle(angle) for axis in stage.connection.axes])


@KINDS
def test_stop_stops_where_it_is_and_lets_it_go_on(kind):
    stage, port = emulated(kind, speed_deg_s=2)
    stage.home()
    here = stage.position()
    start(stage, 20.0)
    port.wait(1.0)
    stage.stop()
    there = stage.position()
    assert (np.abs(there - here) <= 2 * 1.2).all()
    assert np.abs(there - here).max() > 1
    assert np.abs(stage.move([0.0] * len(stage.axes))).max() <= 0.1


def test_a_reply_that_comes_twice_is_not_taken_for_the_next_one():
    stage, port = emulated("ptu", "stale@1")
    stage.home()
    with pytest.raises(DeviceError, match=r"an unexpected line.*The stage was stopped"):
        stage.move([12.0, -8.0])
    assert not port.device.busy(port.time)


def test_a_status_report_that_comes_twice_does_no_harm():
    stage, port = emulated("grbl", "stale@1")
    stage.home()
    assert np.allclose(stage.move([12.0, -8.0, 5.0]), true_angles(stage, port), atol=1e-3)


@KINDS
def test_messages_without_an_end_are_garbage_of_a_ptu_and_are_let_pass_of_grbl(kind):
    stage, port = emulated(kind)
    stage.home()
    port.spoil = lambda _, said: b"[MSG:chatter]\r\n" * 5 + said + b"[MSG:chatter]\r\n" * 5
    if kind == "grbl":
        assert np.allclose(stage.move([1.0, 2.0, 3.0]), [1, 2, 3], atol=0.01)
    else:
        with pytest.raises(DeviceError, match="MSG:chatter"):
            stage.move([1.0, 2.0])


def test_an_axis_that_never_arrives_is_given_the_time_that_its_way_needs():
    stage, port = emulated("grbl", speed_deg_s=5)
    stage.home()
    stage.move([0.0, 0.0, 0.0])
    before = port.time
    stage._controller.report = lambda: ((-30.0, -30.0, -60.0), True)
    with pytest.raises(DeviceError, match=r"axes that still move, at turn 0.000, pan 0.000, tilt 0.000 deg"):
        stage.move([20.0, 0.0, 0.0])
    # 20 deg at 5 deg/s, and what it takes to reach that speed
    needed = PATIENCE * 4.0 + stage.connection.reply_timeout_s
    assert needed <= port.time - before <= needed + 1.5


@KINDS
def test_limits_that_the_device_does_not_allow_are_refused_at_once(kind):
    name, allowed = ("pan", "-158.914 and 158.914") if kind == "ptu" else ("turn", "-330 and 30")
    axes = [{**axis, "limits_deg": [-179, 179]} for axis in connection(kind, "x").model_dump()["axes"]]
    with pytest.raises(InputError, match=rf"axes.0.limits_deg: found \[-179.0, 179.0\]; allowed: between {allowed}"):
        emulated(kind, axes=axes)
    assert name


def test_a_tolerance_finer_than_the_steps_is_refused():
    with pytest.raises(InputError, match=r"tolerance_deg: found 0.01; allowed: at least 0.02571"):
        emulated("ptu", tolerance_deg=0.01)


@KINDS
def test_another_number_of_steps_is_another_device(kind):
    axes = connection(kind, "x").model_dump()["axes"]
    axes[0]["steps_per_deg"] = 19.4445 if kind == "ptu" else 80
    emulated(kind, axes=axes)
    axes[0]["steps_per_deg"] = 77.7
    with pytest.raises(DeviceError, match=rf"axis {axes[0]['name']}: identify: found .* expected: 77.7"):
        emulated(kind, axes=axes)


def test_a_stage_that_cannot_be_opened_gives_its_port_back():
    port = EmulatedPort(device("ptu", "silence"))
    table = connection("ptu", "emulated")
    with pytest.raises(DeviceError, match="no reply"):
        start_stage(table, SerialLine(port, table.where, port.clock))
    assert not port.open


def test_without_homing_it_trusts_where_it_is_and_homes_to_zero():
    stage, port = emulated("grbl", homing="none", settings={"_22": 0, "_20": 0})
    port.device.axes[0].go(port.time, -10.0, 0.0)
    assert np.allclose(stage.position(), [30, 20, -30])
    assert np.allclose(stage.home(), 0)


def test_a_controller_of_ones_own_is_driven_by_the_same_rules():
    class Model:
        identity, resolution, travel = "model", (0.1, 0.1), ((-90.0, 90.0), (-90.0, 90.0))
        at = (0.0, 0.0)

        def home(self, timeout_s):
            self.at = (0.0, 0.0)

        def start(self, targets):
            self.at = tuple(targets)
            return 0.0

        def report(self):
            return self.at, False

        def halt(self):
            return True

        def close(self):
            pass

    with LiveStage(connection("ptu", "model", settle_s=0), Model()) as stage:
        stage.home()
        assert np.array_equal(stage.move([5, -5]), [5, -5])
