"""Public functions of four or more arguments document each of them, and name functions that exist.

griffe reads signatures and numpydoc sections from the source, as it does for the site.
"""

import re
from collections.abc import Iterator
from pathlib import Path

import griffe
import pytest

ROOT = Path(__file__).parents[2]

#: number of arguments, without self, from which on a function has a section ``Parameters``
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


def sections(docstring: str | None, signature: str = "") -> dict[str, list[str]]:
    """Return the names of the sections Parameters and See Also, as griffe reads them."""
    module = griffe.visit("example", Path("example.py"), f'def one({signature}):\n    """{docstring}"""\n')
    return names_of(module["one"])


def names_of(function: griffe.Function) -> dict[str, list[str]]:
    out: dict[str, list[str]] = {}
    for section in function.docstring.parse("numpy", warnings=False) if function.docstring else []:
        if section.kind is griffe.DocstringSectionKind.parameters:
            out["Parameters"] = [parameter.name.lstrip("*") for parameter in section.value]
        elif section.kind is griffe.DocstringSectionKind.admonition and section.title == "See Also":
            entries = re.findall(r"^(\S.*?)(?: : .*)?$", section.value.contents, flags=re.M)
            out["See Also"] = [name.strip() for entry in entries for name in entry.split(",")]
    return out


def fault(names: list[str], documented: list[str] | None) -> str:
    """Return the difference of a section Parameters from the signature, "" for none."""
    if documented is None:
        return f"no section Parameters, {len(names)} arguments" if len(names) >= LEAST else ""
    if documented == names:
        return ""
    missing = [name for name in names if name not in documented]
    unknown = [name for name in documented if name not in names]
    parts = [f"not documented: {', '.join(missing)}"] * bool(missing)
    parts += [f"not in the signature: {', '.join(unknown)}"] * bool(unknown)
    return "; ".join(parts) or f"another order than the signature: {', '.join(documented)}"


def test_parameters_are_those_of_the_signature(package):
    every = list(functions(package))
    assert any(len(arguments(function)) >= LEAST for function in every)
    found = [(one.path, fault(arguments(one), names_of(one).get("Parameters"))) for one in every]
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
