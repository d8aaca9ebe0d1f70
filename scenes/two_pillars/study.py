"""The study of ``study.toml`` as a program: where should an Ensenso N10 stand to measure the two-pillar artefact?

``python scenes/two_pillars/study.py`` gives the numbers of ``mitsim run scenes/two_pillars/study.toml``.
"""

from pathlib import Path

import mitsim as ms

HERE = Path(__file__).resolve().parent

STUDY = ms.StudyFile(
    scene="two_pillars.xml",
    task="task.toml",
    sensor="ensenso-n10",
    seed=1,
    views={"subdivisions": 2, "rolls_deg": [0, 90], "lowest_elevation_deg": 20},
    check={"views": 4},
)

if __name__ == "__main__":
    study = ms.open_study(HERE / "study.toml", STUDY)
    for statement in ms.run_study(study, "runs/two_pillars"):
        print(f"{statement.measurement}: u = {statement.standard_uncertainty:.2g} {statement.unit}")
