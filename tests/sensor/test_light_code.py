"""The codes of light: what each image shows, in which order, and what a sensor file may say."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from characterisation.files.documents import validate
from characterisation.files.errors import InputError
from mitsim.sensor.light_code import (
    GrayCode,
    GrayCodePhaseShift,
    PhaseShift,
    axes,
    check_stack,
    patterns,
    roles,
    value,
)

WIDTH, HEIGHT = 96, 40


def test_a_fringe_is_the_cosine_of_the_stated_convention():
    code = PhaseShift(periods_px=[100, 16], steps=[3, 5], mean=0.4, contrast=0.3)
    images = patterns(code, WIDTH, HEIGHT)
    assert images.shape == (8, HEIGHT, WIDTH) and images.dtype == np.float32
    u = np.arange(WIDTH)
    for image, (period, steps, k) in zip(
        images, [(100, 3, k) for k in range(3)] + [(16, 5, k) for k in range(5)], strict=True
    ):
        expected = 0.4 + 0.3 * np.cos(2 * np.pi * (u + 0.5) / period - 2 * np.pi * k / steps)
        np.testing.assert_allclose(image, np.broadcast_to(expected, image.shape), atol=1e-7)


def test_rows_run_down_as_columns_run_along():
    across, down = (patterns(PhaseShift(periods_px=[50, 10], axis=axis), 30, 30) for axis in ("columns", "rows"))
    np.testing.assert_array_equal(down, across.transpose(0, 2, 1))


def test_gray_patterns_are_those_of_opencv():
    """The order, too: pattern, inverse, from the most significant bit on, columns before rows."""
    other = cv2.structured_light.GrayCodePattern.create(WIDTH, HEIGHT)
    wanted = np.stack(other.generate()[1]) / 255
    white, black, *ours = patterns(GrayCode(axis="both"), WIDTH, HEIGHT)
    np.testing.assert_array_equal(np.stack(ours), wanted)
    assert white.min() == 1 and black.max() == 0


@pytest.mark.parametrize("bits", [None, 3, 7])
def test_neighbouring_stripes_differ_in_one_bit(bits):
    code = GrayCode(bits=bits, inverse=False)
    images = patterns(code, WIDTH, HEIGHT)[2:, 0]
    changes = np.abs(np.diff(images, axis=1)).sum(axis=0)
    stripe = int(code.sequence().gray("columns")[0].stripes(WIDTH)[1])
    assert len(images) == (bits or 7)
    edges = np.arange(WIDTH - 1) % stripe == stripe - 1
    assert (changes[edges] == 1).all() and (changes[~edges] == 0).all()
    # and no two stripes look alike
    assert len(np.unique(images.T, axis=0)) == -(-WIDTH // stripe)


def test_complementary_bit_halves_the_fringe():
    plain, half = (GrayCodePhaseShift(period_px=20, complementary=c) for c in (False, True))
    five, six = (code.sequence().gray("columns")[0].stripes(640) for code in (plain, half))
    assert five == (5, 20) and six == (6, 10)
    kinds = [role.kind for role in roles(half, 640, 480)]
    assert kinds == ["white", "black", *["gray"] * 6, *["phase"] * 4]


def test_roles_tell_what_each_image_shows():
    code = GrayCodePhaseShift(period_px=12, steps=3, inverse=True)
    every, images = roles(code, WIDTH, HEIGHT), patterns(code, WIDTH, HEIGHT)
    for role, image in zip(every, images, strict=True):
        np.testing.assert_allclose(image[0], value(code, role, np.arange(WIDTH, dtype=float)), atol=1e-7)
        if role.kind == "gray_inverse":
            twin = next(r for r in every if (r.kind, r.index) == ("gray", role.index))
            np.testing.assert_array_equal(images[every.index(twin)] + image, 1)
    assert [role.shift for role in every if role.kind == "phase"] == pytest.approx([0, 2 * np.pi / 3, 4 * np.pi / 3])


@given(
    st.one_of(
        st.builds(
            PhaseShift,
            periods_px=st.lists(st.integers(3, 500), min_size=1, max_size=4, unique=True).map(
                lambda periods: sorted(map(float, periods), reverse=True)
            ),
            steps=st.integers(3, 9),
            axis=st.sampled_from(["columns", "rows"]),
        ),
        st.builds(GrayCode, axis=st.sampled_from(["columns", "rows", "both"]), inverse=st.booleans()),
        st.builds(
            GrayCodePhaseShift,
            period_px=st.floats(3, 300),
            complementary=st.booleans(),
            white_black=st.booleans(),
            inverse=st.booleans(),
        ),
    ),
    st.integers(16, 120),
    st.integers(16, 80),
)
def test_any_code_fits_any_projector(code, width, height):
    images, every = patterns(code, width, height), roles(code, width, height)
    assert images.shape == (len(every), height, width)
    assert images.min() >= -1e-6 and images.max() <= 1 + 1e-6
    assert {role.axis for role in every} - {None} == set(axes(code))
    check_stack(images, every)


@pytest.mark.parametrize(
    ("model", "table", "field"),
    [
        (PhaseShift, {"periods_px": [20, 160]}, "periods_px"),
        (PhaseShift, {"periods_px": []}, "periods_px"),
        (PhaseShift, {"periods_px": [20], "steps": 2}, "steps"),
        (PhaseShift, {"periods_px": [160, 20], "steps": [4]}, "steps"),
        (PhaseShift, {"periods_px": [20], "mean": 0.3}, "mean"),
        (GrayCode, {"inverse": False, "white_black": False}, "inverse"),
        (GrayCode, {"bits": 0}, "bits"),
        (GrayCodePhaseShift, {"period_px": 20, "perod": 3}, "perod"),
    ],
)
def test_a_code_that_cannot_be_is_refused(model, table, field):
    with pytest.raises(InputError, match=field):
        validate("sensor.toml", table, model)


def test_more_bits_than_pixels_are_refused():
    with pytest.raises(InputError, match="up to 7"):
        patterns(GrayCode(bits=8), WIDTH, HEIGHT)


@pytest.mark.parametrize("stack", [np.zeros((3, 4, 5), np.uint8), np.zeros((4, 5), np.uint8), np.zeros((4, 4, 5), int)])
def test_a_stack_that_is_not_the_codes_is_refused(stack):
    with pytest.raises(InputError, match="image stack"):
        check_stack(stack, roles(PhaseShift(periods_px=[20]), 20, 20))
