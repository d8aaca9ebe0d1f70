"""TOML documents (studies, tasks, campaigns, sensors) read into checked, frozen dataclass-like models.

A document is a :class:`Document` subclass: unknown keys are refused with the nearest right name, wrong types and
impossible values are refused with the file, the field, the value found and what is allowed.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from characterisation.errors import InputError, nearest


class Document(BaseModel):
    """Base of every model that is read from a TOML file: no unknown keys, no changes after reading."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


Model = TypeVar("Model", bound=Document)


def read_toml(path: str | Path, model: type[Model]) -> Model:
    """Read one TOML file into a model.

    Raises
    ------
    InputError
        If the file is missing, is not TOML, or holds something that the model does not allow.
    """
    path = Path(path)
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(path, "", "no such file", "a TOML file", _neighbours(path)) from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(path, "", f"a file that cannot be read ({error})", "a TOML file in UTF-8") from None
    except tomllib.TOMLDecodeError as error:
        raise InputError(path, "", f"text that is not TOML ({error})", "TOML, see https://toml.io") from None
    return validate(path, table, model)


def validate(where: str | Path, table: dict[str, Any], model: type[Model]) -> Model:
    """Check a table against a model; the first fault is raised as an :class:`InputError`."""
    try:
        return model.model_validate(table)
    except ValidationError as error:
        raise _explain(where, table, error) from None


def _explain(where: str | Path, table: dict[str, Any], error: ValidationError) -> InputError:
    faults = error.errors()
    # a misspelt key usually also makes its right name "missing": the misspelling is the cause, so it is told first
    fault = next((f for f in faults if f["type"] == "extra_forbidden"), faults[0])
    location = [part for part in fault["loc"] if not (isinstance(part, str) and part.startswith("function-"))]
    field = ".".join(str(part) for part in location)
    context = fault.get("ctx", {})
    match fault["type"]:
        case "extra_forbidden":
            key = str(location[-1])
            missing = [
                str(f["loc"][-1]) for f in faults if f["type"] == "missing" and f["loc"][:-1] == fault["loc"][:-1]
            ]
            known = missing + sorted(_keys_beside(location, error))
            return InputError(where, field, "an unknown key", "the keys in docs/formats.md", nearest(key, known))
        case "missing":
            return InputError(where, field, "nothing", "a value: this key is required")
        case "value_error":
            return InputError(where, field, _shown(fault["input"]), str(context.get("error", fault["msg"])))
        case _:
            return InputError(where, field, _shown(fault["input"]), fault["msg"].removeprefix("Input should be "))


def _keys_beside(location: list[Any], error: ValidationError) -> set[str]:
    """Names of all fields of all document models: good enough to find the nearest to a misspelt key."""
    return {name for model in _all_models(Document) for name in model.model_fields}


def _all_models(model: type[Document]) -> Iterable[type[Document]]:
    for child in model.__subclasses__():
        yield child
        yield from _all_models(child)


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 80 else text[:77] + "..."


def _neighbours(path: Path) -> str:
    """Name the files of the same kind that do exist beside a missing one."""
    if not path.parent.is_dir():
        return f"the folder {path.parent} does not exist either"
    there = sorted(p.name for p in path.parent.glob(f"*{path.suffix}"))
    return (nearest(path.name, there) or f"there are: {', '.join(there[:6])}") if there else ""
