"""Results and plan as QIF, CSV and JSON: read by lxml against the schema of QIF 3, by csv and json."""

import csv
import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from characterisation.files.atomic_io import write_netcdf
from characterisation.files.errors import InputError
from characterisation.tasks.definitions import DEFINITIONS
from characterisation.tasks.task_file import Measurement
from characterisation.tasks.task_reading import read_task
from mitsim.report.export.qif import NAMESPACE, write_qif
from mitsim.report.export.results import (
    ExpectedResult,
    RunResults,
    expected_result,
    read_results,
    write_results_csv,
    write_results_json,
)
from mitsim.study import open_study
from mitsim.study.run_folder import read_run
from mitsim.study.scoring import write_inputs
from mitsim.study.session import Session
from mitsim.study.statement_file import StatedMeasurement
from tests.report.conftest import FEATURES as SEEN
from tests.report.conftest import MEASUREMENTS
from tests.report.export.known_cloud import POSE
from tests.report.export.test_export_command import export
from tests.report.view_sphere_run import write_expecting_run

FOLDER = Path(os.environ.get("MITSIM_REAL_DATA") or Path(__file__).resolve().parents[3].parent / "shared" / "real")
SCHEMA = FOLDER / "qif/QIFApplications/QIFDocument.xsd"

FEATURES = """
features.base = { kind = "plane", point_mm = [0, 0, 0], direction = [0, 0, 1], outline_mm = [[0, 0, 0], [9, 0, 0], [0, 9, 0]] }
features.side = { kind = "plane", point_mm = [0, 0, 0], direction = [1, 0, 0], outline_mm = [[0, 0, 0], [0, 9, 0], [0, 0, 9]] }
features.back = { kind = "plane", point_mm = [0, 0, 0], direction = [0, 1, 0], outline_mm = [[0, 0, 0], [9, 0, 0], [0, 0, 9]] }
features.bore = { kind = "cylinder", point_mm = [5, 5, 0], direction = [0, 0, 1], radius_mm = 2, outline_mm = [[5, 5, 0], [5, 5, 9]] }
features.pin = { kind = "cylinder", point_mm = [20, 5, 0], direction = [0, 0, 1], radius_mm = 1e-7, outline_mm = [[20, 5, 0], [20, 5, 9]] }
features.ball = { kind = "sphere", point_mm = [5, 5, 9], radius_mm = 3.25 }
features.seat = { kind = "cone", point_mm = [0, 0, 0], direction = [0, 0, 1], radius_mm = 4, half_angle_deg = 30 }
features.hole = { kind = "circle", of = ["base"], point_mm = [7, 7, 0], radius_mm = 1 }
features.rim = { kind = "edge_point", of = ["base"], point_mm = [9, 0, 0], direction = [1, 0, 0], reach_mm = 2 }
features.middle = { kind = "mid_plane", of = ["side", "far"], outline_mm = [[1, 0, 0], [1, 9, 0], [1, 0, 9]] }
features.far = { kind = "plane", point_mm = [2, 0, 0], direction = [1, 0, 0] }
features.corner = { kind = "intersection", of = ["base", "side", "back"] }
"""  # noqa: E501

#: every kind of measurement: its features, and what QIF calls it with and without a tolerance
KINDS = {
    "intersection_distance": ("base bore pin", "DistanceBetween", "DistanceBetween"),
    "axis_distance": ("bore pin", "DistanceBetween", "DistanceBetween"),
    "point_distance": ("ball corner", "DistanceBetween", "DistanceBetween"),
    "point_plane_distance": ("rim side", "DistanceBetween", "DistanceBetween"),
    "plane_distance": ("far side", "DistanceBetween", "DistanceBetween"),
    "plane_axis_angle": ("base bore", "AngleBetween", "AngleBetween"),
    "axis_angle": ("bore pin", "AngleBetween", "AngleBetween"),
    "plane_angle": ("base side", "AngleBetween", "AngleBetween"),
    "cone_angle": ("seat", "Angle", "Angle"),
    "radius": ("ball", "SphericalRadius", "SphericalRadius"),
    "diameter": ("hole", "Diameter", "Diameter"),
    "position": ("bore base side back", "Position", "UserDefinedLinear"),
    "parallelism": ("bore pin", "Parallelism", "UserDefinedLinear"),
    "perpendicularity": ("side base", "Perpendicularity", "UserDefinedLinear"),
    "angularity": ("side base", "Angularity", "UserDefinedLinear"),
    "coaxiality": ("pin bore", "Coaxiality", "UserDefinedLinear"),
    "symmetry": ("middle side", "Symmetry", "UserDefinedLinear"),
    "flatness": ("base", "Flatness", "UserDefinedLinear"),
    "cylindricity": ("bore", "Cylindricity", "UserDefinedLinear"),
    "pose_position": ("base side back", "UserDefinedLinear", "UserDefinedLinear"),
    "pose_rotation": ("base side back", "UserDefinedAngular", "UserDefinedAngular"),
}


