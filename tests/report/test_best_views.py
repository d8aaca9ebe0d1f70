"""The best views as a table of text, by predicted uncertainty; and why there are none."""

import numpy as np
import pytest
import xarray as xr

from mitsim.report.best_views import best_views
from mitsim.study.run_folder import read_run
from mitsim.views.no_view import why_no_view
from tests.report.conftest import FEATURES, MEASUREMENTS


def test_views_are_listed_by_u_and_those_that_can_hardly_make_the_measurement_are_not(expecting):
    lines = best_views(read_run(expecting).scores, MEASUREMENTS[1], 20, FEATURES[1:]).splitlines()
    # u is 0.01 (12 - view); view 3 has one, and a chance of 30 %
    assert lines[0] == f"{MEASUREMENTS[1]} [mm]: 11 of 12 views can make it"
    assert [int(line.split()[1]) for line in lines[2:]] == [11, 10, 9, 8, 7, 6, 5, 4, 2, 1, 0]
    assert lines[2].endswith(f"noise on {FEATURES[1]}") and " 0.010 " in lines[2]


def test_a_tolerance_is_told_and_u_over_it(expecting):
    lines = best_views(read_run(expecting).scores, MEASUREMENTS[0], 2, FEATURES).splitlines()
    assert lines[0] == f"{MEASUREMENTS[0]} [deg]: 10 of 12 views can make it; tolerance 0.52 deg"
    assert [line.split()[7] for line in lines[2:]] == ["0.019", "0.038"] and len(lines) == 4


def scores_of(n, white=1000.0, alone=1000.0, u=np.nan, chance=0.0):
    """Scores of one measurement of a pin and a plate, from two views; ``n`` (view, feature)."""
    n = np.array(n, float)
    by_feature = {"n": n, "n_white": np.broadcast_to(white, n.shape), "n_only_white": np.broadcast_to(alone, n.shape)}
    by_view = {"uncertainty_possible": False, "predicted_uncertainty": u, "chance": chance}
    fields = {name: (("view", "feature"), values) for name, values in by_feature.items()}
    fields |= {name: (("measurement", "view"), np.full((1, 2), value)) for name, value in by_view.items()}
    places = {"measurement": ["gap"], "view": [3, 8], "feature": ["pin", "plate"]}
    return xr.Dataset(fields, places, {"minimum_points": 100})


@pytest.mark.parametrize(
    ("scores", "words"),
    [
        (scores_of([[40, 900], [59, 900]], alone=80.0), "pin has at most 59 points of 100 from any view: too small"),
        (scores_of([[40, 900], [59, 900]], white=70.0), "pin has at most 59 points of 100 from any view: other faces"),
        (scores_of([[40, 900], [59, 900]]), "pin has at most 59 points of 100 from any view: its finish returns"),
        (scores_of([[10, 900], [900, 20]]), "no view shows pin and plate together: from view 8, the best, plate has"),
        (scores_of([[200, 900], [200, 200]], u=0.1, chance=0.3), "enough points are too rare, at most in 30 % of"),
        (scores_of([[200, 900], [200, 200]]), "the points of pin and plate that a view shows do not determine it"),
    ],
)  # fmt: skip
def test_the_reason_names_the_feature_and_what_takes_its_points(scores, words):
    assert why_no_view(scores, "gap", ["pin", "plate"]).startswith(words)


def test_a_measurement_that_a_view_can_make_has_no_reason(expecting):
    scores = scores_of([[200, 900], [200, 200]])
    scores["uncertainty_possible"][0, 1] = True
    assert why_no_view(scores, "gap", ["pin", "plate"]) == ""


def test_a_table_without_views_gives_the_reason_in_place_of_rows():
    scores = scores_of([[40, 900], [59, 900]])
    scores["unit"], scores["tolerance"] = ("measurement", ["mm"]), ("measurement", [np.nan])
    scores["uncertainty_rank"] = ("measurement", "view"), np.ones((1, 2), int)
    lines = best_views(scores, "gap", 5, ["pin", "plate"]).splitlines()
    assert lines[0] == "gap [mm]: 0 of 2 views can make it" and "pin has at most 59" in lines[1] and len(lines) == 2
