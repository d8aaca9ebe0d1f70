"""How long it takes to score many views of the two-pillar part, map given.

    python tests/benchmarks/scoring.py [sensor ...]

All 642 directions of an icosahedron subdivided three times, also those below the part, and the seven measurements of
scenes/two_pillars/task.toml, with the map that comes with mitsim: first as a study does it by default, for direct
light; then allowing for light by way of other surfaces, on every tenth view. The first views, which compile, are
counted in both.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

from mitsim.prediction import Predictor
from mitsim.prediction.interreflections import InterreflectionEffect
from mitsim.reconstruction.cloud import sensor_geometry
from mitsim.study import MINIMUM_POINTS, CharacterisationTable, StudyFile, open_study
from mitsim.view_scores import score_candidates
from mitsim.views import ViewsTable

ROOT = Path(__file__).parents[2]


def main() -> None:
    """Score, and print the table."""
    print(f"{'sensor':24} {'light':>16} {'views':>6} {'s':>8} {'views/s':>8} {'s for 642':>10}")
    for sensor in sys.argv[1:] or ["ensenso-n10", "david-sls-3"]:
        file = StudyFile(
            scene="two_pillars.xml",
            task="task.toml",
            sensor=sensor,
            characterisation=CharacterisationTable(),
            views=ViewsTable(subdivisions=3, lowest_elevation_deg=-90),
        )
        study = open_study(ROOT / "scenes/two_pillars/benchmark.toml", file)
        assert study.performance_map is not None
        predictor = Predictor.of_sensor(study.sensor, sensor_geometry(study.sensor))
        for light, views, effects in (
            ("direct", study.views, []),
            ("and reflected", study.views[::10], [InterreflectionEffect(study.sensor)]),
        ):
            start = time.perf_counter()
            score_candidates(study.scene, study.task, views, predictor, study.performance_map, MINIMUM_POINTS, effects)
            seconds = time.perf_counter() - start
            rate = len(views) / seconds
            print(f"{sensor:24} {light:>16} {len(views):6d} {seconds:8.1f} {rate:8.1f} {642 / rate:10.0f}")


if __name__ == "__main__":
    main()
