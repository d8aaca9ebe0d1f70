"""A calibrated stage as a file, the poses that it gives, and how sure they are."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from characterisation.files.documents import validate
from characterisation.files.errors import InputError
from characterisation.stage.calibration import BoardCalibration
from characterisation.stage.turning_axes import TurningAxes
from mitsim.maps.campaign.stage_pose import StageTable, read_stage_calibration, write_stage_calibration
from mitsim.sensor.transforms import Transform

AXES = TurningAxes(
    np.array([[0.1, -0.99, 0.05], [1.0, 0.02, -0.01]])
    / np.linalg.norm([[0.1, -0.99, 0.05], [1.0, 0.02, -0.01]], axis=1, keepdims=True),
    np.array([[5.0, 0.0, 510.0], [0.0, -3.0, 495.0]]),
)
ON_BOARD = Transform.from_degrees([178.0, 3.0, 40.0], [35.0, -20.0, 4.0])
ANGLES = np.radians([17.0, -23.0])


@pytest.fixture
def board(rng):
    zero = Transform.from_degrees([4.0, -6.0, 10.0], [-20.0, 30.0, 505.0]).matrix()
    spread = rng.normal(size=(14, 14)) * np.array([2e-4, 2e-4, 0.05, 0.05] * 2 + [3e-4] * 3 + [0.08] * 3)
    return BoardCalibration(AXES, zero, spread.T @ spread, np.empty((0, 6)))


def table(**changes):
    axes = [
        {"name": "pan", "direction": [0, 1, 0], "limits_deg": [-40, 40]},
        {"name": "tilt", "direction": [1, 0, 0], "limits_deg": [-30, 30]},
    ]
    return validate("campaign.toml", {"axes": axes, "calibration": "stage.json", **changes}, StageTable)


def test_a_calibration_comes_back_from_its_file(board, tmp_path):
    write_stage_calibration(tmp_path / "stage.json", board, ["pan", "tilt"], board_from_coupon=ON_BOARD)
    read = read_stage_calibration(tmp_path / "stage.json")
    expected = board.poses(ANGLES[None])[0] @ ON_BOARD.matrix()
    assert np.allclose(read.sensor_from_coupon(ANGLES).matrix(), expected, atol=1e-9)
    assert read.names == ("pan", "tilt")


def test_the_planned_stage_shows_the_normals_that_the_calibrated_one_has(board, tmp_path):
    """Angles of the planned stage, in the view frame of the coupon, turn the coupon's normal to what was wanted."""
    facing = Transform.from_degrees([180.0, 2.0, 0.0], [0.0, 0.0, 0.0])
    write_stage_calibration(tmp_path / "stage.json", board, ["pan", "tilt"], board_from_coupon=facing)
    read = read_stage_calibration(tmp_path / "stage.json")
    planned = read.stage(table(), np.zeros(3))
    wanted = np.array([[0.2, 0.1, 1.0], [-0.3, 0.2, 1.0], [0.05, -0.3, 1.0]])
    wanted /= np.linalg.norm(wanted, axis=1, keepdims=True)
    ray = read.sensor_from_coupon([0.0, 0.0]).translation
    ray = ray / np.linalg.norm(ray)
    x = np.array([1.0, 0.0, 0.0]) - ray[0] * ray  # the view frame: x along the baseline, z back along the ray
    x /= np.linalg.norm(x)
    view = np.stack([x, np.cross(-ray, x), -ray])
    for normal, angles in zip(wanted, planned.angles(wanted), strict=True):
        assert np.allclose(view @ read.sensor_from_coupon(angles).rotation[:, 2], normal, atol=1e-6)


def test_an_axis_that_counts_the_other_way_is_refused(board, tmp_path):
    write_stage_calibration(tmp_path / "stage.json", board, ["pan", "tilt"], board_from_coupon=ON_BOARD)
    read = read_stage_calibration(tmp_path / "stage.json")
    turned = table(
        axes=[
            {"name": "pan", "direction": [0, -1, 0], "limits_deg": [-40, 40]},
            {"name": "tilt", "direction": [1, 0, 0], "limits_deg": [-30, 30]},
        ]
    )
    with pytest.raises(InputError, match=r"axes\.0\.direction: found pan 17\d deg.*the other way"):
        read.stage(turned, np.zeros(3))
    renamed = table(axes=[{"name": "turn", "direction": [0, 1, 0], "limits_deg": [-40, 40]}])
    with pytest.raises(InputError, match="found pan, tilt; allowed: turn"):
        read.stage(renamed, np.zeros(3))


def connection(**changes):
    axes = [
        {"name": "pan", "channel": "P", "limits_deg": [-60, 60]},
        {"name": "tilt", "channel": "T", "limits_deg": [-40, 30]},
    ]
    return {"kind": "ptu", "port": "/dev/ttyUSB0", "axes": axes, **changes}


def test_a_connection_is_of_the_same_axes_and_holds_their_limits():
    assert table(connection=connection()).connection.kind == "ptu"
    with pytest.raises(InputError, match="in the order of the stage's: pan, tilt, not tilt, pan"):
        table(connection=connection(axes=connection()["axes"][::-1]))
    narrow = [{**connection()["axes"][0], "limits_deg": [-30, 60]}, connection()["axes"][1]]
    with pytest.raises(InputError, match="limits_deg of pan within those of its connection, -30 to 60"):
        table(connection=connection(axes=narrow))


@given(data=st.data())
def test_a_damaged_calibration_is_refused_or_read(data, tmp_path_factory):
    """Cut at any place, any byte changed: a message that names the file, or a calibration; never a
    traceback."""
    folder = tmp_path_factory.getbasetemp()
    known = BoardCalibration(AXES, np.eye(4), np.eye(14), np.empty((0, 6)))
    file = folder / "fuzzed.json"
    write_stage_calibration(file, known, ["pan", "tilt"])
    text = bytearray(file.read_bytes())
    if data.draw(st.booleans()):
        text = text[: data.draw(st.integers(0, len(text) - 3))]
    else:
        text[data.draw(st.integers(0, len(text) - 1))] = data.draw(st.integers(0, 255))
    file.write_bytes(text)
    try:
        read = read_stage_calibration(file)
    except InputError as error:
        assert error.where == str(file)
    else:
        assert np.isfinite(read.sensor_from_coupon(np.zeros(2)).matrix()).all()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"schema_version": 2}, "schema_version"),
        ({"axes": []}, "axes"),
        ({"sensor_from_coupon": [[2, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}, "a rotation matrix"),
        ({"axis": 1}, "axis: found an unknown key"),
    ],
)
def test_a_calibration_that_makes_no_sense_is_named(tmp_path, change, words):
    known = BoardCalibration(AXES, np.eye(4), np.eye(14), np.empty((0, 6)))
    file = tmp_path / "stage.json"
    write_stage_calibration(file, known, ["pan", "tilt"])
    file.write_text(json.dumps({**json.loads(file.read_text()), **change}))
    with pytest.raises(InputError, match=words) as caught:
        read_stage_calibration(file)
    assert caught.value.where == str(file)
