"""Pan-tilt units: what is sent and how replies are read."""

import pytest

from characterisation.files.errors import InputError
from mitsim.capture.devices.device_error import DeviceError
from tests.capture.devices.emulated_port import emulated


def sent(port):
    """Record what is sent from now on, as commands."""
    commands, receive = [], port.device.receive

    def recorded(data, now):
        commands.append(data.decode())
        receive(data, now)

    port.device.receive = recorded
    return commands


def test_counts_follow_from_the_resolution_that_the_unit_tells():
    stage, port = emulated("ptu")
    stage.home()
    commands = sent(port)
    stage.move([21.3, -10.0])
    assert "PP414 " in commands  # 21.3 deg / 0.0514285 deg, the manual's own example (4.3.3)
    assert "TP-194 " in commands


def test_it_begins_by_stopping_and_by_making_replies_terse():
    _, port = emulated("ptu")
    assert not port.device.echo
    assert not port.device.verbose


def test_speed_is_set_in_counts_and_kept_within_what_the_unit_allows():
    _, port = emulated("ptu", speed_deg_s=20)
    assert port.device.speed == {"P": 389, "T": 389}
    with pytest.raises(InputError, match=r"speed_deg_s: found 300; allowed: 1.59 to 149 for axis pan"):
        emulated("ptu", speed_deg_s=300)


def test_a_reset_that_answers_with_the_signs_of_both_ends_is_no_fault():
    stage, port = emulated("ptu")
    assert (stage.home() == 0).all()
    assert stage.home().tolist() == [0, 0]
    assert port.device.resetting is None


def replaced(wanted, said):
    """Another reply in the place of one that holds ``wanted``."""
    return lambda _, reply: said if wanted in reply else reply


@pytest.mark.parametrize(
    ("wanted", "said", "complaint"),
    [
        (b"185.1428", b"* 0\r\n", "PR|resolution: found 0 seconds of arc"),
        (b"185.1428", b"* nan\r\n", "PR: found 'nan'; expected: a number"),
        (b"185.1428", b"! Illegal command entered\r\n", "PR: found '! Illegal command entered'"),
        (b"-3090", b"* 4000\r\n", "bounds, channel P: found 4000 to 3090.*Reset the unit"),
        (b"-3090", b"* 1e5\r\n", "PN: found '1e5'; expected: a whole number"),
        (b"* 1000", b"* 0\r\n", "pace, channel P: found 0 counts/s"),
    ],
)
def test_replies_that_cannot_be_are_refused_when_it_is_opened(wanted, said, complaint):
    with pytest.raises(DeviceError, match=complaint):
        emulated("ptu", spoil=replaced(wanted, said))


@pytest.mark.parametrize("said", [b"!P* 100\r\n", b"!P\r\n* 100\r\n", b"!P", b"* 100\r\n!P\r\n"])
def test_the_sign_of_an_end_is_seen_wherever_it_comes(said):
    stage, port = emulated("ptu")
    stage.home()
    stage.move([0.0, 0.0])
    port.heard += said if said != b"* 100\r\n!P\r\n" else b""
    port.spoil = lambda number, reply: said if reply.startswith(b"* ") else reply
    with pytest.raises(DeviceError, match=r"!P: the pan axis has hit its end.*The stage was stopped"):
        stage.move([5.0, 0.0])


def test_an_order_that_the_unit_refuses_is_told_in_its_own_words():
    stage, port = emulated("ptu")
    stage.home()
    stage._controller.travel = ((-1000.0, 1000.0),) * 2
    stage.limits = ((-170.0, 170.0),) * 2
    with pytest.raises(DeviceError, match="PP3306: found '! Maximum allowable Pan position is 3090'"):
        stage.move([170.0, 0.0])
    assert not port.device.busy(port.time)


def test_a_unit_that_is_not_in_the_middle_after_a_reset_is_told():
    stage, port = emulated("ptu")
    port.spoil = lambda _, reply: b"* 57\r\n" if reply == b"* 0\r\n" else reply
    with pytest.raises(DeviceError, match=r"reset \(R\), channel P: found 2.931 deg; expected: 0 deg after a reset"):
        stage.home()


def test_a_reset_that_never_ends_is_given_up():
    stage, port = emulated("ptu", home_timeout_s=4.0)
    port.spoil = lambda _, reply: b"" if b"!T" in reply else reply
    before = port.time
    with pytest.raises(DeviceError, match=r"reset \(R\): found no reply within 4 s"):
        stage.home()
    assert port.time - before < 6
