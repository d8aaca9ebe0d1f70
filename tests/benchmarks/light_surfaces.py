"""How much light is missed by paths over few surfaces, and what more surfaces cost in a virtual measurement.

    python tests/benchmarks/light_surfaces.py [--study STUDY.toml] [--view N]

The light of a view, with all unknowns at their best estimates, on kept paths over 2 to 6 surfaces: its mean on the part
over that of 6 surfaces, the processor time of the first light of the view and of another light on the kept paths, and
the memory of the paths.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

STUDY = Path(__file__).parents[2] / "scenes/two_pillars/study.toml"
SURFACES = (6, 4, 3, 2)


def main() -> None:
    """Print a line for each number of surfaces."""
    from mitsim.scene import backend

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--study", type=Path, default=STUDY)
    parser.add_argument("--view", type=int, default=99)
    given = parser.parse_args()
    backend.activate(None)

    from mitsim.study import open_study
    from mitsim.study.session import Session
    from mitsim.study.virtual.world import Trial

    study, whole = open_study(given.study), 0.0
    view = study.view(given.view, "--view")
    print(f"{'surfaces':>8} {'light':>8} {'first [s]':>10} {'next [s]':>9} {'paths [MB]':>11}")
    for surfaces in SURFACES:
        measure = study.file.measure.model_copy(update={"light_path_depth": surfaces})
        maker = Session(replace(study, file=study.file.model_copy(update={"measure": measure}))).renderer
        assert maker is not None, "the study measures on a map"
        drawn = replace(maker.unknowns, varied=()).draw(Trial(0))
        seconds = []
        for _ in range(2):
            start = time.process_time()
            lit = maker.lit(view, drawn)
            seconds.append(time.process_time() - start)
        light = float(np.mean([np.mean(images) for images in lit.light.radiance.values()]))
        whole = whole or light
        size = maker.view_light(view).bytes / 1e6
        print(f"{surfaces:8} {light / whole:8.4f} {seconds[0]:10.2f} {seconds[1]:9.2f} {size:11.0f}", flush=True)


if __name__ == "__main__":
    main()
