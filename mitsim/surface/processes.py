"""What a machining process leaves behind, as far as light is concerned: priors, to be replaced by measurement.

All of them are engineering judgement (*assumed*) unless ``source`` names something else. The width of the lobe comes
from ``slope`` and ``exponent``; the wide-angle share, what leaves at angles that no single facet accounts for
(scratches, pits, several bounces, smeared metal) and is rendered as matt, grows with Ra and differs by process.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class WideAngle:
    """Share of the light that leaves at wide angles [1]: ``per_um`` times Ra [um], at most ``largest``.

    ``factor`` one sigma of it: the range is share / factor to share x factor. ``source`` where it comes from.
    """

    per_um: float
    largest: float
    factor: float
    source: str = "assumed"

    def share(self, roughness_um: float) -> float:
        """The default at one Ra [um]."""
        return min(self.per_um * roughness_um, self.largest)

    def range(self, roughness_um: float) -> tuple[float, float]:
        """Low and high, one sigma either side."""
        share = self.share(roughness_um)
        return share / self.factor, min(share * self.factor, 1.0)


@dataclass(frozen=True)
class Process:
    """Prior of a machining process.

    ``slope`` across the lay relative to the default law (:func:`mitsim.surface.roughness.stylus_slope`); ``exponent``
    C of the power spectral density; ``lay_ratio`` alpha along the lay over alpha across it, 1 for no lay; ``usual``
    range of Ra [um]; ``wide_angle`` share; ``lobe`` share of the incoherent light in a Beckmann lobe, the rest GGX
    (None: by the exponent); ``feed_marks`` whether Ra is that of regular tool marks.
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
        """Share of Beckmann in the lobe [1].

        Power laws (C up to 2.4) give lobes that GGX fits better, nearly Gaussian spectra (C from 3.5) Beckmann.
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

#: Ra of what lies between and on the feed marks, as a share of Ra, and its range [um]. Assumed: it gives the lobes of
#: alpha 0.05 to 0.1 that the literature has for milled and turned faces whose marks are resolved
MICRO_SHARE, MICRO_RANGE_UM = 0.25, (0.02, 0.3)


def micro_roughness(roughness_um: float) -> float:
    """Ra [um] of a milled or turned face without its feed marks; assumed."""
    return float(np.clip(MICRO_SHARE * roughness_um, *MICRO_RANGE_UM))


def feed(roughness_um: float, nose_radius_mm: float) -> float:
    """Feed f [mm] of an ideal turned profile: Ra = f^2 / (18 sqrt(3) r), a row of parabolas of nose radius r [mm]."""
    return float(np.sqrt(18 * np.sqrt(3) * nose_radius_mm * roughness_um * 1e-3))


def feed_slope(feed_mm: float, nose_radius_mm: float) -> float:
    """Rms slope Rdq [1] across the marks: slopes are uniform in +-f / (2 r), so f / (2 sqrt(3) r)."""
    return float(feed_mm / (2 * np.sqrt(3) * nose_radius_mm))
