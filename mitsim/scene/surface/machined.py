"""Compute how a machined metal face scatters light, from its known properties.

Signal chain, best input first: areal height map; profile trace; Rdq or RSm with Ra; gloss; alpha itself; Ra and
process -> heights sigma, autocorrelation across and along the lay -> coherent share A and alpha at the wavelength ->
wide-angle share -> compensation of the energy that single scattering loses.

On milled and turned faces, Ra is that of the feed marks: parabolas whose slope is uniform in +-f / (2 r). There is no
coherence across them (Wu et al., 2011: exp(-g) fails for periodic profiles). A and the lobe's core are those of an
assumed micro-roughness. Marks too fine for the camera to resolve ("blurred") widen both by the slope of the marks.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from characterisation.files.errors import InputError
from mitsim.scene.surface.diffraction import Autocorrelation, coherent_share, lobe_alpha, phase_variance
from mitsim.scene.surface.energy import energy_factors
from mitsim.scene.surface.gloss import GLOSS_WAVELENGTH_NM, alpha_of_gloss, base_gloss, lobe_gloss
from mitsim.scene.surface.machined_face import MachinedFace, check
from mitsim.scene.surface.metals import normal_reflectance, refractive_index
from mitsim.scene.surface.microfacet import GGX_PER_BECKMANN
from mitsim.scene.surface.processes import LAY_FACTOR, PROCESSES, Process, feed, feed_slope, micro_roughness
from mitsim.scene.surface.roughness import (
    ALPHA_LARGEST,
    correlation_length,
    matern,
    rms_height,
    slope_of_spacing,
    stylus_slope,
)
from mitsim.scene.surface.scatter import ALPHA_FORM, NOMINAL, Deviation, Lay, Scatter

#: one-sigma factor of alpha by its source; the order is known, the values are assumed
FACTORS = {
    "height map": 1.1,
    "profile": 1.15,
    "gloss": 1.2,
    "slope": 1.25,
    "process": 1.6,
    "Ra only": 2.0,
    "alpha": 1.0,
}

NOSE_RADIUS_MM = 0.8


@dataclass(frozen=True)
class _LobeWidths:
    """Alpha across and along the lay, its source, and its one-sigma factor."""

    across: float
    along: float
    provenance: str
    factor: float


def machined(
    face: MachinedFace, wavelength_nm: float, where: str = "a machined face", deviation: Deviation = NOMINAL
) -> Scatter:
    """Return how a face scatters.

    Raises InputError if the properties contradict one another, do not suffice, or would be unused.

    Parameters
    ----------
    face, wavelength_nm
        Its properties, and the wavelength of the light [nm].
    where
        Name of the face in messages.
    deviation
        From the best estimate.
    """
    check(face, where)
    process = PROCESSES[face.process_or_default]
    sigma = _height(face, process)
    feed_variance = 0.0
    if process.feed_marks and face.feed_marks != "resolved" and not face.said:
        radius = face.nose_radius if face.nose_radius is not None else NOSE_RADIUS_MM
        feed_variance = 2 * feed_slope(feed(face.roughness, radius), radius) ** 2
    lobe = _lobe(face, process, sigma, wavelength_nm, where)
    across = np.hypot(lobe.across, np.sqrt(feed_variance))

    def with_marks(share: float) -> float:
        # a uniform slope has no tail: it counts as Beckmann, weighted by variance
        return float((share * lobe.across**2 + feed_variance) / (lobe.across**2 + feed_variance))

    low, high = process.tail_range
    tails = with_marks(low), with_marks(high)
    beckmann = deviation.beckmann(with_marks(process.beckmann), tails)
    lay: Lay = face.lay or "none"
    along, turn_deg = lobe.along, None
    if deviation.lay_deg is not None and face.lay_is_open:
        # a drawn lay runs along u of a lobe that is turned
        strength = 1.0 if face.height_map is not None else LAY_FACTOR
        lay, turn_deg, along = "u", deviation.lay_deg, deviation.along(along, float(across), strength)
    mirror = float(np.hypot(ALPHA_FORM, np.sqrt(feed_variance)))
    alphas = _by_u_and_v(lay, float(across), along)
    if face.alpha_u is not None and face.alpha_v is not None:
        alphas = face.alpha_u, face.alpha_v
    alpha_u, alpha_v = (min(deviation.width(a * face.alpha_factor, lobe.factor), ALPHA_LARGEST) for a in alphas)
    share = process.wide_angle.share(face.roughness) if face.wide_angle is None else face.wide_angle
    ends = process.wide_angle.range(face.roughness) if face.wide_angle is None else (share, share)
    words = _in_words(face, lobe.provenance, turn_deg)
    return Scatter(
        phase_variance=phase_variance(sigma, wavelength_nm),
        alpha_u=alpha_u,
        alpha_v=alpha_v,
        beckmann=beckmann,
        height_um=sigma,
        wide_angle=deviation.share(share, ends),
        wide_angle_range=ends,
        alpha_factor=lobe.factor,
        provenance=deviation.provenance_of(words, lobe.factor, ends, tails),
        lay=face.lay or "none",
        energy_factor=energy_factors(alpha_u, alpha_v, normal_reflectance(face.metal, wavelength_nm)),
        coherent_alpha=_by_u_and_v(lay, mirror, ALPHA_FORM),
        beckmann_range=tails,
        turn_deg=turn_deg,
        lay_open=face.lay_is_open,
    )


def _height(face: MachinedFace, process: Process) -> float:
    if process.feed_marks:
        return rms_height(micro_roughness(face.roughness))
    if face.height_map is not None:
        return face.height_map.Sq
    if face.profile is not None:
        return face.profile.Rq
    return face.Rq if face.Rq is not None else rms_height(face.roughness)


def _lobe(face: MachinedFace, process: Process, sigma: float, wavelength_nm: float, where: str) -> _LobeWidths:
    ratio = process.lay_ratio
    if face.alpha is not None:
        return _LobeWidths(face.alpha, face.alpha, f"alpha {face.alpha:g} as given", FACTORS["alpha"])
    if face.alpha_u is not None and face.alpha_v is not None:
        provenance = f"alpha {face.alpha_u:g} and {face.alpha_v:g} along u and v as given"
        return _LobeWidths(face.alpha_v, face.alpha_u, provenance, FACTORS["alpha"])
    if face.height_map is not None:
        areal = face.height_map
        across = _from_heights(areal.across, areal.Sq, wavelength_nm, where, "height_map")
        along = _from_heights(areal.along, areal.Sq, wavelength_nm, where, "height_map")
        if ratio == 1 and face.lay not in ("u", "v"):
            across = along = float(np.sqrt((across**2 + along**2) / 2))
        return _LobeWidths(across, along, f"height map {areal.name}", FACTORS["height map"])
    if face.profile is not None:
        across = _from_heights(face.profile.autocorrelation, face.profile.Rq, wavelength_nm, where, "profile")
        along = across * ratio
        if face.profile_along is not None:
            second = face.profile_along
            along = _from_heights(second.autocorrelation, second.Rq, wavelength_nm, where, "profile_along")
        return _LobeWidths(across, along, f"profile trace {face.profile.name}", FACTORS["profile"])
    if process.feed_marks and (face.Rdq is not None or face.RSm is not None):
        # the slope of a periodic profile is geometric: RSm is the feed, and Rdq = 9 Ra / f
        slope = face.Rdq if face.Rdq is not None else 9 * face.roughness / (face.RSm or 1.0)
        words = f"Rdq {face.Rdq:g}" if face.Rdq is not None else f"Ra {face.roughness:g} um and feed {face.RSm:g} um"
        return _LobeWidths(float(np.sqrt(2) * slope), float(np.sqrt(2) * slope) * ratio, words, FACTORS["slope"])
    if face.gloss is not None:
        return _of_gloss(face, process, sigma, wavelength_nm, where)
    ra = micro_roughness(face.roughness) if process.feed_marks else face.roughness
    words, factor = _prior_in_words(face, process)
    slope = stylus_slope(ra, face.process_or_default)
    if face.Rdq is not None:
        slope, words, factor = float(np.sqrt(2) * face.Rdq), f"Rdq {face.Rdq:g}", FACTORS["slope"]
    elif face.RSm is not None:
        slope = float(np.sqrt(2) * slope_of_spacing(sigma, face.RSm))
        words, factor = f"Ra {face.roughness:g} um and RSm {face.RSm:g} um", FACTORS["slope"]
    nu = (process.exponent - 1) / 2
    length = correlation_length(sigma, min(slope, ALPHA_LARGEST), nu)
    across = lobe_alpha(_matern_of(length, nu), sigma, wavelength_nm)
    return _LobeWidths(across, across * ratio, words, factor)


def _matern_of(length_um: float, nu: float) -> Autocorrelation:
    return lambda lag: matern(lag / length_um, nu)


def _from_heights(rho: Autocorrelation, sigma: float, wavelength_nm: float, where: str, key: str) -> float:
    try:
        return lobe_alpha(rho, sigma, wavelength_nm)
    except ValueError as error:
        raise InputError(where, key, str(error), "a trace or map of roughness, without form and noise") from None


def _of_gloss(face: MachinedFace, process: Process, sigma: float, wavelength_nm: float, where: str) -> _LobeWidths:
    """Compute alpha at 555 nm from a gloss reading, then the lateral scale, then alpha at the sensor's wavelength."""
    index = refractive_index(face.metal, GLOSS_WAVELENGTH_NM)
    bright = normal_reflectance(face.metal, GLOSS_WAVELENGTH_NM)
    coherent = coherent_share(sigma, GLOSS_WAVELENGTH_NM, np.radians(60))
    wide = process.wide_angle.share(face.roughness) if face.wide_angle is None else face.wide_angle
    beckmann = process.beckmann
    mirror = lobe_gloss(ALPHA_FORM, index, "beckmann")

    def reading(alpha: float) -> float:
        lobe = beckmann * lobe_gloss(alpha, index, "beckmann")
        lobe += (1 - beckmann) * lobe_gloss(GGX_PER_BECKMANN * alpha, index, "ggx")
        return (1 - wide) * (coherent * mirror + (1 - coherent) * lobe) + wide * base_gloss(bright)

    assert face.gloss is not None
    try:
        alpha = alpha_of_gloss(face.gloss, reading, (0.002, ALPHA_LARGEST))
    except ValueError as error:
        found = f"{face.gloss:g} GU on {face.metal} of Ra {face.roughness:g} um"
        hint = "metal reads in the hundreds of GU; check that the reading is at 60 deg"
        raise InputError(where, "gloss", found, str(error), hint) from None
    words = f"gloss {face.gloss:g} GU at 60 deg"
    nu = (process.exponent - 1) / 2
    length = None if process.feed_marks else _length_of_alpha(alpha, sigma, nu)
    if length is None:  # geometric: the slope is the same at every wavelength
        return _LobeWidths(alpha, alpha * process.lay_ratio, words, FACTORS["gloss"])
    across = lobe_alpha(_matern_of(length, nu), sigma, wavelength_nm)
    return _LobeWidths(across, across * process.lay_ratio, words, FACTORS["gloss"])


