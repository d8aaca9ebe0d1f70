"""Screening of whole studies: fields of shared errors where parts stand."""

from pathlib import Path

import numpy as np

from mitsim.maps.prediction.shared_errors import terms
from mitsim.sensor.rig_parameters import moved
from mitsim.study.calibration.accuracy import measured_points
from mitsim.study.virtual.screening import shared_errors
from mitsim.study.virtual.study_unknowns import study_unknowns
from tests.proofs.part_cases import read_part_cases

CASES = Path(__file__).parents[3] / "scenes" / "parts" / "validation.toml"


def test_fields_of_an_n35_are_not_torn_by_the_fold_of_its_distortion():
    """Near the image's corners the polynomial of an N35 folds back, and its rig finds no place again."""
    case = next(one for one in read_part_cases(CASES, ["cone_and_dome__ensenso-n35"]))
    study = case.open()
    unknowns = study_unknowns(study)
    fields = shared_errors(study, unknowns)
    calibration, rig = unknowns.calibration, study.sensor.rig
    points = study.views[3].world_from_sensor.inverse().points(study.scene.bounds.mean(axis=0)[None])
    rng = np.random.default_rng(5)
    drawn = [
        measured_points(study.sensor, points, moved(rig, calibration.names, values))
        - measured_points(study.sensor, points, rig)
        for values in (calibration.draw(rng) for _ in range(300))
    ]
    known = np.sqrt((np.array(drawn) ** 2).sum(axis=-1).mean())
    found = np.sqrt(((terms(points) @ fields.coefficients) ** 2).sum())
    assert 0.9 * known < found < 2 * known  # the temperature is in the fields too
