"""Measure the same worlds with the light of mitsim and with that of the laboratory: what errors owe to the renderer.

Signal chain: draws of a study's unknowns -> light of each world by stock Mitsuba, with mitsim's own finishes -> light
of the same world by mitsim, as a trial traces it -> both on mitsim's imager with the same noise, decoded and measured
in the same way -> differences of the errors.

Unknowns that the laboratory does not share are not drawn: mask and pattern of the unit, decoder, room, form, tail and
lay of a finish. There is no speckle. Errors on bare metal react to a few per cent of light as to another finish, so
those of one world differ. A statement is about their size: a renderer adds to it only as far as the sizes of both sides
differ.
"""

from __future__ import annotations

import gc
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from characterisation.words.progress import track
from mitsim.scene.surface.scatter import Deviation
from mitsim.study import Study
from mitsim.study.virtual.drawn_finish import finish_deviation
from mitsim.study.virtual.plan import rendering_of
from mitsim.study.virtual.rendered import RenderedMeasurements, TracedLight
from mitsim.study.virtual.study_unknowns import study_unknowns
from mitsim.study.virtual.world import Trial, Unknowns
from tests.proofs.laboratory.cases import Judged
from tests.proofs.laboratory.finishes import Surface, surface_of
from tests.proofs.laboratory.worlds import Laboratory, Light
from tests.proofs.tables import markdown, number

#: resampled sets of worlds
_BOOTSTRAP = 2000

#: groups that both sides draw
SHARED = ("calibration", "pose", "finish")


@dataclass(frozen=True)
class Pairs:
    """Errors (measurement, world) of one row with the light of mitsim, and with that of the laboratory."""

    row: Judged
    mitsim: np.ndarray
    laboratory: np.ndarray


class _SameFinishes(Laboratory):
    """A laboratory whose faces have the finishes that mitsim draws: ``deviation`` of a world's number and a shape."""

    def __init__(self, row: Judged, deviation: Callable[[int, str], Deviation]) -> None:
        self.deviation = deviation
        super().__init__(row)

    def surfaces(self, number: int) -> dict[str, Surface]:
        """Return the materials of all faces in a world, by shape."""
        wavelength, where = self.sensor.wavelength_nm, str(self.row.scene_path)
        return {
            name: surface_of(finish, self.row.family, wavelength, self.deviation(number, name), f"{where}: {name}")
            for name, finish in self.finishes.items()
        }


def pairs_of(row: Judged) -> Pairs:
    """Measure the worlds of a row with the light of both sides."""
    study = row.study()
    study = replace(study, sensor=replace(study.sensor, linewidth_nm=None))
    unknowns = _shared_unknowns(study)
    draws = [unknowns.draw(Trial(world)) for world in range(row.file.worlds)]
    bsdf = {name: shape.bsdf().id() for name, shape in zip(study.scene.names, study.scene.shapes, strict=True)}
    view = row.view_of(study)

    def deviation(world: int, shape: str) -> Deviation:
        return finish_deviation(unknowns, draws[world].finish if world >= 0 else -1, bsdf[shape])

    label = f"{row.case.name}, view {row.view}"
    laboratory = _SameFinishes(row, deviation)
    lights = [
        laboratory.light(world, drawn, drawn.placed.inverse() @ view.world_from_sensor)
        for world, drawn in track(list(enumerate(draws)), f"{label}: laboratory", len(draws))
    ]
    del laboratory
    gc.collect()
    renderer = RenderedMeasurements(study, unknowns, rendering_of(study))
    errors = np.full((2, len(study.task.measurements), len(draws)), np.nan)
    for world, (drawn, light) in track(list(enumerate(zip(draws, lights, strict=True))), f"{label}: mitsim"):
        lit = renderer.lit(view, drawn)
        for side, one in enumerate((lit, _in_light_of(light, lit))):
            capture = renderer.exposed(one, None, drawn.seed, keep=True)
            outcome = renderer.outcome(capture, one)
            errors[side, :, world] = [outcome.errors[name] for name in study.task.measurements]
    return Pairs(row, *errors)


def _shared_unknowns(study: Study) -> Unknowns:
    unknowns = study_unknowns(study)
    finish = unknowns.table.finish.model_copy(update={"tail": 0.0, "lay": 0.0})
    varied = tuple(group for group in unknowns.varied if group in SHARED)
    return replace(unknowns, table=unknowns.table.model_copy(update={"finish": finish}), varied=varied)


def _in_light_of(light: Light, lit: TracedLight) -> TracedLight:
    """Return mitsim's traced light with the projected light of the laboratory in its place."""
    radiance = {}
    for name, stack in lit.light.radiance.items():
        roi, other, images = lit.light.rois[name], light.rois[name], stack.copy()
        camera = lit.sensor.sensor.rig.cameras[name]
        whole = np.zeros((camera.height, camera.width), np.float32)
        for image, projected in zip(images, light.projected[name], strict=False):
            whole[other.slices] = projected
            image[:] = lit.sensor.apply_lens(whole[roi.slices], name, roi)
        radiance[name] = images
    return replace(lit, light=replace(lit.light, radiance=radiance))


def size_ratio(first: np.ndarray, second: np.ndarray) -> tuple[float, float, float]:
    """Return the ratio of root mean squares of the ``second`` errors (world,) to the first, with its 95 % interval.

    The interval is that of a bootstrap over worlds, which are independent.
    """
    known = np.isfinite(first) & np.isfinite(second)
    if known.sum() < 2:
        return (float("nan"),) * 3
    squares = np.stack([first[known], second[known]]) ** 2
    again = np.random.default_rng(1).integers(known.sum(), size=(_BOOTSTRAP, known.sum()))
    ratios = np.sqrt(squares[1][again].mean(axis=1) / squares[0][again].mean(axis=1))
    low, high = np.quantile(ratios, [0.025, 0.975])
    return float(np.sqrt(squares[1].mean() / squares[0].mean())), float(low), float(high)


def pairs_table(found: Sequence[Pairs]) -> str:
    """Return the errors of both sides, measurement by measurement, in Markdown."""
    body = []
    for pair in found:
        for m, (name, one) in enumerate(pair.row.study().task.measurements.items()):
            first, second = pair.mitsim[m], pair.laboratory[m]
            known = np.isfinite(first) & np.isfinite(second)
            sizes = [number(float(np.sqrt(np.mean(side[known] ** 2)))) for side in (first, second, second - first)]
            ratio, low, high = size_ratio(first, second)
            lost = [str(int(np.isnan(side).sum())) for side in (first, second)]
            ends = f"{ratio:.2f} [{low:.2f}, {high:.2f}]"
            body.append([pair.row.case.name, str(pair.row.view), name, *sizes, one.unit, ends, " and ".join(lost)])
    head = ["case", "view", "measurement", "rms error, mitsim", "laboratory", "rms difference", "unit"]
    return markdown([*head, "laboratory / mitsim", "worlds without a value"], body)
