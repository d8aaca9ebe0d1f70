"""Write the statement of a run as a digital calibration certificate: DCC 3.2.1 of PTB, numbers after D-SI 2.1.0.

Signal chain: results of a run, who issues them -> administrative data, influences, then for each measurement its
nominal value, error of the stated part with u and 95 % interval, its expected reading with U and k, accepted readings,
number of virtual measurements, verdict -> one document.

The elements are those of PTB's schema (https://ptb.de/dcc/v3.2.1/dcc.xsd), which is LGPL-3.0 and no part of mitsim.
PTB's Schematron rules, in its package dcclib, also ask for conditions of influence and a letter before a version. The
document calls itself simulated and not traceable: it is the statement of a virtual experiment in the form that programs
for certificates read, and no calibration. The laboratory signs it, mitsim does not.
"""

from __future__ import annotations

import uuid
from dataclasses import dataclass, fields
from pathlib import Path
from xml.etree.ElementTree import Element, ElementTree, SubElement, indent, register_namespace

from characterisation.files.atomic_io import atomic_write
from characterisation.files.errors import InputError
from characterisation.statements.statement import ANY_PART
from characterisation.tasks.task_file import effective_deviations
from characterisation.words.numbers import NONE
from characterisation.words.version import __version__
from mitsim.report.declaration import INFLUENCES, VARIED, Declaration
from mitsim.report.export.results import ExpectedResult, RunResults
from mitsim.report.export.xml_text import xml_text

#: XML namespace of digital calibration certificates
DCC = "https://ptb.de/dcc"

#: XML namespace of D-SI, for numbers with units
SI = "https://ptb.de/si"

_SCHEMA = f"{DCC} https://ptb.de/dcc/v3.2.1/dcc.xsd"
_XSI = "http://www.w3.org/2001/XMLSchema-instance"

#: units of D-SI by those of a task
_UNITS = {"mm": r"\milli\metre", "deg": r"\degree"}

_NOT_TRACEABLE = (
    "Simulated: no real sensor has measured a part. The results are those of virtual measurements, and valid for the "
    "sensor, pose, part and influences stated here. They are no calibration."
)


@dataclass(frozen=True)
class Issuer:
    """Who issues a certificate: ``laboratory``, its ``country`` (ISO 3166-1, two capital letters), ``responsible``
    person, ``customer``, and the ``serial`` number of the sensor.
    """

    laboratory: str
    country: str
    responsible: str
    customer: str
    serial: str

    def __post_init__(self) -> None:
        hint = "a digital calibration certificate names its issuer"
        values = {f"--{field.name}": getattr(self, field.name) for field in fields(self)}
        if missing := [name for name, value in values.items() if not value.strip()]:
            raise InputError(", ".join(missing), "", "nothing", "a line of text for each", hint)
        for name, value in values.items():
            if not value.isprintable():  # XML has no control characters
                raise InputError(name, "", repr(value), "a line of text", hint)
        if not (len(self.country) == 2 and self.country.isascii() and self.country.isupper()):
            raise InputError("--country", "", repr(self.country), "two capital letters after ISO 3166-1: GB")


def write_dcc(run_results: RunResults, declared: Declaration, issuer: Issuer, path: str | Path) -> None:
    """Write results as one DCC document.

    Parameters
    ----------
    run_results, declared, issuer, path
        Results of a run, their declaration, who issues the certificate, and file to write.
    """
    register_namespace("dcc", DCC)
    register_namespace("si", SI)
    register_namespace("xsi", _XSI)
    root = dcc_document(run_results, declared, issuer)
    indent(root)
    with atomic_write(path) as file:
        ElementTree(root).write(file, encoding="utf-8", xml_declaration=True)


