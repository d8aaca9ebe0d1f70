"""The verdict of a fit, and what its file keeps of the file that it started from."""

import itertools
import re
from pathlib import Path

import pytest
from scipy.stats import chi2

from mitsim.sensor.preset import load_sensor, presets
from mitsim.twin.sensor.run import sensor_path
from mitsim.twin.sensor.verdict import DotAgreement, verdict_of
from mitsim.twin.sensor.write import Entry, moved_paths, with_cameras, with_entries, with_exposure

ENTRIES = {
    "projector.flux_w": "0.5",
    "imager.smoothing_px": "0.4",
    "imager.read_noise_e": "12",
    "room.gradient": "[0.5, -0.2]",
    "name": '"mine"',
}


@pytest.mark.parametrize(
    ("chi_square", "freedom", "misfit", "word"),
    [
        (14.0, 14, 0.3, "good"),
        (chi2.isf(0.011, 14), 14, 0.3, "good"),
        (chi2.isf(0.009, 14), 14, 0.3, "fair"),
        (43.0, 14, 0.3, "bad"),
        (83.7, 14, 0.3, "bad"),
        (83.7, 14, 0.1, "fair"),  # within the margin of mitsim compare, which says agrees
    ],
)
def test_the_verdict_follows_from_chance_and_ratio_or_the_margin_of_compare(chi_square, freedom, misfit, word):
    found = verdict_of((DotAgreement("sheet", chi_square, freedom, misfit, "sharpness"),))
    assert found.word == word
    assert ("their sharpness differs most, by " in found.why) == (word != "good")


def test_the_worst_capture_decides_and_is_named():
    rows = {"a": 10, "b": 83.7, "c": 40}
    found = verdict_of(tuple(DotAgreement(name, square, 14, 0.3, "level") for name, square in rows.items()))
    assert found.word == "bad"
    assert "chi-square 83.7 of 14 for b" in found.why
    assert verdict_of(()).word == "not tested"


def comments(text):
    """Words of all comments, in order of the file; a # in quotes begins none."""
    return [found[1].strip() for line in text.splitlines() if (found := re.search(r"#\s*(.*)$", line))]


def remarks(text):
    """What stands after the first # of each line."""
    return [line.partition("#")[2].strip() for line in text.splitlines()]


@pytest.mark.parametrize("name", [name for name in presets() if name != "kinect-v2"])
def test_every_comment_of_the_file_is_whole(name):
    """Those of the cameras' own numbers go with the numbers."""
    text = sensor_path(name).read_text(encoding="utf-8")
    tables = re.split(r"(?m)^(?=\[)", text)
    own = [line for table in tables if table.startswith("[cameras.") for line in table.splitlines() if line[:1] != "#"]
    fitted = with_cameras(text, dict(load_sensor(name).rig.cameras), "test")
    fitted = with_exposure(fitted, 1e-3, "as recorded")
    fitted = with_entries(fitted, {key: Entry(value, "fitted") for key, value in ENTRIES.items()})
    replaced = set(comments("\n".join(own)))
    for comment in comments(text):
        assert comment in replaced or comment in fitted
    # a comment that continues on the next line stays in one piece
    before = remarks("".join(table for table in tables if not table.startswith("[cameras.")))
    after = remarks(fitted)
    pairs = [pair for pair in itertools.pairwise(before) if all(one and before.count(one) == 1 for one in pair)]
    for first, second in pairs:
        at = next(n for n, one in enumerate(after) if one.endswith(first))
        assert after[at + 1].endswith(second)


def test_a_number_that_is_not_determined_comes_only_in_place_of_another():
    kept = {"imager.prnu": Entry("0", "not determined", True), "imager.row_noise_e": Entry("0", "not determined", True)}
    made = with_entries("[imager]\nprnu = 0.01  # known\n", kept)
    assert made == "# prnu: not determined\n[imager]\nprnu = 0  # before: 0.01; known\n"
    assert with_entries(made, {"room.gradient": Entry("[0, 0]", "x", True)}) == made


def test_an_array_over_several_lines_is_replaced_whole():
    text = '[room]\n# the light\ngradient = [\n  1.0,  # east\n  2.0,\n]\nnote = "a # in quotes"  # a remark\n'
    made = with_entries(text, {"room.gradient": Entry("[3, 4]", "fitted"), "room.note": Entry('"b"', "")})
    assert made.count("gradient = [3, 4]") == 1
    for kept in ("# the light", "east", "before: gradient = ["):
        assert kept in made
    assert 'note = "b"  # before: "a # in quotes"; a remark' in made


def test_the_title_of_a_file_stays_above_its_first_key():
    made = with_entries('# A camera.\n\ntechnology = "x"\n', {"name": Entry('"mine"', "fitted")})
    assert made.splitlines()[:4] == ["# A camera.", "", "# fitted", 'name = "mine"']


def test_paths_of_every_form_are_moved():
    """Before, only one path in double quotes was; a list was looked for beside the new file after the whole fit."""
    text = "[calibration]\nfile = {}\n\n[other]\nfile = 'l.yml'\n"
    for before, after in (
        ('"l.yml"', '"../a/l.yml"'),
        ("'l.yml'  # of the unit's \"left\"", '"../a/l.yml"  # of the unit\'s "left"'),
        ('["l.yml", "../r.yml"]', '["../a/l.yml", "../r.yml"]'),
        ("[\n  \"l.yml\",  # left\n  'r.yml',\n]", '[\n  "../a/l.yml",  # left\n  "../a/r.yml",\n]'),
    ):
        assert moved_paths(text.format(before), Path("/x/a"), Path("/x/b")) == text.format(after)
