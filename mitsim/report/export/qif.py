"""Write the results and the plan of a run as QIF 3.0 (ISO 23952:2020).

Signal chain: results -> features (definition, nominal, item) -> characteristics (definition, nominal, item) -> plan (a
step for each view, with its pose and its measurements) -> results (a measurement of every characteristic).

A virtual measurement is of a known part. Its value is therefore the expectation, value of this part plus bias, with its
``combinedUncertainty`` (k = 1) and its ``meanError``, the magnitude of the bias; QIF requires both together. The sign
of the bias, the interval, the part and the verdict are attributes. No part was inspected: statuses are
``NOT_ANALYZED``, and that of the inspection ``NOT_CALCULATED``. Lengths are mm, angles degrees, all in the part frame.
"""

from __future__ import annotations

import uuid
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, ElementTree, indent, tostring

from characterisation.files.atomic_io import atomic_write
from characterisation.tasks.definitions import DEFINITIONS
from characterisation.tasks.task_file import Measurement
from characterisation.words.version import __version__
from mitsim.report.export.qif_document import (
    FEATURES,
    GEOMETRIC,
    Ids,
    attributes,
    characteristic,
    decimal,
    element,
    feature_geometry,
    feature_size,
    references,
    tolerance,
    transform,
    zone,
)
from mitsim.report.export.results import ExpectedResult, RunResults

NAMESPACE = "http://qifstandards.org/xsd/qif3"

_PRECEDENCE = ("PRIMARY", "SECONDARY", "TERTIARY")


def write_qif(run_results: RunResults, path: str | Path) -> None:
    """Write results and plan as one QIF document."""
    root = qif_document(run_results)
    indent(root)
    with atomic_write(path) as file:
        ElementTree(root).write(file, encoding="utf-8", xml_declaration=True)


def qif_document(run_results: RunResults) -> Element:
    """Return the document of a run; its id derives from its content, so equal runs give equal documents."""
    ids = Ids()
    standard = {"Organization": {"StandardsOrganizationEnum": "ISO"}, "Designator": "1101"}
    standards = [element("Standard", standard, id=ids.new("standard"))]
    for name in run_results.task.features:
        ids.new("nominal", name)
    content = {
        "QPId": "",
        "Header": {"Application": {"Name": f"mitsim {__version__}"}},
        "StandardsDefinitions": standards,
        "FileUnits": {
            "PrimaryUnits": {
                "AngularUnit": _unit("radian", "degree", "0.017453292519943295"),
                "LinearUnit": _unit("meter", "mm", "0.001"),
            }
        },
        **_datums(ids, run_results),
        "MeasurementResources": {"MeasurementDevices": [_device(ids, run_results)]},
        "Features": _features(ids, run_results),
        "Characteristics": _characteristics(ids, run_results),
        "Plan": _plan(ids, run_results),
        "Results": {"MeasurementResultsSet": [_results(ids, run_results)]},
    }
    root = element("QIFDocument", content, xmlns=NAMESPACE, versionQIF="3.0.0")
    root.set("idMax", str(ids.last))
    root[0].text = str(uuid.uuid5(uuid.NAMESPACE_URL, NAMESPACE + tostring(root, encoding="unicode")))
    return root


def _unit(si: str, name: str, factor: str) -> dict[str, Any]:
    return {"SIUnitName": si, "UnitName": name, "UnitConversion": {"Factor": factor}}


def _datums_of(asked: Measurement) -> tuple[str, ...]:
    """Return the features that are datums of a toleranced zone."""
    definition = DEFINITIONS[asked.kind]
    of_zone = definition.zone and definition.of == "features" and asked.tolerance is not None
    return asked.features[1:] if of_zone else ()


def _datums(ids: Ids, run_results: RunResults) -> dict[str, list[Element] | None]:
    """Return datums, poses of the views, and datum reference frames, in QIF's order."""
    used = {name: _datums_of(asked) for name, asked in run_results.task.measurements.items() if _datums_of(asked)}
    names = list(dict.fromkeys(name for datums in used.values() for name in datums))
    definitions = [
        element(
            "DatumDefinition",
            {"DatumLabel": _label(k), "FeatureNominalIds": references([ids.of("nominal", name)])},
            id=ids.new("datum", name),
        )
        for k, name in enumerate(names)
    ]
    transforms = [
        transform(ids.new("transform", str(number)), f"part_from_sensor of view {number}", pose)
        for number, pose, _ in run_results.plan
    ]
    frames = [
        element(
            "DatumReferenceFrame",
            {"Datums": [_datum(ids, *pair) for pair in zip(datums, _PRECEDENCE, strict=False)]},
            id=ids.new("frame", measurement),
        )
        for measurement, datums in used.items()
    ]
    return {"DatumDefinitions": definitions or None, "Transforms": transforms, "DatumReferenceFrames": frames or None}


def _datum(ids: Ids, name: str, precedence: str) -> Element:
    simple = {"DatumDefinitionId": ids.of("datum", name), "MaterialModifier": "NONE", "ReferencedComponent": "ACTUAL"}
    return element("Datum", {"SimpleDatum": simple, "Precedence": {"PrecedenceEnum": precedence}})


