"""Lines, deadlines, and what is said of ports that cannot be opened."""

import sys

import pytest

from characterisation.files.errors import InputError, MissingEnvironmentError
from mitsim.capture.devices.device_error import DeviceError
from mitsim.capture.devices.serial_line import SerialLine, line_ends, open_line, text_of
from tests.capture.devices.emulated_port import TalkingPort


def line(*chunks, endless=b""):
    port = TalkingPort(*chunks, endless=endless)
    return SerialLine(port, "stage on test", port.clock())


def test_lines_are_put_together_and_blank_ones_skipped():
    talk = line(b"* 1", b"23\r\n\r\n\n", b"ok\r", b"<Id", b"le>\n")
    assert [talk.receive(1.0, "a", "b") for _ in range(3)] == ["* 123", "ok", "<Idle>"]


def test_a_reply_in_time_is_taken_and_silence_ends_at_the_deadline():
    talk = line(b"ok\r\n")
    assert talk.receive(0.5, "a", "b") == "ok"
    with pytest.raises(DeviceError, match=r"stage on test: PP: found no reply within 0.3 s; expected: a star"):
        talk.receive(talk.clock.now() + 0.3, "PP", "a star")
    assert 0.3 <= talk.clock.now() <= 0.35


def test_half_a_line_is_shown():
    with pytest.raises(DeviceError, match=r"a partial line within 0.3 s, '\* -2'"):
        line(b"* -2").receive(0.3, "PP", "*")


def test_bytes_without_a_line_end_are_garbage():
    with pytest.raises(DeviceError, match="bytes without the end of a line"):
        line(endless=b"\xff").receive(100.0, "PP", "*")


def test_lines_without_an_end_do_not_outlast_the_deadline():
    talk = line(endless=b"[MSG:x]\r\n")
    with pytest.raises(DeviceError, match="other lines until the time-out"):
        for _ in range(10_000):
            talk.receive(0.5, "PP", "*")
    assert talk.clock.now() < 0.6


def test_what_came_unasked_is_taken_without_waiting():
    talk = line(b"!P", b"* 7")
    assert talk.unread() == "!P* 7"
    assert talk.unread() == ""


def test_draining_ends_when_it_is_quiet_or_at_last():
    talk = line(b"Pan-Tilt", b"(C)2003")
    assert talk.drain(0.2, 5.0) == "Pan-Tilt(C)2003"
    assert talk.clock.now() < 0.3
    talk = line(endless=b"x")
    talk.drain(0.2, 1.0)
    assert 1.0 <= talk.clock.now() < 1.1


def test_bytes_that_are_no_text_are_shown_as_numbers():
    assert text_of(b"ok \xff\x00\r\n") == "ok \\xff\\x00\r\n"
    assert [line_ends(data) for data in (b"", b"a", b"\r", b"ab\r\nc", b"\n\r")] == [0, 0, 1, 3, 1]


def test_a_port_that_is_not_there_is_named_with_those_that_are():
    with pytest.raises(DeviceError, match=r"stage on /dev/ttyMITSIM: open: found no such port.*Ports of this machine"):
        open_line("/dev/ttyMITSIM", 9600, "stage on /dev/ttyMITSIM")


def test_a_socket_where_nobody_listens_is_a_device_error():
    with pytest.raises(DeviceError, match=r"does not open.*Check that the device is on and has no other connection"):
        open_line("socket://127.0.0.1:9", 9600, "stage")


def test_a_way_of_writing_ports_that_pyserial_does_not_know_is_an_input_error():
    with pytest.raises(InputError, match="port: found 'sokcet://host:1'"):
        open_line("sokcet://host:1", 9600, "stage")


def test_a_port_of_another_user_tells_what_to_do(monkeypatch):
    import serial

    def refuse(*_, **__):
        raise serial.SerialException(13, "could not open port: Permission denied")

    monkeypatch.setattr(serial, "serial_for_url", refuse)
    with pytest.raises(DeviceError, match=r"permission denied.*dialout"):
        open_line("/dev/ttyUSB0", 9600, "stage")


def test_without_pyserial_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "serial", None)
    with pytest.raises(MissingEnvironmentError, match=r"pip install \"mitsim\[hardware\]\""):
        open_line("/dev/ttyUSB0", 9600, "stage")


def test_the_room_is_imported_without_pyserial():
    import subprocess

    code = "import sys; sys.modules['serial'] = None; import mitsim.capture.devices.stage"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
