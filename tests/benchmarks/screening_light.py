"""What the light between faces costs in the screening of views, and what fewer of its samples change.

    python tests/benchmarks/screening_light.py [sensor ...]

Views of the two pillars are screened with three times the pixels and twelve times the paths and photons of the product,
the reference, then with three times as many of all, and as in the product. Columns: processor time of a view (of the
first row with compilation), rank correlation of the predicted risk with the reference (least and largest over
measurements), and rms difference of its logarithm over the ten best views of each measurement.
"""

from __future__ import annotations

import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
from scipy.stats import spearmanr

from mitsim.maps.prediction import interreflections
from mitsim.study import CharacterisationTable, StudyFile, open_study
from mitsim.study.session import Session
from mitsim.study.virtual import screening
from mitsim.views import ViewsTable
from mitsim.views.view_scores import screening_risk

ROOT = Path(__file__).parents[2]
EFFECT, PIXELS = interreflections.InterreflectionEffect, interreflections.PIXELS
PATHS, PHOTONS = interreflections.PATHS, interreflections.PHOTONS

#: factors on the product's pixels, and on its paths and photons
SAMPLES = {"reference": (3, 12), "three times": (3, 3), "product": (1, 1)}


def main() -> None:
    """Screen, and print the table."""
    print(f"{'sensor':24} {'samples':12} {'views':>5} {'s/view':>7} {'rank correlation':>17} {'rms of ten best':>16}")
    for name in sys.argv[1:] or ["ensenso-n10", "photoneo-phoxi-s"]:
        file = StudyFile(
            scene="two_pillars.xml",
            task="task.toml",
            sensor=name,
            characterisation=CharacterisationTable(),
            views=ViewsTable(subdivisions=1, rolls_deg=[0, 90], lowest_elevation_deg=20),
        )
        session = Session(open_study(ROOT / "scenes/two_pillars/benchmark.toml", file))
        prepared = session.predictor, session.unknowns  # a calibration may be simulated here
        assert all(prepared)
        risks, seconds = {}, {}
        for samples, (pixels, paths) in SAMPLES.items():
            interreflections.PIXELS = pixels * PIXELS
            screening.InterreflectionEffect = partial(EFFECT, paths=paths * PATHS, photons=paths * PHOTONS)
            start = time.process_time()
            risks[samples] = screening_risk(session.screen()[0])
            seconds[samples] = (time.process_time() - start) / len(session.study.views)
        for samples, risk in risks.items():
            ranks, differences = compared(risk, risks["reference"])
            print(
                f"{name:24} {samples:12} {len(session.study.views):5} {seconds[samples]:7.3f} "
                f"{np.min(ranks):8.2f} {np.max(ranks):8.2f} {np.sqrt(np.mean(np.square(differences))):16.3f}",
                flush=True,
            )


def compared(risk: np.ndarray, reference: np.ndarray) -> tuple[list[float], list[float]]:
    """Return rank correlations by measurement, and differences of the ten best views of each."""
    ranks, differences = [], []
    for one, other in zip(risk, reference, strict=True):
        both = np.isfinite(one) & np.isfinite(other)
        if both.sum() > 3:
            ranks.append(float(spearmanr(one[both], other[both])[0]))
            best = np.argsort(np.where(both, other, np.inf))[: min(10, both.sum())]
            differences += (one[best] - other[best]).tolist()
    return ranks, differences


if __name__ == "__main__":
    main()
