"""The documented keys of what mitsim writes without a model, against what it writes."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import OpenEXR
import pytest

from characterisation.statements.budget import BudgetLine
from characterisation.statements.statement import statement
from characterisation.statements.tolerance import plus_minus
from characterisation.tasks.result import Repeatability, Result
from mitsim.capture.devices.stage_connection import BAUD
from mitsim.capture.truth import Truth, encode_exr
from mitsim.decoding.measured_document import measured_document
from mitsim.sensor.exposure import PlannedExposure
from mitsim.sensor.transforms import Transform
from mitsim.sensor.unknowns import UnknownsTable
from mitsim.study.exposures.exposure_plan import ExposurePlan
from mitsim.study.exposures.exposure_sweep import ExposureResult, FeatureResult
from mitsim.study.exposures.planned import plan_document, write_plan_csv
from mitsim.study.remedies.change import Change
from mitsim.study.remedies.confirm import find_remedies, remedies_document
from mitsim.study.remedies.entries import RemediesEntry
from mitsim.study.statement_document import statement_document
from mitsim.study.virtual.stated import StatedView
from tests.docs.test_docs import FORMATS, JSON_MODELS, first_column, table_rows


@pytest.fixture(scope="module")
def stated():
    errors = np.random.default_rng(1).normal(0.02, 0.01, 40)
    line = BudgetLine("pose", 1e-4, 5e-5, 2e-4, 1.0, (0.5, 1.0))
    return statement("radius", "mm", errors, plus_minus(20.0, 0.2), (line,), np.arange(40) // 2)


def test_keys_of_a_statement(stated):
    study = SimpleNamespace(
        path=Path("study.toml"),
        sensor=SimpleNamespace(name="ensenso-n10", technology="active_stereo", pattern=None),
        scene=SimpleNamespace(finishes=[]),
        performance_map=None,
        file=SimpleNamespace(seed=1, measure=SimpleNamespace(light_path_depth=2)),
        task=SimpleNamespace(measurements={"radius": SimpleNamespace(unit="deg")}),
    )
    view = SimpleNamespace(number=3, standoff=500.0, world_from_sensor=Transform.from_matrix(np.eye(4)))
    unknowns = SimpleNamespace(
        table=UnknownsTable(), calibration=SimpleNamespace(source="a calibration"), varied=(), expansion=17e-6
    )
    session = SimpleNamespace(study=study, unknowns=unknowns, source="render")
    written = statement_document(session, StatedView(view, [stated], PlannedExposure((1e-3,))))
    assert first_column("columns: statement.json") == set(written)
    measurement = written["measurements"]["radius"]
    assert first_column("columns: statement.json measurement") == set(measurement)
    assert first_column("columns: statement.json decision") == set(measurement["decision"])
    row = next(line for line in FORMATS.splitlines() if line.startswith("| `budget` |"))
    assert {f"`{key}`" for key in measurement["budget"][0]} <= set(row.replace(",", " ").split())
    JSON_MODELS["statement"].model_validate(written)
    # the path of light is an unknown of time of flight alone
    assert written["unknowns"]["calibration"]["path_offset_mm"] == 0 < UnknownsTable().calibration.path_offset_mm


def test_keys_of_a_plan_of_exposures(tmp_path):
    result = ExposureResult(PlannedExposure((1e-3,)), {"plane": FeatureResult(100.0, 0.5, 0.01, 0.0)}, {})
    plan = ExposurePlan(3, result.exposure, ((1e-3, result),), result, result.features, True, (), 1)
    study = SimpleNamespace(
        path=Path("study.toml"),
        sensor=SimpleNamespace(name="ensenso-n10", exposure=SimpleNamespace(limits_s=(1e-5, 1e-2))),
    )
    written = plan_document(study, plan)
    assert first_column("columns: exposures.json") == {*written, "digest"}  # which a run's folder adds
    write_plan_csv(tmp_path / "exposures.csv", plan)
    head = (tmp_path / "exposures.csv").read_text(encoding="utf-8").splitlines()[0].split(",")
    section = FORMATS.partition("`exposures.csv` has")[2].partition("\n\n")[0]
    assert [column for column in head if f"`{column}`" not in section] == []


def test_keys_of_measurements_on_stdout():
    one = Result("radius", "mm", 20.0)
    repeatability = Repeatability("radius", "mm", 2, 2, 20.0, 0.1, 0.1, 20.0)
    written = measured_document([(Path("a.ply"), "ensenso-n10", "simulated")], [[one]], [repeatability])
    assert first_column("columns: measure") == set(written)
    assert first_column("columns: measure cloud") == set(written["clouds"][0])
    assert first_column("columns: measure measurement") == set(written["clouds"][0]["measurements"][0])
    assert first_column("columns: measure repeatability") == set(written["repeatability"][0])


def test_channels_of_a_true_image(tmp_path):
    one = np.ones((2, 2), np.float32)
    pairs, triples = np.stack([one] * 2, axis=-1), np.stack([one] * 3, axis=-1)
    truth = Truth(one, one, triples, one.astype(np.int16), ("a", "b"), pairs, one.astype(bool), one)
    (tmp_path / "left.exr").write_bytes(encode_exr(truth))
    with OpenEXR.File(str(tmp_path / "left.exr"), separate_channels=True) as file:
        assert first_column("channels: truth") == set(file.channels())


def test_baud_rates_are_those_of_the_controllers():
    row = next(line for line in FORMATS.splitlines() if line.startswith("| `baud` |"))
    assert all(f"{rate} ({kind})" in row for kind, rate in BAUD.items())


def test_keys_of_remedies(stated):
    change = Change("spray", "sprayed matt white", {"sprayed": True}, (3,), {"radius": 0.1}, lambda *_: [stated])
    found = find_remedies({"radius": stated}, [change], 40)
    written = remedies_document(found)
    assert first_column("columns: run.json remedies") == set(written)
    assert first_column("columns: run.json remedies tried") == set(written["tried"][0])
    for marker, entry in (
        ("columns: run.json remedies", written["measurements"]["radius"]),
        ("columns: run.json remedies tried", written["tried"][0]["measurements"]["radius"]),
    ):
        row = next(cells for cells in table_rows(marker) if cells[0] == "`measurements`")
        assert all(f"`{key}`" in row[2] for key in entry)
    RemediesEntry.model_validate(written)
