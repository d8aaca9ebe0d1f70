"""The coat of a sprayed part: its statistics, and its effect on what is measured."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mitsim.sensor.unknowns import CoatUnknowns
from mitsim.study.session import Session
from mitsim.study.statement_document import statement_document
from mitsim.study.virtual.coat import Coat, coat_numbers, coated_shapes, drawn_coat
from mitsim.study.virtual.plan import measurements_of
from mitsim.study.virtual.race import Job
from mitsim.study.virtual.stated import budget_groups
from mitsim.study.virtual.study_unknowns import study_unknowns
from mitsim.study.virtual.world import Trial
from tests.smaller_sensors import coarse_sensor
from tests.study.virtual.test_rendered import study_of


def test_the_numbers_of_a_coat_have_mean_0_and_variance_1_and_are_independent() -> None:
    numbers = np.array([coat_numbers(seed) for seed in range(1, 2001)])
    error = 1 / np.sqrt(len(numbers))
    assert np.abs(numbers.mean(axis=0)).max() < 4 * error
    assert np.abs(numbers.std(axis=0) - 1).max() < 4 * error
    assert np.abs(np.corrcoef(numbers.T) - np.eye(numbers.shape[1])).max() < 5 * error


def test_the_mean_thickness_is_uniform_in_its_range() -> None:
    means = 1e3 * np.array([drawn_coat(CoatUnknowns(), seed).mean for seed in range(1, 2001)])
    assert means.min() >= 5 and means.max() <= 20
    assert means.mean() == pytest.approx(12.5, abs=4 * 15 / np.sqrt(12 * 2000))
    assert means.std() == pytest.approx(15 / np.sqrt(12), rel=0.05)


def test_the_thickness_has_the_stated_spread_at_every_place_and_is_smooth() -> None:
    places = np.random.default_rng(3).uniform(-50, 50, (40, 3))
    rng = np.random.default_rng(4)
    coats = [Coat(0.01, 0.2, rng.standard_normal(12)) for _ in range(4000)]
    relative = np.array([one.thickness(places, 100.0) for one in coats]) / 0.01 - 1
    assert np.abs(relative.mean(axis=0)).max() < 4 * 0.2 / np.sqrt(4000)
    assert relative.std(axis=0) == pytest.approx(0.2, rel=4 / np.sqrt(2 * 4000))
    near = np.array([one.thickness(places + 0.5, 100.0) for one in coats[:50]]) / 0.01 - 1
    assert np.abs(near - relative[:50]).max() < 0.06  # half a per cent of the extent


@pytest.fixture(scope="module")
def david(tmp_path_factory):
    return str(coarse_sensor("david-sls-3", 3, tmp_path_factory.mktemp("david")))


def test_an_even_coat_makes_pillars_thicker_by_its_thickness(david) -> None:
    study = study_of(david, unknowns={"coat": {"thickness_um": [200, 200], "spread": 0}})
    maker = measurements_of(study, study_unknowns(study, ("coat",)))
    view = min(study.views, key=lambda one: abs(one.elevation_deg - 45))
    world = maker.unknowns.draw(Trial(0))
    coated, bare = (
        maker._finish(maker._captured(view, replace(world, coat=seed)), Job(view, Trial(0))).errors for seed in (7, 0)
    )
    assert coated["pillar1_radius"] - bare["pillar1_radius"] == pytest.approx(0.2, abs=0.01)
    assert coated["pillar1_pillar2_distance"] - bare["pillar1_pillar2_distance"] == pytest.approx(0, abs=0.01)


def test_only_sprayed_faces_have_a_coat_and_a_statement_says_so(david, tmp_path) -> None:
    white = study_of(david, statement={"trials": 2})
    assert len(coated_shapes(white.scene, CoatUnknowns())) == 5
    assert not coated_shapes(white.scene, CoatUnknowns(thickness_um=(0, 0)))
    metal = study_of(david, scene="two_pillars.xml")
    assert not coated_shapes(metal.scene, CoatUnknowns())
    assert "coat" not in budget_groups(study_unknowns(metal), "render", metal.sensor)
    assert "coat" in budget_groups(study_unknowns(white), "render", white.sensor)
    sprayed = study_of(david, scene="two_pillars.xml", sprayed=True, statement={"trials": 2})
    assert {one.name for one in sprayed.scene.finishes} == {"matt_white"}
    session = Session(sprayed, tmp_path)
    document = statement_document(session, session.state(sprayed.views[0]))
    coat = [one for one in document["influences"] if one["name"] == "thickness of the spray on the part"]
    assert coat and "5 to 20 um" in coat[0]["how"]


def test_a_sprayed_part_measures_as_the_same_part_in_matt_white(david) -> None:
    errors = []
    for scene, sprayed in (("two_pillars.xml", True), ("matt_white.xml", False)):
        study = study_of(david, scene=scene, sprayed=sprayed)
        maker = measurements_of(study, study_unknowns(study, ("noise",)))
        view = min(study.views, key=lambda one: abs(one.elevation_deg - 45))
        [(_, outcome)] = maker.run([Job(view, Trial(3))])
        errors.append(outcome.errors)
    assert np.isfinite(list(errors[0].values())).all() and errors[0] == errors[1]
