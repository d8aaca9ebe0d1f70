"""Replies that are spoilt at random: no traceback, no hang, no wrong angle, and axes that stand."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from characterisation.files.errors import InputError
from mitsim.capture.devices.device_error import DeviceError
from mitsim.capture.devices.serial_line import SerialLine
from mitsim.capture.devices.stage import start_stage
from tests.capture.devices.emulated_port import TalkingPort, emulated, true_angles
from tests.capture.devices.emulator_process import connection

#: no run may take longer [s]: opening, homing, two moves and closing with every time-out of the connection used up
#: once for each of the exchanges that they are made of would be 90 s; a run ends with its first
LONGEST_S = 30.0

FRAGMENTS = [
    b"*\r\n",
    b"* 0\r\n",
    b"* -1\r\n",
    b"* 185.1428\r\n",
    b"! \r\n",
    b"!P",
    b"!T\r\n",
    b"PP * 3\r\n",
    b"* Pan 3\r\n",
    b"ok\r\n",
    b"ok",
    b"error:9\r\n",
    b"ALARM:1\r\n",
    b"Grbl 1.1h ['$' for help]\r\n",
    b"[MSG:x]\r\n",
    b"[",
    b"<",
    b"<Idle|MPos:0.000,0.000,0.000|FS:0,0>\r\n",
    b"<Run|WPos:0,0,0>\r\n",
    b"$100=80.000\r\n",
    b"[VER:1.1h.2019:]\r\n",
    b"\r\n",
    b"\x00",
    b"\xff\xfe",
    b"* " + b"9" * 400 + b"\r\n",
    b"<Idle|MPos:1e999,0,0>\r\n",
]

noise = st.one_of(st.sampled_from(FRAGMENTS), st.binary(max_size=40))
#: what becomes of one reply: nothing, something else, more in front or behind, or a part of it
spoils = st.one_of(
    st.just(lambda said: b""),
    noise.map(lambda bytes_: lambda said: bytes_),
    noise.map(lambda bytes_: lambda said: bytes_ + said),
    noise.map(lambda bytes_: lambda said: said + bytes_),
    st.integers(0, 30).map(lambda cut: lambda said: said[:cut]),
    st.integers(0, 60).map(lambda at: lambda said: said[: at % len(said)] + b"\x8f" + said[at % len(said) + 1 :]),
)


@pytest.mark.parametrize("kind", ["ptu", "grbl"])
@settings(max_examples=100)
@given(data=st.data())
def test_one_spoilt_reply_ends_in_an_error_or_does_no_harm(kind, data):
    number, spoil, seen = data.draw(st.integers(1, 60)), data.draw(spoils), []

    def spoilt(count, said):
        seen.append(count)
        return spoil(said) if count == number else said

    port = None
    try:
        stage, port = emulated(kind, spoil=spoilt)
        with stage:
            stage.home()
            for angles in ([6.0, -4.0, 3.0], [-5.0, 5.0, 1.0]):
                back = stage.move(angles[: len(stage.axes)])
                assert np.abs(back - true_angles(stage, port)).max() <= 2 * stage.connection.tolerance_deg
    except (DeviceError, InputError):
        assert number in seen
    if port is not None:
        assert not port.device.busy(port.time + 0.5)  # a PTU ends its reset, whatever it is told
        assert not port.open
        assert port.time < LONGEST_S


@pytest.mark.parametrize("kind", ["ptu", "grbl"])
@settings(max_examples=60)
@given(replies=st.lists(noise, max_size=60), endless=st.one_of(st.just(b""), noise))
def test_random_talk_never_gives_a_traceback_or_a_hang(kind, replies, endless):
    port = TalkingPort(*[reply for reply in replies if reply], endless=endless)
    table = connection(kind, "noise")
    with pytest.raises((DeviceError, InputError)):  # no noise here makes a whole stage
        stage = start_stage(table, SerialLine(port, table.where, port.clock()))
        stage.home()
    assert port.time < LONGEST_S