def _label(k: int) -> str:
    """Return A, B ... Z, AA, AB ... (ISO 5459)."""
    return (chr(ord("A") + k // 26 - 1) if k >= 26 else "") + chr(ord("A") + k % 26)


def _device(ids: Ids, run_results: RunResults) -> Element:
    method = "rendered" if run_results.source == "render" else "drawn from its performance map"
    words = f"3D vision sensor, simulated: virtual measurements {method}"
    return element("MeasurementDevice", {"Name": run_results.sensor, "Description": words}, id=ids.new("device"))


def _features(ids: Ids, run_results: RunResults) -> dict[str, list[Element]]:
    definitions, nominals, items = list[Element](), list[Element](), list[Element]()
    for name, feature in run_results.task.features.items():
        nominal = run_results.task.nominal(name)
        number, of_nominal = ids.new("definition", name), ids.of("nominal", name)
        tag, head = f"{FEATURES[feature.kind]}Feature", {"Name": name, "FeatureDefinitionId": number}
        definitions.append(element(f"{tag}Definition", feature_size(nominal), id=number))
        nominals.append(element(f"{tag}Nominal", head | feature_geometry(nominal), id=of_nominal))
        item = {"FeatureNominalId": of_nominal, "FeatureName": name, "DeterminationMode": {"Checked": {}}}
        items.append(element(f"{tag}Item", item, id=ids.new("item", name)))
    return {"FeatureDefinitions": definitions, "FeatureNominals": nominals, "FeatureItems": items}


def _characteristics(ids: Ids, run_results: RunResults) -> dict[str, Any]:
    task = run_results.task
    definitions, nominals, items = list[Element](), list[Element](), list[Element]()
    for name, asked in task.measurements.items():
        kind, datums = characteristic(task, asked), _datums_of(asked)
        geometric = kind in GEOMETRIC
        measured = asked.features[:1] if datums else asked.features
        frame = ids.of("frame", name) if datums else None
        limits = zone(kind, task, asked, frame) if geometric else tolerance(kind, asked)
        definition, nominal = ids.new("characteristic definition", name), ids.new("characteristic nominal", name)
        definitions.append(element(f"{kind}CharacteristicDefinition", {"Name": name} | limits, id=definition))
        of_nominal = {
            "Description": asked.kind,
            "CharacteristicDefinitionId": definition,
            "FeatureNominalIds": references(ids.of("nominal", feature) for feature in measured),
            "Name": name,
            "TargetValue": None if geometric else float(asked.nominal),
            "AnalysisMode": "THREEDIMENSIONAL" if kind in ("DistanceBetween", "AngleBetween") else None,
        }
        nominals.append(element(f"{kind}CharacteristicNominal", of_nominal, id=nominal))
        of_item = {
            "Name": name,
            "FeatureItemIds": references(ids.of("item", feature) for feature in measured),
            "MeasurementDeviceIds": references([ids.of("device")]),
            "CharacteristicNominalId": nominal,
        }
        items.append(element(f"{kind}CharacteristicItem", of_item, id=ids.new("characteristic", name)))
    return {
        "FormalStandardId": ids.of("standard"),
        "CharacteristicDefinitions": definitions,
        "CharacteristicNominals": nominals,
        "CharacteristicItems": items,
    }


def _plan(ids: Ids, run_results: RunResults) -> dict[str, Any]:
    """Return a step for each view; its pose is a readable instruction and a transform for computation."""
    instructions, steps = list[Element](), list[Element]()
    for order, (number, pose, names) in enumerate(run_results.plan, 1):
        instruction, turn = ids.new("instruction", str(number)), ids.of("transform", str(number))
        origin = ", ".join(decimal(round(float(value), 6)) for value in pose.translation)
        words = (
            f"Move {run_results.sensor} to view {number}: the origin of its frame to {origin} mm in the part frame, "
            f"rotated by transform {turn} (x right, y down, z forward). Capture once."
        )
        instructions.append(element("TextInstruction", {"TextInstruction": words}, id=instruction))
        measure = {
            "WorkInstructionIds": references([instruction]),
            "Attributes": attributes({"view": number, "part_from_sensor_transform_id": int(turn)}),
            "PreferredResourceIds": references([ids.of("device")]),
            "CharacteristicItemIds": references(ids.of("characteristic", name) for name in names),
        }
        steps.append(element("NumberedPlanElement", {"SequenceNumber": order, "MeasureEvaluateSpecified": measure}))
    return {"WorkInstructions": instructions, "OrderedPlanRoot": {"Steps": steps}}


def _results(ids: Ids, run_results: RunResults) -> Element:
    number = ids.new("results")
    virtual = {"virtual": "expectations; no part was inspected", "study": run_results.study}
    measured = [_measurement(ids, run_results, result) for result in run_results.results]
    content = {
        "Attributes": attributes(virtual),
        "MeasuredCharacteristics": {"CharacteristicMeasurements": measured},
        "InspectionStatus": {"InspectionStatusEnum": "NOT_CALCULATED"},
    }
    return element("MeasurementResults", content, id=number)


def _measurement(ids: Ids, run_results: RunResults, result: ExpectedResult) -> Element:
    kind = characteristic(run_results.task, run_results.task.measurements[result.measurement])
    numbers = {
        "bias": result.bias,
        "bias_uncertainty": result.bias_uncertainty,
        "low_95": result.low,
        "high_95": result.high,
        "accepted_low": result.accepted_low,
        "accepted_high": result.accepted_high,
        "view": result.view,
        "trials": result.trials,
        "without_value": float(result.without_value),
    }
    values: dict[str, str | float | int] = {name: value for name, value in numbers.items() if value is not None}
    content = {
        "Attributes": attributes(values | {"verdict": result.verdict, "errors_of": result.errors_of}),
        "Status": {"CharacteristicStatusEnum": "NOT_ANALYZED"},
        "CharacteristicItemId": ids.of("characteristic", result.measurement),
        "MeasurementDeviceIds": references([ids.of("device")]),
    }
    out = element(f"{kind}CharacteristicMeasurement", content, id=ids.new("measurement", result.measurement))
    if result.expected is not None and result.uncertainty is not None and result.bias is not None:
        errors = {"combinedUncertainty": decimal(result.uncertainty), "meanError": decimal(abs(result.bias))}
        out.append(element("Value", float(result.expected), **errors))
    return out
