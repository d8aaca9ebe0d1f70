"""A study says what it leaves out of the direction of machining marks on its features."""

from dataclasses import replace

from mitsim.study import finishes_of_features, open_study, report_doubts


def test_a_study_names_the_features_whose_marks_have_no_direction(scenes, capsys):
    study = open_study(scenes / "two_pillars" / "study.toml", mapped=False)
    assert {str(one) for one in finishes_of_features(study).values()} == {
        "aluminium/ground Ra 0.74 um",
        "aluminium/ground Ra 0.37 um",
    }
    report_doubts(study)
    told = capsys.readouterr().err
    assert told.startswith("plane and 2 more: no lay, the direction of") and told.count("\n") == 1 and len(told) < 120


def test_a_study_of_matt_faces_says_nothing(scenes, capsys):
    study = open_study(scenes / "two_pillars" / "study.toml", mapped=False)
    white = replace(study.scene, finishes=[None] * len(study.scene.finishes))
    report_doubts(replace(study, scene=white))
    assert capsys.readouterr().err == ""
