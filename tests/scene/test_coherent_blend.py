"""The mirror-like share of a rough face against the wave optics that it stands for."""

from __future__ import annotations

import dataclasses
import itertools
import math
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mitsim.scene.backend import dr, mi
from mitsim.scene.bsdf_descriptions import metal_bsdf
from mitsim.scene.coherent_blend import NAME, register_coherent_blend
from mitsim.scene.surface.energy import directional_albedo, energy_factors
from mitsim.scene.surface.machined import machined
from mitsim.scene.surface.machined_face import MachinedFace

ANGLES_DEG = (0, 30, 45, 60, 75)

#: slope of the facets that count as mirror-like: three times the width of the mirror-like lobe
NARROW = 0.015


def mirror(roughness, wavelength, process="lapped"):
    """Scatter and BSDF of a face made of a perfect mirror (n = 0, k = 1), without its wide-angle share."""
    scatter = machined(MachinedFace(process=process, Ra=roughness, wide_angle=0.0), wavelength)
    scatter = dataclasses.replace(scatter, energy_factor=energy_factors(scatter.alpha_u, scatter.alpha_v, 1.0))
    register_coherent_blend()
    bsdf = mi.load_dict(metal_bsdf((0.0, 1.0), scatter))
    parameters = mi.traverse(bsdf)
    for name in parameters.keys():  # noqa: SIM118 it is no mapping
        dr.make_opaque(parameters[name])  # faces of any roughness share their kernels
    parameters.update()
    return scatter, bsdf


def closed_form(roughness, wavelength, angle):
    """Beckmann's coherent share [1], exp(-(4 pi Rq cos / lambda)^2) with Rq = sqrt(pi / 2) Ra."""
    rq, wavelength_um = math.sqrt(math.pi / 2) * roughness, wavelength / 1000
    return math.exp(-((4 * math.pi * rq * math.cos(angle) / wavelength_um) ** 2))


def surface_seen_at(angle, count):
    """Surface points (count) seen at an angle [rad], turned by the golden angle from one to the next."""
    surface = dr.zeros(mi.SurfaceInteraction3f, count)
    turn = np.pi * (3 - np.sqrt(5)) * np.arange(count)
    x, y = np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn)
    surface.wi = mi.Vector3f(*(mi.Float(v.astype(np.float32)) for v in (x, y, np.full(count, np.cos(angle)))))
    surface.sh_frame = mi.Frame3f(mi.Vector3f(0, 0, 1))
    return surface


@cache
def stratified(side):
    """Three numbers (side^2,) in the unit interval for each of as many samples."""
    count = side**2
    rng = np.random.default_rng(7)
    cells = np.stack(np.meshgrid(np.arange(side), np.arange(side))).reshape(2, -1)
    first, second = (cells + rng.random((2, count))) / side
    pick = rng.permutation((np.arange(count) + rng.random(count)) / count)
    return [np.minimum(v, 1 - 1e-7).astype(np.float32) for v in (pick, first, second)]


def sampled(bsdf, angle, side=512):
    """Weights (n,) and half-way slopes (n,) of stratified samples of a BSDF seen at an angle [rad]."""
    surface = surface_seen_at(angle, side**2)
    pick, first, second = (mi.Float(values) for values in stratified(side))
    found, weight = bsdf.sample(mi.BSDFContext(), surface, pick, mi.Point2f(first, second))
    half = np.array(surface.wi + found.wo, float)
    return np.ravel(np.array(weight, float)), np.hypot(half[0], half[1]) / half[2]


@pytest.fixture(scope="module", params=itertools.product([0.05, 0.09, 0.2, 0.4], [550, 850]), ids=str)
def face(request):
    """Roughness [um], wavelength [nm], scatter, and weights and slopes of the samples at each of the angles."""
    scatter, bsdf = mirror(*request.param)
    return *request.param, scatter, [sampled(bsdf, angle) for angle in np.radians(ANGLES_DEG)]


def test_the_mirror_like_share_is_that_of_beckmann_and_spizzichino(face):
    """Share of the light that facets of a slope under 0.015 send, against the closed forms of both distributions."""
    roughness, wavelength, scatter, samples = face
    q = (NARROW / scatter.alpha_u) ** 2
    q_ggx = (NARROW / scatter.ggx_alpha[0]) ** 2
    factor_ggx, factor_beckmann = scatter.energy_factor
    of_rest = scatter.beckmann * factor_beckmann * -math.expm1(-q)
    of_rest += (1 - scatter.beckmann) * factor_ggx * q_ggx / (1 + q_ggx)
    of_mirror = -math.expm1(-((NARROW / 0.005) ** 2))
    for angle, (weight, slope) in zip(np.radians(ANGLES_DEG), samples, strict=True):
        found = weight[slope < NARROW].sum() / len(weight)
        share = closed_form(roughness, wavelength, angle)
        assert (found - of_rest) / (of_mirror - of_rest) == pytest.approx(share, abs=0.01)


