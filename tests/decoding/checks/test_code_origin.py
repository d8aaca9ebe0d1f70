"""Codes whose origin is not the one that the sensor file states: the warning says what to write, and it is right."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from characterisation.point_cloud import Status
from mitsim.capture.decoding import Decoding
from mitsim.decoding.checks.fringe_wave import has_jump
from mitsim.decoding.cloud import capture_cloud
from mitsim.sensor.camera import Camera
from mitsim.sensor.light_code import GrayCode, GrayCodePhaseShift, PhaseShift
from mitsim.sensor.transforms import Transform
from tests.decoding.checks.test_sanity import PAIRED, SETTINGS, gray, pair, said, sequence, taken

WAVES = {
    "pixel": {"at": "pixel"},
    "sine": {"wave": "sine"},
    "sine of pixels": {"wave": "sine", "at": "pixel"},
    "minus cosine": {"half_turn": True},
    "minus sine": {"wave": "sine", "half_turn": True},
    "backward": {"backward": True},
    "sine backward": {"wave": "sine", "backward": True},
}


def fringes(period=16, steps=4, half_turn=False, backward=False, **more):
    angles = np.arange(steps) * 360 / steps + (180 if half_turn else 0)
    return {"show": "fringes", "period_px": period, "phases_deg" if backward else "shifts_deg": list(angles), **more}


def coded(*groups, stripe=8, **more):
    return sequence(*groups, gray(stripe_px=stripe, inverse="none", **more), "white", "black")


def stated(capture, code):
    return replace(capture, decoding=Decoding(pattern=code))


def off_surface(capture):
    """Share of valid pixels, and distances along z of their points from plane or ball [mm]."""
    cloud = capture_cloud(capture, SETTINGS)
    points = cloud.points[cloud.valid].astype(float)
    plane = points[:, 2] - (500 + 0.1 * points[:, 0])
    ball = np.linalg.norm(points - [10, 0, 460], axis=1) - 40
    return cloud.valid.mean(), np.minimum(np.abs(plane), np.abs(ball))


def advised(group, words):
    """A group of fringes as the warning says to write it."""
    out = dict(group)
    for key in ("wave", "at"):
        told = re.search(f'{key} = "(\\w+)"', words)
        out |= {key: told.group(1)} if told else {}
    if "the shifts in the reverse order" in words:
        out["shifts_deg"] = out["shifts_deg"][::-1]
    if "the shifts with the opposite sign" in words:
        out["phases_deg"] = out.pop("shifts_deg")
    if "180 deg more" in words:
        key = "phases_deg" if "phases_deg" in out else "shifts_deg"
        out[key] = [angle + (-180 if key == "phases_deg" else 180) for angle in out[key]]
    return out


@pytest.mark.parametrize("stripe", [8, 16])
@pytest.mark.parametrize("wave", WAVES)
def test_the_advice_for_fringes_beside_a_gray_code_gives_the_surface(stripe, wave):
    """A stripe as wide as a fringe lets all pixels be valid, and a quarter of them a period wrong."""
    capture = taken(coded(fringes(**WAVES[wave]), stripe=stripe))
    wrong = stated(capture, coded(fringes(), stripe=stripe))
    words = said(wrong)
    assert "they fit if the fringes of the columns have" in words
    assert "bits" not in words
    right = stated(capture, coded(advised(fringes(), words), stripe=stripe))
    assert said(right) == ""
    assert np.median(off_surface(right)[1]) < 0.3
    assert np.median(off_surface(wrong)[1]) > 4
    if stripe == 16 and wave == "sine":
        share, off = off_surface(wrong)
        assert share > 0.99
        assert 0.2 < np.mean(off > 100) < 0.35


@pytest.mark.parametrize("period", [8, 15, 17, 32])
@pytest.mark.parametrize("steps", [3, 4])
def test_fringes_of_another_period_are_noticed_by_the_gray_code(period, steps):
    """Before, no word was said of 16 px for 17: all pixels were valid, and a tenth of them 180 mm off."""
    capture = taken(coded(fringes(period=period, steps=steps), stripe=16))
    words = said(stated(capture, coded(fringes(steps=steps), stripe=16)))
    told = re.search(r"at 16 px change by one period over ([0-9.]+) px", words)
    assert told is not None and float(told[1]) == pytest.approx(period, rel=0.03)
    assert said(capture) == ""


@pytest.mark.parametrize("steps", [3, 4, 5])
@pytest.mark.parametrize("gamma", [1.0, 2.2])
@pytest.mark.parametrize("stripe", [8, 16])
def test_a_gamma_is_no_other_origin(steps, gamma, stripe):
    for group in (fringes(steps=steps), fringes(steps=steps, wave="sine"), fringes(steps=steps, at="pixel")):
        assert said(taken(coded(group, stripe=stripe), gamma=gamma)) == ""
    capture = taken(coded(fringes(steps=steps, wave="sine"), stripe=stripe), gamma=gamma)
    assert 'have wave = "sine"' in said(stated(capture, coded(fringes(steps=steps), stripe=stripe)))


def test_several_periods_have_one_wave():
    """Two periods that beat at 48 px, four stripes of 12 px."""
    groups = [fringes(16), fringes(12)]
    shown = [fringes(16, wave="sine"), fringes(12, wave="sine")]
    capture = taken(coded(*shown, stripe=12))
    assert said(capture) == ""
    assert 'they fit if the fringes of the columns have wave = "sine"' in said(
        stated(capture, coded(*groups, stripe=12))
    )


def test_an_origin_that_is_no_usual_one_is_measured():
    capture = taken(coded(fringes(shifts_deg=[40.0, 130.0, 220.0, 310.0])))
    words = said(stated(capture, coded(fringes())))
    told = [int(each) for each in re.search(r"shifts_deg = \[(.*?)\] at 16 px", words).group(1).split(", ")]
    assert np.abs(np.subtract(told, [40, 130, 220, 310])).max() <= 2
    assert np.median(off_surface(stated(capture, coded(fringes(shifts_deg=told))))[1]) < 0.8


def test_a_centred_gray_code_under_fringes_from_the_edge():
    """Stripes of 10 px over 256 columns: 32 of them are centred by 32 px, 1.6 fringes of 20 px."""
    capture = taken(coded(fringes(20), stripe=10, offset_px="centred"))
    assert said(capture) == ""
    words = said(stated(capture, coded(fringes(20), stripe=10)))
    assert 'the Gray code of the columns has offset_px = "centred"' in words


@pytest.mark.parametrize("code", [GrayCodePhaseShift(period_px=16), PhaseShift(periods_px=[260, 40, 16])])
def test_codes_of_our_own_are_told_the_same_key(code):
    capture = taken(code.model_copy(update={"wave": "sine"}))
    assert said(capture) == ""
    assert 'have wave = "sine"' in said(stated(capture, code))


@pytest.mark.parametrize("periods", [[260, 52, 10.4], [260, 40, 16], [20, 18.6], [300, 60, 12]])
@pytest.mark.parametrize("wave", ["sine", "minus cosine", "minus sine"])
def test_the_advice_for_fringes_alone_gives_the_surface(periods, wave):
    """A ratio of five of the periods hides a quarter turn: the coordinate only jumps inside the projector."""
    groups = [fringes(period, 5) for period in periods]
    capture = taken(sequence(*[fringes(period, 5, **WAVES[wave]) for period in periods]))
    assert said(capture) == ""
    words = said(stated(capture, sequence(*groups)))
    assert "the fringes of the columns fit if they have" in words
    right = stated(capture, sequence(*[advised(group, words) for group in groups]))
    assert np.median(off_surface(right)[1]) < 0.3


def test_a_shadow_is_no_jump():
    """Rejected but lit pixels are skipped; unlit ones end a surface."""
    row = np.array([[1.0, 2, 3, 4, np.nan, np.nan, 96, 97, 98, 99]])
    lit = np.isfinite(row)
    assert not has_jump(row, lit, 100)[0]
    assert has_jump(row, np.ones_like(lit), 100)[0]
    assert not has_jump(np.array([[1.0, 90, 3, 88, 5, 86, 7, 84, 9, 82]]), np.ones((1, 10), bool), 100)[0]


def wide(width, height, focal):
    K = np.array([[focal, 0, width / 2 - 0.5], [0, focal, height / 2 - 0.5], [0, 0, 1]])
    return Camera(K, np.zeros(5), width, height, Transform.from_degrees((0.5, -11, 0.3), (100.0, 3.0, 5.0)))


@pytest.mark.parametrize(
    ("width", "height", "focal"), [(200, 150, 211), (200, 150, 110), (280, 150, 120), (240, 192, 253)]
)
@pytest.mark.parametrize("shown", [0, "centred"])
def test_the_origin_of_a_gray_code_along_both_axes_is_named(width, height, focal, shown):
    beamer = wide(width, height, focal)
    capture = taken(sequence(gray(offset_px=shown), gray("rows", offset_px=shown)), beamer=beamer)
    assert said(capture) == ""
    other = "centred" if shown == 0 else None
    words = said(stated(capture, sequence(gray(offset_px=other), gray("rows", offset_px=other))))
    assert f"offset_px = {shown if shown == 0 else chr(34) + shown + chr(34)} in [pattern]" in words


@pytest.mark.parametrize("inverse", ["each", "none"])
def test_columns_beyond_the_projector_show_the_origin(inverse):
    """The camera sees the whole field: 28 of 200 columns of a centred code lie beyond the projector."""
    plain = [] if inverse == "each" else ["white", "black"]
    capture = taken(sequence(*plain, gray(inverse=inverse, offset_px="centred")), beamer=wide(200, 150, 211))
    words = said(stated(capture, sequence(*plain, gray(inverse=inverse))))
    assert "decode to columns beyond the projector" in words
    assert 'offset_px = "centred"' in words


def test_two_cameras_see_columns_beyond_the_projector():
    code = sequence(gray(offset_px="centred"))
    capture = taken(code, pair(), beamer=wide(200, 150, 211))
    assert said(capture, PAIRED) == ""
    assert 'offset_px = "centred"' in said(stated(capture, sequence(gray())), PAIRED)


def test_depths_with_both_origins_are_stated_where_nothing_decides():
    """Columns alone, and a field wider than the view: a wall is a wall with either origin."""
    capture = taken(sequence(gray(offset_px="centred")), beamer=wide(240, 192, 253))
    words = said(stated(capture, sequence(gray())))
    assert "the images do not tell where the Gray code begins" in words
    depths = [float(each) for each in re.findall(r"at (\d+) mm", words)]
    assert abs(depths[1] - 498) < 5
    assert depths[0] > 550
    assert said(stated(capture, sequence(gray(offset_px=0)))) == ""
    assert said(replace(stated(capture, sequence(gray())), source="simulated")) == ""


@pytest.mark.parametrize("shown", [1, 3, 10])
@pytest.mark.parametrize("width", [200, 240])
def test_an_offset_of_both_axes_is_measured_by_the_rows(width, shown):
    """A program that counts from 1: depths are off by a column, without any other sign."""
    beamer = wide(200, 150, 211) if width == 200 else wide(240, 192, 253)
    capture = taken(sequence(gray(offset_px=shown), gray("rows", offset_px=shown)), beamer=beamer)
    assert said(capture) == ""
    words = said(stated(capture, sequence(gray(), gray("rows"))))
    assert f"offset_px = {shown} in [pattern]" in words
    assert said(stated(capture, sequence(gray(offset_px=0), gray("rows", offset_px=0)))).count("offset_px") == 0


@pytest.mark.parametrize("down", [-2.0, 1.5])
def test_a_projector_that_stands_lower_is_no_offset(down):
    """The rows miss by a distance that grows toward the camera, or by no whole pixel."""
    capture = taken(sequence(gray(), gray("rows")), beamer=wide(200, 150, 211))
    assert "offset_px" not in said(with_rig_moved(capture, down))


def with_rig_moved(capture, down):
    projector = capture.rig.projector
    place = projector.sensor_from_camera
    moved = replace(
        projector, sensor_from_camera=Transform(place.rotation, place.translation + np.array([0.0, down, 0.0]))
    )
    return replace(capture, rig=replace(capture.rig, projector=moved))


def test_a_range_decides_between_origins():
    capture = stated(taken(sequence(gray(offset_px="centred")), beamer=wide(240, 192, 253)), sequence(gray()))
    near = SETTINGS.model_copy(update={"near_mm": 400, "far_mm": 540})
    words = said(capture, near)
    assert "of the lit pixels meet their light" in words
    assert 'offset_px = "centred"' in words


def test_a_code_that_fills_its_bits_has_one_origin():
    capture = taken(GrayCode(axis="columns"))
    assert said(capture) == ""
    assert (capture_cloud(capture, SETTINGS).status == Status.VALID).mean() > 0.95


def test_an_origin_that_is_whole_periods_away_is_stated_beside_the_other():
    """The fringes agree with either: a rig of 1920 columns was 50 mm off, another 280 mm, without a word."""
    capture = taken(coded(fringes(period=8), offset_px="centred"), beamer=wide(240, 192, 253))
    words = said(stated(capture, coded(fringes(period=8))))
    assert "the images do not tell where the Gray code begins" in words and 'offset_px = "centred"' in words
    depths = [float(each) for each in re.findall(r"at (\d+) mm", words)]
    assert abs(depths[1] - 498) < 5 and depths[0] > 530
    assert said(stated(capture, coded(fringes(period=8), offset_px="centred"))) == ""


@pytest.mark.parametrize(("period", "wave"), [(16, "minus cosine"), (32, "sine")])
def test_fringes_and_gray_code_are_both_named_if_either_may_count_from_elsewhere(period, wave):
    """Centred by 8 px, half or a quarter of a period: to blame the fringes alone was 95 mm off."""
    beamer, group = wide(240, 192, 253), fringes(period)
    for shown in (coded(group, offset_px="centred"), coded(fringes(period, **WAVES[wave]))):
        words = said(stated(taken(shown, beamer=beamer), coded(group)))
        assert 'or if the Gray code of the columns has offset_px = "centred" in [pattern]' in words
        rights = [coded(advised(group, words)), coded(group, offset_px="centred")]
        off = [np.median(off_surface(stated(taken(shown, beamer=beamer), right))[1]) for right in rights]
        assert min(off) < 0.5 and max(off) > 50


@pytest.mark.parametrize(("period", "centred"), [(16, True), (8, True), (32, True), (16, False), (8, False)])
def test_edges_beyond_the_projector_tell_a_gray_code_from_fringes(period, centred):
    """Centred by 28 px, seven quarters of 16 px: the fringes were blamed, 1000 mm off."""
    beamer, group = wide(200, 150, 211), fringes(period)
    shown = coded(group, offset_px="centred") if centred else coded(fringes(period, wave="sine"))
    words = said(stated(taken(shown, beamer=beamer), coded(group)))
    assert ('has offset_px = "centred" in [pattern]' in words) == centred
    assert ('have wave = "sine"' in words) != centred
