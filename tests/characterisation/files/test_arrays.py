"""The number that turns a median absolute deviation into a standard deviation is written in one place."""

from pathlib import Path

import pytest
from scipy.stats import norm

from characterisation.features.robust_fit import ROUNDED_MEDIAN_TO_STD
from characterisation.files import arrays


def test_the_number_is_that_of_a_normal_distribution():
    assert pytest.approx(1 / norm.ppf(0.75), rel=1e-15) == arrays.MEDIAN_TO_STD
    assert pytest.approx(1 / norm.ppf(0.75), abs=5e-5) == ROUNDED_MEDIAN_TO_STD


def test_no_other_module_writes_it():
    root = Path(arrays.__file__).parents[2]
    files = [file for package in ("characterisation", "mitsim") for file in (root / package).rglob("*.py")]
    found = [file.name for file in files if "* 1.482" in (text := file.read_text()) or "= 1.482" in text]
    assert len(files) > 500
    assert found == ["arrays.py"]
