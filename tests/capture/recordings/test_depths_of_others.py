"""Depth images whose numbers lie along the rays, or in OpenEXR's format."""

from __future__ import annotations

import json

import numpy as np
import OpenEXR
import pytest

from characterisation.files.errors import InputError
from mitsim.capture.recordings.any_recording import ReadOptions, read_recording

WIDTH, HEIGHT, FOCAL = 320, 240, 260.0


def camera_file(folder):
    """Return the calibration of a camera of 63 deg."""
    path = folder / "camera.json"
    path.write_text(json.dumps({"fx": FOCAL, "fy": FOCAL, "cx": 159.5, "cy": 119.5, "width": WIDTH, "height": HEIGHT}))
    return path


def slopes():
    """Return x and y of the image at depth 1."""
    columns, rows = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    return (columns - 159.5) / FOCAL, (rows - 119.5) / FOCAL


def room(noise=0.0):
    """Return depths [mm] of a wall, a floor and a box before them, with noise of a time-of-flight camera."""
    x, y = slopes()
    depth = np.minimum(2000 / (1 + 0.2 * x), np.where(y > 0.05, 450 / np.maximum(y, 0.05), np.inf))
    depth = np.where((np.abs(x) < 0.15) & (np.abs(y) < 0.15), 1200, depth)
    return depth + noise * np.random.default_rng(3).standard_normal(depth.shape)


def along_rays(depth):
    """Return distances along the rays."""
    x, y = slopes()
    return depth * np.sqrt(1 + x * x + y * y)


def imported(folder, values, **named):
    """Return the capture of values in a file."""
    np.save(folder / "depth.npy", values.astype(np.float32))
    return read_recording(folder / "depth.npy", ReadOptions(calibration=str(camera_file(folder)), **named)).capture


def test_distances_along_the_rays_are_read_as_such(tmp_path):
    capture = imported(tmp_path, along_rays(room()), along="ray")
    assert capture.derived["depth"] == pytest.approx(room(), rel=1e-6)
    assert capture.settings["along"] == "ray" and "warnings" not in capture.settings


@pytest.mark.parametrize("noise", [0, 8])
def test_planes_tell_distances_along_the_rays(tmp_path, noise):
    """A wall and a floor at 2 m were curved by up to 0.3 m, without a word."""
    ranges = along_rays(room(noise))
    (warning,) = imported(tmp_path, ranges).settings["warnings"]
    assert "say --along ray" in warning
    assert "warnings" not in imported(tmp_path, ranges, along="axis").settings
    assert "warnings" not in imported(tmp_path, room(noise)).settings


def test_a_curved_part_is_not_taken_for_distances(tmp_path):
    """The inverse depth of a sphere bends as that of a plane along rays does, by its radius."""
    x, y = slopes()
    for radius in (400, 900):
        middle = 700 + radius
        along, square = middle / np.sqrt(1 + x * x + y * y), x * x + y * y + 1
        inside = radius**2 - middle**2 + along**2
        ball = np.where(inside > 0, (along - np.sqrt(np.maximum(inside, 0))) / np.sqrt(square), np.nan)
        assert "warnings" not in imported(tmp_path, ball).settings


def test_along_is_refused_where_it_has_no_meaning(tmp_path):
    with pytest.raises(InputError, match=r"--along: found 'rays'; allowed: axis \| ray"):
        imported(tmp_path, room(), along="rays")
    x, y = slopes()
    np.save(tmp_path / "points.npy", np.stack([x, y, np.ones_like(x)], axis=-1) * room()[..., None])
    with pytest.raises(InputError, match="--along for an array of points"):
        read_recording(tmp_path / "points.npy", ReadOptions(along="ray"))


@pytest.mark.parametrize("channels", [("Z",), ("R", "G", "B"), ("V",), ("Z", "R", "A"), ("A", "depth.V", "R")])
def test_depths_in_openexr_are_read(tmp_path, channels):
    depth = room().astype(np.float32)
    file = tmp_path / "depth.exr"
    colour = {name: np.zeros_like(depth) for name in channels}
    depths = [name for name in channels if name.endswith(("Z", "V"))] or list(channels)
    OpenEXR.File({"type": OpenEXR.scanlineimage}, colour | dict.fromkeys(depths, depth)).write(str(file))
    capture = read_recording(file, ReadOptions(calibration=str(camera_file(tmp_path)))).capture
    assert np.array_equal(capture.derived["depth"], depth)


def test_openexr_without_depths_is_refused(tmp_path):
    file = tmp_path / "colour.exr"
    colour = {name: np.full((HEIGHT, WIDTH), value, np.float32) for name, value in zip("RGB", (1, 2, 3), strict=True)}
    OpenEXR.File({"type": OpenEXR.scanlineimage}, colour).write(str(file))
    options = ReadOptions(calibration=str(camera_file(tmp_path)))
    with pytest.raises(InputError, match=r"colour\.exr: channels: found B, G, R"):
        read_recording(file, options)
    whole = file.read_bytes()
    for length in (4, 60, len(whole) // 2):
        file.write_bytes(whole[:length])
        with pytest.raises(InputError, match=r"colour\.exr"):
            read_recording(file, options)
