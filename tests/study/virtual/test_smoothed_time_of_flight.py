"""The filter over interreflections of a time of flight, whose pixels are as wide as a tenth of a cylinder."""

from dataclasses import replace
from pathlib import Path

import pytest

from mitsim.capture.simulated.rendering import Rendering
from mitsim.scene import backend
from mitsim.study import StudyFile, open_study
from mitsim.study.session import Session
from mitsim.study.virtual.world import Trial
from mitsim.views import ViewsTable

PARTS = Path(__file__).parents[3] / "scenes" / "parts"


@pytest.mark.parametrize("separate", [False, True])
def test_the_filter_does_not_move_a_radius(separate, tmp_path):
    """Filters of 2.5 px, and of 1.5 px for light of its own, moved the radius by 0.5 and 0.2 mm."""
    backend.activate()
    file = StudyFile(
        scene="spindle.xml",
        parameters={"finish": "white"},
        task="task.toml",
        sensor="kinect-v2",
        views=ViewsTable(subdivisions=2, rolls_deg=(0, 90), lowest_elevation_deg=20),
    )
    study = open_study(PARTS / "spindle" / "study.toml", file)
    measured = Session(study, tmp_path, None, separate).renderer
    # lying across the view, so that both steps are seen
    view = max(study.views, key=lambda one: -one.world_from_sensor.rotation[2, 2])

    def radius(rendering: Rendering) -> float:
        other = measured.rendered_as(rendering)
        other.unknowns = replace(measured.unknowns, varied=())
        lit = other.lit(view, other.unknowns.draw(Trial(0)))
        return other.outcome(other.exposed(lit, None, 7), lit).errors["second_radius"]

    used = measured.rendering
    sharp = replace(
        used,
        indirect=replace(used.indirect, samples=256, smoothing_px=0.0),
        kept=replace(used.kept, smoothing_px=0.0),
    )
    assert radius(used) == pytest.approx(radius(sharp), abs=0.1)
