"""The study of ``tolerances.toml`` as a program: the sprayed part, whose measurements have tolerances.

``python scenes/two_pillars/tolerances.py`` gives the numbers of ``mitsim run scenes/two_pillars/tolerances.toml``.
"""

from pathlib import Path

import mitsim as ms

HERE = Path(__file__).resolve().parent

STUDY = ms.StudyFile(
    scene="sprayed_pillars.xml",
    task="task_with_tolerances.toml",
    sensor="zivid-2-m70",
    seed=1,
    views={"subdivisions": 2, "rolls_deg": [0, 90], "lowest_elevation_deg": 20},
)

if __name__ == "__main__":
    study = ms.open_study(HERE / "tolerances.toml", STUDY)
    for statement in ms.run_study(study, "runs/tolerances"):
        print(f"{statement.measurement}: {statement.verdict}")
