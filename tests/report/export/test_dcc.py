"""The digital calibration certificate: elements in PTB's order, numbers in D-SI's form and those of the statement."""

import re
from dataclasses import replace

import pytest

from characterisation.files.errors import InputError
from characterisation.statements.verdict_words import Reason
from mitsim.report.declaration import Declaration, Note
from mitsim.report.export.dcc import DCC, SI, Issuer, write_dcc
from mitsim.report.first_screen import FirstScreen
from tests.report.export.test_export_command import export
from tests.report.export.test_results import FOLDER, every_kind  # noqa: F401

etree = pytest.importorskip("lxml.etree")

#: PTB's schema, which is LGPL-3.0 and no part of this repository: dcc.xsd with the files it imports beside it
SCHEMA = FOLDER / "dcc" / "dcc.xsd"

ISSUER = Issuer("Laboratory & co", "GB", "A. Person", "Customer", "SN 12")

#: children that DCC 3.2.1 and D-SI 2.1.0 allow in elements that mitsim writes, in their order: ``?`` may be absent,
#: ``+`` and ``*`` repeat
GRAMMAR = {
    "digitalCalibrationCertificate": "administrativeData measurementResults",
    "coreData": "countryCodeISO3166_1 usedLangCodeISO639_1+ mandatoryLangCodeISO639_1+ uniqueIdentifier "
    "identifications? beginPerformanceDate endPerformanceDate performanceLocation",
    "dccSoftware": "software+",
    "usedSoftware": "software+",
    "software": "name release",
    "items": "item+",
    "item": "name model? identifications",
    "identifications": "identification+",
    "identification": "issuer value name?",
    "calibrationLaboratory": "contact",
    "contact": "name location",
    "customer": "name location",
    "location": "countryCode? further?",
    "further": "content+",
    "respPersons": "respPerson+",
    "respPerson": "person mainSigner?",
    "person": "name",
    "statements": "statement+",
    "statement": "name? traceable? declaration?",
    "declaration": "content+",
    "description": "content+",
    "noQuantity": "content+",
    "name": "content+",
    "measurementResults": "measurementResult+",
    "measurementResult": "name usedMethods? usedSoftware? measuringEquipments? influenceConditions? results",
    "usedMethods": "usedMethod+",
    "usedMethod": "name description? norm*",
    "measuringEquipments": "measuringEquipment+",
    "measuringEquipment": "name identifications?",
    "results": "result+",
    "result": "name description? data",
    "influenceConditions": "influenceCondition+",
    "influenceCondition": "name description? data",
    "text": "content+",
    "data": "text* list*",
    "list": "quantity+",
    "real": "value unit expandedUnc? coverageInterval?",
    "expandedUnc": "uncertainty coverageFactor coverageProbability",
    "coverageInterval": "standardUnc intervalMin intervalMax coverageProbability",
}

#: the form of texts, by element: XML schema's date, and the patterns of D-SI
NUMBER = r"[-+]?(\d*\.\d+|\d+\.\d*|\d+)([Ee][-+]?\d+)?"
FORMS = {
    "beginPerformanceDate": r"\d{4}-\d\d-\d\d",
    "endPerformanceDate": r"\d{4}-\d\d-\d\d",
    "release": r"[A-Za-z] ?(\d{1,3}\.){0,3}\d{1,3}",
    "performanceLocation": "laboratory|customer|laboratoryBranch|customerBranch|other",
    "issuer": "manufacturer|calibrationLaboratory|customer|owner|other",
    "countryCode": "[A-Z]{2}",
    "countryCodeISO3166_1": "[A-Z]{2}",
    "uncertainty": NUMBER.removeprefix("[-+]?"),
    "standardUnc": NUMBER.removeprefix("[-+]?"),
    "intervalMin": NUMBER,
    "intervalMax": NUMBER,
    "coverageFactor": r"[1-9]\d*\.\d*|[1-9]\d*",
    "coverageProbability": r"0(\.\d*)?|1",
    "unit": r"\\milli\\metre|\\degree|\\one",
}


