"""Gray code against OpenCV's own decoder, and what becomes of bits that cannot be read."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from characterisation.files.errors import InputError
from characterisation.point_cloud import Status
from mitsim.decoding.structured_light.decoder import decode_coordinates
from mitsim.decoding.structured_light.gray_code import binary_of_gray
from mitsim.sensor.decoder_settings import DecoderSettings
from mitsim.sensor.light_code import GrayCode, GrayCodePhaseShift, roles, value

WIDTH, HEIGHT = 300, 200
SETTINGS = DecoderSettings(near_mm=300, far_mm=900)
SHAPE = (60, 80)


def coordinates(rng):
    """What each pixel of a camera sees: any projector coordinate, between pixel centres as well."""
    return rng.uniform(-0.49, WIDTH - 0.51, SHAPE), rng.uniform(-0.49, HEIGHT - 0.51, SHAPE)


def draw(code, u, v, dtype=np.uint8, scale=1):
    """Images of a surface with random albedo and ambient light."""
    rng = np.random.default_rng(4)
    albedo, ambient = rng.uniform(30, 200, SHAPE), rng.uniform(5, 40, SHAPE)
    every = roles(code, WIDTH, HEIGHT)
    images = np.stack([ambient + albedo * value(code, r, v if r.axis == "rows" else u) for r in every]) * scale
    return images if np.issubdtype(dtype, np.floating) else np.rint(images).astype(dtype)


def decode(stack, code, full_scale=255, settings=SETTINGS):
    return decode_coordinates(stack, code, (WIDTH, HEIGHT), settings, full_scale=full_scale)


@given(st.lists(st.integers(0, 2**16 - 1), min_size=1))
def test_binary_of_gray_undoes_the_gray_code(numbers):
    n = np.array(numbers, np.uint16)
    np.testing.assert_array_equal(binary_of_gray(n ^ (n >> 1)), n)


def test_the_columns_and_rows_are_those_that_opencv_decodes(rng):
    code, other = GrayCode(axis="both"), cv2.structured_light.GrayCodePattern.create(WIDTH, HEIGHT)
    other.setWhiteThreshold(5)
    stack = draw(code, *coordinates(rng))
    ours = decode(stack, code)
    images = list(stack[2:])
    for row in range(0, SHAPE[0], 3):
        for column in range(0, SHAPE[1], 3):
            failed, (x, y) = other.getProjPixel(images, column, row)
            assert not failed
            assert (ours["columns"].value[row, column], ours["rows"].value[row, column]) == (x, y)


@pytest.mark.parametrize("thresholds", [(True, True), (True, False), (False, True)], ids=["all", "inverse", "middle"])
@pytest.mark.parametrize(("dtype", "scale"), [(np.uint8, 1), (np.uint16, 16), (np.float32, 1)])
def test_every_threshold_and_depth_gives_the_stripe(thresholds, dtype, scale, rng):
    inverse, white_black = thresholds
    code, (u, v) = GrayCode(inverse=inverse, white_black=white_black), coordinates(rng)
    found = decode(draw(code, u, v, dtype, scale), code, 255 * scale)["columns"]
    assert (found.status == Status.VALID).all()
    np.testing.assert_array_equal(found.value, np.rint(u))
    assert np.allclose(found.sigma, 1 / np.sqrt(12))


def test_coarse_stripes_are_found_by_their_middle(rng):
    code, (u, v) = GrayCode(bits=6), coordinates(rng)  # 9 bits would be needed: stripes of 8 px
    found = decode(draw(code, u, v), code)["columns"]
    first = np.floor((u + 0.5) / 8) * 8
    np.testing.assert_array_equal(found.value, (first + np.minimum(first + 8, WIDTH) - 1) / 2)  # 300 px cut the last
    assert np.isclose((found.value - u).std(), found.sigma[0, 0], rtol=0.05)


@pytest.mark.parametrize("offset", [0.0, 10.0])
def test_the_centre_of_a_stripe_that_the_projector_cuts_is_that_of_its_part_inside(offset, rng):
    """Before, columns 1136 to 1139 of 1140 gave 1143.5."""
    code, width = GrayCode(bits=7, offset_px=offset), 1140  # stripes of 16 px
    u = np.tile(np.arange(width, dtype=float), (2, 1))
    stack = np.stack([20 + 200 * value(code, role, u) for role in roles(code, width, 2)]).astype(np.uint8)
    found = decode_coordinates(stack, code, (width, 2), SETTINGS, full_scale=255)["columns"].value
    first = np.floor((u + offset) / 16) * 16 - offset
    inside = np.maximum(first, 0), np.minimum(first + 16, width)
    np.testing.assert_array_equal(found, (inside[0] + inside[1] - 1) / 2)


def test_a_pixel_on_an_edge_gets_the_edge(rng):
    """Half of its light comes from either stripe: one bit is undecided, and both its values lead to neighbours."""
    code = GrayCode(bits=5)
    stripe, (_, v) = 16, coordinates(rng)
    edge = rng.integers(1, WIDTH // stripe, SHAPE) * stripe - 0.5
    both = [draw(code, edge + side, v, float) for side in (-0.1, 0.1)]
    found = decode(np.rint((both[0] + both[1]) / 2).astype(np.uint8), code)["columns"]
    assert (found.status == Status.VALID).all()
    np.testing.assert_array_equal(found.value, edge)


def test_light_from_two_far_stripes_is_inconsistent(rng):
    code, (u, v) = GrayCode(), coordinates(rng)
    mixed = (draw(code, u, v, float) + draw(code, (u + WIDTH / 2) % WIDTH - 0.49, v, float)) / 2
    found = decode(np.rint(mixed).astype(np.uint8), code)["columns"]
    assert np.mean(found.status == Status.PHASE_INCONSISTENT) > 0.99


def test_a_dark_pixel_is_faint_and_a_blown_out_one_saturated(rng):
    code, (u, v) = GrayCode(), coordinates(rng)
    stack = draw(code, u, v)
    stack[:, :10] = stack[1, :10]  # black in every image
    stack[:, 10:20] = 255
    stack[0, 20:30] = 255  # white blown out, but the bits can be told apart
    status = decode(stack, code)["columns"].status
    assert (status[:10] == Status.LOW_MODULATION).all()
    assert (status[10:20] == Status.SATURATED).all()
    assert (status[20:] == Status.VALID).all()


def test_a_stripe_beyond_the_projector_is_inconsistent(rng):
    code, (u, v) = GrayCode(), coordinates(rng)  # 9 bits tell 512 columns, the projector has 300
    found = decode(draw(code, u + 205, v), code)["columns"]
    beyond = np.rint(u + 205) >= WIDTH
    assert (found.status[beyond] == Status.PHASE_INCONSISTENT).all()
    assert (found.status[~beyond] == Status.VALID).all()


@pytest.mark.parametrize("complementary", [True, False])
@pytest.mark.parametrize(
    "thresholds", [(True, False), (False, True), (False, False)], ids=["inverse", "middle", "mean"]
)
@pytest.mark.parametrize(("mean", "contrast"), [(0.5, 0.5), (0.4, 0.3)])
def test_fringes_with_gray_orders_are_exact(complementary, thresholds, mean, contrast, rng):
    inverse, white_black = thresholds
    code = GrayCodePhaseShift(
        period_px=17.3,
        steps=5,
        complementary=complementary,
        inverse=inverse,
        white_black=white_black,
        mean=mean,
        contrast=contrast,
    )
    u, v = coordinates(rng)
    found = decode_coordinates(draw(code, u, v, float), code, (WIDTH, HEIGHT), SETTINGS, full_scale=255)["columns"]
    assert (found.status == Status.VALID).all()
    assert np.abs(found.value - u).max() < 1e-5


def test_the_complementary_bit_keeps_the_edges_of_the_fringes(rng):
    """Blurred stripes: within half a pixel of an edge the bit is as good as random."""
    u, v = coordinates(rng)
    wrong = {}
    for complementary in (True, False):
        code = GrayCodePhaseShift(period_px=16, steps=4, complementary=complementary)
        shift = rng.uniform(-0.5, 0.5, SHAPE)
        stack = np.stack(
            [
                image if role.kind == "phase" else shifted
                for role, image, shifted in zip(
                    roles(code, WIDTH, HEIGHT),
                    draw(code, u, v),
                    draw(code, np.clip(u + shift, -0.49, WIDTH - 0.51), v),
                    strict=True,
                )
            ]
        )
        found = decode_coordinates(stack, code, (WIDTH, HEIGHT), SETTINGS, full_scale=255)["columns"]
        wrong[complementary] = np.mean(~(np.abs(found.value - u) < 8))
    assert wrong[True] == 0
    # |shift| is 1/4 px in the mean, and an edge comes every 16 px: 1/64 of 4800 pixels, +- 4 sigma
    assert abs(wrong[False] - 1 / 64) < 4 * np.sqrt(1 / 64 / u.size)


def test_a_phase_that_contradicts_the_gray_code_is_refused(rng):
    code, (u, v) = GrayCodePhaseShift(period_px=20, steps=4), coordinates(rng)
    stack = draw(code, u, v)
    fringes = slice(-4, None)
    stack[fringes, :30] = draw(code, u + 10, v)[fringes, :30]  # half a fringe elsewhere
    found = decode_coordinates(stack, code, (WIDTH, HEIGHT), SETTINGS, full_scale=255)["columns"]
    # refused where the phase is 3/8 to 5/8 of a period from the stripe's centre; the stripe is +-1/4 wide: half of them
    assert abs(np.mean(found.status[:30] == Status.PHASE_INCONSISTENT) - 0.5) < 4 * np.sqrt(0.25 / 2400)
    assert (found.status[30:] == Status.VALID).all()


def test_quantisation_enters_as_the_closed_form_says(rng):
    code, (u, v) = GrayCodePhaseShift(period_px=20, steps=8), coordinates(rng)
    stack = draw(code, u, v)
    found = decode_coordinates(stack, code, (WIDTH, HEIGHT), SETTINGS, full_scale=255)["columns"]
    expected = 20 / (2 * np.pi) * np.sqrt(2 / 8 / 12) / found.modulation
    assert np.isclose(((found.value - u) / expected).std(), 1, rtol=0.05)  # 4800 pixels: standard error 1 %


def test_a_stack_of_another_code_is_refused():
    with pytest.raises(InputError, match="image stack"):
        decode(np.zeros((7, *SHAPE), np.uint8), GrayCode())
    with pytest.raises(InputError, match="full_scale"):
        decode(np.zeros((20, *SHAPE), np.uint8), GrayCode(), full_scale=300)