def dcc_document(run_results: RunResults, declared: Declaration, issuer: Issuer) -> Element:
    """Return the document; its identifier derives from the statement's digest and the issuer."""
    root = Element(f"{{{DCC}}}digitalCalibrationCertificate", {"schemaVersion": "3.2.1"})
    root.set(f"{{{_XSI}}}schemaLocation", _SCHEMA)
    _administrative(_add(root, "administrativeData"), run_results, declared, issuer)
    result = _add(_add(root, "measurementResults"), "measurementResult")
    _text(result, "name", "Measurement uncertainty by virtual measurements")
    _methods(result, run_results, declared)
    _software(_add(result, "usedSoftware"))
    equipment = _add(_add(result, "measuringEquipments"), "measuringEquipment")
    _text(equipment, "name", f"3D vision sensor {run_results.sensor}, simulated")
    _identified(_add(equipment, "identifications"), "owner", issuer.serial, "serial number")
    conditions = _add(result, "influenceConditions")
    for name, text in [fact for fact in declared.facts if fact[0] in INFLUENCES and fact[1]] or [(VARIED, NONE)]:
        condition = _add(conditions, "influenceCondition")
        _text(condition, "name", name)
        _text(_add(condition, "data"), "text", text)
    results = _add(result, "results")
    for expected_result in run_results.results:
        _result(results, expected_result)
    return root


def _administrative(to: Element, run_results: RunResults, declared: Declaration, issuer: Issuer) -> None:
    _software(_add(to, "dccSoftware"))
    core = _add(to, "coreData")
    _add(core, "countryCodeISO3166_1", issuer.country)
    _add(core, "usedLangCodeISO639_1", "en")
    _add(core, "mandatoryLangCodeISO639_1", "en")
    named = "/".join((declared.number, issuer.laboratory, issuer.customer, issuer.serial))
    _add(core, "uniqueIdentifier", str(uuid.uuid5(uuid.NAMESPACE_URL, f"{DCC}/{named}")))
    of_number = "calibrationLaboratory", declared.number, "first digits of the SHA-256 of statement.json"
    _identified(_add(core, "identifications"), *of_number)
    for name in ("beginPerformanceDate", "endPerformanceDate"):
        _add(core, name, declared.date)
    _add(core, "performanceLocation", "other")
    item = _add(_add(to, "items"), "item")
    _text(item, "name", f"3D vision sensor {run_results.sensor}, simulated")
    _add(item, "model", run_results.sensor)
    _identified(_add(item, "identifications"), "owner", issuer.serial, "serial number")
    laboratory = _add(_add(to, "calibrationLaboratory"), "contact")
    _text(laboratory, "name", issuer.laboratory)
    _add(_add(laboratory, "location"), "countryCode", issuer.country)
    person = _add(_add(to, "respPersons"), "respPerson")
    _text(_add(person, "person"), "name", issuer.responsible)
    _add(person, "mainSigner", "true")
    customer = _add(to, "customer")
    _text(customer, "name", issuer.customer)
    _text(_add(customer, "location"), "further", "not stated")  # DCC asks for a location, mitsim knows none
    statements = _add(to, "statements")
    simulated = _add(statements, "statement")
    _add(simulated, "traceable", "false")
    _text(simulated, "declaration", _NOT_TRACEABLE)
    for name, text in declared.facts:
        if text and name not in INFLUENCES:
            statement = _add(statements, "statement")
            _text(statement, "name", name)
            _text(statement, "declaration", text)


def _methods(to: Element, run_results: RunResults, declared: Declaration) -> None:
    used = _add(_add(to, "usedMethods"), "usedMethod", refType="basic_methodMeasurementUncertainty")
    _text(used, "name", "Simulate and analyse, a virtual experiment")
    method = "rendered and decoded" if run_results.source == "render" else "drawn from a performance map"
    words = [f"Virtual measurements {method}.", *(note.in_full for note in declared.notes)]
    _text(used, "description", " ".join(words))
    for norm in ("JCGM 101:2008", "ISO/TS 15530-4:2008"):
        _add(used, "norm", norm)


def _software(to: Element) -> None:
    software = _add(to, "software")
    _text(software, "name", "mitsim")
    _add(software, "release", f"v{__version__}")


