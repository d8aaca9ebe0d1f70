"""Read TOML documents (studies, tasks, campaigns, sensors) into checked, frozen models.

A document is a subclass of :class:`Document`. For an unknown key the error lists the keys of its table. For a wrong
type or value it names the file, the field, the value found and the allowed values.
"""

from __future__ import annotations

import copy
import dataclasses
import json
import re
import unicodedata
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from pydantic import AfterValidator, BaseModel, ConfigDict, ValidationError, WithJsonSchema
from pydantic.fields import FieldInfo

from characterisation.files.errors import InputError, nearest
from characterisation.files.toml_tables import read_toml_table


class Document(BaseModel):
    """Base class of all models read from TOML files: unknown keys are rejected, and values cannot change."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


Model = TypeVar("Model", bound=Document)

#: what a name may be made of: it may become part of a file's name, of a table or of a page; none begins or ends with a
#: space or a dot, and no separator of a path, quotation mark, bracket of markup or control character is in one
_NAME = r"\w(?:[\w .,()#&'=@~°%+-]*[\w)'°%+-])?"

#: longest name [bytes]: with prefix and suffix, a file name stays under the common limit of 255 bytes
LONGEST_NAME = 100


def checked_name(name: str) -> str:
    """Return a name that may become part of a file's name or of a page; ValueError, for pydantic, if it may not."""
    # marks belong to the letter before them, as in Thai and Hindi; none is a letter of its own
    letters = name[:1] + "".join(letter for letter in name[1:] if not unicodedata.category(letter).startswith("M"))
    if len(name.encode("utf-8", "replace")) > LONGEST_NAME or not re.fullmatch(_NAME, letters):
        raise ValueError(
            f"a name of at most {LONGEST_NAME} bytes that begins with a letter, digit or underscore, of these, spaces "
            "and . , ( ) # & ' = @ ~ + - %; no / \\ : < > | * ? and no quotation marks"
        )
    return name


#: name that a user gives to a sensor, feature or measurement
Name = Annotated[
    str, AfterValidator(checked_name), WithJsonSchema({"type": "string", "pattern": f"^{_NAME}$", "maxLength": 100})
]


def read_toml(path: str | Path, model: type[Model]) -> Model:
    """Read one TOML file into a model. Raises InputError if the file is missing, is not TOML, or violates the model."""
    return validate(path, read_toml_table(path), model)


def validate(where: str | Path, table: dict[str, Any], model: type[Model], context: Any = None) -> Model:
    """Check a table against a model; raise an :class:`InputError` with the first fault and all missing keys.

    Parameters
    ----------
    where, table, model, context
        File or object that messages name; parsed content of the file; type of the document; passed to its validators.
    """
    try:
        return model.model_validate(table, context=context)
    except ValidationError as error:
        raise _explain(where, table, model, error, missing_keys(table, model, context)) from None


def missing_error(where: str | Path, keys: Iterable[str]) -> InputError:
    """Return the error that names missing keys."""
    names = list(keys)
    allowed = "a value: this key is required" if len(names) == 1 else "a value for each: these keys are required"
    return InputError(where, ", ".join(names), "nothing", allowed)


def missing_keys(table: dict[str, Any], model: type[Document], context: Any = None) -> list[str]:
    """Return the dotted names of all required keys that a table lacks, including those of missing tables.

    An empty table is inserted for each missing key. If validation then finds keys missing in it, it is a table;
    otherwise the key is a value.
    """
    filled = copy.deepcopy(table)
    lacking: list[tuple[Any, ...]] = []
    while new := [loc for loc in dict.fromkeys(_missing_in(filled, model, context)) if loc not in lacking]:
        lacking += new
        for loc in new:
            _fill(filled, loc)
    tables = {loc[:depth] for loc in lacking for depth in range(1, len(loc))}
    return [".".join(map(str, loc)) for loc in lacking if loc not in tables]


