"""The best views as a table of text, by predicted uncertainty."""

from mitsim.report.best_views import best_views
from mitsim.study.run_folder import read_run

from .conftest import FEATURES, MEASUREMENTS


def test_views_are_listed_by_u_and_those_that_can_hardly_make_the_measurement_are_not(expecting):
    lines = best_views(read_run(expecting).scores, MEASUREMENTS[1], 20).splitlines()
    # u is 0.01 (12 - view); view 3 has one, and a chance of 30 %
    assert lines[0] == f"{MEASUREMENTS[1]} [mm]: 11 of 12 views can make it"
    assert [int(line.split()[1]) for line in lines[2:]] == [11, 10, 9, 8, 7, 6, 5, 4, 2, 1, 0]
    assert lines[2].endswith(f"noise on {FEATURES[1]}") and " 0.010 " in lines[2]


def test_a_tolerance_is_told_and_u_over_it(expecting):
    lines = best_views(read_run(expecting).scores, MEASUREMENTS[0], 2).splitlines()
    assert lines[0] == f"{MEASUREMENTS[0]} [deg]: 10 of 12 views can make it; tolerance 0.52 deg"
    assert [line.split()[7] for line in lines[2:]] == ["0.019", "0.038"] and len(lines) == 4
