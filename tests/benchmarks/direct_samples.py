"""How far direct light with few rays per pixel is from that with a hundred, over the noise of the sensor.

    python tests/benchmarks/direct_samples.py [--sensors NAME ...]

The two pillars in ground aluminium of Ra 0.37, one view 45 deg above the plate, one drawn world. In pixels over 2 % of
full well, the difference of every image is divided by the imager's noise at that brightness. The root mean square
leaves out the farthest hundredth, which lies at edges, where decoders give no point.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from mitsim.scene import backend

SCENES = Path(__file__).parents[2] / "scenes" / "two_pillars"


def main() -> None:
    """Print a row for each sensor and number of rays."""
    parser = argparse.ArgumentParser(description=__doc__)
    names = ["photoneo-phoxi-s", "david-sls-3", "zivid-2-m70", "ensenso-n10"]
    parser.add_argument("--sensors", nargs="+", default=names)
    given = parser.parse_args()
    backend.activate(None)
    print(f"{'sensor':<20} {'camera':<8} rays  seconds    68 %     rms  over 1")
    for name in given.sensors:
        rows(name)


def rows(name: str) -> None:
    """Print the rows of one sensor."""
    from mitsim.capture.simulated.render_residual import temporal_noise
    from mitsim.study import StudyFile, open_study
    from mitsim.study.virtual.plan import measurements_of
    from mitsim.study.virtual.study_unknowns import study_unknowns
    from mitsim.study.virtual.world import Trial

    file = {
        "scene": "two_pillars.xml",
        "parameters": {"plane_Ra": 0.37, "pillar_Ra": 0.37},
        "task": "task.toml",
        "sensor": name,
        "views": {"subdivisions": 1, "lowest_elevation_deg": 20},
    }
    study = open_study(SCENES / "study.toml", StudyFile.model_validate(file))
    maker = measurements_of(study, study_unknowns(study))
    view = min(study.views, key=lambda one: abs(one.elevation_deg - 45))
    drawn, imager = maker.unknowns.draw(Trial(100)), study.sensor.imager

    def electrons(samples: int) -> tuple[dict[str, np.ndarray], float]:
        maker.rendering = replace(maker.rendering, samples=samples)
        maker.lit(view, drawn)  # compiles
        began = time.perf_counter()
        light = maker.lit(view, drawn).light
        seconds = time.perf_counter() - began
        return {
            eye: images * study.sensor.electrons() * light.exposures[0] for eye, images in light.radiance.items()
        }, seconds

    reference, _ = electrons(100)
    for samples in (1, 4, 9, 16):
        light, seconds = electrons(samples)
        for eye, images in light.items():
            lit = reference[eye] > 0.02 * imager.full_well
            size = np.abs(images - reference[eye])[lit] / temporal_noise(reference[eye][lit], imager)
            rms = np.sqrt(np.mean(size[size <= np.quantile(size, 0.99)] ** 2))
            print(
                f"{name:<20} {eye:<8} {samples:4d} {seconds:8.2f} {np.quantile(size, 0.683):7.3f} {rms:7.3f} "
                f"{(size > 1).mean():7.4f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
