"""The [stage.connection] table."""

import re
import tomllib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from characterisation.files.documents import validate
from characterisation.files.errors import InputError
from mitsim.capture.devices.stage_connection import AxisConnection, StageConnection
from tests.capture.devices.emulator_process import GRBL, PTU, connection


def test_ports_have_the_speed_that_devices_are_delivered_with():
    assert connection("ptu", "/dev/ttyUSB0").bits_per_second == 9600
    assert connection("grbl", "/dev/ttyACM0").bits_per_second == 115200
    assert connection("grbl", "/dev/ttyACM0", baud=250000).bits_per_second == 250000


@given(st.floats(-500, 500), st.floats(-10, 10).filter(lambda gear: abs(gear) > 0.01), st.floats(-360, 360))
def test_own_degrees_and_angles_are_inverse(angle, gear, zero):
    axis = AxisConnection(name="pan", channel="P", limits_deg=(-1, 1), gear=gear, zero_deg=zero)
    assert axis.angle(axis.device_angle(angle)) == pytest.approx(angle, abs=1e-9)


def test_a_reversed_axis_turns_the_other_way():
    axis = AxisConnection(name="tilt", channel="Y", limits_deg=(-1, 1), gear=-2, zero_deg=-90)
    assert (axis.device_angle(0), axis.device_angle(10)) == (-90, -110)


@pytest.mark.parametrize(
    ("table", "changes", "said"),
    [
        (PTU, {"axes": [{"name": "a", "channel": "X", "limits_deg": [-1, 1]}]}, "of kind ptu: channels P, T, not X"),
        (GRBL, {"axes": [{"name": "a", "channel": "P", "limits_deg": [-1, 1]}]}, "channels X, Y, Z, not P"),
        (PTU, {"axes": [PTU["axes"][0], PTU["axes"][0]]}, "each channel and each name once"),
        (PTU, {"axes": [{"name": "a", "channel": "P", "limits_deg": [1, 1]}]}, "the lower limit before the upper"),
        (PTU, {"axes": [{**PTU["axes"][0], "gear": 0}]}, "a gear that turns the axis"),
        (PTU, {"axes": []}, "List should have at least 1 item"),
        (PTU, {"prot": "x"}, "did you mean 'port'"),
        (PTU, {"port": " /dev/ttyUSB0"}, "without blanks around it"),
        (PTU, {"reply_timeout_s": 0}, "greater than 0"),
        (PTU, {"kind": "zaber"}, "'ptu' or 'grbl'"),
    ],
)
def test_what_cannot_be_is_refused_with_what_is_allowed(table, changes, said):
    with pytest.raises(InputError, match=said):
        validate("campaign.toml", {**table, "port": "COM3", **changes}, StageConnection)


PAGE = (Path(__file__).resolve().parents[3] / "docs/how-to/stage.md").read_text(encoding="utf-8")


def test_the_pages_examples_are_valid():
    examples = re.findall(r"```toml\n(.*?)```", PAGE, re.DOTALL)
    assert [validate("stage.md", tomllib.loads(text), StageConnection).kind for text in examples] == ["ptu", "grbl"]
