"""A form tolerance of the drawing is the default of the form deviation, and is not counted twice."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from mitsim.study import SetTable
from mitsim.study.view_sets.joined import JoinedMeasurements
from mitsim.study.virtual.form import drawn_form, measured_with_form
from mitsim.study.virtual.plan import measurements_of
from mitsim.study.virtual.race import Job
from mitsim.study.virtual.stated import budget_groups
from mitsim.study.virtual.study_unknowns import study_unknowns
from mitsim.study.virtual.world import Trial
from tests.smaller_sensors import coarse_sensor
from tests.study.virtual.test_rendered import SCENES, study_of

FLAT = """
[measurements.flat]
kind = "flatness"
features = ["plane"]
nominal = 0
unit = "mm"
tolerance = 0.4
"""


@pytest.fixture(scope="module")
def flat(tmp_path_factory):
    """A study of the pillars under coarse fringes, with a tolerance of the plane's flatness, by unknowns."""
    folder = tmp_path_factory.mktemp("flat")
    sensor = str(coarse_sensor("david-sls-3", 3, folder))
    text = (SCENES / "task.toml").read_text()
    kept = re.split(r"(?m)^(?=\[measurements\.)", text)
    kept = [kept[0], *(one for one in kept[1:] if one.startswith("[measurements.plane_pillar1_angle]"))]
    (folder / "task.toml").write_text("".join(kept) + FLAT)
    return lambda **unknowns: study_of(sensor, task=str(folder / "task.toml"), unknowns=unknowns)


def test_a_quarter_of_the_tolerance_is_the_default_and_the_study_overrides_it(flat) -> None:
    assert drawn_form(flat().task, {}) == {"plane": 0.1}
    assert drawn_form(flat().task, {"plane": 0.0, "pillar1": 0.02}) == {"plane": 0.0, "pillar1": 0.02}
    assert study_unknowns(flat()).table.form.features == {"plane": 0.1}
    sensor = flat().sensor
    assert "form" in budget_groups(study_unknowns(flat()), "render", sensor)
    assert "form" not in budget_groups(study_unknowns(flat(form={"features": {"plane": 0}})), "render", sensor)


def test_form_moves_other_measurements_of_the_face_but_not_that_of_the_form_itself(flat) -> None:
    study = flat(coat={"thickness_um": [0, 0]})
    maker = measurements_of(study, study_unknowns(study, ("form",)))
    view = min(study.views, key=lambda one: abs(one.elevation_deg - 45))
    world = maker.unknowns.draw(Trial(0))
    bent, plane = (
        maker._finish(maker._captured(view, replace(world, form=seed)), Job(view, Trial(0))) for seed in (world.form, 0)
    )
    assert world.form and abs(bent.errors["plane_pillar1_angle"] - plane.errors["plane_pillar1_angle"]) > 1e-3
    assert bent.errors["flat"] == plane.errors["flat"]
    assert np.array_equal(bent.deviations["flat"], plane.deviations["flat"], equal_nan=True)


def test_a_form_is_measured_once_and_the_rest_with_it(flat) -> None:
    """Half of the time of a trial of a large plane went to a flatness that was then replaced."""
    task, asked = flat().task, []

    def evaluate(part, with_form):
        asked.append((with_form, list(part.measurements)))
        return dict.fromkeys(part.measurements, with_form)

    found = measured_with_form(task, evaluate, deviates=True)
    assert list(found) == list(task.measurements)
    assert [name for name, with_form in found.items() if not with_form] == ["flat"]
    assert sorted(name for _, names in asked for name in names) == sorted(task.measurements)


def test_a_set_of_one_view_is_measured_like_the_view(flat) -> None:
    """Before, its flatness had the form of the drawing as well."""
    study = flat(coat={"thickness_um": [0, 0]})
    maker = measurements_of(study, study_unknowns(study))
    view = min(study.views, key=lambda one: abs(one.elevation_deg - 45))
    ((_, alone),) = maker.run([Job(view, Trial(3))])
    ((day, joined),) = JoinedMeasurements(maker, [view], SetTable()).run([3])
    assert day == 3 and np.isfinite(alone.errors["flat"])
    assert joined.errors == alone.errors
    np.testing.assert_equal(joined.deviations, alone.deviations)
