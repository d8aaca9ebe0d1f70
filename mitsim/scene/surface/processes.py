"""Define priors of machining processes for the scattering of light, to be replaced by measurements.

All of them are engineering judgement (*assumed*) unless ``source`` names a source. ``slope`` and ``exponent`` give the
width of the lobe. The wide-angle share is light at angles that no single facet explains (scratches, pits, several
bounces, smeared metal). It is rendered as matt, grows with Ra and depends on the process.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class WideAngle:
    """Share of the light that leaves at wide angles [1]: ``per_um`` times Ra [um], at most ``largest``.

    ``factor``: its one-sigma factor; the range is share / factor to share x factor. ``source`` of the numbers.
    """

    per_um: float
    largest: float
    factor: float
    source: str = "assumed"

    def share(self, roughness_um: float) -> float:
        """Return the default share at one Ra [um]."""
        return min(self.per_um * roughness_um, self.largest)

    def range(self, roughness_um: float) -> tuple[float, float]:
        """Return the one-sigma range, low and high."""
        share = self.share(roughness_um)
        return share / self.factor, min(share * self.factor, 1.0)


@dataclass(frozen=True)
class Process:
    """Prior of a machining process.

    - ``slope`` across the lay relative to the default law (:func:`mitsim.scene.surface.roughness.stylus_slope`).
    - ``exponent``: C of the power spectral density.
    - ``lay_ratio``: alpha along the lay over alpha across it, 1 for no lay.
    - ``usual`` range of Ra [um].
    - ``wide_angle`` share.
    - ``lobe``: Beckmann share of the incoherent light, the rest is GGX; None derives it from the exponent.
    - ``feed_marks``: whether Ra is that of regular tool marks.
    """

    slope: float
    exponent: float
    lay_ratio: float
    usual: tuple[float, float]
    wide_angle: WideAngle
    lobe: float | None = None
    feed_marks: bool = False

    @property
    def beckmann(self) -> float:
        """Return the Beckmann share of the lobe [1].

        Lobes of power-law spectra (C up to 2.4) are closer to GGX, those of nearly Gaussian spectra (C from 3.5) to
        Beckmann.
        """
        if self.lobe is not None:
            return self.lobe
        return float(np.interp(self.exponent, [2.4, 2.6, 3.0, 3.5], [0.0, 0.3, 0.6, 1.0]))


_WARD = "Ward 1992, recalled: .23 and .32 of the light for rolled brass and aluminium, .44 for brushed aluminium"
_BLASTED = "assumed: about .10 from several bounces at the usual Ra"

PROCESSES: dict[str, Process] = {
    "polished": Process(1.0, 2.4, 1.0, (0.01, 0.1), WideAngle(0.15, 0.05, 3.0)),
    "lapped": Process(1.0, 2.6, 1.0, (0.03, 0.4), WideAngle(0.20, 0.20, 2.5)),
    "ground": Process(1.1, 2.5, 0.25, (0.05, 1.6), WideAngle(0.25, 0.30, 2.5)),
    "brushed": Process(1.0, 2.6, 0.3, (0.2, 1.0), WideAngle(0.60, 0.40, 2.0, _WARD)),
    "rolled": Process(0.7, 2.6, 0.5, (0.05, 0.5), WideAngle(0.80, 0.35, 2.0, _WARD)),
    "milled": Process(1.0, 2.5, 0.2, (0.4, 6.3), WideAngle(0.06, 0.15, 3.0), feed_marks=True),
    "turned": Process(1.0, 2.5, 0.2, (0.4, 6.3), WideAngle(0.05, 0.12, 3.0), feed_marks=True),
    "bead_blasted": Process(1.0, 3.5, 1.0, (0.3, 2.0), WideAngle(0.10, 0.20, 2.0, _BLASTED)),
    "grit_blasted": Process(1.2, 3.0, 1.0, (1.0, 6.0), WideAngle(0.035, 0.20, 2.0, _BLASTED), lobe=1.0),
    "edm": Process(1.2, 3.0, 1.0, (0.13, 6.0), WideAngle(0.08, 0.25, 2.5), lobe=0.5),
}

#: Ra between and on the feed marks, as a share of Ra, and its range [um]. Assumed: it gives the lobes of alpha 0.05 to
#: 0.1 of the literature for milled and turned faces with resolved marks
MICRO_SHARE, MICRO_RANGE_UM = 0.25, (0.02, 0.3)


def micro_roughness(roughness_um: float) -> float:
    """Return Ra [um] of a milled or turned face without its feed marks; assumed."""
    return float(np.clip(MICRO_SHARE * roughness_um, *MICRO_RANGE_UM))


def feed(roughness_um: float, nose_radius_mm: float) -> float:
    """Return the feed f [mm] of an ideal turned profile, parabolas of nose radius r [mm]: Ra = f^2 / (18 sqrt(3) r)."""
    return float(np.sqrt(18 * np.sqrt(3) * nose_radius_mm * roughness_um * 1e-3))


def feed_slope(feed_mm: float, nose_radius_mm: float) -> float:
    """Return the rms slope Rdq [1] across the marks: slopes uniform in +-f / (2 r) give f / (2 sqrt(3) r)."""
    return float(feed_mm / (2 * np.sqrt(3) * nose_radius_mm))