def _missing_in(table: dict[str, Any], model: type[Document], context: Any) -> list[tuple[Any, ...]]:
    try:
        model.model_validate(table, context=context)
    except ValidationError as error:
        out = []
        for fault in error.errors():
            if fault["type"] == "missing":
                out.append(_location(table, fault["loc"]))
            elif fault["type"] == "union_tag_not_found":
                out.append((*_location(table, fault["loc"]), fault["ctx"]["discriminator"].strip("'")))
        return out
    return []


def _fill(table: Any, location: tuple[Any, ...]) -> None:
    """Put an empty table where a key is missing."""
    for part in location[:-1]:
        table = table[part]
    if isinstance(table, dict):
        table[location[-1]] = {}


def _location(table: Any, parts: tuple[Any, ...]) -> tuple[Any, ...]:
    """Return the location of a fault in the table as written, without names of validators and table variants."""
    out: list[Any] = []
    for index, part in enumerate(parts):
        if isinstance(part, str) and (part.startswith("function-") or part == "[key]"):
            continue
        inside = isinstance(table, list) if isinstance(part, int) else isinstance(table, dict) and part in table
        if not inside and index < len(parts) - 1:
            continue  # the table variant that a key has selected
        out.append(part)
        try:
            table = table[part]
        except (KeyError, IndexError, TypeError):
            table = None
    return tuple(out)


def _explain(
    where: str | Path, table: dict[str, Any], model: type[Document], error: ValidationError, missing: list[str]
) -> InputError:
    faults = error.errors()
    # a misspelt key usually makes the correct key "missing" too: report the misspelling first, as the cause
    order = {"extra_forbidden": 0, "unexpected_keyword_argument": 0, "missing": 2, "union_tag_not_found": 2}
    fault = min(faults, key=lambda candidate: order.get(candidate["type"], 1))
    location = _location(table, fault["loc"])
    field = ".".join(str(part) for part in location)
    context = fault.get("ctx", {})
    also = f"Also missing: {', '.join(missing)}" if missing else ""
    match fault["type"]:
        case "extra_forbidden" | "unexpected_keyword_argument":
            key = str(location[-1])
            names = _keys_at(model, fault["loc"][:-1])
            meant = nearest(key, names)
            other_keys = [missing_key for missing_key in missing if f"{missing_key.rpartition('.')[2]!r}" not in meant]
            also = f"Also missing: {', '.join(other_keys)}" if other_keys else ""
            above = "" if meant and key not in fields_of(model) else _header_above(where, field)
            meant = "" if above else meant
            hint = _joined(meant, above, also)
            return InputError(where, field, "an unknown key", ", ".join(names) or "no keys", hint)
        case "missing" | "union_tag_not_found":
            return missing_error(where, missing or [field])
        case "union_tag_invalid":
            key = f"{field}.{context['discriminator'].strip(chr(39))}".strip(".")
            tag, names = context["tag"], [tag.strip("' ") for tag in context["expected_tags"].split(",")]
            hint = _joined(nearest(str(tag), names), also)
            return InputError(where, key, shown(tag, where), ", ".join(map(repr, names)), hint)
        case "value_error":
            allowed = str(context.get("error", fault["msg"]))
            key = allowed.partition(" ")[0]  # a rule of several keys names the first
            found = fault["input"]
            if isinstance(found, dict) and key in found:
                field, found = f"{field}.{key}".removeprefix("."), found[key]
            return InputError(where, field, shown(found, where), allowed, also)
        case "model_type" | "model_attributes_type" | "dict_type" | "dataclass_type":
            keys = ", ".join(_keys_at(model, fault["loc"]))
            return InputError(where, field, shown(fault["input"], where), "a table" + f": {keys}" * bool(keys), also)
        case "int_parsing_size" | "int_type" if isinstance(fault["input"], int):
            return InputError(where, field, "a whole number of too many digits", "-2^63 to 2^63 - 1", also)
        case _:
            allowed = fault["msg"].removeprefix("Input should be ")
            for python, toml in _TYPES.items():
                allowed = allowed.replace(python, toml)
            return InputError(where, field, shown(fault["input"], where), allowed, also)


