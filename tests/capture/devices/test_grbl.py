"""GRBL: reports, settings, states, and what its numbers mean."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from characterisation.files.errors import InputError
from mitsim.capture.devices.device_error import DeviceError
from mitsim.capture.devices.grbl_reports import (
    ALARMS,
    ERRORS,
    StatusReport,
    parse_refusal,
    parse_setting,
    parse_status,
    parse_version,
)
from tests.capture.devices.emulated_port import EmulatedPort, device, emulated, true_angles


def test_status_reports_of_the_manual_are_read():
    idle = parse_status("<Idle|MPos:0.000,-10.000,5.000|FS:0,0|WCO:0.000,1.551,5.664>")
    assert idle == StatusReport("Idle", "", (0, -10, 5), None, (0, 1.551, 5.664))
    held = parse_status("<Hold:0|WPos:-2.500,0.000,11.000|Bf:15,128|F:500|Pn:XP|Ov:100,100,100>")
    assert held == StatusReport("Hold", "0", None, (-2.5, 0, 11), None)


@pytest.mark.parametrize(
    "line",
    [
        "",
        "ok",
        "<>",
        "<Idle>",
        "<Idle|FS:0,0>",
        "<Idle|MPos:1,2>",
        "<Idle|MPos:1,2,x>",
        "<Idle|MPos:nan,0,0>",
        "<Idle|MPos:1,2,3",
        "<1dle|MPos:1,2,3>",
        "<Idle|MPos:1,2,3|WPos:1,2,3>",
        "<Idle|MPos:1,2,inf>",
    ],
)
def test_what_is_no_status_report_is_none(line):
    assert parse_status(line) is None


@given(st.text(max_size=80))
def test_any_line_is_read_or_is_not(line):
    for parse in (parse_status, parse_setting, parse_version, parse_refusal):
        parse(line)
        parse(f"<{line}>")


def test_numbers_are_told_in_words():
    assert parse_refusal("error:9") == "error:9, locked by an alarm: it must be homed first"
    assert parse_refusal("ALARM:1") == "ALARM:1, a limit switch was hit; its position is lost"
    assert parse_refusal("error:99") == "error:99, a number unknown to GRBL 1.1"
    assert parse_refusal("ok") is None
    # all of doc/csv/error_codes_en_US.csv and alarm_codes_en_US.csv
    assert sorted(ERRORS) == [*range(1, 18), *range(20, 39)]
    assert sorted(ALARMS) == list(range(1, 10))


def test_versions_of_reports_and_welcomes_are_read():
    assert parse_version("[VER:1.1h.20190830:]") == ("1.1", "GRBL 1.1h.20190830")
    assert parse_version("[VER:v1.1d.20161014:Table 3]") == ("1.1", "GRBL 1.1d.20161014 Table 3")
    assert parse_version("Grbl 0.9j ['$' for help]") == ("0.9", "GRBL 0.9j")
    assert parse_version("[OPT:V]") is None


def test_a_board_that_does_not_restart_is_asked_and_one_that_does_is_waited_for():
    stage, port = emulated("grbl")
    assert stage.identity == "GRBL 1.1h.20190830"
    opened = EmulatedPort(device("grbl"))
    opened.device.opened(0.0)
    assert b"Grbl 1.1h" in opened.device.output
    assert port.device.alarm  # locked, and left so


def test_another_version_is_refused():
    with pytest.raises(DeviceError, match=r"identify \(\$I\): found 'GRBL 0.9j.*'; expected: GRBL 1.1"):
        emulated("grbl", "wrong")


@pytest.mark.parametrize("offset", ["0,0,0", "-3.5,12,7"])
def test_work_positions_are_made_machine_positions_by_their_offset(offset):
    stage, port = emulated("grbl", settings={"_10": 0, "offset": offset})
    stage.home()
    for angles in ([4.0, -3.0, 2.0], [-4.0, 3.0, 1.0]):
        back = stage.move(angles)
        assert np.allclose(back, angles, atol=0.01)
        assert np.allclose(true_angles(stage, port), angles, atol=0.01)


def test_the_axes_share_the_time_of_the_slowest_and_keep_their_speed():
    stage, port = emulated("grbl", speed_deg_s=10)
    stage.home()
    stage.move([0.0, 0.0, 0.0])
    before = port.time
    axes = zip(stage.connection.axes, [20, 5, 1], strict=True)
    stage._controller.start([axis.device_angle(angle) for axis, angle in axes])
    while port.device.busy(port.time):
        port.wait(0.01)
    assert port.time - before == pytest.approx(2.0, abs=0.05)  # 20 deg at 10 deg/s


@pytest.mark.parametrize(
    ("number", "value", "said"),
    [
        (13, 1, r"GRBL setting \$13: found 1; allowed: 0"),
        (22, 0, r"GRBL setting \$22: found 0; allowed: 1, with limit switches"),
        (100, 0, r"GRBL setting \$100: found 0; allowed: more than 0"),
        (111, 0, r"GRBL setting \$111: found 0"),
        (132, 0, r"GRBL setting \$132: found 0"),
    ],
)
def test_settings_that_a_stage_cannot_work_with_are_told(number, value, said):
    with pytest.raises(InputError, match=said):
        emulated("grbl", settings={f"_{number}": value})


def test_a_speed_beyond_the_boards_is_refused():
    with pytest.raises(
        InputError, match=r"speed_deg_s: found 90; allowed: at most 60 for axis turn. the board's \$112"
    ):
        emulated("grbl", speed_deg_s=90)


def test_travel_runs_below_the_switch_and_is_unknown_without_soft_limits():
    stage, _ = emulated("grbl")
    assert stage._controller.travel == ((-360, 0), (-180, 0), (-180, 0))
    stage, _ = emulated("grbl", settings={"_20": 0})
    assert stage._controller.travel == ((-np.inf, np.inf),) * 3


def test_travel_runs_above_a_low_switch_that_is_the_origin():
    def spoil(_, said):
        return said.replace(b"[OPT:V,", b"[OPT:VZ,")

    axes = [{"name": "pan", "channel": "X", "limits_deg": [10, 20]}]
    stage, _ = emulated("grbl", spoil=spoil, settings={"_23": 1}, axes=axes)
    assert stage._controller.travel == ((0, 180),)


@pytest.mark.parametrize("state", ["Hold:0", "Door:1", "Alarm", "Sleep", "Check"])
def test_a_state_that_somebody_else_has_caused_ends_the_move(state):
    stage, port = emulated("grbl")
    stage.home()
    port.spoil = lambda _, said: said.replace(b"<Jog", f"<{state}".encode())
    with pytest.raises(DeviceError, match=rf"status \(\?\): found state {state}; expected: Idle or Jog or Run"):
        stage.move([5.0, 5.0, 5.0])
    assert not port.device.busy(port.time)


def test_a_target_beyond_the_travel_is_refused_by_the_board_in_words():
    stage, port = emulated("grbl")
    stage.home()
    port.device.settings[130] = 40.0  # changed behind our back
    with pytest.raises(DeviceError, match=r"error:15, a target beyond its travel.*The stage was stopped"):
        stage.move([0.0, -20.0, 0.0])


def test_homing_that_finds_no_switch_is_told_in_words():
    stage, _ = emulated(
        "grbl", spoil=lambda _, said: said.replace(b"ok\r\n", b"ALARM:9\r\n") if said == b"ok\r\n" else said
    )
    with pytest.raises(DeviceError, match=r"\$H: found ALARM:9, homing: no switch found"):
        stage.home()


def test_a_homing_cycle_is_stopped_by_a_reset():
    stage, port = emulated("grbl", home_timeout_s=0.2)
    with pytest.raises(DeviceError, match=r"\$H: found no reply within 0.2 s.*The stage was stopped"):
        stage.home()
    assert port.device.homing is None
    assert port.device.alarm


def test_an_end_of_the_travel_may_be_reached_but_for_a_part_of_a_step():
    axes = [{"name": "pan", "channel": "X", "limits_deg": [-90.004, 90.004], "zero_deg": -90}]
    stage, _ = emulated("grbl", axes=axes)
    stage.home()
    assert stage.move([90.004])[0] == pytest.approx(90, abs=1e-3)
    assert stage.move([-90.004])[0] == pytest.approx(-90, abs=1e-3)
