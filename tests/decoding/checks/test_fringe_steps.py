"""Images of one period that contradict one another: repeated, of another shift, of another exposure."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mitsim.decoding.checks.fringe_steps import contradiction
from tests.decoding.checks.test_code_origin import coded, fringes, stated
from tests.decoding.checks.test_sanity import said, taken


def levels(shifts, rng, gains=1.0, exponent=1.0, noise=1.0):
    """Images (N, n) of pixels of any phase and reflectance, of a projector with an exponent."""
    phase, reflectance = rng.uniform(0, 2 * np.pi, 4000), rng.uniform(0.2, 1.0, 4000)
    shown = (0.5 + 0.5 * np.cos(phase - np.asarray(shifts)[:, None])) ** exponent
    return np.reshape(gains, (-1, 1)) * (10 + 150 * reflectance * shown) + rng.normal(0, noise, shown.shape)


@pytest.mark.parametrize("steps", [4, 5, 8])
def test_steps_that_differ_contradict_the_pattern_and_gamma_does_not(steps, rng):
    shifts = np.arange(steps) * 2 * np.pi / steps
    assert contradiction(levels(shifts, rng), shifts) < 0.005
    assert contradiction(levels(shifts, rng, exponent=2.2), shifts) < 0.03
    part = levels(shifts, rng, exponent=2.2)
    bright = part[:, part[0] > part[2]]  # half of the phases
    assert contradiction(bright, shifts) == 0
    other = shifts + np.where(np.arange(steps) == 2, 0.3, 0)
    assert contradiction(levels(other, rng), shifts) > 0.05
    assert contradiction(levels(shifts, rng, gains=1 + 0.3 * (np.arange(steps) == 1)), shifts) > 0.04


def test_three_steps_cannot_contradict_one_another(rng):
    shifts = np.arange(3) * 2 * np.pi / 3
    assert contradiction(levels(shifts + np.array([0, 0.5, 0]), rng), shifts) == 0


def changed(capture, name, image):
    stack = capture.images["camera"].copy()
    stack[name] = image(capture.images["camera"])
    return replace(capture, images={"camera": stack})


@pytest.mark.parametrize("steps", [3, 4])
def test_an_image_that_is_there_twice_is_said(steps):
    """Before, all pixels were valid and 8 mm off, without a word."""
    capture = taken(coded(fringes(steps=steps), stripe=16))
    assert "images 2 and 3 of the sequence, fringes of the columns at 16 px, are the same" in said(
        changed(capture, 2, lambda stack: stack[1])
    )


def test_images_of_other_shifts_or_exposures_are_said():
    capture = taken(coded(fringes(steps=4), stripe=16))
    assert said(capture) == ""
    brighter = changed(capture, 2, lambda stack: np.clip(stack[2] * 1.2, 0, 255))
    assert "the 4 fringe images of the columns at 16 px contradict one another" in said(brighter)
    dark = changed(capture, 2, lambda stack: np.zeros_like(stack[2]))
    assert "do not follow the Gray code" in said(dark)
    turned = taken(coded(fringes(steps=4) | {"shifts_deg": [0, 90, 180, 225]}, stripe=16))
    assert "contradict one another by" in said(stated(turned, coded(fringes(steps=4), stripe=16)))
