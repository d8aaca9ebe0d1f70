"""The study of ``set.toml`` as a program: several views that together measure within limits of uncertainty.

``python scenes/two_pillars/set.py`` gives the numbers of ``mitsim run scenes/two_pillars/set.toml``.
"""

from pathlib import Path

import mitsim as ms

HERE = Path(__file__).resolve().parent

STUDY = ms.StudyFile(
    scene="two_pillars.xml",
    task="task.toml",
    sensor="ensenso-n10",
    views={"subdivisions": 2, "rolls_deg": [0, 90], "lowest_elevation_deg": 20},
    set={
        "limits": {"pillar1_pillar2_distance": 0.3, "pillar1_pillar2_angle": 1.2, "pillar1_radius": 0.5},
        "joining": "robot",
        "trials": 12,
    },
)

if __name__ == "__main__":
    study = ms.open_study(HERE / "set.toml", STUDY)
    for statement in ms.run_study(study, "runs/set"):
        print(f"{statement.measurement}: u = {statement.standard_uncertainty:.2g} {statement.unit}")