def declared():
    first = FirstScreen([Reason("fits")], "good")
    facts = [("Varied", "pose"), ("Left out", "coatings"), ("Exposure", ""), ("Decision rule", "simple acceptance")]
    return Declaration(
        "sensor measures part", "2026-11-27", "0123456789abcdef", first, [], facts, [Note("Error = a − b.")]
    )


@pytest.fixture(scope="module")
def document(every_kind, tmp_path_factory):  # noqa: F811
    path = tmp_path_factory.mktemp("dcc") / "all.xml"
    write_dcc(every_kind, declared(), ISSUER, path)
    return etree.parse(path)


def tag(element):
    return etree.QName(element).localname


def test_elements_stand_in_the_order_of_the_schema(document):
    seen = set()
    for element in document.iter():
        children = "".join(f"{tag(child)} " for child in element)
        seen.add(tag(element))
        of_si = {"real"} & {tag(one) for one in (element, *element.iterancestors())}
        assert etree.QName(element).namespace == (SI if of_si else DCC)
        if tag(element) in ("administrativeData", "quantity"):  # any order; a name, then one of several
            continue
        rule = GRAMMAR.get(tag(element), "")
        pattern = "".join(f"({name.rstrip('?+*')} ){name[-1] if name[-1] in '?+*' else ''}" for name in rule.split())
        assert re.fullmatch(pattern, children), (tag(element), children)
        if not rule:
            assert element.text and element.text == " ".join(element.text.split()), tag(element)
    assert set(GRAMMAR) <= seen


def test_texts_have_the_form_that_the_schema_asks_for(document):
    for element in document.iter():
        if form := FORMS.get(tag(element)):
            assert re.fullmatch(form, element.text), (tag(element), element.text)


def test_the_document_is_valid_against_ptbs_schema(document):
    if not SCHEMA.is_file():
        pytest.skip(f"no {SCHEMA}: PTB's schema is LGPL-3.0 and not part of mitsim")
    schema = etree.XMLSchema(etree.parse(SCHEMA))
    assert schema.validate(document), schema.error_log


def test_numbers_are_those_of_the_statement(document, every_kind):  # noqa: F811
    results = document.findall(f".//{{{DCC}}}result")
    assert len(results) == len(every_kind.results)
    for element, one in zip(results, every_kind.results, strict=True):
        numbers = {
            quantity.find("{*}name/{*}content").text: float(quantity.find("{*}real/{*}value").text)
            for quantity in element.iter(f"{{{DCC}}}quantity")
            if quantity.find("{*}real") is not None
        }
        assert numbers["nominal value"] == one.nominal and numbers["number of virtual measurements"] == one.trials
        assert numbers.get("tolerance, upper deviation") == (0.1 if one.tolerance else None)
        assert numbers.get("error, measured less true") == one.bias
        interval, expanded = element.find(".//{*}coverageInterval"), element.find(".//{*}expandedUnc")
        assert (interval is None) == (one.bias is None) == (expanded is None)
        if interval is not None:
            assert [float(child.text) for child in interval] == [1e-9, -1, 1, 0.95]
            assert [float(child.text) for child in expanded] == [
                1.25,
                1.25e9,
                0.95,
            ]  # from the bias, -0.25, to the farther end


@pytest.mark.parametrize(
    ("nominal", "tolerance", "deviations"),
    [
        (12.5, (-0.2, 0.1), {"lower deviation": -0.2, "upper deviation": 0.1}),
        (0.1, (-0.1, 0.3), {"upper deviation": 0.3}),  # no value is below 0
        (0.1, 0.1, {"upper deviation": 0.1}),
        (0.0, 0.1, {"upper deviation": 0.1}),
    ],
)
def test_a_lower_limit_without_an_effect_is_none(every_kind, tmp_path, nominal, tolerance, deviations):  # noqa: F811
    result = replace(every_kind.results[0], nominal=nominal, tolerance=tolerance)
    write_dcc(replace(every_kind, results=[result]), declared(), ISSUER, tmp_path / "dcc.xml")
    found = {
        quantity.find("{*}name/{*}content").text: float(quantity.find("{*}real/{*}value").text)
        for quantity in etree.parse(tmp_path / "dcc.xml").iter(f"{{{DCC}}}quantity")
        if quantity.find("{*}name/{*}content").text.startswith("tolerance")
    }
    assert found == {f"tolerance, {name}": value for name, value in deviations.items()}


