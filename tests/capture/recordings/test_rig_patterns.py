"""The rig files of the how-to show what they say: patterns computed as the named programs, or the text, define them.

No function of mitsim makes the expected images: whole numbers of pixels, their Gray codes, and waves of pixel numbers.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import pytest

from mitsim.sensor.light_code import patterns
from mitsim.sensor.preset import load_sensor
from tests.capture.recordings.test_rig_files import FILES, RIGS

Image = np.ndarray[Any, Any]
ON, OFF = 1.0, 0.0


def gray_of(number):
    return number ^ (number >> 1)


class Screen:
    """A projector to paint on: an image varies along columns or rows by a function of the pixel's number."""

    def __init__(self, width, height):
        self.width, self.height = width, height

    def plain(self, level):
        return np.full((self.height, self.width), level)

    def paint(self, axis, function):
        u, v = np.arange(self.width), np.arange(self.height)
        along = function(u)[None, :] if axis == "columns" else function(v)[:, None]
        return np.broadcast_to(along, (self.height, self.width)).astype(float)

    def bit(self, axis, bit, shift=0, wide=1):
        """Bit of the Gray code of (pixel + shift) // wide, 0 is the least significant."""
        return self.paint(axis, lambda p: (gray_of((p + shift) // wide) >> bit) & 1)

    def pair(self, *which, **more):
        image = self.bit(*which, **more)
        return [image, 1 - image]

    def fringes(self, axis, period, phases_deg, *, middle, wave=np.cos):
        """Waves of the pixel's number, or of its middle when pixels are [0, 1], [1, 2] ..."""
        x = 0.5 if middle else 0.0
        return [
            self.paint(axis, lambda p, t=t: 0.5 + 0.5 * wave(2 * np.pi * (p + x) / period + np.radians(t)))
            for t in phases_deg
        ]


def opencv(s):
    done, images = cv2.structured_light.GrayCodePattern.create(s.width, s.height).generate()
    assert done
    return [image / 255 for image in images] + [s.plain(ON), s.plain(OFF)]


def moreno(s):
    """Scan3d-capture: white, black; then bit after bit of the code of c + (2^bits - width) / 2, each with its inverse.

    It shows as many bits along rows as along columns, the most significant ones.
    """
    bits = {axis: int(np.ceil(np.log2(size))) for axis, size in (("columns", s.width), ("rows", s.height))}
    out = [s.plain(ON), s.plain(OFF)]
    for axis, size in (("columns", s.width), ("rows", s.height)):
        for number in range(min(bits.values())):
            out += s.pair(axis, bits[axis] - 1 - number, shift=(2 ** bits[axis] - size) // 2)
    return out


def kamino(s, cell=100):
    """kamino410/phase-shifting, with blocks of ``cell`` px: cos(2 pi u / P + (k - 2) 120 deg), k = 1, 2, 3.

    P is 2/3 and 1 of a cell. OpenCV's GrayCodePattern numbers the cells.
    """
    out = []
    for axis in ("columns", "rows"):
        for period in (2 * cell / 3, cell):
            out += s.fringes(axis, period, [120 * (k - 2) for k in (1, 2, 3)], middle=False)
    cells = -(-s.width // cell), -(-s.height // cell)
    _, coarse = cv2.structured_light.GrayCodePattern.create(*cells).generate()
    for image in coarse:
        wide = np.kron(image, np.ones((cell, cell)))[: s.height, : s.width]
        out.append(wide / 255)
    return [*out, s.plain(ON), s.plain(OFF)]


def pair_of_cameras(s):
    """The seven most significant of ten bits: stripes of 8 px."""
    out = []
    for axis in ("columns", "rows"):
        for bit in range(6, -1, -1):
            out += s.pair(axis, bit, wide=8)
    return [*out, s.plain(ON), s.plain(OFF)]


def hierarchical(s, periods, steps):
    out = []
    for period in periods:
        out += s.fringes("columns", period, [-360 * k / steps for k in range(steps)], middle=True)
    return out


def complementary(s, period, white_black=False, fringes_first=True):
    stripes = -(-s.width // (period // 2))
    bits = [s.bit("columns", bit, wide=period // 2) for bit in range(int(np.ceil(np.log2(stripes))) - 1, -1, -1)]
    waves = s.fringes("columns", period, [0, -90, -180, -270], middle=True)
    plain = [s.plain(ON), s.plain(OFF)] if white_black else []
    return plain + (waves + bits if fringes_first else bits + waves)


def rows(s):
    images = [s.bit("rows", bit) for bit in range(int(np.ceil(np.log2(s.height))) - 1, -1, -1)]
    return [s.plain(OFF), s.plain(ON), *images, *(1 - image for image in images)]


def on_off(s):
    """Sorted names: x_bit00_off, x_bit00_on, x_bit01_off ...; bit 0 of seven is the finest, of stripes of 2 px."""
    out = []
    for axis in ("columns", "rows"):
        for bit in range(7):
            out += s.pair(axis, bit, wide=2)[::-1]
    return out


def threshold(s):
    bits = int(np.ceil(np.log2(s.width)))
    return [s.plain(ON), s.plain(OFF), *(s.bit("columns", bit) for bit in range(bits - 1, -1, -1))]


SHOWN: dict[str, Callable[[Screen], list[Image]]] = {
    "opencv": opencv,
    "moreno": moreno,
    "pair": pair_of_cameras,
    "fringes": lambda s: hierarchical(s, [920, 152, 25.333], 4),
    "complementary": lambda s: complementary(s, 32),
    "pair-fringes": lambda s: complementary(s, 40, white_black=True, fringes_first=False),
    "rows": rows,
    "fisheye": lambda s: complementary(s, 40, white_black=True, fringes_first=False),
    "both-axes": kamino,
    "on-off": on_off,
    "threshold": threshold,
    "beat": lambda s: hierarchical(s, [30, 29], 8),
}


def code_of(tmp_path, name, text=None):
    (tmp_path / "rig.toml").write_text(text or FILES[name], encoding="utf-8")
    cameras = list(RIGS[name].cameras.values())
    RIGS[name].calibration(tmp_path, cameras[0], cameras[1] if len(cameras) == 2 else RIGS[name].projector)
    return load_sensor(tmp_path / "rig.toml", "decoding", (240, 180)).pattern


def test_every_rig_file_has_its_program():
    assert set(SHOWN) == set(FILES)


@pytest.mark.parametrize("name", SHOWN)
def test_a_rig_file_shows_what_its_program_shows(tmp_path, name):
    width, height = RIGS[name].projector.width, RIGS[name].projector.height
    found = patterns(code_of(tmp_path, name), width, height)
    expected = SHOWN[name](Screen(width, height))
    assert len(found) == len(expected)
    for number, (image, other) in enumerate(zip(found, expected, strict=True)):
        assert np.abs(image - other).max() < 1e-5, f"image {number}"


@pytest.mark.parametrize(("width", "height"), [(1024, 768), (800, 600), (854, 480), (1280, 800), (1366, 768)])
def test_moreno_and_taubin_s_program_on_other_projectors(tmp_path, width, height):
    """projector_info.txt has the size in which the calibration is: halved until the bits that are shown suffice."""
    shown = min(int(np.ceil(np.log2(size))) for size in (width, height))
    halved = [int(np.ceil(np.log2(size))) - shown for size in (width, height)]
    size = width >> halved[0], height >> halved[1]
    text = FILES["moreno"].replace("1024", str(size[0])).replace("768", str(size[1]))
    found = patterns(code_of(tmp_path, "moreno", text), *size)
    expected = moreno(Screen(width, height))
    assert len(found) == len(expected)
    for image, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(image, other[:: 2 ** halved[1], :: 2 ** halved[0]][: size[1], : size[0]])


@pytest.mark.parametrize("width", [800, 1024, 1140, 1280, 1366])
def test_a_centred_code_is_that_of_lanman_and_taubin_s_program(width):
    """White first; code of c + floor((2^n - width) / 2), most significant bit first."""
    from mitsim.sensor.image_sequence import ImageSequence

    code = ImageSequence(
        kind="image_sequence",
        images=[{"show": "white"}, {"show": "black"}, {"show": "gray", "offset_px": "centred"}],
    )
    bits = int(np.ceil(np.log2(width)))
    column = np.arange(width) + (2**bits - width) // 2
    expected = [(gray_of(column) >> (bits - 1 - n)) & 1 for n in range(bits)]
    np.testing.assert_array_equal(patterns(code, width, 4)[2:, 0], expected)
