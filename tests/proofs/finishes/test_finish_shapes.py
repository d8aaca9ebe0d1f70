"""Fits of the shape of a finish: known shapes, closed forms of the priors, and the priors of the code."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.special import logit

from mitsim.scene.surface.energy import directional_albedo
from mitsim.scene.surface.microfacet import GGX_PER_BECKMANN
from mitsim.scene.surface.processes import LAY_FACTOR, PROCESSES, TAIL_RANGE, WIDE_ANGLE_FACTOR, moved_odds
from tests.proofs.finishes import measured_surfaces, shape_fit
from tests.proofs.finishes.measured_surfaces import WARD, MeasuredSurface

REAL_DATA = Path(os.environ.get("MITSIM_REAL_DATA") or Path(__file__).resolve().parents[3].parent / "shared" / "real")


def known_surface(wide, kept, tail, alpha, concentrated=1.0, process="polished", noise=0.0):
    incidence, leaving = (
        np.radians(one.ravel()) for one in np.meshgrid(np.arange(1.0, 88.0), measured_surfaces.EXIT_DEG)
    )
    brdf = shape_fit.model(np.array([*logit([wide, kept, tail]), *np.log([alpha, concentrated])]), incidence, leaving)
    brdf = 0.9 * brdf * np.exp(noise * np.random.default_rng(1).standard_normal(brdf.shape))
    return MeasuredSurface("known", process, incidence, leaving, brdf, np.full(brdf.shape, 0.9), concentrated != 1)


@pytest.mark.parametrize("tail", [0.05, 0.6])
@pytest.mark.parametrize("wide", [0.02, 0.3])
def test_a_known_shape_is_found(wide, tail):
    found = shape_fit.fit_shape(known_surface(wide, 0.7, tail, 0.12, noise=0.02))
    assert found.wide_angle == pytest.approx(wide, rel=0.05) and wide <= found.bound * 1.05
    assert found.tail == pytest.approx(tail, abs=0.05) and found.alpha == pytest.approx(0.12, rel=0.03)
    assert found.misfit < 0.03 and found.least <= found.wide_angle * 1.02 and found.most >= found.wide_angle * 0.98


def test_a_lay_that_differs_from_the_prior_is_found_where_the_wide_angle_share_is_small():
    found = shape_fit.fit_shape(known_surface(1.1e-3, 1 - 1e-12, 0.2, 0.1, 8.0, "ground", 0.02))
    assert found.lay == pytest.approx(1 / 8, rel=0.15)


def test_the_lobe_of_a_fit_is_that_of_the_renderer():
    """Its energy over the hemisphere, by facets of the code's own quadrature; in the plane alone, at the normal.

    At normal incidence a round lobe is the same in all planes: the energy is the integral of f cos over one of them.
    """
    angles = np.radians(np.linspace(0.01, 89.99, 4000))
    for distribution, alpha in (("ggx", GGX_PER_BECKMANN * 0.3), ("beckmann", 0.3)):
        value = shape_fit.lobe(np.full(angles.shape, 1e-6), angles, alpha, distribution)
        # half of the full turn on each side; exit on the far side of the normal has half vector (o - i) / 2
        energy = np.trapezoid(2 * np.pi * np.sin(angles) * np.cos(angles) * value, angles)
        assert energy == pytest.approx(directional_albedo(1e-6, alpha, alpha, distribution), rel=5e-3)


def test_the_factor_of_a_known_spread_and_its_interval():
    logs = np.log(3.0) * np.random.default_rng(2).standard_normal((400, 12))
    found = [shape_fit.factor_of(row.tolist()) for row in logs]
    inside = np.mean([one.low <= 3.0 <= one.high for one in found])
    assert abs(inside - 0.95) < 3 * np.sqrt(0.95 * 0.05 / 400)


def test_odds_move_by_their_factor_and_stay_below_the_largest_share():
    for share in (1e-4, 0.1, 0.55):
        moved = moved_odds(share, 4.2)
        assert moved / (0.6 - moved) == pytest.approx(4.2 * share / (0.6 - share))
        assert moved_odds(moved, 1 / 4.2) == pytest.approx(share) and moved < 0.6


def test_a_surface_in_the_middle_of_the_prior_has_its_middle_place():
    process = PROCESSES["ground"]
    ra = float(np.sqrt(np.prod(process.usual)))
    alpha = shape_fit.stylus_slope(ra, "ground")
    share = process.wide_angle.share(ra)
    one = known_surface(share, 1 - 1e-12, process.beckmann, alpha, 1 / process.lay_ratio, "ground")
    places = shape_fit.places_in_prior(one, draws=400)
    assert all(0.3 < place < 0.7 for place in places)
    bright, dark = (replace(one, brdf=one.brdf * factor) for factor in (1e3, 1e-3))
    assert shape_fit.places_in_prior(bright, draws=50) == [1.0] * 3
    assert shape_fit.places_in_prior(dark, draws=50) == [0.0] * 3


@pytest.mark.real
def test_the_priors_of_the_code_are_those_of_the_measurements():
    """The constants lie in the 95 % intervals of the fits, within 10 % of their middle."""
    if not (REAL_DATA / "brdf_metals").is_dir():
        pytest.skip(f"no goniometer data in {REAL_DATA}")
    shapes = [shape_fit.fit_shape(one) for one in measured_surfaces.goniometer_surfaces(REAL_DATA)]
    shapes += [shape_fit.fit_shape(one) for one in measured_surfaces.merl_surfaces(REAL_DATA)]
    shares = shape_fit.spread_of_shares(shapes, [(process, share) for process, share, _ in WARD.values()])
    lays = shape_fit.spread_of_lays(shapes, [(name, along / across) for name, _, (along, across) in WARD.values()])
    for factor, constant in ((shares, WIDE_ANGLE_FACTOR), (lays, LAY_FACTOR)):
        assert factor.low < constant < factor.high and constant == pytest.approx(factor.value, rel=0.1)
    assert all(one.tail <= TAIL_RANGE[1] for one in shapes if one.surface.process != "grit_blasted")
    exponent, height, central = shape_fit.roughness_factor(*measured_surfaces.roughness_pairs(REAL_DATA))
    assert 0.4 < exponent < 0.7 and central < 1.6 < height.high
