"""The list of slow tests stays true: what it names exists, in order and once."""

import ast
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
LISTED = (ROOT / "tests/slow_tests.txt").read_text(encoding="utf-8").split()


def test_every_listed_test_exists():
    files: dict[str, set[str]] = {}
    for line in LISTED:
        files.setdefault(line.partition("::")[0], set()).add(line.partition("::")[2])
    gone = []
    for file, names in files.items():
        there = {""} if (ROOT / file).exists() else set()
        if there:
            tree = ast.parse((ROOT / file).read_text(encoding="utf-8"))
            there |= {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}
        gone += [f"{file}::{name}".removesuffix("::") for name in sorted(names - there)]
    assert not gone, "renamed or gone: change tests/slow_tests.txt"


def test_the_list_is_sorted_and_names_nothing_twice():
    assert sorted(set(LISTED)) == LISTED
    whole = {line for line in LISTED if "::" not in line}
    assert not [line for line in LISTED if "::" in line and line.partition("::")[0] in whole]
