"""Shared functions of four or more arguments document each argument, and sections See Also name what exists.

A function is shared if the interface promises it or another room uses its name; a room is ``mitsim.X`` or
``characterisation.X``. Any section Parameters is complete.

Constants of modules and classes stand on a line each, so that each has a comment of its own. griffe reads signatures
and numpydoc sections from the source, as it does for the site.
"""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import griffe
import pytest

import characterisation
import mitsim

ROOT = Path(__file__).parents[2]

#: least number of arguments, without self, of a shared function that must have a section Parameters
LEAST = 4

#: the commands: their options are documented by ``--help``
COMMANDS = "mitsim.cli"


@pytest.fixture(scope="module", params=["mitsim", "characterisation"])
def package(request):
    loaded = griffe.load(request.param, search_paths=[ROOT], docstring_parser="numpy", allow_inspection=False)
    assert Path(loaded.filepath).is_relative_to(ROOT)
    return loaded


def functions(holder: griffe.Module | griffe.Class) -> Iterator[griffe.Function]:
    for member in holder.members.values():
        if member.is_alias or member.path == COMMANDS:
            continue
        if member.is_function and not member.name.startswith("_"):
            yield member
        elif member.is_module or (member.is_class and not member.name.startswith("_")):
            yield from functions(member)


def arguments(function: griffe.Function) -> list[str]:
    names = [parameter.name for parameter in function.parameters]
    bound = function.parent.is_class and "staticmethod" not in function.labels
    return names[1:] if bound else names


def names_of(function: griffe.Function) -> dict[str, list[str]]:
    out: dict[str, list[str]] = {}
    for section in function.docstring.parse("numpy", warnings=False) if function.docstring else []:
        if section.kind is griffe.DocstringSectionKind.parameters:
            out["Parameters"] = [parameter.name.lstrip("*") for parameter in section.value]
        elif section.kind is griffe.DocstringSectionKind.admonition and section.title == "See Also":
            entries = re.findall(r"^(\S.*?)(?: : .*)?$", section.value.contents, flags=re.M)
            out["See Also"] = [name.strip() for entry in entries for name in entry.split(",")]
    return out


def names_used(source: str) -> set[str]:
    """Return all names that a module reads, imports or takes from an object."""
    nodes = list(ast.walk(ast.parse(source)))
    return {one.id for one in nodes if isinstance(one, ast.Name)} | {
        one.attr if isinstance(one, ast.Attribute) else one.name
        for one in nodes
        if isinstance(one, ast.Attribute | ast.alias)
    }


@pytest.fixture(scope="module")
def users() -> dict[str, set[str]]:
    """The rooms that use each name."""
    out: dict[str, set[str]] = {}
    for path in (path for top in ("mitsim", "characterisation") for path in (ROOT / top).rglob("*.py")):
        for name in names_used(path.read_text(encoding="utf-8")):
            out.setdefault(name, set()).add(room(path.relative_to(ROOT).with_suffix("").as_posix().replace("/", ".")))
    return out


def room(path: str) -> str:
    return ".".join(path.split(".")[:2])


def shared(function: griffe.Function, users: dict[str, set[str]]) -> bool:
    """Return whether a function, or the class of a method, is promised, or another room uses its name."""
    promised = {*mitsim.__all__, *characterisation.__all__}
    names = {function.name, function.parent.name} if function.parent.is_class else {function.name}
    return bool(names & promised) or bool(users.get(function.name, set()) - {room(function.path)})


def fault(names: list[str], documented: list[str] | None, needed: bool = True) -> str:
    """Return the difference of a section Parameters from the signature, "" for none."""
    if documented is None:
        return f"no section Parameters, {len(names)} arguments" if needed and len(names) >= LEAST else ""
    missing = [name for name in names if name not in documented]
    unknown = [name for name in documented if name not in names]
    parts = [f"not documented: {', '.join(missing)}"] * bool(missing)
    parts += [f"not in the signature: {', '.join(unknown)}"] * bool(unknown)
    return "; ".join(parts)


