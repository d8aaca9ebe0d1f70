"""Discs that overlap: what they share, and that pooled figures are as certain as is said."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from characterisation.coupon.discs import disc_offsets, independent_share, lens_share


def hexagonal(step: float, columns: int, rows: int) -> np.ndarray:
    j, i = np.mgrid[:rows, :columns]
    return np.stack([j * step * np.sqrt(3) / 2, (i + 0.5 * (j % 2)) * step], axis=-1).reshape(-1, 2)


def membership(centres: np.ndarray, radius: float, size: int) -> np.ndarray:
    """Which pixels (size^2,) of a square image each disc holds, (pixels, p) of 0 and 1."""
    out = np.zeros((size * size, len(centres)))
    for number, centre in enumerate(centres):
        rows, columns = (centre + disc_offsets(radius)).T
        out[rows * size + columns, number] = 1
    return out


def test_a_disc_holds_its_area():
    for radius in (3, 6, 8, 12):
        assert np.isclose(len(disc_offsets(radius)), np.pi * radius**2, rtol=0.08)


def test_the_lens_of_two_discs():
    assert np.allclose(lens_share([0.0, 6.0, 12.0, 20.0], 6.0), [1.0, 2 / 3 - np.sqrt(3) / (2 * np.pi), 0.0, 0.0])


@pytest.mark.parametrize("apart", [3, 7, 13, 20, 31])
def test_the_lens_is_the_share_of_pixels_in_common(apart):
    here = {tuple(p) for p in disc_offsets(20)}
    there = {tuple(p) for p in disc_offsets(20) + np.array([0, apart])}
    assert np.isclose(len(here & there) / len(here), lens_share(apart, 20.0), atol=0.01)


def test_discs_apart_count_in_full():
    assert (independent_share(hexagonal(12.0, 4, 4), 6.0) == 1).all()
    assert independent_share(np.empty((0, 2)), 6.0).shape == (0,)


def test_a_disc_apart_counts_in_full_beside_a_pair():
    share = independent_share([[0, 0], [0, 6], [50, 50]], 6.0)
    assert share[2] == 1
    assert np.allclose(share[:2], 1 / (1 + lens_share(6.0, 6.0)))


@given(arrays(float, st.tuples(st.integers(1, 25), st.just(2)), elements=st.integers(0, 40), unique=False))
def test_a_mean_with_the_shares_has_the_variance_they_predict(centres):
    """1 / (sum of w) is w^T C w / (sum of w)^2 exactly, however the discs lie, and on one another too."""
    share = independent_share(centres, 6.0)
    correlation = lens_share(np.linalg.norm(centres[:, None] - centres, axis=-1), 6.0)
    assert np.isclose(share @ correlation @ share / share.sum() ** 2, 1 / share.sum(), rtol=1e-9)
    assert (share > 0).all()
    assert share.sum() <= len(centres) + 1e-9


@pytest.mark.parametrize("step", [4, 6, 9, 13])
def test_pooled_fraction_and_variance_over_overlapping_patches_scatter_as_predicted(step, rng):
    """4000 images of independent pixels: their pooled F and sigma^2 have the variances that the shares give."""
    trials, radius, size = 4000, 6.0, 60
    centres = np.rint(hexagonal(step, 36 // step, 36 // step)).astype(int) + 8
    holds = membership(centres, radius, size)
    count = len(disc_offsets(radius))
    share = independent_share(centres, radius)
    # the scatter of a sample variance over 4000 trials is sqrt(2 / 4000) = 2.2 %; 4 of those, and 2 % for the lens
    # in place of whole pixels
    bound = 4 * np.sqrt(2 / trials) + 0.02

    kept = (rng.random((trials, size * size)) < 0.7).astype(np.float32) @ holds / count
    pooled = kept @ share / share.sum()
    assert np.isclose(pooled.var(), 0.7 * 0.3 / count / share.sum(), rtol=bound)

    plane = np.linalg.qr(np.column_stack([np.ones(count), disc_offsets(radius)]))[0]
    pixel = (centres[:, None] + disc_offsets(radius)) @ [size, 1]
    values = rng.standard_normal((trials, size * size), np.float32)
    squares = np.stack([(values[:, p] ** 2).sum(1) - ((values[:, p] @ plane) ** 2).sum(1) for p in pixel], axis=-1) / (
        count - 3
    )
    pooled = squares @ share / share.sum()
    assert np.isclose(pooled.var(), 2 / (count - 3) / share.sum(), rtol=bound)
    if step < 2 * radius:  # as if they were independent, it would be said too small by more than the bound
        assert pooled.var() > (1 + 2 * bound) * 2 / (count - 3) / len(centres)
