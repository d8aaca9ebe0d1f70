"""What mitsim brings in: licences on the list, versions that are bounded, and no import of what is not asked for."""

import ast
import importlib.metadata
import importlib.util
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]

#: what is imported where it is found, and asked for nowhere: vendors' SDKs, and packages of the same name as ours
OF_OTHERS = {"nxlib", "mitsim", "characterisation"}

#: packages that belong to one which is asked for, and come in the version that it wants
PART_OF = {"dask": "distributed", "markupsafe": "jinja2", "pydantic_core": "pydantic"}


def script(name):
    spec = importlib.util.spec_from_file_location(name, ROOT / ".ci" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def licences():
    return script("licences")


@pytest.fixture(scope="module")
def versions():
    return script("versions")


def test_every_licence_may_come_in(licences):
    assert len(licences.closure()) > 30
    assert licences.refused() == {}


def test_the_page_names_every_package(licences):
    page = (ROOT / "docs/reference/licences.md").read_text(encoding="utf-8")
    assert page.startswith(licences.PAGE)
    named = {name for row in re.findall(r"^\| .* \| (.*) \|$", page, re.MULTILINE) for name in row.split(", ")}
    missing = licences.closure().keys() - named
    assert not missing, "python .ci/licences.py > docs/reference/licences.md"


@pytest.mark.parametrize(
    ("expression", "allowed"),
    [
        ("MIT", True),
        ("GPL-3.0-only", False),
        ("MIT OR GPL-3.0-only", True),
        ("GPL-2.0-only OR Apache-2.0", True),
        ("MIT AND GPL-3.0-only", False),
        ("(MIT OR Apache-2.0) AND Zlib", True),
        ("CC-BY-NC-4.0", False),
        ("LGPL-2.1-only", False),
        ("", False),
        ("Proprietary", False),
    ],
)
def test_expressions_are_judged_by_all_that_they_ask_for(licences, expression, allowed):
    assert (not licences.parts(expression) - licences.ALLOWED) is allowed


def test_every_dependency_has_a_lowest_version_and_the_renderer_an_exact_one(versions):
    pins = [versions.lowest(one) for one in versions.requirements()]
    assert {"mitsuba==3.9.1", "drjit==1.5.0"} <= set(pins)
    exact = [one for one in versions.requirements() if "==" in one.partition(";")[0]]
    assert sorted(versions.name_of(one) for one in exact) == ["drjit", "mitsuba"]
    assert versions.lowest("karellen-llvm-core>=23.1.3,<24; platform_system == 'Linux'") == (
        "karellen-llvm-core==23.1.3; platform_system == 'Linux'"
    )
    with pytest.raises(SystemExit, match="no lowest version"):
        versions.lowest("numpy<3")


def statements(parent: ast.AST) -> Iterator[ast.AST]:
    """All statements inside a part of a program, but not their expressions, which import nothing."""
    for node in ast.iter_child_nodes(parent):
        if isinstance(node, (ast.stmt, ast.excepthandler, ast.match_case)):
            yield node
            yield from statements(node)


def test_nothing_is_imported_that_is_not_asked_for(versions):
    asked = {versions.name_of(one) for one in versions.requirements()}
    for name, whole in PART_OF.items():
        needed = importlib.metadata.requires(whole) or []
        assert whole in asked and versions.name_of(name) in map(versions.name_of, needed)
    owners = importlib.metadata.packages_distributions()
    unasked = {}
    for path in [*(ROOT / "mitsim").rglob("*.py"), *(ROOT / "characterisation").rglob("*.py")]:
        for node in statements(ast.parse(path.read_text(encoding="utf-8"))):
            names = [one.name for one in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and node.level == 0:
                names = [node.module]
            for name in {one.partition(".")[0] for one in names} - sys.stdlib_module_names - OF_OTHERS - PART_OF.keys():
                if not asked & {versions.name_of(owner) for owner in owners.get(name, [name])}:
                    unasked.setdefault(name, path.relative_to(ROOT).as_posix())
    assert unasked == {}


def test_the_root_of_the_repository_holds_text_only():
    """Wheels were left there once."""
    listed = subprocess.run(["git", "-C", ROOT, "ls-files", "-z"], capture_output=True, text=True, check=False)
    if listed.returncode:
        pytest.skip("not in a git clone")
    names = [name for name in listed.stdout.split("\0") if name and "/" not in name]
    assert "pyproject.toml" in names
    assert [name for name in names if b"\0" in (ROOT / name).read_bytes()] == []
