"""A validation of view scores is read whole, or refused with what is wrong."""

from pathlib import Path

import numpy as np
import pytest

from mitsim.capture.indirect_light import IndirectLight
from mitsim.errors import InputError
from mitsim.scene.triangles import triangles
from mitsim.sensor.preset import load_sensor
from mitsim.study import StudyFile, open_study
from mitsim.validation.score_plan import IndirectLightTable, read_score_validation, told

ROOT = Path(__file__).parents[2]
SCENES = ROOT / "scenes/two_pillars"


def test_a_check_for_every_sensor_and_sample_with_its_own_finish(written):
    checks = read_score_validation(written())
    assert [check.sample.name for check in checks] == ["matt white", "Ra 0.74"]
    assert [check.study.scene.finishes[0].name for check in checks] == ["matt_white", "aluminium/ground"]
    assert checks[1].study.scene.finishes[0].roughness == 0.74
    assert len({check.folder for check in checks}) == len({check.digest for check in checks}) == 2
    assert "2 surfaces" in told("here.toml", checks)


def test_the_artefact_in_matt_white_has_the_shapes_of_the_metal_one():
    white, metal = (
        open_study(
            SCENES / "study.toml",
            StudyFile(scene=scene, task="task.toml", sensor="ensenso-n10", views={"subdivisions": 0}),
        ).scene
        for scene in ("matt_white.xml", "two_pillars.xml")
    )
    assert white.names == metal.names
    np.testing.assert_array_equal(triangles(white), triangles(metal))


def test_the_part_is_put_down_about_its_middle_by_as_much_as_was_asked(written):
    check = read_score_validation(written(("repeats = 2", "repeats = 400\nplacement.turn_deg = 2.0")))[0]
    view, middle = check.study.views[0], check.study.scene.centre
    motions = [check.pose(view, k) @ view.world_from_sensor.inverse() for k in range(400)]
    shifts = np.array([motion.points(middle[None])[0] - middle for motion in motions])
    turns = np.array([np.arccos((np.trace(motion.rotation) - 1) / 2) for motion in motions])
    # of 1200 normal numbers the standard deviation is known to 2 %, and 4 of these are allowed
    assert shifts.std() == pytest.approx(1.0, rel=0.08)
    assert np.sqrt((turns**2).mean() / 3) == pytest.approx(np.radians(2.0), rel=0.08)
    again = check.pose(view, 7)
    np.testing.assert_array_equal(again.matrix(), check.pose(view, 7).matrix())
    assert check.seed(view, 0) != check.seed(view, 1)


def test_what_decides_a_measurement_changes_the_digest_and_the_number_of_views_does_not(written):
    def digest(*changes):
        return read_score_validation(written(*changes))[0].digest

    plain = digest()
    assert digest(("lowest_elevation_deg = 0", "lowest_elevation_deg = 20")) == plain
    assert digest(("repeats = 2", "repeats = 5")) == plain  # what is kept of two is kept of five
    for change in (("seed = 1", "seed = 2"), ("samples_per_pixel = 16",
                   "samples_per_pixel = 9"), ("light_path_depth = 2", "light_path_depth = 1")):  # fmt: skip
        assert digest(change) != plain


@pytest.mark.parametrize(("sensor", "usual"), [("ensenso-n10", 4), ("david-sls-3", 16), ("kinect-v2", 16)])
def test_a_sensor_that_reads_a_phase_is_rendered_of_more_light_paths_unless_told(sensor, usual):
    preset = load_sensor(sensor)
    assert IndirectLightTable().of(preset) == IndirectLight(usual, 1.5)
    assert IndirectLightTable(samples=7, smoothing_px=2.0).of(preset) == IndirectLight(7, 2.0)


def test_what_is_usual_for_a_sensor_has_the_digest_of_what_is_told(written):
    def digest(samples):
        told = ("light_path_depth = 2", f"light_path_depth = 2\nindirect_light.samples = {samples}")
        return read_score_validation(written(told))[0].digest

    assert digest(4) == read_score_validation(written())[0].digest != digest(16)


@pytest.mark.parametrize(("old", "new", "says"), [
    ('name = "Ra 0.74"', 'name = "matt white"', "samples that each have a name of their own"),
    ('name = "Ra 0.74"', 'name = "../out"', "samples.1.name"),
    ("repeats = 2", "repeats = 0", "repeats"),
    ("seed = 1", 'seed = 1\nmaps = { "kinect-v2" = "kinect-v2" }', "no such sensor"),
    ("plane_Ra = 0.74", "plane_Ra = 0.05", "0.09 to 0.74 um"),
    ('task = "task.toml"', 'task = "tsk.toml"', "task.toml"),
    ("repeats = 2", "repeat = 4", "did you mean 'repeats'"),
])  # fmt: skip
def test_what_cannot_be_done_is_refused_before_it_begins(written, old, new, says):
    with pytest.raises(InputError) as caught:
        read_score_validation(written((old, new)))
    assert says in str(caught.value)
