"""Define priors of machining processes for the scattering of light, to be replaced by measurements.

All of them are engineering judgement (*assumed*) unless ``source`` names a source. ``slope`` and ``exponent`` give the
width of the lobe. The wide-angle share is light at angles that no single facet explains (scratches, pits, several
bounces, smeared metal). It is rendered as matt, grows with Ra and depends on the process.

The spread of the shape, and three of the wide-angle shares, are fitted to measured metals whose Ra is unknown: nine of
a goniometer at 2 to 5.7 um, nine fits of MERL spheres (Low et al. 2012) and three of Ward (SIGGRAPH 1992). The command
``python -m tests.proofs finishes FOLDER`` prints the fits and their 95 % intervals.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

#: largest wide-angle share of a machined metal [1]. The largest of 18 that the data determine is 0.49
LARGEST_WIDE_ANGLE = 0.6

#: one-sigma factor of the odds w / (0.6 - w) of a wide-angle share w, about the best estimate of the process: 4.20,
#: 95 % interval 2.96 to 8.36, of 18 surfaces
WIDE_ANGLE_FACTOR = 4.2

#: one-sigma factor of the ratio of alpha along the lay to alpha across it: 2.34, 95 % interval 1.73 to 6.48, of 6
#: surfaces
LAY_FACTOR = 2.3

#: one-sigma range of the Beckmann share of a lobe. None of 16 measured metals has more than 0.5 (largest 0.14), so at
#: most 17 % of all have (one-sided 95 %)
TAIL_RANGE = (0.0, 0.5)

#: the same of blasted and eroded faces, whose share the measurements do not determine: that of a uniform distribution
UNKNOWN_TAIL = (0.16, 0.84)


@dataclass(frozen=True)
class WideAngle:
    """Share of the light that leaves at wide angles [1]: ``per_um`` times Ra [um], at most ``largest``.

    ``factor``: one-sigma factor of its odds w / (:data:`LARGEST_WIDE_ANGLE` - w). ``source`` of the share.
    """

    per_um: float
    largest: float
    source: str = "assumed"
    factor: float = WIDE_ANGLE_FACTOR

    def share(self, roughness_um: float) -> float:
        """Return the default share at one Ra [um]."""
        return min(self.per_um * roughness_um, self.largest)

    def range(self, roughness_um: float) -> tuple[float, float]:
        """Return the one-sigma range, low and high."""
        share = self.share(roughness_um)
        return moved_odds(share, 1 / self.factor), moved_odds(share, self.factor)


def moved_odds(share: float, factor: float) -> float:
    """Return the share w [1] whose odds w / (LARGEST_WIDE_ANGLE - w) are ``factor`` times those of ``share``."""
    odds = share / (LARGEST_WIDE_ANGLE - share) * factor
    return LARGEST_WIDE_ANGLE * odds / (1 + odds)


@dataclass(frozen=True)
class Process:
    """Prior of a machining process."""

    slope: float  # across the lay relative to the default law (:func:`mitsim.scene.surface.roughness.stylus_slope`)
    exponent: float  # C of the power spectral density
    lay_ratio: float  # alpha along the lay over alpha across it, 1 for no lay
    usual: tuple[float, float]  # range of Ra [um]
    wide_angle: WideAngle  # wide-angle share
    #: Beckmann share of the incoherent light, the rest is GGX; None derives it from the exponent
    lobe: float | None = None
    feed_marks: bool = False  # whether Ra is that of regular tool marks
    tail: tuple[float, float] = TAIL_RANGE  # one-sigma range of that share

    @property
    def beckmann(self) -> float:
        """Return the Beckmann share of the lobe [1].

        Lobes of power-law spectra (C up to 2.4) are closer to GGX, those of nearly Gaussian spectra (C from 3.5) to
        Beckmann.
        """
        if self.lobe is not None:
            return self.lobe
        return float(np.interp(self.exponent, [2.4, 2.6, 3.0, 3.5], [0.0, 0.3, 0.6, 1.0]))

    @property
    def tail_range(self) -> tuple[float, float]:
        """Return the one-sigma range of :attr:`beckmann`, low and high [1]; it contains the best estimate."""
        return min(self.tail[0], self.beckmann), max(self.tail[1], self.beckmann)


_BRUSHED = "Ward 1992: .44 of the light, Ra unknown; a lower median is assumed"
_ROLLED = "geometric mean of .23 and .32 (Ward 1992) and .18 (goniometer)"
_POLISHED = "geometric mean of two goniometer surfaces and nine MERL spheres, .004 to .49"
_GRIT = "goniometer: .47 and .44 on two blasted metals"
_BLASTED = "assumed: about .10 from several bounces at the usual Ra"

PROCESSES: dict[str, Process] = {
    "polished": Process(1.0, 2.4, 1.0, (0.01, 0.1), WideAngle(1.0, 0.10, _POLISHED)),
    "lapped": Process(1.0, 2.6, 1.0, (0.03, 0.4), WideAngle(0.20, 0.20)),
    "ground": Process(1.1, 2.5, 0.25, (0.05, 1.6), WideAngle(0.25, 0.30)),
    "brushed": Process(1.0, 2.6, 0.3, (0.2, 1.0), WideAngle(0.60, 0.40, _BRUSHED)),
    "rolled": Process(0.7, 2.6, 0.5, (0.05, 0.5), WideAngle(1.5, 0.35, _ROLLED)),
    "milled": Process(1.0, 2.5, 0.2, (0.4, 6.3), WideAngle(0.06, 0.15), feed_marks=True),
    "turned": Process(1.0, 2.5, 0.2, (0.4, 6.3), WideAngle(0.05, 0.12), feed_marks=True),
    "bead_blasted": Process(1.0, 3.5, 1.0, (0.3, 2.0), WideAngle(0.10, 0.20, _BLASTED), tail=UNKNOWN_TAIL),
    "grit_blasted": Process(1.2, 3.0, 1.0, (1.0, 6.0), WideAngle(0.19, 0.50, _GRIT), lobe=1.0, tail=UNKNOWN_TAIL),
    "edm": Process(1.2, 3.0, 1.0, (0.13, 6.0), WideAngle(0.08, 0.25), lobe=0.5, tail=UNKNOWN_TAIL),
}

#: Ra between and on the feed marks, as a share of Ra. Assumed, with its range: they give the lobes of alpha 0.05 to 0.1
#: of the literature for milled and turned faces with resolved marks
MICRO_SHARE = 0.25

#: range of Ra between and on the feed marks [um]
MICRO_RANGE_UM = (0.02, 0.3)


def micro_roughness(roughness_um: float) -> float:
    """Return Ra [um] of a milled or turned face without its feed marks; assumed."""
    return float(np.clip(MICRO_SHARE * roughness_um, *MICRO_RANGE_UM))


def feed(roughness_um: float, nose_radius_mm: float) -> float:
    """Return the feed f [mm] of an ideal turned profile, parabolas of nose radius r [mm]: Ra = f^2 / (18 sqrt(3) r)."""
    return float(np.sqrt(18 * np.sqrt(3) * nose_radius_mm * roughness_um * 1e-3))


def feed_slope(feed_mm: float, nose_radius_mm: float) -> float:
    """Return the rms slope Rdq [1] across the marks: slopes uniform in +-f / (2 r) give f / (2 sqrt(3) r)."""
    return float(feed_mm / (2 * np.sqrt(3) * nose_radius_mm))
