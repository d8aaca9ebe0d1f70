"""Each example exists as a TOML file and as a program, and both say the same; so both give the same numbers."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

import mitsim as ms
from characterisation.files.documents import read_toml

SCENES = Path(__file__).resolve().parents[2] / "scenes"
PROGRAMS = [path for path in sorted(SCENES.glob("*/*.py")) if path.with_suffix(".toml").exists()]


def program(path: Path):
    """The module of a program; importing it runs nothing."""
    spec = importlib.util.spec_from_file_location(f"scene_program_{path.stem}", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("path", PROGRAMS, ids=lambda path: f"{path.parent.name}/{path.stem}")
def test_a_program_states_what_its_toml_file_states(path):
    module = program(path)
    stated = getattr(module, "STUDY", None) or module.CAMPAIGN
    assert stated == read_toml(path.with_suffix(".toml"), type(stated))
    assert path.with_suffix(".toml").name in path.read_text(encoding="utf-8")


def test_the_studies_and_the_campaign_have_programs():
    assert {f"{path.parent.name}/{path.stem}" for path in PROGRAMS} >= {
        "two_pillars/study",
        "two_pillars/set",
        "two_pillars/tolerances",
        "two_pillars/quick",
        "coupon/campaign",
        "coupon/quick",
        "coupon/spread",
    }


def test_a_study_opened_from_a_program_has_the_scores_of_its_file():
    path = SCENES / "two_pillars/study.toml"
    few = {"views": {"subdivisions": 0, "rolls_deg": [0], "lowest_elevation_deg": 50}}
    stated = program(path.with_suffix(".py")).STUDY
    sides = [
        ms.score(ms.open_study(path, file.model_copy(update={"views": type(file.views)(**few["views"])})))
        for file in (stated, read_toml(path, ms.StudyFile))
    ]
    for name in ("n", "mean_sigma", "V_m"):
        np.testing.assert_array_equal(*(side[name].values for side in sides))
    assert sides[0]["n"].values.max() > 100
