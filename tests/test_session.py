"""One session of a study for all commands: what it prepares, and when."""

from pathlib import Path

import numpy as np
import pytest

from characterisation.files.errors import InputError
from mitsim.study import StatementTable, StudyFile, open_study, session
from mitsim.study.session import Session
from mitsim.study.virtual.stated import statement_document
from tests.smaller_sensors import coarse_sensor

SCENES = Path(__file__).parents[1] / "scenes" / "two_pillars"


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    table = {
        "scene": "matt_white.xml",
        "task": "task.toml",
        "sensor": str(coarse_sensor("ensenso-n10", 2, tmp_path_factory.mktemp("sensor"))),
        "measure": {"by": "map"},
        "score": {"light_path_depth": 1},
        "views": {"subdivisions": 0, "rolls_deg": [0], "lowest_elevation_deg": 20},
    }
    return open_study(SCENES / "study.toml", StudyFile.model_validate(table))


def test_to_screen_needs_neither_a_folder_nor_the_measurements(study, monkeypatch):
    monkeypatch.setattr(session, "measurements_of", lambda *_: pytest.fail("measurements were prepared"))
    scores, inputs = Session(study).screen()
    assert scores.sizes["view"] == len(inputs) == len(study.views)


def test_measurements_that_were_released_are_made_again_the_same_and_unknowns_stay(study, tmp_path):
    here, table = Session(study, tmp_path / "a"), StatementTable(trials=2)
    view, unknowns, first = study.views[0], here.unknowns, here.measurements
    here.release()
    stated = here.state(view, table)
    assert here.unknowns is unknowns and here.measurements is not first
    other = Session(study, tmp_path / "b").state(view, table)
    np.testing.assert_equal(statement_document(here, stated), statement_document(here, other))
    assert (tmp_path / "a/trials/view_0000.jsonl").read_bytes() == (tmp_path / "b/trials/view_0000.jsonl").read_bytes()


def test_a_session_that_shares_nothing_has_trials_of_its_own(study, tmp_path):
    together, apart = Session(study, tmp_path), Session(study, tmp_path, separate_light=True)
    assert together.digest != apart.digest


def test_a_view_that_the_study_lacks_is_one_message(study):
    assert study.view(2) is study.views[2]
    with pytest.raises(InputError, match=f"--view.*99.*0 to {len(study.views) - 1}"):
        study.view(99, "--view")
