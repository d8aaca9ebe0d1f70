"""From what is said of a face to how it scatters, and what cannot be said together."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from characterisation.files.errors import InputError
from mitsim.scene.surface.diffraction import lobe_alpha
from mitsim.scene.surface.gloss import lobe_gloss
from mitsim.scene.surface.machined import machined
from mitsim.scene.surface.machined_face import MachinedFace
from mitsim.scene.surface.measured import height_map, profile
from mitsim.scene.surface.metals import CONSTANTS, refractive_index
from mitsim.scene.surface.processes import PROCESSES, feed, feed_slope
from mitsim.scene.surface.roughness import band_limited_slope, correlation_length, matern, rms_height


def random_profile(rng, points=20000, length=16.0, rms=0.5):
    """Gaussian heights [um] every 0.5 um, exp(-(tau / (length / 2))^2)."""
    frequency = np.fft.rfftfreq(points)
    z = np.fft.irfft(np.fft.rfft(rng.normal(size=points)) * np.exp(-((np.pi * frequency * length) ** 2) / 2), points)
    return profile(0.5, rms * z / z.std())


def areal(rng, rms=0.5, length_u=8.0, length_v=8.0):
    fy, fx = np.meshgrid(np.fft.fftfreq(512), np.fft.rfftfreq(512), indexing="ij")
    envelope = np.exp(-((np.pi * fx * length_u) ** 2 + (np.pi * fy * length_v) ** 2) / 2)
    z = np.fft.irfft2(np.fft.rfft2(rng.normal(size=(512, 512))) * envelope, (512, 512))
    return height_map(rms * z / z.std(), 1.0)


def test_lapped_metal_has_the_tabulated_widths():
    """Table of the reference note for C = 2.6, Beckmann-equivalent alpha at 405, 450, 660, 850 and 940 nm."""
    table = {
        0.05: [0.026, 0.025, 0.024, 0.026, 0.027],
        0.1: [0.050, 0.047, 0.038, 0.033, 0.032],
        0.2: [0.088, 0.085, 0.073, 0.065, 0.061],
        0.4: [0.152, 0.147, 0.129, 0.117, 0.113],
        0.8: [0.257, 0.249, 0.221, 0.204, 0.197],
    }
    for roughness, expected in table.items():
        face = MachinedFace(process="lapped", Ra=roughness)
        found = [machined(face, wavelength).alpha_u for wavelength in (405, 450, 660, 850, 940)]
        assert np.allclose(found, expected, atol=0.0006)


def test_ground_metal_scatters_as_the_maps_were_made_with():
    """Ra: coherent share and alpha at 850 nm."""
    table = {0.05: (0.42, 0.030), 0.09: (0.06, 0.034), 0.2: (0, 0.074), 0.37: (0, 0.129), 0.74: (0, 0.229)}
    for roughness, (coherent, alpha) in table.items():
        found = machined(MachinedFace(process="ground", Ra=roughness), 850)
        assert np.isclose(found.coherent, coherent, atol=0.005)
        assert np.isclose(found.alpha_u, alpha, atol=0.0005)
        assert found.alpha_u == found.alpha_v


@pytest.mark.parametrize("process", sorted(PROCESSES))
def test_more_roughness_is_a_wider_lobe(process):
    widths = [machined(MachinedFace(process=process, Ra=ra), 850).alpha_v for ra in (0.1, 0.2, 0.4, 0.8)]
    assert widths == sorted(widths)


@pytest.mark.parametrize("process", [name for name, process in PROCESSES.items() if process.lay_ratio < 1])
def test_the_lobe_is_narrow_along_the_lay(process):
    ratio = PROCESSES[process].lay_ratio
    none, u, v = (machined(MachinedFace(process=process, Ra=0.6, lay=lay), 850) for lay in (None, "u", "v"))
    assert (u.alpha_u, u.alpha_v) == (v.alpha_v, v.alpha_u)
    assert u.alpha_v == none.alpha_v == none.alpha_u
    assert u.alpha_u <= ratio * u.alpha_v * (1 + 1e-9)
    assert "lay not given" in none.provenance
    assert "lay" not in u.provenance
    assert (none.lay, u.lay, v.lay) == ("none", "u", "v")


def test_feed_marks_widen_the_lobe_across_them_and_leave_no_spike():
    blurred = machined(MachinedFace(process="turned", Ra=0.8, lay="u"), 850)
    resolved = machined(MachinedFace(process="turned", Ra=0.8, lay="u", feed_marks="resolved"), 850)
    marks = 2 * feed_slope(feed(0.8, 0.8), 0.8) ** 2
    assert np.isclose(blurred.alpha_v**2, resolved.alpha_v**2 + marks)
    assert blurred.alpha_u == resolved.alpha_u
    assert np.isclose(blurred.coherent_alpha[1] ** 2, 0.005**2 + marks)
    assert resolved.coherent_alpha == (0.005, 0.005)
    # A is that of the micro-roughness, a quarter of Ra; that of the whole Ra would be nothing
    assert np.isclose(resolved.height_um, rms_height(0.2))
    assert machined(MachinedFace(process="turned", Ra=0.4), 850).coherent > 0.01
    assert blurred.beckmann > 0.5 > resolved.beckmann


def test_a_sharper_nose_makes_steeper_marks():
    sharp, blunt = (machined(MachinedFace(process="turned", Ra=0.8, nose_radius=r), 850).alpha_v for r in (0.4, 1.6))
    assert sharp > blunt


def test_spacing_of_turned_marks_is_the_feed():
    """Ra and feed fix the nose radius: Rdq = 9 Ra / f."""
    marks = feed(0.8, 0.8) * 1e3
    found = machined(MachinedFace(process="turned", Ra=0.8, RSm=marks), 850)
    assert np.isclose(found.alpha_v, np.sqrt(2) * feed_slope(feed(0.8, 0.8), 0.8))


def test_a_measured_slope_takes_the_place_of_the_prior():
    found = machined(MachinedFace(process="ground", Ra=0.4, Rdq=0.05), 850)
    nu, sigma = (PROCESSES["ground"].exponent - 1) / 2, rms_height(0.4)
    length = correlation_length(sigma, np.sqrt(2) * 0.05, nu)
    assert np.isclose(band_limited_slope(sigma, length, nu), np.sqrt(2) * 0.05)
    assert np.isclose(found.alpha_v, lobe_alpha(lambda lag: matern(lag / length, nu), sigma, 850))
    assert found.alpha_factor == 1.25
    assert found.provenance.startswith("Rdq 0.05")


def test_spacing_is_slope():
    """RSm = 2 pi Rq / Rdq says the same as Rdq."""
    spacing = 2 * np.pi * rms_height(0.4) / 0.05
    one, other = (
        machined(MachinedFace(process="ground", Ra=0.4, **more), 850) for more in ({"Rdq": 0.05}, {"RSm": spacing})
    )
    assert np.isclose(one.alpha_u, other.alpha_u)


def test_a_trace_gives_the_width_of_its_heights(rng):
    """Gaussian autocorrelation of length 8 um: alpha = 2 Rq / l; some 600 lengths, so 5 %."""
    trace = random_profile(rng)
    found = machined(MachinedFace(process="ground", profile=trace, lay="v"), 450)
    assert np.isclose(found.alpha_u, 2 * 0.5 / 8, rtol=0.05)
    assert np.isclose(found.alpha_v, found.alpha_u * PROCESSES["ground"].lay_ratio)
    assert np.isclose(found.height_um, trace.Rq)
    assert found.alpha_factor == 1.15
    along = random_profile(rng, length=64.0)
    both = machined(MachinedFace(process="ground", profile=trace, profile_along=along, lay="v"), 450)
    assert np.isclose(both.alpha_v, 2 * 0.5 / 32, rtol=0.1)


def test_a_height_map_gives_both_widths(rng):
    found = machined(MachinedFace(process="ground", height_map=areal(rng, length_u=48.0), lay="u"), 450)
    assert np.isclose(found.alpha_v, 2 * 0.5 / 8, rtol=0.08)
    assert np.isclose(found.alpha_u, 2 * 0.5 / 48, rtol=0.12)
    round_one = machined(MachinedFace(process="bead_blasted", height_map=areal(rng)), 450)
    assert round_one.alpha_u == round_one.alpha_v
    assert np.isclose(round_one.alpha_u, 2 * 0.5 / 8, rtol=0.05)
    assert found.alpha_factor == 1.1


def test_a_gloss_reading_comes_back_from_the_lobe():
    """The lobe that a reading was turned into reads it, at 555 nm: 0.85 GGX and 0.15 Beckmann, and 5 % wide-angle."""
    found = machined(MachinedFace(process="ground", Ra=0.2, gloss=300), 555)
    index = refractive_index("aluminium", 555)
    lobe = 0.85 * lobe_gloss(found.ggx_alpha[0], index, "ggx") + 0.15 * lobe_gloss(found.alpha_u, index, "beckmann")
    coherent = np.exp(-((4 * np.pi * rms_height(0.2) * 0.5 / 0.555) ** 2))
    mirror = lobe_gloss(0.005, index, "beckmann")
    assert np.isclose(0.95 * ((1 - coherent) * lobe + coherent * mirror), 300, atol=0.5)
    assert machined(MachinedFace(process="ground", Ra=0.2, gloss=300), 850).alpha_u < found.alpha_u


def test_alpha_is_taken_as_it_is():
    found = machined(MachinedFace(Ra=0.4, alpha=0.1, alpha_factor=1.5), 850)
    assert np.isclose(found.alpha_u, 0.15)
    assert found.alpha_factor == 1.0
    two = machined(MachinedFace(Ra=0.4, alpha_u=0.03, alpha_v=0.1), 850)
    assert (two.alpha_u, two.alpha_v) == (0.03, 0.1)


def test_better_knowledge_has_a_smaller_factor(rng):
    faces = [
        MachinedFace(process="ground", height_map=areal(rng)),
        MachinedFace(process="ground", profile=random_profile(rng)),
        MachinedFace(process="ground", Ra=0.4, gloss=150),
        MachinedFace(process="ground", Ra=0.4, Rdq=0.08),
        MachinedFace(process="ground", Ra=0.4),
        MachinedFace(Ra=0.4),
    ]
    assert [machined(face, 850).alpha_factor for face in faces] == [1.1, 1.15, 1.2, 1.25, 1.6, 2.0]


@given(
    st.sampled_from(sorted(CONSTANTS)),
    st.sampled_from(sorted(PROCESSES)),
    st.floats(0.005, 10.0),
    st.floats(400.0, 1000.0),
    st.floats(0.1, 10.0),
)
def test_every_metal_process_and_roughness_gives_shares_and_widths_that_can_be(metal, process, ra, wavelength, factor):
    found = machined(MachinedFace(metal=metal, process=process, Ra=ra, alpha_factor=factor), wavelength)
    assert 0 <= found.coherent <= 1
    assert 0 <= found.beckmann <= 1
    assert 0 < found.alpha_u <= 0.5
    assert 0 < found.alpha_v <= 0.5
    low, high = found.wide_angle_range
    assert 0 <= low <= found.wide_angle <= high <= 1
    assert all(1 <= gain < 1.6 for gain in found.energy_factor)


@pytest.mark.parametrize(
    ("said", "field", "says"),
    [
        ({"Ra": None}, "Ra", "looked up by Ra"),
        ({"Ra": None, "alpha": 0.1}, "Ra", "looked up by Ra"),
        ({"Ra": None, "gloss": 100}, "Ra", "looked up by Ra"),
        ({"Rdq": 0.1, "RSm": 40.0}, "RSm", "RSm beside Rdq"),
        ({"Rdq": 0.1, "alpha": 0.1}, "alpha", "alpha beside Rdq"),
        ({"gloss": 100, "alpha": 0.1}, "alpha", "alpha beside gloss"),
        ({"alpha": 0.1, "alpha_u": 0.1, "alpha_v": 0.2}, "alpha_u", "alpha_u beside alpha"),
        ({"alpha_u": 0.1}, "alpha_v", "beside alpha_u"),
        ({"alpha_v": 0.1}, "alpha_u", "beside alpha_v"),
        ({"alpha": 0.1, "lay": "u"}, "lay", "lay beside alpha"),
        ({"process": "bead_blasted", "lay": "u"}, "lay", "a lay on a bead_blasted face"),
        ({"Rq": 0.1}, "Rq", "1 to 2 times Ra"),
        ({"Rq": 0.5, "process": "milled"}, "Rq", "Rq beside process milled"),
        ({"Rq": 0.5, "process": "turned"}, "Rq", "Rq beside process turned"),
        ({"nose_radius": 0.8}, "nose_radius_mm", "nose_radius_mm beside process ground"),
        ({"feed_marks": "resolved"}, "feed_marks", "feed_marks beside process ground"),
        ({"process": "turned", "feed_marks": "resolved", "Rdq": 0.1}, "Rdq", "Rdq beside feed_marks resolved"),
        ({"process": "turned", "nose_radius": 0.8, "RSm": 140.0}, "nose_radius_mm", "nose_radius_mm beside RSm"),
        ({"gloss": 2000}, "gloss", "check that the reading is at 60 deg"),
        ({"profile": "trace", "Rq": 0.5}, "Rq", "Rq beside a profile"),
        ({"profile": "trace", "Ra": 4.0}, "Ra", "beside a profile"),
        ({"profile": "trace", "Rdq": 0.1}, "Rdq", "Rdq beside profile"),
        ({"profile_along": "trace"}, "profile_along", "with profile and a lay"),
        ({"profile": "trace", "profile_along": "trace"}, "profile_along", "with profile and a lay"),
    ],
)
def test_what_cannot_stand_together_is_refused_by_name(rng, said, field, says):
    given = {"Ra": 0.4, **{key: random_profile(rng) if value == "trace" else value for key, value in said.items()}}
    with pytest.raises(InputError, match=says) as caught:
        machined(MachinedFace(**given), 850, "part.xml")
    assert caught.value.field == field
    assert caught.value.where == "part.xml"


def test_a_roughness_that_is_not_given_is_that_of_the_trace(rng):
    trace = random_profile(rng)
    assert MachinedFace(profile=trace).roughness == trace.Ra
    assert MachinedFace(Ra=0.42, profile=trace).roughness == 0.42
    assert np.isclose(machined(MachinedFace(profile=trace), 850).height_um, 0.5, rtol=0.01)
