"""The page of the interface: it lists all public names and no other, and its example runs."""

import re
from pathlib import Path

import characterisation
import mitsim

PAGE = (Path(__file__).resolve().parents[2] / "docs" / "reference" / "interface.md").read_text(encoding="utf-8")


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


def test_every_member_that_is_listed_is_there():
    for package in (mitsim, characterisation):
        for name in listed(f"`{package.__name__}`"):
            if name[0].isupper():
                owner, _, member = name.partition(".")
                one = getattr(package, owner)
                assert (
                    hasattr(one, member)
                    or member in getattr(one, "__dataclass_fields__", {})
                    or member in getattr(one, "model_fields", {})
                ), name


def test_the_examples_run(workplace):
    examples = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    names: dict[str, object] = {}
    for example in examples:
        exec(example, names)
    assert names["found"]["pillar1_pillar2_distance"].possible
    assert names["on_plane"].sum() > 1000