#: types in pydantic's messages, and what a user writes
_TYPES = {
    "a valid tuple": "a list",
    "a valid list": "a list",
    "a valid integer": "a whole number",
    "a valid number": "a number",
    "a valid string": "a text",
    "a valid boolean": "true or false",
}


def _joined(*sentences: str) -> str:
    return " ".join(sentence for sentence in sentences if sentence)


def _header_above(where: str | Path, field: str) -> str:
    """Return why a key of a TOML file stands in a table, as a hint; empty of keys in no table."""
    table = ".".join(part for part in field.split(".")[:-1] if not part.isdecimal())
    if not table or not str(where).lower().endswith(".toml"):
        return ""
    return f"keys after the header [{table}] belong to that table; keys of the whole file come before all headers"


def _keys_at(model: type[Document], location: tuple[Any, ...]) -> list[str]:
    """Return the keys of the table at a pydantic location, which also names validators and table variants."""
    here: list[Any] = [model]
    for part in location:
        here = [member for option in here for member in _options(option)]
        models = [annotation for annotation in here if _is_table(annotation)]
        variants = [table for table in models if part in _tags(table)]
        inside = [fields_of(table)[part].annotation for table in models if part in fields_of(table)]
        values = [get_args(annotation)[-1] for annotation in here if get_origin(annotation) is dict]
        lists = [annotation for annotation in here if get_origin(annotation) in (list, tuple, set)]
        items = [member for annotation in lists for member in get_args(annotation)]
        if isinstance(part, int):
            here = items
        elif part != "[key]" and not str(part).startswith("function-"):
            here = variants or inside or values or here
    here = [member for option in here for member in _options(option)]
    return list(dict.fromkeys(name for table in here if _is_table(table) for name in fields_of(table)))


def _is_table(annotation: Any) -> bool:
    return isinstance(annotation, type) and (issubclass(annotation, BaseModel) or dataclasses.is_dataclass(annotation))


def fields_of(model: type) -> Mapping[str, FieldInfo]:
    """Return the fields of a model, or of a data class that a model contains, by their keys in the file."""
    if issubclass(model, BaseModel):
        return model.model_fields
    assert dataclasses.is_dataclass(model)
    hints = get_type_hints(model, include_extras=True)
    infos = {
        field.name: FieldInfo.from_annotated_attribute(hints[field.name], field.default)
        for field in dataclasses.fields(model)
    }
    return {info.alias or name: info for name, info in infos.items()}


def _options(annotation: Any) -> list[Any]:
    """Return the types that an annotation stands for: the members of a union, without ``Annotated``."""
    if get_origin(annotation) is Annotated:
        return _options(get_args(annotation)[0])
    if get_origin(annotation) in (Union, UnionType):
        return [option for member in get_args(annotation) for option in _options(member)]
    return [annotation]


def _tags(model: type) -> set[str]:
    """Return the values and the name by which pydantic tells a table variant from others."""
    literals = [field.annotation for field in fields_of(model).values() if get_origin(field.annotation) is Literal]
    return {model.__name__, *(value for literal in literals for value in get_args(literal))}


def shown(value: Any, where: str | Path = "") -> str:
    """Return a value as its file has it, shortened: in JSON for a ``.json`` file, otherwise in TOML."""
    try:
        if str(where).lower().endswith(".json") and not isinstance(value, str):
            text = json.dumps(value, ensure_ascii=False, default=str)
        else:
            text = _in_toml(value)
    except (ValueError, TypeError, RecursionError):  # an integer of thousands of digits, or nesting as deep
        text = f"a {type(value).__name__} too long to show"
    return text if len(text) <= 80 else text[:77] + "..."


def _in_toml(value: Any) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {_in_toml(item)}" for key, item in value.items()) + " }" if value else "{}"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(map(_in_toml, value)) + "]"
    if isinstance(value, bool):
        return "true" if value else "false"
    if value is None:
        return "nothing"
    return repr(value) if isinstance(value, (str, int, float)) else str(value)
