"""A rig moved by named parameters is the rig that OpenCV's own derivatives say, and its covariance keeps in a file."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from characterisation.files.errors import InputError
from mitsim.sensor.camera import Camera, Rig
from mitsim.sensor.preset import load_sensor, presets
from mitsim.sensor.rig_covariance import RigCovariance, read_rig_covariance, write_rig_covariance
from mitsim.sensor.rig_parameters import (
    PATH_NAMES,
    moved,
    parameter_differences,
    parameter_names,
    parameter_values,
    path_error,
)
from mitsim.sensor.transforms import Transform

SENSORS = {name: load_sensor(name) for name in presets()}
FISHEYE = Camera(
    np.array([[420.0, 0, 318], [0, 421, 240], [0, 0, 1]]),
    np.array([0.05, -0.01, 0.002, -5e-4]),
    640,
    480,
    Transform.from_degrees([1, -4, 2], [80, 1, 3]),
    "fisheye",
)
STEP = {"px": 0.5, "rad": 1e-3, "mm": 0.3}


def steps(names, scale):
    """A plausible error of every parameter, times ``scale`` (n,)."""
    return scale * np.array([STEP.get(name.rpartition("_")[2], 1e-3) for name in names])


@pytest.mark.parametrize("name", presets())
def test_a_rig_moved_by_zero_is_the_same_rig(name):
    rig = SENSORS[name].rig
    names = parameter_names(rig)
    same = moved(rig, names, np.zeros(len(names)))
    for eye, camera in (rig.cameras | {"projector": rig.projector}).items():
        other = (same.cameras | {"projector": same.projector})[eye]
        assert np.array_equal(camera.matrix, other.matrix) and np.array_equal(camera.distortion, other.distortion)
        assert np.array_equal(camera.sensor_from_camera.matrix(), other.sensor_from_camera.matrix())


@given(st.sampled_from(presets()), st.data())
def test_values_move_by_what_was_asked_and_back(name, data):
    rig = SENSORS[name].rig
    names = parameter_names(rig)
    by = steps(names, data.draw(arrays(float, len(names), elements=st.floats(-1, 1))))
    there = moved(rig, names, by)
    apart = parameter_values(there, names) - parameter_values(rig, names)
    linear = ["rotation" not in name for name in names]  # rotation vectors do not add up
    assert np.allclose(apart[linear], by[linear], atol=1e-9)
    assert np.allclose(parameter_differences(rig, there, names), by, atol=1e-9)
    grid = np.array([[100.0, 80.0], [300.0, 200.0]])
    back = moved(there, names, by * np.where(linear, -1, 0))
    for start in range(len(names)):  # about three axes at once, the inverse is the negative
        if "rotation_x" in names[start]:
            back = moved(back, names[start : start + 3], -by[start : start + 3])
    for eye, camera in rig.cameras.items():
        points = camera.sensor_from_camera.points(camera.rays(grid) * 600)
        assert np.allclose(back.cameras[eye].project(points), grid, atol=1e-6)


@pytest.mark.parametrize("name", ["ensenso-n10", "ensenso-n35", "david-sls-3", "kinect-v2"])
def test_pixels_move_as_the_jacobian_of_opencv_says(name, rng):
    rig = SENSORS[name].rig
    names = parameter_names(rig)
    for eye, camera in (rig.cameras | {"projector": rig.projector}).items():
        pixels = rng.uniform([0.2, 0.2], [0.8, 0.8], (40, 2)) * [camera.width, camera.height]
        points = camera.sensor_from_camera.points(camera.rays(pixels) * 700)
        local = camera.sensor_from_camera.inverse().points(points)
        _, jacobian = cv2.projectPoints(
            local.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), camera.matrix, camera.distortion
        )
        turn, shift, rest = jacobian[:, :3], jacobian[:, 3:6], jacobian[:, 6:]
        own = [n for n in names if n.rpartition(".")[0] == eye]
        known = {
            "focal_x_px": rest[:, 0],
            "focal_y_px": rest[:, 1],
            "principal_x_px": rest[:, 2],
            "principal_y_px": rest[:, 3],
        }
        known |= {
            n: rest[:, 4 + k]
            for k, n in enumerate(
                ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tx", "ty")[
                    : rest.shape[1] - 4
                ]
            )
        }
        # the camera turns and moves, so the point turns and moves the other way in its frame
        known |= {f"rotation_{a}_rad": -turn[:, k] for k, a in enumerate("xyz")}
        aside = -shift @ camera.sensor_from_camera.rotation.T
        known |= {f"position_{a}_mm": aside[:, k] for k, a in enumerate("xyz")}
        for full in own:
            h = 1e-5 if "px" not in full else 1e-3
            ends = []
            for sign in (1, -1):
                other = moved(rig, [full], [sign * h])
                ends.append((other.cameras | {"projector": other.projector})[eye].project(points).reshape(-1))
            found = (ends[0] - ends[1]) / (2 * h)
            expected = known[full.rpartition(".")[2]]
            assert np.allclose(found, expected, rtol=1e-4, atol=1e-4 * max(np.abs(expected).max(), 1e-6)), full


def test_names_hold_what_a_calibration_estimates():
    rig = SENSORS["ensenso-n10"].rig
    names = parameter_names(rig, projector=False)
    assert names[:9] == tuple(
        "left." + n
        for n in ("focal_x_px", "focal_y_px", "principal_x_px", "principal_y_px", "k1", "k2", "p1", "p2", "k3")
    )
    assert names[9:] == (
        *("right." + n.partition(".")[2] for n in names[:9]),
        *(
            f"right.{what}"
            for what in (
                "rotation_x_rad",
                "rotation_y_rad",
                "rotation_z_rad",
                "position_x_mm",
                "position_y_mm",
                "position_z_mm",
            )
        ),
    )
    assert {n for n in parameter_names(rig) if n.startswith("projector")} == {
        n.replace("right", "projector") for n in names if n.startswith("right")
    }
    tilted = parameter_names(SENSORS["ensenso-n35"].rig, projector=False)
    assert "left.tx" in tilted and "left.k4" not in tilted and "left.s1" not in tilted
    fish = parameter_names(Rig({"a": FISHEYE}))
    assert [n for n in fish if n.startswith("a.k")] == ["a.k1", "a.k2", "a.k3", "a.k4"]


def test_a_fisheye_moves_too():
    rig = Rig({"a": replace(FISHEYE, sensor_from_camera=Transform.identity()), "b": FISHEYE})
    other = moved(rig, ["b.k4", "b.position_y_mm"], [0.001, 2.0])
    assert other.cameras["b"].distortion[3] == pytest.approx(0.0005) and other.cameras["b"].centre[1] == 3
    assert other.cameras["a"] is rig.cameras["a"]


def test_the_path_of_light_is_no_parameter_of_the_optics():
    rig = SENSORS["kinect-v2"].rig
    other = moved(rig, PATH_NAMES, [5.0, 0.01])
    assert other.cameras == rig.cameras
    assert path_error(PATH_NAMES, [5.0, 0.01]) == (5.0, 0.01) and path_error(["a.k1"], [1.0]) == (0.0, 0.0)


def test_unknown_and_doubled_names_are_refused():
    rig = SENSORS["ensenso-n10"].rig
    with pytest.raises(InputError, match=r"left\.k9, right\.q.*did you mean"):
        moved(rig, ["left.k9", "right.q"], [0, 0])
    with pytest.raises(InputError, match="twice"):
        moved(rig, ["left.k1", "left.k1"], [0, 0])
    with pytest.raises(InputError, match="projector"):
        parameter_names(Rig({"projector": FISHEYE}))


def spread(names, rng, rank):
    """A covariance of these parameters, of low rank if asked."""
    factor = rng.normal(size=(len(names), rank)) * steps(names, np.ones(len(names)))[:, None]
    return RigCovariance(tuple(names), factor @ factor.T, "virtual calibration: a test", {"board": "none", "poses": 7})


@pytest.mark.parametrize("rank", [3, 60])
@pytest.mark.parametrize("name", ["ensenso-n10", "ensenso-n35", "kinect-v2"])
def test_a_file_gives_back_what_was_written(name, rank, rng, tmp_path):
    rig = SENSORS[name].rig
    names = parameter_names(rig) + (PATH_NAMES if name == "kinect-v2" else ())
    written = spread(names, rng, rank)
    write_rig_covariance(tmp_path / "c.toml", written, rig)
    read = read_rig_covariance(tmp_path / "c.toml", rig)
    assert read.names == written.names and read.source == written.source and read.details == written.details
    scale = np.outer(written.one_sigma, written.one_sigma)
    assert np.abs((read.covariance - written.covariance) / scale).max() < 1e-6


@given(rank=st.integers(1, 5))
def test_draws_have_the_covariance(rank):
    names = parameter_names(SENSORS["kinect-v2"].rig, projector=False)
    wanted = spread(names, np.random.default_rng(rank), rank)
    rng = np.random.default_rng(7)
    drawn = np.array([wanted.draw(rng) for _ in range(3000)]) / wanted.one_sigma
    assert np.abs(drawn.mean(axis=0)).max() < 5 / np.sqrt(3000)
    # a covariance of n draws has a standard error under sqrt(2 / n)
    assert np.abs(drawn.T @ drawn / 3000 - wanted.correlation).max() < 5 * np.sqrt(2 / 3000)
    assert np.linalg.matrix_rank(drawn, tol=1e-4 * np.linalg.norm(drawn)) == min(rank, len(names))


def test_a_parameter_without_spread_is_not_drawn(rng):
    covariance = RigCovariance(("left.k1", "left.k2"), np.diag([0.0, 4.0]), "one-sigma figures")
    first, second = covariance.draw(rng)
    assert first == 0 and second != 0


BAD = {
    "no source": (lambda t: t.replace("source =", "sauce ="), "source"),
    "an unknown parameter": (lambda t: t.replace("left.k3", "left.k9"), r"left\.k9.*no parameter.*left\.k"),
    "a negative sigma": (lambda t: t.replace('"left.k1" = ', '"left.k1" = -', 1), "one_sigma.left.k1"),
    "another rig": (lambda t: t.replace("626.18", "700.5"), r"left\.focal_x_px 700\.5.*626\.18.*another rig"),
    "a missing nominal": (lambda t: "\n".join(t.split("\n")[:-2]) + "\n", r"nominal: right\.position_z_mm"),
    "too few rows": (lambda t: t.replace("  [1],\n", "", 1), "23 rows"),
    "a correlation of 2": (lambda t: t.replace("  [1],", "  [2],", 1), r"correlation\.0\.0"),
    "a diagonal of a half": (lambda t: t.replace("  [1],", "  [0.5],", 1), "ones on the diagonal"),
    "no TOML": (lambda t: t + "[", "not TOML"),
}


@pytest.mark.parametrize("fault", BAD)
def test_a_bad_file_is_refused_with_what_is_wrong(fault, rng, tmp_path):
    change, message = BAD[fault]
    rig = SENSORS["ensenso-n10"].rig
    path = tmp_path / "c.toml"
    write_rig_covariance(path, replace(spread(parameter_names(rig, projector=False), rng, 40), details={}), rig)
    text = path.read_text()
    path.write_text(change(text))
    with pytest.raises(InputError, match=f"(?s)c.toml.*{message}"):
        read_rig_covariance(path, rig)


@pytest.mark.parametrize(
    ("correlation", "message"),
    [
        ("[[1, 0.2, 0.1], [0.3, 1, 0], [0.1, 0, 1]]", "0.3 in row 2, column 1, 0.2 across|0.2 in row 1, column 2"),
        ("[[1], [0.9, 1], [-0.9, 0.9, 1]]", "eigenvalue of -0.8"),
    ],
)
def test_correlations_that_cannot_be_are_refused(correlation, message, tmp_path):
    rig = SENSORS["ensenso-n10"].rig
    sigma = '"left.k1" = 1.0\n"left.k2" = 1.0\n"left.k3" = 1.0\n'
    nominal = '"left.k1" = -0.43676\n"left.k2" = 0.24510\n"left.k3" = -0.09039\n'
    path = tmp_path / "c.toml"
    path.write_text(f'source = "x"\ncorrelation = {correlation}\n[one_sigma]\n{sigma}[nominal]\n{nominal}')
    with pytest.raises(InputError, match=message):
        read_rig_covariance(path, rig)


def test_one_sigma_figures_alone_are_enough(tmp_path):
    rig = SENSORS["ensenso-n10"].rig
    path = tmp_path / "c.toml"
    path.write_text('source = "one-sigma figures"\n[one_sigma]\n"left.k1" = 0.002\n[nominal]\n"left.k1" = -0.43676\n')
    assert np.allclose(read_rig_covariance(path, rig).covariance, 4e-6)
