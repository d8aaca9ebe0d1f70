"""How far shared interreflections are from those rendered at the drawn pose, with and without moving their images.

python tests/benchmarks/moved_light.py [--sensors NAME ...] [--view N] [--worlds N]

Two pillars, drawn poses, calibrations and finishes. For each world: mean displacement of the part [px], and root mean
square of the difference to a rendering at the pose of the world (64 samples a pixel), over the standard deviation of
that rendering over the part.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from unittest import mock

import numpy as np

from mitsim.scene import backend

STUDY = Path(__file__).parents[2] / "scenes" / "two_pillars" / "study.toml"


def main() -> None:
    """Print a row for each world."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sensors", nargs="+", default=["ensenso-n10", "zivid-2-m70"])
    parser.add_argument("--view", type=int, default=99)
    parser.add_argument("--worlds", type=int, default=5)
    given = parser.parse_args()
    backend.activate(None)
    for name in given.sensors:
        for row in rows(name, given.view, given.worlds):
            print(name, row, flush=True)


def rows(name: str, number: int, worlds: int):
    """Yield the rows of one sensor."""
    from mitsim.study import open_study
    from mitsim.study.virtual import rendered
    from mitsim.study.virtual.plan import rendering_of
    from mitsim.study.virtual.study_unknowns import study_unknowns
    from mitsim.study.virtual.world import Trial

    study = open_study(STUDY)
    study = open_study(STUDY, study.file.model_copy(update={"sensor": name}))
    unknowns = replace(study_unknowns(study), varied=("pose", "calibration", "finish"))
    how = rendering_of(study)
    finer = replace(how, indirect=replace(how.indirect, samples=64))
    together = rendered.RenderedMeasurements(study, unknowns, how)
    apart = rendered.RenderedMeasurements(study, unknowns, finer, separate_light=True)
    view = study.view(number)
    camera = next(iter(study.sensor.rig.cameras))

    def interreflections(maker, drawn):
        known = {}
        with mock.patch.object(rendered, "IndirectImages", side_effect=_recorded(known, rendered.IndirectImages)):
            lit = maker.lit(view, drawn)
        optics = study.sensor.rig.cameras[camera]
        whole = np.zeros((optics.height, optics.width))
        whole[lit.light.rois[camera].slices] = known["images"][camera][0]
        return whole

    for world in range(worlds):
        drawn = unknowns.draw(Trial(world))
        true = interreflections(apart, drawn)
        moved = interreflections(together, drawn)
        with mock.patch.object(rendered, "moved_images", lambda images, _: images):
            unmoved = interreflections(together, drawn)
        seen = (true > 0) & (moved > 0) & (unmoved > 0)
        size = true[seen].std()
        errors = [np.sqrt(((one - true)[seen] ** 2).mean()) / size for one in (unmoved, moved)]
        optics, centre = study.sensor.rig.cameras[camera], np.array([study.scene.centre], float)
        shown = [
            optics.project(pose.inverse().points(centre))[0]
            for pose in (view.world_from_sensor, drawn.placed.inverse() @ view.world_from_sensor)
        ]
        yield f"{np.linalg.norm(shown[1] - shown[0]):5.1f} px  as traced {errors[0]:.2f}  moved {errors[1]:.2f}"


def _recorded(known, make):
    def images(stacks, *more):
        known["images"] = stacks
        return make(stacks, *more)

    return images


if __name__ == "__main__":
    main()
