"""The committed JSON schema of the sensor file against the code, and the presets against the schema."""

from __future__ import annotations

import tomllib
from importlib.resources import files
from pathlib import Path

import pytest

from mitsim.sensor.preset import presets
from mitsim.sensor.schema import schema_text, sensor_schema

COMMITTED = Path(__file__).parents[2] / "docs/reference/sensor.schema.json"


def test_the_committed_schema_is_that_of_the_code():
    assert COMMITTED.read_text(encoding="utf-8") == schema_text(), (
        "python -m mitsim.sensor.schema > docs/reference/sensor.schema.json"
    )


@pytest.mark.parametrize("name", presets())
def test_every_key_of_a_preset_is_in_the_schema(name):
    """What an editor would underline: keys that no table has, and required ones that are missing."""
    schema = sensor_schema()

    def resolved(part):
        return schema["$defs"][part["$ref"].rpartition("/")[2]] if "$ref" in part else part

    def check(value, part):
        part = resolved(part)
        choices = [resolved(each) for each in part.get("oneOf", part.get("anyOf", []))]
        if "discriminator" in part:
            key = part["discriminator"]["propertyName"]
            return check(value, {"$ref": part["discriminator"]["mapping"][value[key]]})
        if choices:
            wanted = "object" if isinstance(value, dict) else "array" if isinstance(value, list) else None
            choices = [each for each in choices if each.get("type") == wanted] if wanted else []
            return [check(value, each) for each in choices[:1]]
        if isinstance(value, dict) and "properties" in part:
            assert set(part.get("required", [])) <= set(value) <= set(part["properties"])
            return [check(each, part["properties"][key]) for key, each in value.items()]
        if isinstance(value, dict):
            return [check(each, part["additionalProperties"]) for each in value.values()]
        return None

    check(tomllib.loads((files("mitsim.sensor") / "presets" / f"{name}.toml").read_text(encoding="utf-8")), schema)
