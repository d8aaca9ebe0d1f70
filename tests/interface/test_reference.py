"""The page of the interface: it lists all public names and no other, and its example runs."""

import ast
import inspect
import re
import sys
from pathlib import Path

import pytest

import characterisation
import mitsim

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "docs" / "site"))

from interface_pages import PAGE as PATH
from interface_pages import members, tables

PAGE = PATH.read_text(encoding="utf-8")


def listed(heading: str) -> set[str]:
    """Names in the first column of the tables under a heading."""
    part = PAGE.split(f"\n## {heading}\n")[1].split("\n## ")[0]
    cells = re.findall(r"^\| `([^`]+)`", part, re.MULTILINE)
    return {re.split(r"[(: ]", cell)[0] for cell in cells}


def test_the_page_lists_what_is_public_and_nothing_else():
    for package, short in ((mitsim, "ms"), (characterisation, "characterisation")):
        names = {
            name.removeprefix(f"{short}.") for name in listed(f"`{package.__name__}`") if name.startswith(f"{short}.")
        }
        assert names == set(package.__all__)


def signatures(heading: str) -> dict[str, str]:
    """Parameters, as the first column states them, by the name before the bracket."""
    part = PAGE.split(f"\n## {heading}\n")[1].split("\n## ")[0]
    return dict(re.findall(r"^\| `([\w.]+)\((.*?)\)` \|", part, re.MULTILINE))


def stated(parameters: str) -> list[tuple[str, bool, object]]:
    """Name, whether by keyword alone, and default of each; ``...`` is a default that the page leaves out."""
    arguments = ast.parse(f"def f({parameters}): pass").body[0].args
    first = [inspect.Parameter.empty] * (len(arguments.args) - len(arguments.defaults))
    defaults = first + [ast.literal_eval(one) for one in arguments.defaults]
    plain = [(one.arg, False, default) for one, default in zip(arguments.args, defaults, strict=True)]
    named = zip(arguments.kwonlyargs, arguments.kw_defaults, strict=True)
    return plain + [(one.arg, True, ast.literal_eval(default)) for one, default in named]


def test_every_parameter_of_every_function_is_listed_with_its_default():
    for package, short in ((mitsim, "ms"), (characterisation, "characterisation")):
        found = signatures(f"`{package.__name__}`")
        functions = {f"{short}.{name}" for name in package.__all__ if inspect.isfunction(getattr(package, name))}
        assert functions <= set(found)
        for name, parameters in found.items():
            owner, _, member = name.removeprefix(f"{short}.").partition(".")
            one = getattr(package, owner)
            if member:
                one = getattr(one, member)
            true = [
                (each.name, each.kind is each.KEYWORD_ONLY, each.default)
                for each in inspect.signature(one).parameters.values()
                if each.name != "self"
            ]
            page = stated(parameters)
            assert [row[:2] for row in page] == [row[:2] for row in true], name
            assert all(said in (..., default) for (*_, said), (*_, default) in zip(page, true, strict=True)), name


@pytest.mark.parametrize("package", [mitsim, characterisation], ids=lambda package: package.__name__)
def test_methods_and_no_others_are_listed_with_brackets(package):
    rows = [row for heading, every in tables(package.__name__) if heading == "Types" for row in every]
    for cell, told in rows:
        one = getattr(package, re.split(r"[`(: ]", cell.strip("`"))[0].rpartition(".")[2])
        for name, brackets in re.findall(r"`([a-z]\w*)(\([^`]*\))?`", told):
            assert callable(getattr(one, name, None)) == bool(brackets), (cell, name)


@pytest.mark.parametrize("package", [mitsim, characterisation], ids=lambda package: package.__name__)
def test_every_member_that_is_listed_is_there(package):
    types = [rows for heading, rows in tables(package.__name__) if heading == "Types"]
    promised = {owner: names for rows in types for owner, names in members(rows).items()}
    assert {"PointCloud", "PerformanceMap"} <= set(promised)
    for owner, names in promised.items():
        one = getattr(package, owner)
        for name in names:
            fields = getattr(one, "__dataclass_fields__", {}) | getattr(one, "model_fields", {})
            assert hasattr(one, name) or name in fields, (owner, name)


def test_the_examples_run(workplace):
    examples = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    names: dict[str, object] = {}
    for example in examples:
        exec(example, names)
    assert names["found"]["pillar1_pillar2_distance"].possible
    assert names["on_plane"].sum() > 1000
