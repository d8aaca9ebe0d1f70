"""How long it takes to score many views of the two-pillar part, map given.

    python tests/benchmarks/scoring.py [sensor ...]

All 642 directions of an icosahedron subdivided three times, also those below the part, and the seven measurements of
scenes/two_pillars/task.toml, with the map that comes with mitsim: first for direct light without the calibration, then
as `mitsim study score` and `mitsim run` do it. The first views, which compile, are counted in both.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

from mitsim.decoding.cloud import sensor_geometry
from mitsim.maps.prediction import Predictor
from mitsim.study import MINIMUM_POINTS, CharacterisationTable, StudyFile, open_study
from mitsim.study.virtual.screening import screen
from mitsim.views import ViewsTable
from mitsim.views.view_scores import score_candidates

ROOT = Path(__file__).parents[2]


def main() -> None:
    """Score, and print the table."""
    print(f"{'sensor':24} {'effects':>12} {'views':>6} {'s':>8} {'views/s':>8}")
    for sensor in sys.argv[1:] or ["ensenso-n10", "david-sls-3"]:
        file = StudyFile(
            scene="two_pillars.xml",
            task="task.toml",
            sensor=sensor,
            characterisation=CharacterisationTable(),
            views=ViewsTable(subdivisions=3, lowest_elevation_deg=-90),
        )
        study = open_study(ROOT / "scenes/two_pillars/benchmark.toml", file)
        table = study.performance_map
        assert table is not None
        predictor = Predictor.of_sensor(study.sensor, sensor_geometry(study.sensor))
        for name in ("none", "as shipped"):
            start = time.perf_counter()
            if name == "none":
                score_candidates(study.scene, study.task, study.views, predictor, table, MINIMUM_POINTS)
            else:
                screen(study, predictor, table)
            seconds, count = time.perf_counter() - start, len(study.views)
            print(f"{sensor:24} {name:>12} {count:6d} {seconds:8.1f} {count / seconds:8.1f}", flush=True)


if __name__ == "__main__":
    main()