def _length_of_alpha(alpha: float, sigma: float, nu: float) -> float | None:
    """Return the lateral scale [um] whose lobe at 555 nm has this alpha; None if there is none."""

    def excess(log_length: float) -> float:
        length = float(np.exp(log_length))
        return float(np.log(lobe_alpha(_matern_of(length, nu), sigma, GLOSS_WAVELENGTH_NM) / alpha))

    ends = np.log([0.3, 1e4])
    if not excess(ends[1]) <= 0 <= excess(ends[0]):
        return None
    return float(np.exp(brentq(excess, *ends, xtol=1e-7)))


def _by_u_and_v(lay: Lay, across: float, along: float) -> tuple[float, float]:
    """Return the widths along u and v of a lobe; one without a lay is as wide as across it."""
    if lay == "none":
        return across, across
    return (along, across) if lay == "u" else (across, along)


def _prior_in_words(face: MachinedFace, process: Process) -> tuple[str, float]:
    name = face.process_or_default
    marks = f", feed marks {face.feed_marks or 'blurred'}" if process.feed_marks else ""
    if face.process is None:
        return f"prior of {name} metal, the process not being given, for Ra {face.roughness:g} um", FACTORS["Ra only"]
    return f"prior of {name.replace('_', '-')} metal for Ra {face.roughness:g} um{marks}", FACTORS["process"]


def _in_words(face: MachinedFace, provenance: str, turn_deg: float | None) -> str:
    words = provenance
    if turn_deg is not None:
        words = f"{provenance}; lay drawn at {turn_deg:.0f} deg"
    elif face.lay_is_open:
        words = f"{provenance}; lay not given: round, as wide as across the lay"
    return words if face.alpha_factor == 1 else f"{words}; times {face.alpha_factor:g}"