def _result(to: Element, expected_result: ExpectedResult) -> None:
    result = _add(to, "result")
    _text(result, "name", expected_result.measurement)
    measured = f"{expected_result.kind.replace('_', ' ')} of {', '.join(expected_result.features)}"
    _text(result, "description", f"{measured}, from view {expected_result.view}")
    table = _add(_add(result, "data"), "list")
    unit = _UNITS[expected_result.unit]
    _real(_quantity(table, "nominal value", "basic_nominalValue"), expected_result.nominal, unit)
    bias, uncertainty = expected_result.bias, expected_result.uncertainty
    low, high = expected_result.error_low, expected_result.error_high
    if bias is not None and uncertainty is not None and low is not None and high is not None:
        error = _real(_quantity(table, "error, measured less true", "basic_measurementError"), bias, unit)
        interval = _si(error, "coverageInterval")
        _si(interval, "standardUnc", _number(uncertainty))
        _si(interval, "intervalMin", _number(low))
        _si(interval, "intervalMax", _number(high))
        _si(interval, "coverageProbability", "0.95")
        largest = max(bias - low, high - bias)
        if expected_result.expected is not None:
            part = "nominal part" if expected_result.errors_of == ANY_PART else expected_result.errors_of
            quantity = _quantity(table, f"expected reading of a {part}", "basic_measuredValue")
            reading = _real(quantity, expected_result.expected, unit)
            if largest >= uncertainty > 0:  # D-SI has no coverage factor below 1
                expanded = _si(reading, "expandedUnc")
                _si(expanded, "uncertainty", _number(largest))
                _si(expanded, "coverageFactor", f"{largest / uncertainty:.4f}")
                _si(expanded, "coverageProbability", "0.95")
    deviations = effective_deviations(expected_result.nominal, expected_result.tolerance) or (None, None)
    limits = {
        "tolerance, lower deviation": deviations[0],
        "tolerance, upper deviation": deviations[1],
        "accepted readings, lowest": expected_result.accepted_low,
        "accepted readings, highest": expected_result.accepted_high,
    }
    for name, value in limits.items():
        if value is not None:
            _real(_quantity(table, name), value, unit)
    if expected_result.tolerance is not None and expected_result.accepted_high is None:
        _text(_quantity(table, "accepted readings"), "noQuantity", "none")
    _real(_quantity(table, "number of virtual measurements"), float(expected_result.trials), r"\one")
    _real(_quantity(table, "share without a value"), expected_result.without_value, r"\one")
    _text(_quantity(table, "verdict on the measurement, not on a part"), "noQuantity", expected_result.verdict)


def _quantity(to: Element, name: str, reference: str = "") -> Element:
    quantity = _add(to, "quantity", **({"refType": reference} if reference else {}))
    _text(quantity, "name", name)
    return quantity


def _real(to: Element, value: float, unit: str) -> Element:
    real = _si(to, "real")
    _si(real, "value", _number(value))
    _si(real, "unit", unit)
    return real


def _number(value: float) -> str:
    """Format a number as D-SI's decimal, with all its digits."""
    return repr(float(value))


def _identified(to: Element, issuer: str, value: str, name: str) -> None:
    identification = _add(to, "identification")
    _add(identification, "issuer", issuer)
    _add(identification, "value", value)
    _text(identification, "name", name)


def _text(to: Element, tag: str, text: str) -> None:
    """Add an element with a text in English."""
    _add(_add(to, tag), "content", text, lang="en")


def _add(to: Element, tag: str, text: str = "", **attributes: str) -> Element:
    out = SubElement(to, f"{{{DCC}}}{tag}", attributes)
    out.text = xml_text(" ".join(text.split())) or None
    return out


def _si(to: Element, tag: str, text: str = "") -> Element:
    out = SubElement(to, f"{{{SI}}}{tag}")
    out.text = text or None
    return out
