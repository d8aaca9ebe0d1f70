"""A lens in mm and pixels in um in place of a focal length in pixels."""

import tomllib
from importlib.resources import files

import numpy as np
import pytest

from characterisation.files.errors import InputError
from mitsim.sensor.preset import load_sensor

PRESET = (files("mitsim.sensor") / "presets" / "zivid-2-m70.toml").read_text()


def sensor(tmp_path, change):
    """A preset with the lines of its first camera's ``focal_px`` and ``principal_px`` changed."""
    table = tomllib.loads(PRESET)
    name = next(iter(table["cameras"]))
    lines, inside = [], False
    for line in PRESET.splitlines():
        inside = line.startswith(f"[cameras.{name}]") or (inside and not line.startswith("["))
        if inside and line.startswith("focal_px"):
            lines += change
        elif not (inside and line.startswith("principal_px")):
            lines.append(line)
    (tmp_path / "mine.toml").write_text("\n".join(lines))
    return table, name, tmp_path / "mine.toml"


def test_a_lens_of_the_data_sheet_is_a_focal_length_in_pixels(tmp_path):
    table, name, path = sensor(tmp_path, ["focal_mm = 8.0", "pixel_um = [3.45, 3.2]"])
    eye = load_sensor(path).rig.cameras[name]
    width, height = table["cameras"][name]["width"], table["cameras"][name]["height"]
    # a pixel p wide at the focal length f is seen under atan(p / f); in pixels the focal length is f / p
    assert np.allclose(eye.matrix[[0, 1], [0, 1]], [8.0 / 3.45e-3, 8.0 / 3.2e-3])
    assert np.allclose(eye.matrix[:2, 2], [(width - 1) / 2, (height - 1) / 2])


def test_the_imager_says_the_pixel_of_its_cameras(tmp_path):
    table, name, path = sensor(tmp_path, ["focal_mm = 8"])
    eye = load_sensor(path).rig.cameras[name]
    assert eye.matrix[0, 0] == pytest.approx(8000 / table["imager"]["pixel_um"])


@pytest.mark.parametrize(
    ("lines", "says"),
    [
        (["focal_mm = 8", "focal_px = [1e3, 1e3]"], "one of the two"),
        (["focal_mm = -8"], "a number over 0"),
        (["focal_mm = [8, 8, 8]"], "a number over 0"),
        (["focal_length_mm = 8"], "write focal_mm"),
        (["focal_length_px = 900"], "write focal_px"),
        (["focal_mm = 8", "pixel_size_um = 3"], "write pixel_um"),
    ],
)
def test_what_is_meant_is_told(tmp_path, lines, says):
    _, name, path = sensor(tmp_path, lines)
    with pytest.raises(InputError, match=says) as caught:
        load_sensor(path)
    assert f"cameras.{name}." in str(caught.value)


def test_a_projector_needs_its_own_pixel(tmp_path):
    lines = PRESET.splitlines()
    at = lines.index("[projector]")
    focal = next(i for i in range(at, len(lines)) if lines[i].startswith("focal_px"))
    lines[focal] = "focal_mm = 12"
    (tmp_path / "mine.toml").write_text("\n".join(lines))
    with pytest.raises(InputError, match=r"projector\.pixel_um"):
        load_sensor(tmp_path / "mine.toml")
