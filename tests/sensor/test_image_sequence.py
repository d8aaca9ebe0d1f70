"""Sequences of images in any order: roles, patterns, and the same coordinates as the codes of our own."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from characterisation.files.errors import InputError
from characterisation.point_cloud import Status
from mitsim.decoding.structured_light.decoder import decode_coordinates
from mitsim.sensor.decoder_settings import DecoderSettings
from mitsim.sensor.image_sequence import ImageSequence
from mitsim.sensor.light_code import GrayCode, GrayCodePhaseShift, PhaseShift, patterns, roles

WIDTH, HEIGHT = 100, 60
SETTINGS = DecoderSettings(near_mm=400, far_mm=900)
WHITE, BLACK = {"show": "white"}, {"show": "black"}


def sequence(*images, **more):
    return ImageSequence(kind="image_sequence", images=list(images), **more)


def gray(axis="columns", **more):
    return {"show": "gray", "axis": axis, **more}


def fringes(period, axis="columns", **more):
    return {"show": "fringes", "axis": axis, "period_px": period, **more}


def shown(code, levels=200.0, black=20.0):
    """Images of a camera whose pixels are those of the projector."""
    return np.rint(black + levels * patterns(code, WIDTH, HEIGHT)).astype(np.uint8)


def decoded(code, stack=None, settings=SETTINGS):
    return decode_coordinates(shown(code) if stack is None else stack, code, (WIDTH, HEIGHT), settings, full_scale=255)


def assert_true(found, tolerance):
    truth = {"columns": np.arange(WIDTH)[None, :], "rows": np.arange(HEIGHT)[:, None]}
    for axis, coordinate in found.items():
        assert (coordinate.status == Status.VALID).all(), axis
        assert np.abs(coordinate.value - truth[axis]).max() <= tolerance, axis


@pytest.mark.parametrize("first", ["most_significant", "least_significant"])
@pytest.mark.parametrize("inverse", ["none", "each", "all"])
@pytest.mark.parametrize("white_first", [True, False])
def test_gray_bits_in_any_order_give_the_columns_and_rows(first, inverse, white_first):
    plain = [WHITE, BLACK]
    bits = [gray("rows", first=first, inverse=inverse), gray("columns", first=first, inverse=inverse)]
    code = sequence(*plain, *bits) if white_first else sequence(*bits, *reversed(plain))
    assert_true(decoded(code), 0.0)


def test_a_sequence_in_our_own_order_is_our_own_code():
    own = GrayCode(axis="both")
    code = sequence(WHITE, BLACK, gray(inverse="each"), gray("rows", inverse="each"))
    assert code.roles(WIDTH, HEIGHT) == roles(own, WIDTH, HEIGHT)
    np.testing.assert_array_equal(patterns(code, WIDTH, HEIGHT), patterns(own, WIDTH, HEIGHT))
    both = GrayCodePhaseShift(period_px=20, steps=4)
    same = sequence(WHITE, BLACK, gray(stripe_px=10), fringes(20, steps=4))
    np.testing.assert_array_equal(patterns(same, WIDTH, HEIGHT), patterns(both, WIDTH, HEIGHT))
    for a, b in zip(decoded(both).values(), decoded(same).values(), strict=True):
        np.testing.assert_array_equal(a.value, b.value)
        np.testing.assert_array_equal(a.status, b.status)
    periods = PhaseShift(periods_px=[110, 16], steps=[3, 5])
    same = sequence(fringes(16, steps=5), fringes(110, steps=3))
    stack = shown(periods)
    np.testing.assert_array_equal(
        decoded(same, np.concatenate([stack[3:], stack[:3]]))["columns"].value, decoded(periods)["columns"].value
    )


@pytest.mark.parametrize(
    "shifts", [[0, 90, 180, 270], [-120, 0, 120], [270, 180, 90, 0], [10, 100, 250], [0, 30, 60, 90]]
)
def test_any_shifts_give_the_phase(shifts):
    """Levels are rounded to 1 DN of a modulation of 100: sigma of 0.003 rad or 0.05 px at worst-placed shifts."""
    code = sequence(gray(stripe_px=8), WHITE, fringes(16, shifts_deg=shifts), BLACK)
    assert_true(decoded(code), 0.05)


@pytest.mark.parametrize("wave", ["cosine", "sine"])
@pytest.mark.parametrize("at", ["edge", "pixel"])
@pytest.mark.parametrize("sign", [1, -1])
def test_the_words_of_an_owner_show_his_formula(wave, at, sign):
    """mean + contrast wave(2 pi x / P + theta), x from the edge or from the middle of the first pixel."""
    angles = [-120.0, 10.0, 120.0]
    listed = {"phases_deg": angles} if sign > 0 else {"shifts_deg": angles}
    x = np.arange(WIDTH) + (0.5 if at == "edge" else 0.0)
    function = {"cosine": np.cos, "sine": np.sin}[wave]
    code = sequence(gray(stripe_px=8), fringes(16, wave=wave, at=at, **listed))
    shown_here = patterns(code, WIDTH, HEIGHT)[-3:, 0]
    for image, angle in zip(shown_here, angles, strict=True):
        np.testing.assert_allclose(
            image, 0.5 + 0.5 * function(2 * np.pi * x / 16 + sign * np.radians(angle)), atol=1e-6
        )
    assert_true(decoded(code), 0.05)


@pytest.mark.parametrize("wave", ["cosine", "sine"])
@pytest.mark.parametrize("at", ["edge", "pixel"])
def test_our_own_codes_take_the_same_words(wave, at):
    x = 2 * np.pi * (np.arange(WIDTH) + (0.5 if at == "edge" else 0.0)) / 16
    expected = 0.5 + 0.5 * {"cosine": np.cos, "sine": np.sin}[wave](x - np.pi / 2)
    for code, index in (
        (PhaseShift(periods_px=[110, 16], wave=wave, at=at), 5),
        (GrayCodePhaseShift(period_px=16, wave=wave, at=at), -3),
    ):
        np.testing.assert_allclose(patterns(code, WIDTH, HEIGHT)[index, 0], expected, atol=1e-6)
        assert_true(decoded(code), 0.05)


@pytest.mark.parametrize("offset", [0, 3, 14, 28, "centred"])
@pytest.mark.parametrize("more", [{"inverse": "each"}, {"bits": 4, "inverse": "all"}, {"inverse": "none"}])
def test_column_c_has_the_code_of_c_plus_offset(offset, more):
    """The bits of 100 columns in a code of 128: 28 columns are left, 14 on either side of a centred code."""
    code = sequence(WHITE, BLACK, gray(offset_px=offset, **more))
    number = (np.arange(WIDTH) + (14 if offset == "centred" else offset)) >> (3 if "bits" in more else 0)
    bits = more.get("bits", 7)
    images = {
        (role.kind, role.index): image[0]
        for role, image in zip(code.roles(WIDTH, HEIGHT), patterns(code, WIDTH, HEIGHT), strict=True)
    }
    for bit in range(bits):
        np.testing.assert_array_equal(images["gray", bit], ((number ^ (number >> 1)) >> (bits - 1 - bit)) & 1)
    found = decoded(code)["columns"]
    assert (found.status == Status.VALID).all()
    assert np.abs(found.value - np.arange(WIDTH)).max() <= (4 if "bits" in more else 0)
    own = GrayCode(offset_px=offset, bits=bits, inverse=more["inverse"] != "none")
    if more["inverse"] != "all":
        np.testing.assert_array_equal(patterns(own, WIDTH, HEIGHT), patterns(code, WIDTH, HEIGHT))
        np.testing.assert_array_equal(decoded(own)["columns"].value, found.value)


def test_columns_between_the_edges_of_offset_stripes():
    code = sequence(gray(bits=4, inverse="each", offset_px="centred"))
    found = decode_coordinates(shown(code), code, (WIDTH, HEIGHT), SETTINGS, full_scale=255, interpolate=True)
    inner = found["columns"].value[:, 8:-8]
    assert np.abs(inner - np.arange(WIDTH)[8:-8]).max() < 0.6


def test_fringes_under_an_offset_gray_code():
    code = sequence(gray(stripe_px=8, offset_px=5), fringes(16, steps=4))
    assert_true(decoded(code), 0.05)


def test_stripes_beyond_the_projector_are_no_coordinates():
    """Images of columns 0 to 99 of an offset code; with the offset of another, 10 columns lie beyond."""
    shown_code, stated = (sequence(gray(inverse="each", offset_px=offset)) for offset in (0, 10))
    found = decoded(stated, shown(shown_code))["columns"]
    assert (found.status[:, :10] == Status.PHASE_INCONSISTENT).all()
    assert (found.status[:, 10:] == Status.VALID).all()


def test_several_periods_under_one_gray_code_measure_with_the_finest():
    """Gray stripes of 40 px, fringes of 32 and 80/3 px that beat at 160 px: stripes of 1/4 of the beat."""
    code = sequence(
        fringes(80 / 3, steps=4),
        fringes(32, steps=4),
        gray(stripe_px=40, inverse="all"),
        fringes(12, "rows", steps=4),
        gray("rows", stripe_px=6, inverse="each"),
    )
    assert_true(decoded(code), 0.05)


def test_images_that_nobody_needs_are_left_out():
    code = sequence({"show": "unused", "count": 3}, WHITE, gray(), {"show": "unused"}, BLACK)
    stack = shown(code)
    assert (stack[:3] == 20).all()
    stack[:3], stack[-2] = 255, 99
    assert_true(decoded(code, stack), 0.0)


def test_stripes_wider_than_a_pixel_are_known_to_half_their_width():
    code = sequence(WHITE, BLACK, gray(bits=4))
    found = decoded(code)["columns"]
    assert np.isclose(found.sigma, 8 / np.sqrt(12)).all()
    assert np.abs(found.value - np.arange(WIDTH)).max() == 3.5


def test_gamma_comes_from_white_and_black_where_three_steps_cannot_tell_it():
    """A projector of gamma 2.2: without correction three steps are wrong by 0.2 rad, up to half a pixel of 16."""
    code = sequence(WHITE, fringes(20, steps=3), gray(stripe_px=10), BLACK)
    stack = (20 + 200 * patterns(code, WIDTH, HEIGHT).astype(float) ** 2.2).astype(np.float32)
    off = {}
    for corrected in (False, True):
        settings = SETTINGS.model_copy(update={"correct_gamma": corrected})
        found = decoded(code, stack, settings)["columns"]
        off[corrected] = np.nanmax(np.abs(found.value - np.arange(WIDTH)))
    assert off[False] > 0.5
    assert off[True] < 0.02
    with pytest.raises(InputError, match="5 or more"):
        decoded(sequence(gray(stripe_px=10), fringes(20, steps=3)), stack[1:-1], settings)
    with pytest.raises(InputError, match="equidistant"):
        decoded(sequence(WHITE, fringes(20, shifts_deg=[0, 90, 180]), gray(stripe_px=10), BLACK), stack, settings)


@given(
    st.permutations(["white", "black", "columns", "rows", "fringes"]),
    st.sampled_from(["none", "each", "all"]),
    st.booleans(),
    st.integers(3, 6),
)
def test_every_order_shows_each_image_once_and_decodes(order, inverse, least_first, steps):
    first = "least_significant" if least_first else "most_significant"
    groups = {
        "white": WHITE,
        "black": BLACK,
        "columns": gray(stripe_px=8, first=first, inverse=inverse),
        "rows": gray("rows", first=first, inverse=inverse),
        "fringes": fringes(16, steps=steps),
    }
    code = sequence(*[groups[name] for name in order])
    every = code.roles(WIDTH, HEIGHT)
    assert len(every) == len(set(every)) == 2 + (4 + 6) * (1 if inverse == "none" else 2) + steps
    assert_true(decoded(code), 0.05)


@pytest.mark.parametrize(
    ("images", "message"),
    [
        ([WHITE, BLACK], "at least one group"),
        ([gray()], "inverse, white and black, or fringes"),
        ([WHITE, gray()], "inverse, white and black, or fringes"),
        ([WHITE, WHITE, BLACK, gray()], "once each"),
        ([gray(inverse="each"), gray(inverse="all")], "one group of gray"),
        ([fringes(16, steps=4), fringes(16, steps=3)], "one of fringes for each period"),
        ([fringes(16)], "steps or shifts_deg"),
        ([fringes(16, shifts_deg=[0, 1, 2], phases_deg=[0, 1, 2])], "one of the three"),
        ([fringes(16, steps=4, wave="triangle")], "wave"),
        ([gray(inverse="each", offset_px=-1)], "offset_px"),
        ([fringes(16, steps=4, shifts_deg=[0, 1, 2])], "steps or shifts_deg"),
        ([fringes(16, shifts_deg=[0, 120, 360])], "different shifts"),
        ([{"show": "white", "count": 2}, BLACK, gray()], "one white"),
        ([{"show": "dots"}], "dots"),
    ],
)
def test_a_sequence_that_cannot_be_decoded_is_refused(images, message):
    with pytest.raises(ValidationError, match=message):
        sequence(*images)


def test_an_offset_leaves_stripes_for_all_columns():
    with pytest.raises(InputError, match="from an offset of 29 px on"):
        gray_group({"offset_px": 29}).roles(WIDTH, HEIGHT)
    with pytest.raises(InputError, match="from an offset of 29 px on"):
        roles(GrayCode(offset_px=29), WIDTH, HEIGHT)


@pytest.mark.parametrize("given", [{"bits": 5}, {"bits": 3, "stripe_px": 8}, {"stripe_px": 1e-3}])
def test_gray_bits_cover_the_projector_or_are_refused(given):
    if "stripe_px" in given and given["stripe_px"] < 1:
        with pytest.raises(ValidationError, match="greater than or equal to 1"):
            gray_group(given)
    elif "stripe_px" in given:
        with pytest.raises(InputError, match="3 Gray bits of stripes of 8 px"):
            gray_group(given).roles(WIDTH, HEIGHT)
    else:
        assert len(gray_group(given).roles(WIDTH, HEIGHT)) == 10


def gray_group(given):
    return sequence(gray(inverse="each", **given))
