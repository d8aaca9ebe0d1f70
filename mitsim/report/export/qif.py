"""Write the results and the plan of a run as QIF 3.0 (ISO 23952:2020).

Signal chain: results -> features (definition, nominal, item) -> characteristics (definition, nominal, item) -> plan (a
step for each view, with its pose and its measurements) -> results (a measurement of every characteristic).

A virtual measurement is of a perfect part. Its value is therefore the expectation, nominal plus bias, with its
``combinedUncertainty`` (k = 1) and its ``meanError``, the magnitude of the bias; QIF requires both together. The sign
of the bias, the interval and the verdict are attributes. No part was inspected: statuses are ``NOT_ANALYZED``, and that
of the inspection ``NOT_CALCULATED``. Lengths are mm, angles degrees, all in the part frame.
"""

from __future__ import annotations

import uuid
from pathlib import Path
from xml.etree.ElementTree import Element, ElementTree, SubElement, indent, tostring

from characterisation.files.atomic_io import atomic_write
from characterisation.tasks.definitions import DEFINITIONS
from characterisation.tasks.task_file import Measurement
from mitsim.report.export.qif_document import (
    GEOMETRIC,
    Ids,
    attributes,
    characteristic,
    decimal,
    feature_definition,
    feature_nominal,
    references,
    text,
    tolerance,
    transform,
    zone,
)
from mitsim.report.export.results import Result, RunResults
from mitsim.running.version import __version__

NAMESPACE = "http://qifstandards.org/xsd/qif3"

_PRECEDENCE = ("PRIMARY", "SECONDARY", "TERTIARY")


def write_qif(found: RunResults, path: str | Path) -> None:
    """Write results and plan as one QIF document."""
    root = qif_document(found)
    indent(root)
    with atomic_write(path) as file:
        ElementTree(root).write(file, encoding="utf-8", xml_declaration=True)


def qif_document(found: RunResults) -> Element:
    """Return the document of a run; its id derives from its content, so equal runs give equal documents."""
    root, ids = Element("QIFDocument", xmlns=NAMESPACE, versionQIF="3.0.0"), Ids()
    identity = text(root, "QPId", "")
    application = SubElement(SubElement(root, "Header"), "Application")
    text(application, "Name", f"mitsim {__version__}")
    standard = SubElement(SubElement(root, "StandardsDefinitions", n="1"), "Standard", id=ids.new("standard", ""))
    text(SubElement(standard, "Organization"), "StandardsOrganizationEnum", "ISO")
    text(standard, "Designator", "1101")
    _units(root)
    for name in found.task.features:
        ids.new("nominal", name)
    _datums(root, ids, found)
    _devices(root, ids, found)
    _features(root, ids, found)
    _characteristics(root, ids, found)
    _plan(root, ids, found)
    _results(root, ids, found)
    root.set("idMax", str(ids.last))
    identity.text = str(uuid.uuid5(uuid.NAMESPACE_URL, NAMESPACE + tostring(root, encoding="unicode")))
    return root


def _units(root: Element) -> None:
    units = SubElement(SubElement(root, "FileUnits"), "PrimaryUnits")
    for tag, si, name, factor in (
        ("AngularUnit", "radian", "degree", "0.017453292519943295"),
        ("LinearUnit", "meter", "mm", "0.001"),
    ):
        unit = SubElement(units, tag)
        text(unit, "SIUnitName", si)
        text(unit, "UnitName", name)
        text(SubElement(unit, "UnitConversion"), "Factor", factor)


def _datums_of(asked: Measurement) -> tuple[str, ...]:
    """Return the features that are datums of a toleranced zone."""
    definition = DEFINITIONS[asked.kind]
    of_zone = definition.zone and definition.of == "features" and asked.tolerance is not None
    return asked.features[1:] if of_zone else ()


