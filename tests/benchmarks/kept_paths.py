"""How noisy the interreflections of a view are, over the sensor's noise, and what smoothing them leaves.

python tests/benchmarks/kept_paths.py [--sensors NAME ...] [--view N] [--study STUDY] [--most-pixels N]

Two pillars of `scenes/two_pillars/study.toml`, or another study, the best estimate and three drawn finishes. *noise*:
from two seeds, of which 68.3 % of the lit pixels have less; *rendered* anew for one finish, and on the *kept* paths of
the view. *bias* of the smoothing: root of the mean over 25 x 25 px of the product of two seeds' differences between
smoothed and plain images, median and 68.3 % quantile over the part. All in standard deviations of the temporal noise of
the sensor.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from mitsim.scene import backend

STUDY = Path(__file__).parents[2] / "scenes" / "two_pillars" / "study.toml"


def main() -> None:
    """Print a row for each sensor, camera and finish."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sensors", nargs="+", default=["ensenso-n10", "david-sls-3"])
    parser.add_argument("--view", type=int, default=99)
    parser.add_argument("--study", type=Path, default=STUDY)
    parser.add_argument("--most-pixels", type=int, help="of which more have fewer paths; by default that of studies")
    given = parser.parse_args()
    backend.activate(None)
    for name in given.sensors:
        for row in rows(given.study, name, given.view, given.most_pixels):
            print(row, flush=True)


def rows(path: Path, name: str, number: int, most_pixels: int | None):
    """Yield the rows of one sensor."""
    from characterisation.files.documents import read_toml
    from mitsim.capture.simulated.kept_light import keep_light
    from mitsim.capture.simulated.render_residual import temporal_noise
    from mitsim.scene.light_transport.light_paths import LightPaths
    from mitsim.scene.light_transport.transport import trace
    from mitsim.study import StudyFile, open_study
    from mitsim.study.virtual.plan import measurements_of
    from mitsim.study.virtual.study_unknowns import study_unknowns
    from mitsim.study.virtual.world import Trial

    study = open_study(path, read_toml(path, StudyFile).model_copy(update={"sensor": name}))
    maker = measurements_of(study, study_unknowns(study))
    simulated, sensor, view = maker.simulated, study.sensor, study.view(number, "--view")
    pose, rois, rendering = view.world_from_sensor, maker.view_light(view).rois, maker.rendering
    if most_pixels is not None:
        rendering = replace(rendering, kept=replace(rendering.kept, most_pixels=most_pixels))

    def lit(how, seed: int):
        finishes = map(maker.part.scene_in, (-1, 101, 102, 103, 104))
        return keep_light(simulated, study.scene, pose, rois, how, finishes, seed)

    plain = replace(rendering, kept=replace(rendering.kept, smoothing_px=0.0))
    kept, unsmoothed = ([lit(how, seed) for seed in (1, 2)] for how in (rendering, plain))
    electrons = sensor.electrons()
    for day in (None, 0, 1, 2):
        finish = -1 if day is None else maker.unknowns.draw(Trial(day)).finish
        scene, _ = maker.part.in_finish(finish)
        for camera, roi in rois.items():
            some = np.unique(np.linspace(0, simulated.patterns.count - 1, 4).astype(int))
            on_paths = [one[camera].images(scene, simulated)[some] * electrons for one in kept]
            sharp = [one[camera].images(scene, simulated)[some] * electrons for one in unsmoothed]
            anew = [
                simulated.indirect_radiance(
                    scene, pose, camera, rendering.indirect_settings, seed=seed, depth=rendering.depth, roi=roi
                )[some]
                * electrons
                for seed in (1, 2)
            ]
            paths = LightPaths(rendering.samples, 1)
            direct = trace(scene, simulated.rays[camera], simulated.patterns, pose, paths, roi)[some] * electrons
            light = direct + on_paths[0]
            seconds = sensor.exposure.exposures(light[np.argmax(light.mean(axis=(1, 2)))], sensor.imager.full_well)[0]
            lit = (light > 0) & (light * seconds < sensor.imager.full_well)
            unit = temporal_noise(light * seconds, sensor.imager) / seconds
            noises = [
                np.percentile(np.abs((one - other) / unit)[lit], 68.3) / np.sqrt(2.0) for one, other in (anew, on_paths)
            ]
            (one, other), (first, second) = on_paths, sharp
            product = (((one - first) * (other - second) / unit**2) * lit).mean(axis=0)
            bias = cv2.blur(product, (25, 25))[lit.any(axis=0)]
            bias = np.sqrt(np.maximum(np.percentile(bias, [50, 68.3]), 0))
            yield (
                f"{name:<14} {camera:<7} {'best estimate' if day is None else f'day {day}':<14} "
                f"noise rendered {noises[0]:.3f}  kept {noises[1]:.3f}   bias {bias[0]:.2f} {bias[1]:.2f}"
            )


if __name__ == "__main__":
    main()
