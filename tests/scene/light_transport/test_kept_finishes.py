"""Lobes that kept paths do not resolve are widened: the light has less noise, and the same sum."""

from __future__ import annotations

import numpy as np
import pytest

from mitsim.scene.light_transport.kept_finishes import broad, least_width, resolved
from mitsim.scene.light_transport.kept_paths import KeptPaths, mattering
from mitsim.scene.light_transport.light_paths import LightPaths
from mitsim.scene.light_transport.plain_scene import distinct_bsdfs
from mitsim.scene.light_transport.transport import trace
from mitsim.scene.load import bsdf_of
from mitsim.scene.surface.scatter import Deviation
from tests.scene.light_transport.test_kept_paths import POSE, candidates, deviating, dots, two_faces

pytestmark = pytest.mark.usefixtures("no_other_scenes")

GROUND = {
    "type": "blendbsdf",
    "weight": 0.2,
    "first": {
        "type": "coherent_blend",
        "mirror": {"type": "roughconductor", "distribution": "beckmann", "alpha_u": 0.002, "alpha_v": 0.002},
        "lobe": {"type": "roughconductor", "distribution": "beckmann", "alpha_u": 0.04, "alpha_v": 0.2},
    },
    "second": {"type": "roughconductor", "distribution": "ggx", "alpha": 0.1},
}


def test_lobes_are_sampled_wider_and_narrower_and_none_is_evaluated_narrower_than_that():
    lobes = broad(GROUND)["first"]
    wide, middle, narrow = (
        blend["first"]["lobe"] for blend in (lobes["first"]["first"], lobes["first"]["second"], lobes["second"])
    )
    assert {lobe["distribution"] for lobe in (wide, middle, narrow)} == {"ggx"}
    assert narrow["alpha_u"] < middle["alpha_u"] < 0.04 < wide["alpha_u"]
    assert least_width(GROUND) == narrow["alpha_u"]

    drawn = resolved(GROUND, 0.15)
    assert drawn["first"]["lobe"] == {**GROUND["first"]["lobe"], "alpha_u": 0.15}
    assert drawn["second"]["alpha"] == 0.15
    assert drawn["first"]["mirror"] == GROUND["first"]["mirror"]
    assert resolved(GROUND, 0.04) == GROUND
    assert least_width({"type": "diffuse"}) == 0
    assert broad({"type": "diffuse"})["first"] == {"type": "diffuse"}


def test_light_of_a_narrow_finish_is_less_noisy_with_resolved_lobes_and_has_the_same_sum():
    scene, (rays, light), repeats = two_faces(), dots(), 6
    # the scene's finishes are changed in place: first all about the best estimates
    widths = {
        shape.bsdf().id(): least_width(finish.description)
        for shape, finish in zip(scene.shapes, scene.finishes, strict=True)
        if finish
    }
    every = [candidates(scene, rays, light, seed) for seed in range(repeats)]
    marked = deviating(scene, Deviation(alpha=-1.0, lay=-3.0, lay_deg=35.0))
    as_drawn = distinct_bsdfs(marked)
    described = {
        shape.bsdf().id(): finish.description
        for shape, finish in zip(marked.shapes, marked.finishes, strict=True)
        if finish
    }
    widened = [
        bsdf_of(resolved(described[bsdf.id()], widths[bsdf.id()])) if bsdf.id() in widths else bsdf for bsdf in as_drawn
    ]

    def images(bsdfs):
        return np.array(
            [
                KeptPaths.of(mattering([paths], [bsdfs], roi, len(paths), 1), roi).codes(bsdfs, light)
                for paths, roi in every
            ],
            float,
        )

    def noise(seeds):
        return np.sqrt(seeds.var(axis=0, ddof=1).mean()) / seeds.mean()

    sharp, wide = images(as_drawn), images(widened)
    assert noise(wide) < 0.5 * noise(sharp)
    anew = trace(marked, rays, light, POSE, LightPaths(1024, 50, 3, photons=1600**2, indirect_only=True))
    rendered = np.asarray(anew, float)[: light.codes].sum()
    assert wide.sum(axis=(1, 2, 3)).mean() == pytest.approx(rendered, rel=0.05)
