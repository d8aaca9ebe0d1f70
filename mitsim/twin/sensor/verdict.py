"""State in one word whether a fitted sensor file reproduces the captures that it was fitted to.

Signal chain: chi-square and degrees of freedom of the dots of each capture, largest difference of a feature ->
probability of so large a chi-square by chance -> the worst capture decides.

- ``good``: the probability is at least :data:`CHANCE`.
- ``fair``: it is smaller, but chi-square is at most :data:`FAIR` times its degrees of freedom, or no feature of the
  dots differs by more than the margin of ``mitsim compare`` for noise, contrast and lengths. A sheet with hundreds of
  patches shows differences that do not matter. The uncertainties of the fit were enlarged by the root of the ratio
  (Birge, Phys. Rev. 40 (1932) 207).
- ``bad``: neither holds. No parameters of the file reproduce the dots, so the fitted numbers compensate for something
  that the file does not describe.
- ``not tested``: no capture shows dots.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from scipy.stats import chi2

from characterisation.words.numbers import percent
from mitsim.twin.compare.compared_quantities import NOISE_FACTOR

Word = Literal["good", "fair", "bad", "not tested"]

#: smallest probability by chance of a good fit
CHANCE = 0.01

#: largest reduced chi-square of a fair fit; *assumed*: features then miss by 1.7 of their uncertainties
FAIR = 3.0


@dataclass(frozen=True)
class DotAgreement:
    """The dots of a ``capture`` against the best simulation: chi-square and its degrees of freedom.

    ``misfit`` is the root mean square, over the field, of the logarithm of recorded over simulated, of the ``feature``
    that differs most.
    """

    capture: str
    chi_square: float
    freedom: int
    misfit: float
    feature: str

    @property
    def reduced(self) -> float:
        """Return chi-square over its degrees of freedom."""
        return self.chi_square / max(self.freedom, 1)

    @property
    def word(self) -> Word:
        """Return the verdict of this capture alone."""
        if float(chi2.sf(self.chi_square, max(self.freedom, 1))) >= CHANCE:
            return "good"
        return "fair" if self.reduced <= FAIR or self.misfit <= math.log(NOISE_FACTOR) else "bad"


@dataclass(frozen=True)
class Verdict:
    """The ``word``, and a sentence with its reason and what to do."""

    word: Word
    why: str


def verdict_of(agreements: tuple[DotAgreement, ...]) -> Verdict:
    """Return the verdict of a fit: that of the capture which agrees least."""
    if not agreements:
        return Verdict("not tested", "no capture shows dots, so nothing tests the fitted numbers against an image")
    worst = max(agreements, key=lambda agreement: (("good", "fair", "bad").index(agreement.word), agreement.reduced))
    numbers = f"chi-square {worst.chi_square:.1f} of {worst.freedom} for {worst.capture}"
    most = f"{worst.feature} differs most, by {percent(math.expm1(worst.misfit))}"
    why = {
        "good": "the simulated dots agree with the recorded ones",
        "fair": f"the dots differ a little: their {most}; the intervals contain it",
        "bad": f"no numbers of this file reproduce the dots: their {most}. Start from another preset, or "
        "check --window, the sheet, the exposure, and that repeats differ in nothing but noise; F and sigma of this "
        "file are not those of the camera",
    }[worst.word]
    return Verdict(worst.word, f"{numbers}: {why}")