@pytest.fixture(scope="module")
def every_kind(tmp_path_factory):
    """Results of each kind of measurement, with a tolerance and without; one has no value."""
    assert set(KINDS) == set(DEFINITIONS)
    lines = [FEATURES]
    for kind, (features, *_) in KINDS.items():
        named = ", ".join(f'"{name}"' for name in features.split())
        nominal = 0 if DEFINITIONS[kind].zone else 12.5
        for suffix, tolerance in (("toleranced", "tolerance = 0.1"), ("free", "")):
            lines.append(
                f"[measurements.{kind}_{suffix}]\nkind = '{kind}'\nfeatures = [{named}]\nnominal = {nominal}\n"
                f"unit = '{DEFINITIONS[kind].unit}'\n{tolerance}"
            )
    path = tmp_path_factory.mktemp("task") / "task.toml"
    path.write_text("\n".join(lines))
    task = read_task(path)
    results = [
        ExpectedResult(
            name,
            m.kind,
            m.features,
            m.unit,
            m.nominal,
            m.tolerance,
            12,
            m.nominal - 0.25,
            -0.25,
            0.01,
            1e-9,
            m.nominal - 1,
            m.nominal + 1,
            200,
            0.0,
            "fits",
            -1.0,
            1.0,
            "any part",
        )
        for name, m in task.measurements.items()
    ]
    results[0] = replace(
        results[0],
        expected=None,
        bias=None,
        bias_uncertainty=None,
        uncertainty=None,
        low=None,
        high=None,
        error_low=None,
        error_high=None,
        without_value=1.0,
    )
    plan = ((12, POSE, tuple(task.measurements)[:5]), (40, POSE.inverse(), tuple(task.measurements)[5:]))
    return RunResults(tuple(results), task, "test-sensor", "study.toml", "render", plan)


@pytest.fixture(scope="module")
def document(every_kind, tmp_path_factory):
    etree = pytest.importorskip("lxml.etree")
    path = tmp_path_factory.mktemp("qif") / "all.qif"
    write_qif(every_kind, path)
    return etree.parse(path)


def test_qif_is_valid_against_the_schema(document):
    etree = pytest.importorskip("lxml.etree")
    if not SCHEMA.is_file():
        pytest.skip(f"no schema in {FOLDER}: set MITSIM_REAL_DATA, see docs/how-to/real-captures.md")
    schema = etree.XMLSchema(etree.parse(SCHEMA))
    assert schema.validate(document), schema.error_log
    spoilt = etree.ElementTree(etree.fromstring(etree.tostring(document)))  # the schema does look at references
    spoilt.find(".//{*}CharacteristicItemId").text = "1"
    assert not schema.validate(spoilt)


def test_qif_of_a_study_with_any_file_name_is_xml(every_kind, tmp_path):
    etree = pytest.importorskip("lxml.etree")
    name = os.fsdecode(b"a\x01\xe9&<>\xc3\xa9\xef\xbf\xbe.toml")  # control, Latin-1, UTF-8, no character
    write_qif(replace(every_kind, study=name), tmp_path / "all.qif")
    found = etree.parse(tmp_path / "all.qif").find(".//{*}*[@name='mitsim.study']").get("value")
    assert found == r"a\x01\udce9&<>é\ufffe.toml"


def test_qif_counts_and_references_hold(document):
    numbers = [int(one.get("id")) for one in document.iter() if one.get("id")]
    assert len(numbers) == len(set(numbers)) and max(numbers) == int(document.getroot().get("idMax"))
    lists = [one for one in document.iter() if one.get("n")]
    assert lists and all(len(one) == int(one.get("n")) for one in lists)
    named = [int(one.text) for one in document.iter() if one.tag.endswith("Id") and not one.tag.endswith("QPId")]
    assert len(named) > 300 and set(named) <= set(numbers)
    assert document.getroot().tag == f"{{{NAMESPACE}}}QIFDocument"


