"""Limits of ISO 286: published ones, the standard's formulas, and fits in a STEP file."""

from itertools import pairwise

import numpy as np
import pytest

from characterisation.tasks.task_reading import read_task
from mitsim.scene.authoring.fits import fit_deviations
from mitsim.scene.authoring.part_folder import read_part, write_part
from mitsim.scene.authoring.read_step import step_installed
from tests.scene.authoring.bracket import bracket, write_step
from tests.scene.authoring.drawing import Drawing

#: limit deviations [um], as ISO 286-2:2010 and tables of workshops print them
PUBLISHED = [
    ("H7", 50, 0, 25),
    ("g6", 50, -25, -9),
    ("H8", 20, 0, 33),
    ("k6", 80, 2, 21),
    ("k9", 80, 0, 74),
    ("f7", 25, -41, -20),
    ("e8", 45, -89, -50),
    ("d9", 100, -207, -120),
    ("h6", 18, -11, 0),
    ("js6", 10, -4.5, 4.5),
    ("j6", 30, -4, 9),
    ("m6", 40, 9, 25),
    ("n6", 35, 17, 33),
    ("p6", 70, 32, 51),
    ("r6", 70, 43, 62),
    ("s6", 50, 43, 59),
    ("h11", 500, -400, 0),
    ("A11", 50, 320, 480),
    ("F8", 40, 25, 64),
    ("J7", 30, -9, 12),
    ("K7", 40, -18, 7),
    ("K7", 3, -10, 0),
    ("M7", 40, -25, 0),
    ("M6", 300, -41, -9),
    ("N7", 6, -16, -4),
    ("N9", 30, -52, 0),
    ("N9", 3, -29, -4),
    ("P7", 25, -35, -14),
    ("P9", 8, -51, -15),
    ("S7", 60, -72, -42),
    ("X8", 35, -119, -80),
]


@pytest.mark.parametrize(("name", "size", "low", "high"), PUBLISHED)
def test_limits_are_the_published_ones(name, size, low, high):
    assert fit_deviations(name, size) == pytest.approx((low / 1000, high / 1000), abs=1e-12)


@pytest.mark.parametrize("name", ["H7/g6", "H", "7", "H19", "H4", "i7", "hH7", "cd6", "v6", "j8", "K9", ""])
def test_classes_that_the_tables_do_not_have_have_no_limits(name):
    assert fit_deviations(name, 10.0) is None
    assert fit_deviations("H7", 500.1) is None
    assert fit_deviations("H7", 0.0) is None
    assert fit_deviations("a9", 1.0) is None


#: multiples of the tolerance factor i = 0.45 D^(1/3) + 0.001 D (ISO 286-1)
GRADES = {5: 7, 6: 10, 7: 16, 8: 25, 9: 40, 10: 64, 11: 100, 12: 160, 13: 250, 14: 400, 16: 1000, 18: 2500}
MAIN = [3, 6, 10, 18, 30, 50, 80, 120, 180, 250, 315, 400, 500]
DIVIDED = [18, 24, 30, 40, 50, 65, 80, 100, 120, 140, 160, 180, 200, 225, 250, 280, 315, 355, 400, 450, 500]


def width(grade, size):
    return GRADES[grade] * (0.45 * size ** (1 / 3) + 0.001 * size)


def test_standard_tolerances_are_those_of_the_formula_rounded():
    for low, high in pairwise(MAIN):
        for grade in GRADES:
            found = fit_deviations(f"H{grade}", high)[1] * 1000
            assert found == pytest.approx(width(grade, (low * high) ** 0.5), rel=0.05, abs=0.8), (grade, high)


#: distance of the shaft's nearer limit from its nominal size [um], by the formulas of ISO 286-1
FORMULAS = {
    "d": lambda size: 16 * size**0.44,
    "e": lambda size: 11 * size**0.41,
    "f": lambda size: 5.5 * size**0.41,
    "g": lambda size: 2.5 * size**0.34,
    "k": lambda size: 0.6 * size ** (1 / 3),
    "m": lambda size: width(7, size) - width(6, size),
    "n": lambda size: 5 * size**0.34,
    "p": lambda size: width(7, size) + 2.5,
    "s": lambda size: width(8, size) + 2.5 if size <= 50 else width(7, size) + 0.4 * size,
    "u": lambda size: width(7, size) + size,
    "v": lambda size: width(7, size) + 1.25 * size,
    "x": lambda size: width(7, size) + 1.6 * size,
    "y": lambda size: width(7, size) + 2 * size,
    "z": lambda size: width(7, size) + 2.5 * size,
    "za": lambda size: width(8, size) + 3.15 * size,
    "zb": lambda size: width(9, size) + 4 * size,
    "zc": lambda size: width(10, size) + 5 * size,
}


@pytest.mark.parametrize("letter", FORMULAS)
def test_deviations_of_shafts_are_those_of_the_formulas_rounded(letter):
    ranges = DIVIDED if letter >= "s" else MAIN[3:]
    for low, high in pairwise(ranges):
        found = np.abs(fit_deviations(f"{letter}7", high)).min() * 1000
        assert found == pytest.approx(FORMULAS[letter]((low * high) ** 0.5), rel=0.026, abs=3.5), high


@pytest.mark.skipif(not step_installed(), reason="OpenCASCADE, which reads STEP, is not installed")
def test_fits_of_a_step_file_have_their_limits_and_unknown_ones_a_remark(tmp_path, step_here):
    """Before, none had limits, and only the task's file said it."""
    path = write_step([("bracket", bracket(), None)], tmp_path / "bracket.step", "AP242DIS")
    face = {one.name: one.entities[0] for one in read_part(path).faces}
    drawing = Drawing(path.read_text())
    for name, size, fit in (
        ("bore_12mm_left", 12.0, "'H','hole','7',''"),
        ("bore_12mm_right", 12.0, "'G6','hole','',''"),
        ("boss_20mm", 20.0, "'G','shaft','6',''"),
        ("seat_18mm", 18.0, "'CD','hole','6',''"),
    ):
        made = drawing.size("diameter", face[name], items=(drawing.measure(size, "nominal value"),))
        drawing.add(f"PLUS_MINUS_TOLERANCE(#{drawing.add(f'LIMITS_AND_FITS({fit})')},#{made})")
    path.write_text(drawing.whole())
    part = write_part(path, tmp_path / "made")
    limits = {one.features[0]: one.limits for one in read_task(tmp_path / "made/task.toml").measurements.values()}
    assert limits == {
        "bore_12mm_left": pytest.approx((12.0, 12.018)),
        "bore_12mm_right": pytest.approx((12.006, 12.017)),
        "boss_20mm": pytest.approx((19.98, 19.993)),
        "seat_18mm": (-np.inf, np.inf),
    }
    assert any("seat_18mm" in one and "the fit CD6 has no limits here" in one for one in part.drawing.in_part)
    assert "the fit H7" in (tmp_path / "made/task.toml").read_text()