@pytest.mark.parametrize(
    ("tolerance", "accepted", "written"),
    [
        (0.1, (12.46, 12.54), {"accepted readings, lowest": "12.46", "accepted readings, highest": "12.54"}),
        (0.1, (None, 0.07), {"accepted readings, highest": "0.07"}),  # a zone
        (0.1, (None, None), {"accepted readings": "none"}),
        (None, (None, None), {}),
    ],
)
def test_the_accepted_readings_are_those_of_the_statement(every_kind, tmp_path, tolerance, accepted, written):  # noqa: F811
    low, high = accepted
    result = replace(every_kind.results[0], tolerance=tolerance, accepted_low=low, accepted_high=high)
    write_dcc(replace(every_kind, results=[result]), declared(), ISSUER, tmp_path / "dcc.xml")
    names = etree.parse(tmp_path / "dcc.xml").findall(f".//{{{DCC}}}quantity/{{{DCC}}}name/{{{DCC}}}content")
    found = {name.text: name.getparent().getnext() for name in names if name.text.startswith("accepted")}
    assert {name: "".join(value[0].itertext()).strip() for name, value in found.items()} == written


def test_the_country_is_the_laboratorys_alone(document):
    countries = [one.getparent().getparent().getparent() for one in document.iter(f"{{{DCC}}}countryCode")]
    assert [tag(one) for one in countries] == ["calibrationLaboratory"]


def test_the_document_says_that_it_is_no_calibration(document):
    statements = document.findall(f".//{{{DCC}}}statement")
    assert statements[0].find("{*}traceable").text == "false" and "no calibration" in statements[0][1][0].text
    assert [one.find("{*}name/{*}content").text for one in statements[1:]] == ["Decision rule"]


@pytest.mark.parametrize("influences", [[("Varied", "pose"), ("Left out", "coatings")], []])
def test_every_result_has_methods_and_conditions(every_kind, tmp_path, influences):  # noqa: F811
    """PTB's rules: a result without either is *unacceptable*. Before, influences were statements, and no conditions."""
    facts = [("Decision rule", "simple acceptance"), *influences]
    write_dcc(every_kind, replace(declared(), facts=facts), ISSUER, tmp_path / "dcc.xml")
    (result,) = etree.parse(tmp_path / "dcc.xml").findall(f".//{{{DCC}}}measurementResult")
    assert result.find("{*}usedMethods/{*}usedMethod") is not None
    conditions = result.findall("{*}influenceConditions/{*}influenceCondition")
    found = [(one.find("{*}name/{*}content").text, one.find("{*}data/{*}text/{*}content").text) for one in conditions]
    assert found == (influences or [("Varied", "\N{EN DASH}")])


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"laboratory": " "}, "--laboratory"),
        ({"country": "Germany"}, "--country"),
        ({"serial": "SN\x0112"}, "--serial"),
    ],
)
def test_an_issuer_is_named(change, field):
    with pytest.raises(InputError, match=field):
        Issuer(**{**ISSUER.__dict__, **change})


def test_the_command_asks_who_issues_and_writes_nothing(tmp_path):
    from tests.report.export.test_results import TASK, with_names_of_tasks, write_expecting_run

    folder = with_names_of_tasks(write_expecting_run(tmp_path / "run"))
    (tmp_path / "task.toml").write_text(TASK)
    asked = ["results", folder, "--task", tmp_path / "task.toml", "-o", tmp_path / "out.xml"]
    with pytest.raises(InputError, match="--laboratory, --country, --responsible, --customer, --serial"):
        export(*asked)
    assert not (tmp_path / "out.xml").exists()
    export(*asked, "--laboratory", "L", "--country", "GB", "--responsible", "P", "--customer", "C", "--serial", "1")
    read = etree.parse(tmp_path / "out.xml")
    assert read.find(f".//{{{DCC}}}measuringEquipment//{{{DCC}}}value").text == "1"