def test_qif_holds_values_uncertainties_and_tolerances(document, every_kind):
    found = {one.get("id"): one for one in document.iter() if one.get("id")}
    measurements = document.find(".//{*}CharacteristicMeasurements")
    assert len(measurements) == 2 * len(KINDS)
    for one, result in zip(measurements, every_kind.results, strict=True):
        item = found[one.find("{*}CharacteristicItemId").text]
        nominal = found[item.find("{*}CharacteristicNominalId").text]
        definition = found[nominal.find("{*}CharacteristicDefinitionId").text]
        wanted = KINDS[result.kind][1 if result.tolerance else 2]
        for element, end in ((one, "Measurement"), (item, "Item"), (nominal, "Nominal"), (definition, "Definition")):
            assert element.tag.partition("}")[2] == f"{wanted}Characteristic{end}", result.measurement
        assert item.find("{*}Name").text == result.measurement
        value = one.find("{*}Value")
        if result.expected is None:
            assert value is None
            continue
        assert (float(value.text), value.attrib) == (
            result.nominal - 0.25,
            {"combinedUncertainty": "0.000000001", "meanError": "0.25"},
        )
        if result.tolerance is None:
            assert definition.find("{*}NonTolerance").text == "MEASURED"
            continue
        largest = definition.find("{*}ToleranceValue")
        largest = definition.find("{*}Tolerance/{*}MaxValue") if largest is None else largest
        assert float(largest.text) == 0.1
        least = definition.find("{*}Tolerance/{*}MinValue")
        assert (least is None) == DEFINITIONS[result.kind].zone
        assert least is None or float(least.text) == -0.1


def test_qif_datums_and_zones(document):
    def definition(name):
        (one,) = [
            one
            for one in document.iter(
                "{*}PositionCharacteristicDefinition",
                "{*}ParallelismCharacteristicDefinition",
                "{*}PerpendicularityCharacteristicDefinition",
            )
            if one.find("{*}Name").text == name
        ]
        frame = document.find(f".//{{*}}DatumReferenceFrame[@id='{one.find('{*}DatumReferenceFrameId').text}']")
        labels = [
            document.find(f".//{{*}}DatumDefinition[@id='{one.text}']/{{*}}DatumLabel").text
            for one in frame.iter("{*}DatumDefinitionId")
        ]
        return one.find("{*}ZoneShape")[0].tag.partition("}")[2], labels

    assert definition("position_toleranced") == ("DiametricalZone", ["A", "B", "C"])  # base, side, back
    assert definition("parallelism_toleranced") == ("DiametricalZone", ["D"])  # an axis along an axis
    assert definition("perpendicularity_toleranced") == ("PlanarZone", ["A"])  # a plane on a plane


def test_qif_plan_has_the_poses_of_its_views(document, every_kind):
    steps = document.findall(".//{*}MeasureEvaluateSpecified")
    assert [len(step.findall("{*}CharacteristicItemIds/{*}Id")) for step in steps] == [5, 2 * len(KINDS) - 5]
    for step, (number, pose, _) in zip(steps, every_kind.plan, strict=True):
        said = {one.get("name"): one.get("value") for one in step.find("{*}Attributes")}
        assert said["mitsim.view"] == str(number)
        transform = document.find(f".//{{*}}Transform[@id='{said['mitsim.part_from_sensor_transform_id']}']")
        columns = [[float(v) for v in transform.find(f"{{*}}Rotation/{{*}}{a}Direction").text.split()] for a in "XYZ"]
        np.testing.assert_allclose(np.transpose(columns), pose.rotation, atol=1e-11)
        np.testing.assert_allclose(
            [float(v) for v in transform.find("{*}Origin").text.split()], pose.translation, atol=1e-9
        )
        instruction = document.find(f".//{{*}}TextInstruction[@id='{step.find('{*}WorkInstructionIds/{*}Id').text}']")
        assert f"view {number}" in instruction[0].text


def test_the_same_results_give_the_same_document(every_kind, tmp_path):
    for name in ("one.qif", "two.qif"):
        write_qif(every_kind, tmp_path / name)
    assert (tmp_path / "one.qif").read_bytes() == (tmp_path / "two.qif").read_bytes()


