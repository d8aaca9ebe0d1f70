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
from mitsim.scene.surface.measured import HeightMap, Profile
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

#: properties that determine the lobe of a face; at most one may be given
INPUTS = ("height_map", "profile", "Rdq", "RSm", "gloss", "alpha", "alpha_u")

#: largest ratio of a given Ra to a measured Ra (or Sa): samples and cut-offs differ
RA_AGREES_WITHIN = 1.25

NOSE_RADIUS_MM = 0.8


@dataclass(frozen=True)
class MachinedFace:
    """Known properties of a machined face; None if not given.

    - ``Ra``, ``Rq``, ``RSm`` [um]; ``Rdq`` [1].
    - ``profile`` across the lay and ``profile_along`` it.
    - ``gloss`` [GU at 60 deg].
    - ``alpha``, ``alpha_u``, ``alpha_v`` [1] in Beckmann's sense at the sensor's wavelength.
    - ``lay``: direction of the marks.
    - ``nose_radius`` of the tool [mm]; ``feed_marks`` "blurred" or "resolved".
    - ``alpha_factor``: a multiplier on alpha; ``wide_angle`` share.
    """

    metal: str = "aluminium"
    process: str | None = None
    Ra: float | None = None
    Rq: float | None = None
    Rdq: float | None = None
    RSm: float | None = None
    profile: Profile | None = None
    profile_along: Profile | None = None
    height_map: HeightMap | None = None
    gloss: float | None = None
    alpha: float | None = None
    alpha_u: float | None = None
    alpha_v: float | None = None
    lay: Lay | None = None
    nose_radius: float | None = None
    feed_marks: str | None = None
    alpha_factor: float = 1.0
    wide_angle: float | None = None

    @property
    def process_or_default(self) -> str:
        """Return the process, by default ground."""
        return self.process or "ground"

    @property
    def roughness(self) -> float:
        """Return Ra [um], measured if not given; NaN without either."""
        if self.Ra is not None:
            return self.Ra
        if self.profile is not None:
            return self.profile.Ra
        return self.height_map.Sa if self.height_map is not None else float("nan")


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

    Parameters
    ----------
    face, wavelength_nm
        Its properties, and the wavelength of the light [nm].
    where
        Name of the face in messages.
    deviation
        From the best estimate.

    Raises
    ------
    InputError
        If the properties contradict one another, do not suffice, or would be unused.
    """
    check(face, where)
    process = PROCESSES[face.process_or_default]
    sigma = _height(face, process)
    feed_variance = 0.0
    if process.feed_marks and face.feed_marks != "resolved" and not _said(face):
        feed_variance = 2 * _feed_slope(face) ** 2
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
    if deviation.lay_deg is not None and lay_is_open(face):
        # a drawn lay runs along u of a lobe that is turned
        strength = 1.0 if face.height_map is not None else LAY_FACTOR
        lay, turn_deg, along = "u", deviation.lay_deg, deviation.along(along, float(across), strength)
    mirror = float(np.hypot(ALPHA_FORM, np.sqrt(feed_variance)))
    alpha_u, alpha_v = (
        min(deviation.width(a * face.alpha_factor, lobe.factor), ALPHA_LARGEST)
        for a in _directions(lay, float(across), along, face)
    )
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
        coherent_alpha=_mirror_directions(lay, mirror),
        beckmann_range=tails,
        turn_deg=turn_deg,
        lay_open=lay_is_open(face),
    )


def lay_is_open(face: MachinedFace) -> bool:
    """Return whether the process leaves marks whose direction is not given; ``lay = "none"`` says there are none."""
    width_stated = face.lay is not None or face.alpha is not None or face.alpha_u is not None
    return not width_stated and PROCESSES[face.process_or_default].lay_ratio < 1


def check(face: MachinedFace, where: str) -> None:
    """Reject properties that contradict one another, do not suffice, or would be unused.

    Raises
    ------
    InputError
        Naming both of two properties that exclude each other.
    """
    process_name = face.process_or_default
    process = PROCESSES[process_name]
    said = [name for name in INPUTS if getattr(face, name) is not None]
    if face.alpha_v is not None and face.alpha_u is None:
        raise InputError(where, "alpha_u", "nothing, beside alpha_v", "both alpha_u and alpha_v, or neither")
    if face.alpha_u is not None and face.alpha_v is None:
        raise InputError(where, "alpha_v", "nothing, beside alpha_u", "both alpha_u and alpha_v, or neither")
    if len(said) > 1:
        raise InputError(
            where, said[1], f"{said[1]} beside {said[0]}", "one of them", f"keep {said[0]}, the better source"
        )
    if face.Ra is None and face.profile is None and face.height_map is None:
        hint = "performance maps are looked up by Ra"
        raise InputError(where, "Ra", "nothing", "a number of um, or a profile or height_map to take it from", hint)
    measured = face.profile.Ra if face.profile else face.height_map.Sa if face.height_map else None
    if face.Ra is not None and measured is not None:
        source = "profile" if face.profile else "height_map"
        if not 1 / RA_AGREES_WITHIN <= face.Ra / measured <= RA_AGREES_WITHIN:
            allowed = f"the {measured:.3g} um of the {source}, within a factor {RA_AGREES_WITHIN:g}"
            raise InputError(
                where, "Ra", f"{face.Ra:g} um beside a {source}", allowed, "check its unit, or leave Ra out"
            )
    if face.Rq is not None:
        if measured is not None:
            raise InputError(
                where, "Rq", "Rq beside a profile or height_map", "one of them", "Rq is taken from the file"
            )
        if face.Ra is not None and not 1 <= face.Rq / face.Ra <= 2:
            raise InputError(where, "Rq", f"{face.Rq:g} um beside Ra {face.Ra:g} um", "1 to 2 times Ra")
    if face.profile_along is not None and (face.profile is None or face.lay not in ("u", "v")):
        raise InputError(where, "profile_along", "profile_along alone", "with profile and a lay of u or v")
    if face.lay in ("u", "v"):
        if face.alpha is not None or face.alpha_u is not None:
            name = "alpha" if face.alpha is not None else "alpha_u and alpha_v"
            raise InputError(
                where, "lay", f"lay beside {name}", "one of them", "alpha_u and alpha_v already give the directions"
            )
        if process.lay_ratio == 1 and face.height_map is None and face.profile_along is None:
            raise InputError(where, "lay", f"a lay on a {process_name} face", "none: that process leaves no lay")
    if not process.feed_marks:
        for name in ("nose_radius", "feed_marks"):
            if getattr(face, name) is not None:
                key = "nose_radius_mm" if name == "nose_radius" else name
                raise InputError(where, key, f"{key} beside process {process_name}", "milled or turned faces only")
    elif face.Rq is not None:
        allowed = "none: the height between the feed marks is assumed from Ra"
        raise InputError(where, "Rq", f"Rq beside process {process_name}", allowed, "leave Rq out")
    elif face.feed_marks == "resolved" and face.alpha is None and face.alpha_u is None and _said(face):
        allowed = "feed_marks blurred, or alpha of what lies between the marks"
        raise InputError(where, said[0], f"{said[0]} beside feed_marks resolved", allowed, "it includes the marks")
    elif face.nose_radius is not None and _said(face):
        raise InputError(where, "nose_radius_mm", f"nose_radius_mm beside {said[0]}", "one of them")


def _said(face: MachinedFace) -> bool:
    """Return whether the lobe's width has a source other than Ra and process."""
    return any(getattr(face, name) is not None for name in INPUTS)


def _height(face: MachinedFace, process: Process) -> float:
    if process.feed_marks:
        return rms_height(micro_roughness(face.roughness))
    if face.height_map is not None:
        return face.height_map.Sq
    if face.profile is not None:
        return face.profile.Rq
    return face.Rq if face.Rq is not None else rms_height(face.roughness)


def _feed_slope(face: MachinedFace) -> float:
    radius = face.nose_radius if face.nose_radius is not None else NOSE_RADIUS_MM
    return feed_slope(feed(face.roughness, radius), radius)


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


def _directions(lay: Lay, across: float, along: float, face: MachinedFace) -> tuple[float, float]:
    if face.alpha_u is not None and face.alpha_v is not None:
        return face.alpha_u, face.alpha_v
    if lay == "none":
        return across, across
    return (along, across) if lay == "u" else (across, along)


def _mirror_directions(lay: Lay, mirror: float) -> tuple[float, float]:
    if lay == "none":
        return mirror, mirror
    return (ALPHA_FORM, mirror) if lay == "u" else (mirror, ALPHA_FORM)


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
    elif lay_is_open(face):
        words = f"{provenance}; lay not given: round, as wide as across the lay"
    return words if face.alpha_factor == 1 else f"{words}; times {face.alpha_factor:g}"
