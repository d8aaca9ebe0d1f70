"""What a TOML document lacks comes in one message, whatever is missing."""

from __future__ import annotations

import copy
from typing import Annotated, Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import Field, model_validator

from characterisation.files.documents import Document, missing_keys, validate
from characterisation.files.errors import InputError, nearest


class Fixed(Document):
    rule: Literal["fixed"]
    seconds: float


class Automatic(Document):
    rule: Literal["automatic"]
    level: float = 0.5


class Optics(Document):
    width: int
    focal: tuple[float, float]
    model: str = "perspective"


class Whole(Document):
    name: str
    cameras: dict[str, Optics]
    exposure: Annotated[Fixed | Automatic, Field(discriminator="rule")]
    groups: list[Optics] = Field(default=[])
    note: str | None = None


TABLE = {
    "name": "a",
    "cameras": {"left": {"width": 3, "focal": [1.0, 1.0]}, "right": {"width": 3, "focal": [1.0, 1.0]}},
    "exposure": {"rule": "fixed", "seconds": 0.1},
    "groups": [{"width": 1, "focal": [1.0, 2.0]}],
}
REQUIRED = [
    "name",
    "cameras.left.width",
    "cameras.left.focal",
    "cameras.right.width",
    "cameras.right.focal",
    "exposure.seconds",
    "groups.0.width",
    "groups.0.focal",
]


def without(keys):
    table = copy.deepcopy(TABLE)
    for key in keys:
        *path, last = key.split(".")
        inner = table
        for part in path:
            inner = inner[int(part) if part.isdigit() else part]
        del inner[last]
    return table


@given(st.sets(st.sampled_from(REQUIRED)))
def test_exactly_the_keys_that_were_taken_out_are_missing(taken):
    assert set(missing_keys(without(taken), Whole)) == taken


@given(st.sets(st.sampled_from(REQUIRED), min_size=1))
def test_all_of_them_stand_in_one_message(taken):
    with pytest.raises(InputError, match="required") as caught:
        validate("a.toml", without(taken), Whole)
    assert set(caught.value.field.split(", ")) == taken


def test_of_a_missing_table_its_own_keys_are_told():
    assert set(missing_keys({"name": "a", "cameras": {"left": {}}}, Whole)) == {
        "cameras.left.width",
        "cameras.left.focal",
        "exposure.rule",
    }
    assert missing_keys(TABLE | {"exposure": {"seconds": 1}}, Whole) == ["exposure.rule"]


def test_another_fault_is_told_first_and_what_is_missing_beside_it():
    table = without(["name"])
    table["cameras"]["left"]["width"] = "wide"
    with pytest.raises(InputError, match=r"cameras.left.width: found 'wide'.*Also missing: name"):
        validate("a.toml", table, Whole)
    table = without(["name", "cameras.left.width"])
    table["cameras"]["left"]["widht"] = 3
    with pytest.raises(InputError, match=r"cameras.left.widht: .*did you mean 'width'\? Also missing: name$"):
        validate("a.toml", table, Whole)


class Elsewhere(Document):
    scale: float = 1.0
    widht: float = 1.0


@pytest.mark.parametrize(
    ("place", "field", "allowed"),
    [
        ([], "scale", "name, cameras, exposure, groups, note"),
        (["cameras", "left"], "cameras.left.scale", "width, focal, model"),
        (["groups", 0], "groups.0.scale", "width, focal, model"),
        (["exposure"], "exposure.scale", "rule, seconds"),
    ],
)
def test_an_unknown_key_gets_the_keys_of_its_own_table(place, field, allowed):
    """Another document has this key: the hint was to write the key that is refused."""
    table = copy.deepcopy(TABLE)
    inner = table
    for part in place:
        inner = inner[part]
    inner["scale"] = 2.0
    with pytest.raises(InputError) as caught:
        validate("a.toml", table, Whole)
    assert (caught.value.field, caught.value.allowed) == (field, allowed)
    assert "'scale'" not in caught.value.hint


@pytest.mark.parametrize(("place", "table"), [(("cameras", "left"), "cameras.left"), (("groups", 0), "groups")])
def test_a_key_of_the_whole_file_in_a_table_is_refused_with_the_cause(place, table):
    content = copy.deepcopy(TABLE)
    inner = content
    for part in place:
        inner = inner[part]
    inner["note"] = "of the file"
    with pytest.raises(InputError, match=rf"after the header \[{table}\] belong to that table"):
        validate("a.toml", content, Whole)
    with pytest.raises(InputError) as of_json:
        validate("a.json", content, Whole)
    assert "header" not in of_json.value.hint


def test_the_variant_of_a_table_gives_its_own_keys_and_the_nearest_of_them():
    table = copy.deepcopy(TABLE) | {"exposure": {"rule": "automatic", "seconds": 0.1, "levle": 1}}
    with pytest.raises(InputError, match=r"exposure\.\w+: found an unknown key; allowed: rule, level"):
        validate("a.toml", table, Whole)


class Even(Document):
    width: int
    rows: dict[str, list[bool]] = Field(default={})

    @model_validator(mode="after")
    def _even(self) -> Even:
        if self.width % 2:
            raise ValueError("width of an even number")
        if self.rows:
            raise ValueError("no rows here")
        return self


def test_a_value_is_shown_as_its_file_has_it():
    """A rule of a whole table names the key, and shows no Python."""
    with pytest.raises(InputError, match=r"^a\.toml: width: found 3; allowed: width of an even number$"):
        validate("a.toml", {"width": 3}, Even)
    table = {"width": 2, "rows": {"a": [True]}}
    with pytest.raises(InputError, match=r"found \{ width = 2, rows = \{ a = \[true\] \} \}; allowed: no rows"):
        validate("a.toml", table, Even)
    with pytest.raises(InputError, match=r'found \{"width": 2, "rows": \{"a": \[true\]\}\}; allowed: no rows'):
        validate("a.json", table, Even)


def test_a_value_in_place_of_a_table_gets_the_keys_of_the_table():
    for table, place in (
        (TABLE | {"cameras": {"left": 3}}, "cameras.left: found 3; allowed: a table: width, focal, model"),
        (TABLE | {"cameras": [1]}, r"cameras: found \[1\]; allowed: a table"),
    ):
        with pytest.raises(InputError, match=place):
            validate("a.toml", table, Whole)


@pytest.mark.parametrize(
    ("key", "value", "allowed"),
    [
        ("width", "wide", "a whole number"),
        ("focal", 3, "a list"),
        ("focal", [1, "x"], "a number"),
        ("model", 3, "a text"),
    ],
)
def test_types_are_named_as_toml_has_them(key, value, allowed):
    camera = {"width": 640, "focal": [1, 1]} | {key: value}
    with pytest.raises(InputError, match=f"allowed: {allowed}"):
        validate("a.toml", TABLE | {"cameras": {"left": camera}}, Whole)


def test_a_name_is_not_its_own_correction():
    """Before, a folder in place of a file was told: did you mean this very name?"""
    assert nearest("task.toml", ["task.toml", "study.toml", "tasks.toml"]) == "did you mean 'tasks.toml'?"
    assert nearest("task.toml", ["task.toml"]) == ""
    assert nearest("task.toml", ["Task.toml"]) == "did you mean 'Task.toml'?"