def _datums(root: Element, ids: Ids, found: RunResults) -> None:
    """Write datums, poses of the views, and datum reference frames, in QIF's order."""
    used = {name: _datums_of(asked) for name, asked in found.task.measurements.items() if _datums_of(asked)}
    names = list(dict.fromkeys(name for some in used.values() for name in some))
    if names:
        list_ = SubElement(root, "DatumDefinitions", n=str(len(names)))
        for k, name in enumerate(names):
            datum = SubElement(list_, "DatumDefinition", id=ids.new("datum", name))
            text(datum, "DatumLabel", _label(k))
            references(datum, "FeatureNominalIds", [ids.of("nominal", name)])
    list_ = SubElement(root, "Transforms", n=str(len(found.plan)))
    for number, pose, _ in found.plan:
        transform(list_, ids.new("transform", str(number)), f"part_from_sensor of view {number}", pose)
    if not used:
        return
    list_ = SubElement(root, "DatumReferenceFrames", n=str(len(used)))
    for measurement, some in used.items():
        frame = SubElement(list_, "DatumReferenceFrame", id=ids.new("frame", measurement))
        datums = SubElement(frame, "Datums", n=str(len(some)))
        for name, precedence in zip(some, _PRECEDENCE, strict=False):
            one = SubElement(datums, "Datum")
            simple = SubElement(one, "SimpleDatum")
            text(simple, "DatumDefinitionId", ids.of("datum", name))
            text(simple, "MaterialModifier", "NONE")
            text(simple, "ReferencedComponent", "ACTUAL")
            text(SubElement(one, "Precedence"), "PrecedenceEnum", precedence)


