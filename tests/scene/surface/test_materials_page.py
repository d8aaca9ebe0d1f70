"""The tables of docs/explanation/materials.md, recomputed: priors, energy, and published measurements."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import brentq

from mitsim.scene.surface.diffraction import coherent_share, lobe_alpha
from mitsim.scene.surface.energy import directional_albedo, energy_factors
from mitsim.scene.surface.machined import machined
from mitsim.scene.surface.machined_face import MachinedFace
from mitsim.scene.surface.microfacet import GGX_PER_BECKMANN
from mitsim.scene.surface.processes import PROCESSES
from mitsim.scene.surface.roughness import (
    ALPHA_LARGEST,
    correlation_length,
    rms_height,
    stylus_slope,
)
from tests.figures_of_surfaces import short_wave_height

PAGE = Path(__file__).resolve().parents[3] / "docs" / "explanation" / "materials.md"

RA_PER_RQ = 1 / rms_height(1.0)


def table(name):
    """Rows of cells of the table that follows a marker comment."""
    text = PAGE.read_text(encoding="utf-8")
    assert text.count(f"<!-- table: {name} -->") == 1
    rows = text.partition(f"<!-- table: {name} -->\n")[2].partition("\n\n")[0].splitlines()[2:]
    return [[cell.strip() for cell in row.strip("|").split("|")] for row in rows]


def processes():
    for (name, process), returned_light in zip(PROCESSES.items(), energy(), strict=True):
        ratio = f"{process.lay_ratio:g}" if process.lay_ratio < 1 else "none"
        usual = f"{process.usual[0]:g} to {process.usual[1]:g}"
        shape = [f"{process.slope:g}", f"{process.exponent:g}", ratio, f"{process.beckmann:.2f}"]
        yield [f"`{name}`", usual, *shape, *returned_light[1:]]


def wide_angle():
    for name, process in PROCESSES.items():
        share, low, high = process.wide_angle, *process.usual
        ends = " to ".join(f"{share.share(ra):.3f}" for ra in (low, high))
        assert share.factor == 4.2
        yield [f"`{name}`", f"{share.per_um:g}", f"{share.largest:g}", ends]


def returned(process, roughness):
    """What a perfect mirror of that finish returns at 0, 15, 30, 45, 60 and 75 deg."""
    scatter = machined(MachinedFace(process=process, Ra=roughness), 850)
    ggx, beckmann = energy_factors(scatter.alpha_u, scatter.alpha_v, 1.0)
    lobes = np.array(
        [
            scatter.beckmann * beckmann * directional_albedo(angle, scatter.alpha_u, scatter.alpha_v, "beckmann")
            + (1 - scatter.beckmann) * ggx * directional_albedo(angle, *scatter.ggx_alpha, "ggx")
            for angle in np.radians([0, 15, 30, 45, 60, 75])
        ]
    )
    coherent = np.array([scatter.coherent_at(angle) for angle in np.radians([0, 15, 30, 45, 60, 75])])
    specular = coherent + (1 - coherent) * lobes
    return scatter.wide_angle + (1 - scatter.wide_angle) * specular


def energy():
    for name, process in PROCESSES.items():
        found = np.array([returned(name, ra) for ra in np.geomspace(*process.usual, 25)])
        near, at_60, at_75 = found[:, :4], found[:, 4], found[:, 5]
        yield [f"`{name}`", f"{near.min():.2f} to {near.max():.2f}", f"{at_60.min():.3f}", f"{at_75.min():.2f}"]


def speckle_contrast(coherent):
    """Contrast of coherent and diffuse light together, r = A / (1 - A)."""
    r = coherent / (1 - coherent)
    return np.sqrt(1 + 2 * r) / (1 + r)


def white_light_contrast(roughness):
    """Gaussian heights and a spectrum of 300 nm about 550 nm, FWHM: (1 + 16 Rq^2 s^2)^(-1/4)."""
    spread = 2 * np.pi * (300 / 2.355) / 550**2 * 1e3
    return (1 + 16 * rms_height(roughness) ** 2 * spread**2) ** -0.25


def alpha(process, roughness, wavelength=550.0, lay=None):
    return machined(MachinedFace(process=process, Ra=roughness, lay=lay), wavelength)


def spike_limit():
    """Rq / lambda at which a spike 1 mrad across is as bright as the middle of a lobe of alpha 0.1."""
    solid_angle = np.pi * 0.5e-3**2
    return brentq(lambda x: coherent_share(x, 1000.0) / solid_angle * 4 * np.pi * 0.1**2 - 1, 0.1, 0.5)


def short_waves(sigma, longest):
    nu = (PROCESSES["bead_blasted"].exponent - 1) / 2
    ra = sigma * RA_PER_RQ
    return short_wave_height(sigma, correlation_length(sigma, stylus_slope(ra, "bead_blasted"), nu), nu, longest)


def gaussian(sigma, length, wavelength):
    return lobe_alpha(lambda lag: np.exp(-((lag / length) ** 2)), sigma, wavelength)


def published():
    """Our number and the published one of every row that has a number, each as the page prints it."""
    rolled, brushed = alpha("rolled", 0.3, lay="u"), alpha("brushed", 0.4, lay="u")
    saturated = brentq(lambda ra: speckle_contrast(coherent_share(rms_height(ra), 633)) - 0.99, 0.01, 0.2)
    tanner = {rq: (alpha("ground", rq * RA_PER_RQ, 633).alpha_u, 1.772 * 0.152 * rq**0.4) for rq in (0.2, 0.5, 1, 1.5)}
    smooth, medium = coherent_share(0.05, 1000), coherent_share(0.14, 1000)
    yield "1a", f"A = {smooth:.2f}", "mostly coherent", smooth > 0.5
    yield "1b", f"A = {medium:.3f}", "little coherent", 0.01 < medium < 0.1
    yield "1c", f"{spike_limit():.2f}", "0.3", abs(spike_limit() / 0.3 - 1) < 0.1
    contrast = speckle_contrast(coherent_share(rms_height(0.1), 633))
    yield "2a", f"{contrast:.3f}", "1", contrast > 0.99
    oblique = np.degrees(np.arccos(0.1 / 0.4))
    yield "2b", f"{oblique:.0f} deg", "high", oblique > 60
    yield "3a", f"{saturated:.3f} um", "0.25 um", 1 / 1.6 < saturated / 0.25 < 1.6
    fine, coarse = white_light_contrast(0.2), white_light_contrast(5)
    yield "3b", f"{fine:.2f} to {coarse:.2f}", "usable", fine > 0.5 and 0.05 < coarse < 0.2
    yield "4", f"{short_waves(2.66, 30.0):.2f} um", "0.86 um", abs(short_waves(2.66, 30.0) / 0.86 - 1) < 0.25
    for row, (across, along), ours in (
        ("5a", (0.160, 0.050), rolled),
        ("5b", (0.090, 0.040), rolled),
        ("5c", (0.130, 0.088), brushed),
    ):
        yield f"{row} across", f"{ours.alpha_v:.3f}", f"{across:.3f}", across / 1.6 <= ours.alpha_v <= across * 1.6
        yield f"{row} along", f"{ours.alpha_u:.3f}", f"{along:.3f}", along / 1.6 <= ours.alpha_u <= along * 1.6
    yield "7a", "2", "1.95, 1.91", max(abs(c / 2 - 1) for c in (1.95, 1.91)) < 0.1
    yield "7b", "2", "0.82 to 1.70", max(abs(c / 2 - 1) for c in (0.82, 1.70)) < 0.1
    for letter, (ours, theirs) in zip("abcd", tanner.values(), strict=True):
        yield f"9{letter}", f"{ours:.3f}", f"{theirs:.3f}", theirs / 1.6 <= ours <= theirs * 1.6
    for row, found, theirs in (("10", gaussian(2.27, 20.9, 633.0), 0.217), ("11", gaussian(0.28, 1.77, 500.0), 0.316)):
        yield row, f"{found:.3f}", f"{theirs:.3f}", abs(found / theirs - 1) < 0.05
    widest = GGX_PER_BECKMANN * ALPHA_LARGEST
    yield "12", f"up to {widest:.2f}", "0.394, 0.454, 0.553", widest > 0.553


@pytest.mark.parametrize("rows", [processes, wide_angle], ids=lambda rows: rows.__name__)
def test_tables_of_priors_and_energy_are_those_of_the_code(rows):
    written = table(rows.__name__)
    computed = list(rows())
    assert [row[: len(computed[0])] for row in written] == computed


def test_hits_and_misses_are_those_of_the_code():
    words = {True: "hit", False: "miss"}
    written = {row[0]: row for row in table("published")}
    computed = list(published())
    assert list(written) == [row for row, *_ in computed]
    for row, ours, theirs, hit in computed:
        assert (written[row][2], written[row][3]) == (theirs, ours), row
        assert written[row][4].startswith(words[hit]), row


def test_only_the_named_finishes_lose_more_than_five_percent_up_to_60_deg():
    low = {row[0].strip("`") for row in energy() if float(row[2]) < 0.95}
    assert low == {"bead_blasted", "grit_blasted", "edm"}