def test_csv_and_json_say_the_same(every_kind, tmp_path):
    write_results_csv(every_kind, tmp_path / "all.csv")
    write_results_json(every_kind, tmp_path / "all.json")
    with (tmp_path / "all.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    said = json.loads((tmp_path / "all.json").read_text())
    assert list(rows[0]) == list(said["results"][0])
    for row, one, result in zip(rows, said["results"], every_kind.results, strict=True):
        assert row["measurement"] == one["measurement"] == result.measurement
        assert row["features"].split() == one["features"] == list(result.features)
        for key in ("expected", "uncertainty", "tolerance"):
            value = getattr(result, key)
            assert one[key] == value and row[key] == ("" if value is None else repr(value))
    assert [one["view"] for one in said["plan"]] == [12, 40]
    assert np.array_equal(said["plan"][0]["part_from_sensor"], POSE.matrix())


TASK = """
[features."plane"]
kind = "plane"
point_mm = [0, 0, 0]
direction = [0, 0, 1]
[features.pillar]
kind = "cylinder"
point_mm = [0, 0, 0]
direction = [0, 0, 1]
radius_mm = 20
[measurements."angle 1"]
kind = "plane_axis_angle"
features = ["plane", "pillar"]
nominal = 0
unit = "deg"
[measurements."radius & co"]
kind = "radius"
features = ["pillar"]
nominal = 20
unit = "mm"
tolerance = 0.5
"""


def with_names_of_tasks(folder):
    """A run of the report's tests, whose names no task could have, with others in their place."""
    names = {MEASUREMENTS[0]: "angle 1", SEEN[0]: "plane"}
    for file in (folder / "run.json", folder / "statement.json"):
        text = file.read_text(encoding="utf-8")
        for old, new in names.items():
            text = text.replace(old, new)
        file.write_text(text, encoding="utf-8")
    for file in (folder / "scores.nc", folder / "checks.nc"):
        data = xr.load_dataset(file)
        own = {
            name: [names.get(str(v), str(v)) for v in data[name].values]
            for name in ("measurement", "feature")
            if name in data
        }
        write_netcdf(data.assign_coords(own), file)
    return folder


def test_a_study_keeps_its_task_in_the_folder_that_is_exported(tmp_path, monkeypatch):
    """The folder is moved, the study is gone, and the command runs elsewhere."""
    monkeypatch.chdir(Path(__file__).parents[3] / "scenes")
    study = open_study("two_pillars/tolerances.toml")
    write_inputs(Session(study, tmp_path / "inputs"))
    before, after = with_names_of_tasks(write_expecting_run(tmp_path / "run")), tmp_path / "moved" / "run"
    (tmp_path / "task.toml").write_text(TASK)
    given = read_results(before, tmp_path / "task.toml")
    (before / "task.json").write_bytes((tmp_path / "inputs" / "task.json").read_bytes())
    assert read_run(before).task() == study.task
    with pytest.raises(InputError, match="the task of the run"):
        read_results(before)
    own = replace(study, task=read_task(tmp_path / "task.toml"))
    write_inputs(Session(own, tmp_path / "inputs"))
    (before / "task.json").write_bytes((tmp_path / "inputs" / "task.json").read_bytes())
    after.parent.mkdir()
    before.rename(after)
    (tmp_path / "task.toml").unlink()
    monkeypatch.chdir(tmp_path / "moved")
    assert read_results("run").results == given.results and read_results("run").task == given.task
    for name in ("out.qif", "out.csv", "out.json"):
        export("results", "run", "-o", name)
        assert Path(name).stat().st_size > 300
    export("run", "run", "-o", "out.glb")


@pytest.mark.parametrize(
    ("kind", "nominal", "tolerance", "errors_of", "value"),
    [
        ("radius", 20.0, 0.5, "any part", 20.0),
        ("coaxiality", 0.0, 0.3, "part at the limit of the tolerance", 0.3),
        ("point_distance", 0.1, 0.3, "part at the limit of the tolerance", 0.4),
        ("plane_angle", 90.0, 0.2, "part at the limit of the tolerance", 89.8),
        ("coaxiality", 0.0, None, "part far from nominal", None),
    ],
)
def test_readings_are_those_of_the_part_whose_errors_are_stated(kind, nominal, tolerance, errors_of, value):
    """A reading of a zone is never negative, and one of a right angle never above 90 deg."""
    asked = Measurement(
        kind=kind, features=("a", "b"), nominal=nominal, unit=DEFINITIONS[kind].unit, tolerance=tolerance
    )
    stated = StatedMeasurement(
        unit=asked.unit,
        trials=200,
        without_value=0.0,
        bias=-0.01,
        bias_uncertainty=0.001,
        standard_uncertainty=0.05,
        interval=(-0.11, 0.09),
        interval_corrected=(-0.1, 0.1),
        numerical_tolerance=0.005,
        settled=True,
        repeatability=None,
        budget=[],
        tolerance=tolerance,
        share_of_tolerance=None,
        verdict="fits",
        errors_of=errors_of,
    )
    one = expected_result("m", asked, stated, 3)
    assert (one.error_low, one.error_high, one.errors_of) == (-0.11, 0.09, errors_of)
    if value is None:
        assert one.expected is one.low is one.high is None
    else:
        assert (one.expected, one.low, one.high) == (value - 0.01, value - 0.11, value + 0.09)


def test_a_task_with_another_nominal_or_tolerance_than_that_of_the_run_is_refused(tmp_path):
    """Its nominal value would move the expected reading, beside a verdict on another tolerance."""
    folder = with_names_of_tasks(write_expecting_run(tmp_path / "run"))
    task = tmp_path / "task.toml"
    task.write_text(TASK)
    own = read_task(task).model_dump(mode="json", exclude_unset=True, exclude_none=True)
    (folder / "task.json").write_text(json.dumps(own), encoding="utf-8")
    assert read_results(folder, task).results == read_results(folder).results
    for key in ("nominal", "tolerance"):
        changed = TASK.replace(f"{key} = ", f"{key} = 1", 1)
        assert changed != TASK
        task.write_text(changed)
        with pytest.raises(InputError, match=r"task\.toml: measurements\..*the run's task"):
            read_results(folder, task)


def test_results_have_the_accepted_readings_of_the_statement(tmp_path):
    """Those of the sheet to sign: of a length, of a zone, and of one that accepts none."""
    folder = with_names_of_tasks(write_expecting_run(tmp_path / "run"))
    (tmp_path / "task.toml").write_text(TASK)
    statement = json.loads((folder / "statement.json").read_text())
    rule = {"rule": "ISO 14253-1", "fits_corrected": True, "needed": None, "false_accept": None, "false_reject": None}
    rule |= {"consumer_risk": None, "producer_risk": None}
    readings = [[19.82, 20.18], [None, 0.07], None]
    for one, accepted in zip(statement["measurements"].values(), readings, strict=False):
        one["decision"] = rule | {"accepted": accepted}
    (folder / "statement.json").write_text(json.dumps(statement))
    read = read_results(folder, tmp_path / "task.toml")
    ends = [(one.accepted_low, one.accepted_high) for one in read.results]
    assert ends == [(19.82, 20.18), (None, 0.07), (None, None)][: len(ends)]
    write_qif(read, tmp_path / "out.qif")
    said = pytest.importorskip("lxml.etree").parse(tmp_path / "out.qif").findall(".//{*}CharacteristicMeasurements/*")
    written = [one.get("value") for one in said[0].iter("{*}AttributeD1") if "accepted" in one.get("name")]
    assert written == ["19.82", "20.18"]


def test_a_run_without_a_statement_says_how_to_go_on(tmp_path):
    folder = write_expecting_run(tmp_path / "run")
    (folder / "statement.json").unlink()
    with pytest.raises(InputError, match=r"statement\.json.*run the same mitsim run again"):
        read_results(folder)


def test_results_are_read_from_a_run(tmp_path):
    folder = with_names_of_tasks(write_expecting_run(tmp_path / "run"))
    statement = json.loads((folder / "statement.json").read_text())
    with pytest.raises(InputError, match=r"task\.json: found no such file.*--task FILE"):
        read_results(folder)
    (tmp_path / "task.toml").write_text(TASK)
    found = read_results(folder, tmp_path / "task.toml")
    stated = statement["measurements"]
    for one in found.results:
        bias = stated[one.measurement]["bias"]
        assert one.uncertainty == stated[one.measurement]["standard_uncertainty"]
        assert one.expected == (None if bias is None else one.nominal + bias)
    assert [number for number, *_ in found.plan] == [2, 7]  # the run has a set of views
    write_qif(found, tmp_path / "run.qif")
    (tmp_path / "other.toml").write_text(TASK.replace("radius & co", "size"))
    with pytest.raises(InputError, match="the task of the run"):
        read_results(folder, tmp_path / "other.toml")
    as_json = read_task(tmp_path / "task.toml").model_dump(mode="json", exclude_unset=True, exclude_none=True)
    (folder / "task.json").write_text(json.dumps(as_json | {"measurements": {}}), encoding="utf-8")
    with pytest.raises(InputError, match=r"task\.json.*measurements"):
        read_results(folder)
    as_json["measurements"]["radius & co"]["features"] = ["plane"]  # which has no radius
    (folder / "task.json").write_text(json.dumps(as_json), encoding="utf-8")
    with pytest.raises(InputError, match=r"task\.json.*measurements\.radius & co"):
        read_results(folder)
    (folder / "statement.json").unlink()
    with pytest.raises(InputError, match=r"statement\.json"):
        read_results(folder, tmp_path / "task.toml")