def _label(k: int) -> str:
    """Return A, B ... Z, AA, AB ... (ISO 5459)."""
    return (chr(ord("A") + k // 26 - 1) if k >= 26 else "") + chr(ord("A") + k % 26)


def _devices(root: Element, ids: Ids, found: RunResults) -> None:
    devices = SubElement(SubElement(root, "MeasurementResources"), "MeasurementDevices", n="1")
    device = SubElement(devices, "MeasurementDevice", id=ids.new("device", ""))
    text(device, "Name", found.sensor)
    how = "rendered" if found.source == "render" else "drawn from its performance map"
    text(device, "Description", f"3D vision sensor, simulated: virtual measurements {how}")


def _features(root: Element, ids: Ids, found: RunResults) -> None:
    features, task = SubElement(root, "Features"), found.task
    count = str(len(task.features))
    definitions, nominals, items = (
        SubElement(features, f"Feature{tag}", n=count) for tag in ("Definitions", "Nominals", "Items")
    )
    for name, feature in task.features.items():
        nominal, number = task.nominal(name), ids.new("definition", name)
        feature_definition(definitions, number, feature.kind, nominal)
        feature_nominal(nominals, ids.of("nominal", name), name, feature.kind, nominal, number)
        tag = nominals[-1].tag.replace("Nominal", "Item")
        item = SubElement(items, tag, id=ids.new("item", name))
        text(item, "FeatureNominalId", ids.of("nominal", name))
        text(item, "FeatureName", name)
        SubElement(SubElement(item, "DeterminationMode"), "Checked")


def _characteristics(root: Element, ids: Ids, found: RunResults) -> None:
    task, count = found.task, str(len(found.task.measurements))
    out = SubElement(root, "Characteristics")
    text(out, "FormalStandardId", ids.of("standard", ""))
    definitions, nominals, items = (
        SubElement(out, f"Characteristic{tag}", n=count) for tag in ("Definitions", "Nominals", "Items")
    )
    for name, asked in task.measurements.items():
        kind = characteristic(task, asked)
        definition = SubElement(
            definitions, f"{kind}CharacteristicDefinition", id=ids.new("characteristic definition", name)
        )
        text(definition, "Name", name)
        if kind in GEOMETRIC:
            zone(definition, kind, task, asked, ids.of("frame", name) if _datums_of(asked) else None)
        else:
            tolerance(definition, kind, asked, asked.kind)
        nominal = SubElement(nominals, f"{kind}CharacteristicNominal", id=ids.new("characteristic nominal", name))
        text(nominal, "Description", asked.kind)
        text(nominal, "CharacteristicDefinitionId", ids.of("characteristic definition", name))
        measured = asked.features[:1] if _datums_of(asked) else asked.features
        references(nominal, "FeatureNominalIds", [ids.of("nominal", one) for one in measured])
        text(nominal, "Name", name)
        if kind not in GEOMETRIC:
            text(nominal, "TargetValue", float(asked.nominal))
        if kind in ("DistanceBetween", "AngleBetween"):
            text(nominal, "AnalysisMode", "THREEDIMENSIONAL")
        item = SubElement(items, f"{kind}CharacteristicItem", id=ids.new("characteristic", name))
        text(item, "Name", name)
        references(item, "FeatureItemIds", [ids.of("item", one) for one in measured])
        references(item, "MeasurementDeviceIds", [ids.of("device", "")])
        text(item, "CharacteristicNominalId", ids.of("characteristic nominal", name))


def _plan(root: Element, ids: Ids, found: RunResults) -> None:
    """Write a step for each view; its pose is a readable instruction and a transform for computation."""
    plan = SubElement(root, "Plan")
    instructions = SubElement(plan, "WorkInstructions", n=str(len(found.plan)))
    steps = SubElement(SubElement(plan, "OrderedPlanRoot"), "Steps", n=str(len(found.plan)))
    for order, (number, pose, names) in enumerate(found.plan, 1):
        instruction = SubElement(instructions, "TextInstruction", id=ids.new("instruction", str(number)))
        place = ", ".join(decimal(round(float(value), 6)) for value in pose.translation)
        text(
            instruction,
            "TextInstruction",
            (
                f"Move {found.sensor} to view {number}: the origin of its frame to {place} mm in the part frame, "
                f"rotated by transform {ids.of('transform', str(number))} (x right, y down, z forward). Capture once."
            ),
        )
        step = SubElement(steps, "NumberedPlanElement")
        text(step, "SequenceNumber", order)
        measure = SubElement(step, "MeasureEvaluateSpecified")
        references(measure, "WorkInstructionIds", [ids.of("instruction", str(number))])
        attributes(measure, {"view": number, "part_from_sensor_transform_id": int(ids.of("transform", str(number)))})
        references(measure, "PreferredResourceIds", [ids.of("device", "")])
        references(measure, "CharacteristicItemIds", [ids.of("characteristic", name) for name in names])


def _results(root: Element, ids: Ids, found: RunResults) -> None:
    sets = SubElement(SubElement(root, "Results"), "MeasurementResultsSet", n="1")
    results = SubElement(sets, "MeasurementResults", id=ids.new("results", ""))
    attributes(results, {"virtual": "expectation for a perfect part; no part was inspected", "study": found.study})
    measured = SubElement(
        SubElement(results, "MeasuredCharacteristics"), "CharacteristicMeasurements", n=str(len(found.results))
    )
    for one in found.results:
        _measurement(measured, ids, found, one)
    text(SubElement(results, "InspectionStatus"), "InspectionStatusEnum", "NOT_CALCULATED")


def _measurement(parent: Element, ids: Ids, found: RunResults, one: Result) -> None:
    kind = characteristic(found.task, found.task.measurements[one.measurement])
    out = SubElement(parent, f"{kind}CharacteristicMeasurement", id=ids.new("measurement", one.measurement))
    numbers = {"bias": one.bias, "bias_uncertainty": one.bias_uncertainty, "low_95": one.low, "high_95": one.high}
    known: dict[str, str | float | int] = {name: value for name, value in numbers.items() if value is not None}
    attributes(
        out,
        known
        | {
            "view": one.view,
            "trials": one.trials,
            "without_value": float(one.without_value),
            "verdict": one.verdict,
        },
    )
    text(SubElement(out, "Status"), "CharacteristicStatusEnum", "NOT_ANALYZED")
    text(out, "CharacteristicItemId", ids.of("characteristic", one.measurement))
    references(out, "MeasurementDeviceIds", [ids.of("device", "")])
    if one.expected is not None and one.uncertainty is not None and one.bias is not None:
        errors = {"combinedUncertainty": decimal(one.uncertainty), "meanError": decimal(abs(one.bias))}
        text(out, "Value", float(one.expected), errors)