def test_parameters_are_those_of_the_signature(package, users):
    every = list(functions(package))
    needed = {one.path for one in every if shared(one, users)}
    assert any(len(arguments(one)) >= LEAST for one in every if one.path in needed)
    documented = {one.path: names_of(one).get("Parameters") for one in every}
    found = [(one.path, fault(arguments(one), documented[one.path], one.path in needed)) for one in every]
    faults = [f"{path}: {words}" for path, words in found if words]
    assert not faults, "\n" + "\n".join(faults)


def test_see_also_names_what_exists(package):
    faults = []
    for one in functions(package):
        for name in names_of(one).get("See Also", []):
            inside = [one.parent, one.module]
            if not any(name in holder.members for holder in inside) and not exists(package, name):
                faults.append(f"{one.path}: {name}")
    assert not faults, "\n" + "\n".join(faults)


def exists(package: griffe.Module, path: str) -> bool:
    top, _, rest = path.partition(".")
    if top != package.name:
        return bool(rest) and (ROOT / top).is_dir()  # of the other package
    try:
        package[rest]
    except KeyError:
        return False
    return True


@pytest.mark.parametrize(
    ("signature", "documented", "expected"),
    [
        ("a, b, c, d", ["a, b", "c", "d"], ""),
        ("a, b, *c, d, **e", ["a", "b", "*c", "d", "**e"], ""),
        ("a, b, c", [], ""),
        ("a, b, c, d", [], "no section Parameters, 4 arguments"),
        ("a, b, c, d", ["a", "b", "d"], "not documented: c"),
        ("a, b", ["a", "bb"], "not documented: b; not in the signature: bb"),
    ],
)
def test_faults_are_found(signature, documented, expected):
    lines = ["Parameters", "----------", *(f"{names}\n        Meaning." for names in documented)] if documented else []
    docstring = "\n    ".join(["Return a number.", "", *lines, ""])
    module = griffe.visit("example", Path("example.py"), f'def one({signature}):\n    """{docstring}"""\n')
    one = module["one"]
    assert fault(arguments(one), names_of(one).get("Parameters")) == expected


@pytest.mark.parametrize(
    ("user", "needed"),
    [("from package.one import f", True), ("from package import one\n\none.f()", True), ("def f(): ...", False)],
)
def test_functions_of_other_rooms_are_shared(user, needed):
    module = griffe.visit("package.one", Path("one.py"), "def f(a, b, c, d): ...")
    assert shared(module["f"], {name: {"package.two"} for name in names_used(user)}) == needed
    assert not shared(module["f"], {name: {"package.one"} for name in names_used(user)})


def packed_constants(source: str) -> list[str]:
    """Return the assignments of a module and its classes that give several names their values at once."""
    bodies = [one.body for one in ast.walk(ast.parse(source)) if isinstance(one, ast.Module | ast.ClassDef)]
    assignments = [one for body in bodies for one in body if isinstance(one, ast.Assign)]
    return [
        ast.unparse(one)
        for one in assignments
        if len(one.targets) > 1 or (isinstance(one.targets[0], ast.Tuple) and isinstance(one.value, ast.Tuple))
    ]


def test_each_constant_has_a_line_of_its_own():
    files = [path for package in ("mitsim", "characterisation") for path in (ROOT / package).rglob("*.py")]
    assert len(files) > 500
    found = {str(path.relative_to(ROOT)): packed_constants(path.read_text(encoding="utf-8")) for path in files}
    faults = [f"{path}: {line}" for path, lines in found.items() for line in lines]
    assert not faults, "one constant a line, each below a comment:\n" + "\n".join(faults)


@pytest.mark.parametrize(
    ("source", "count"),
    [
        ("_STEPS, _MOST = 12, 5", 1),
        ("class A:\n    low, high = 0, 1", 1),
        ("low = high = 0", 1),
        ("_ENDS = 0, 1", 0),
        ("_NODES, _WEIGHTS = quadrature(96)", 0),
        ("def f():\n    low, high = 0, 1", 0),
    ],
)
def test_packed_constants_are_found(source, count):
    assert len(packed_constants(source)) == count