def test_a_fine_face_at_60_deg_is_half_a_mirror():
    """Ra 0.09 um at 850 nm: A = 0.50, and 0.06 at normal incidence."""
    scatter, _ = mirror(0.09, 850)
    assert scatter.coherent == pytest.approx(0.062, abs=0.001)
    assert scatter.coherent_at(np.radians(60)) == pytest.approx(0.499, abs=0.001)


def test_what_the_mirror_gains_the_rest_loses(face):
    """White furnace: what comes back is what the two lobes return, shared at that angle, to 1 %, and not over 1.

    The lobes alone return up to 1.0025, as their energy factor is that of 30 deg.
    """
    roughness, wavelength, scatter, samples = face
    factor_ggx, factor_beckmann = scatter.energy_factor
    for angle, (weight, _) in zip(np.radians(ANGLES_DEG), samples, strict=True):
        found = weight.mean()
        rest = scatter.beckmann * factor_beckmann * directional_albedo(angle, *[scatter.alpha_u] * 2, "beckmann")
        rest += (1 - scatter.beckmann) * factor_ggx * directional_albedo(angle, *scatter.ggx_alpha, "ggx")
        share = closed_form(roughness, wavelength, angle)
        assert found == pytest.approx(share + (1 - share) * rest, rel=0.01)
        assert found < 1.003


@given(st.integers(0, 2**31), st.sampled_from([0.05, 0.09, 0.2]), st.floats(0, 1))
def test_camera_and_lamp_may_change_places(seed, roughness, near):
    """Helmholtz: f(i, o) = f(o, i), near the mirror direction and anywhere. Single precision of a steep flank."""
    _, bsdf = mirror(roughness, 850)
    rng = np.random.default_rng(seed)
    one = rng.normal(size=(200, 3))
    other = one * [-1, -1, 1] * near + (1 - near) * rng.normal(size=(200, 3))
    one, other = (np.abs(d) * np.where(np.arange(3) == 2, 1, np.sign(d)) for d in (one, other))
    one, other = (
        mi.Vector3f((d / np.linalg.norm(d, axis=1, keepdims=True)).T.astype(np.float32)) for d in (one, other)
    )
    there, back = (dr.zeros(mi.SurfaceInteraction3f, 200) for _ in range(2))
    there.wi, back.wi = one, other
    context = mi.BSDFContext()
    forth = np.array(bsdf.eval(context, there, other)[0]) / np.array(other.z)
    reverse = np.array(bsdf.eval(context, back, one)[0]) / np.array(one.z)
    np.testing.assert_allclose(forth, reverse, rtol=2e-3, atol=1e-5 * max(1e-9, forth.max()))


def blend(phase_variance, mirror_alpha, lobe_alpha):
    """Description of a blend of two round lobes, with a factor that is not 1."""
    register_coherent_blend()
    conductor = {"type": "roughconductor", "eta": 0.0, "k": 1.0}
    return {
        "type": NAME,
        "phase_variance": phase_variance,
        "c_0": -0.5,
        "c_1": 0.1,
        "c_2": 0.0,
        "mirror": {**conductor, "alpha": mirror_alpha},
        "lobe": {**conductor, "alpha": lobe_alpha},
    }


@pytest.mark.parametrize("angle_deg", [0, 40, 70])
def test_directions_are_drawn_with_the_density_that_is_told(angle_deg):
    """Mitsuba's own chi^2 test on the sphere, with lobes wide enough for its grid."""
    from mitsuba.chi2 import BSDFAdapter, ChiSquareTest, SphericalDomain

    angle = np.radians(angle_deg)
    adapter = BSDFAdapter(NAME, blend(2.0, 0.3, 0.5), wi=[float(np.sin(angle)), 0.0, float(np.cos(angle))])
    assert ChiSquareTest(SphericalDomain(), *adapter, sample_dim=3).run(significance_level=0.001)


def test_value_density_and_weight_agree():
    bsdf, context = mi.load_dict(blend(2.0, 0.05, 0.3)), mi.BSDFContext()
    rng = np.random.default_rng(3)
    surface = surface_seen_at(np.radians(50), 10_000)
    pick, first, second = (mi.Float(v.astype(np.float32)) for v in rng.random((3, 10_000)))
    found, weight = bsdf.sample(context, surface, pick, mi.Point2f(first, second))
    value, density = bsdf.eval_pdf(context, surface, found.wo)
    np.testing.assert_allclose(value, bsdf.eval(context, surface, found.wo), rtol=1e-6)
    np.testing.assert_allclose(density, bsdf.pdf(context, surface, found.wo), rtol=1e-6)
    np.testing.assert_allclose(density, found.pdf, rtol=1e-6)
    np.testing.assert_allclose(np.array(weight) * np.array(density), value, rtol=1e-5)


def test_only_faces_that_ever_mirror_have_a_mirror_like_lobe():
    """Ra 0.4 um keeps 2.5 % at 75 deg in the infrared, and 0.02 % in the green."""
    for wavelength, has in ((850, True), (550, False)):
        scatter, _ = mirror(0.4, wavelength)
        assert (metal_bsdf((0.0, 1.0), scatter)["type"] == NAME) == has
