"""Make the JSON schema of the sensor TOML file, for editors: ``python -m mitsim.sensor.schema > sensor.schema.json``.

The schema is derived from :class:`~mitsim.sensor.sensor_file.SensorFile`, so it has every key, its type and its limits.
Keys that only some purposes need are optional. The schema does not express conditions between keys; ``mitsim`` itself
checks those.
"""

from __future__ import annotations

import json
import math
from typing import Any

from mitsim.sensor.sensor_file import SensorFile

#: keys, by table, that a calibration file or the working range may contain instead
_OPTIONAL = {
    "OpticsTable": ("width", "height", "focal_px", "principal_px"),
    "DecoderSettings": ("near_mm", "far_mm"),
    "MatcherSettings": ("near_mm", "far_mm"),
}

#: keys, by table, whose default stands for unknown: NaN, or 0 px
_UNKNOWN = {
    "mitsim sensor": ("working_range_mm", "projector", "imager"),
    "ProjectorTable": ("width", "height", "focal_px", "principal_px"),
}


def sensor_schema() -> dict[str, Any]:
    """Return the JSON schema (draft 2020-12) of a sensor TOML file as written, before its calibration is read."""
    schema = SensorFile.model_json_schema()
    schema["$schema"] = "https://json-schema.org/draft/2020-12/schema"
    schema["title"] = "mitsim sensor"
    for name, optional in _OPTIONAL.items():
        table = schema["$defs"][name]
        table["required"] = [key for key in table.get("required", []) if key not in optional]
    lens = {"anyOf": [{"type": "number"}, {"type": "array", "items": {"type": "number"}}]}
    for name in ("OpticsTable", "ProjectorTable"):  # alternatives to focal_px, see mitsim.sensor.lens_keys
        schema["$defs"][name]["properties"] |= {"focal_mm": lens, "pixel_um": lens}
    schema["required"].remove("cameras")
    for table in (schema, *schema["$defs"].values()):
        for key, entry in table.get("properties", {}).items():
            default = entry.get("default")
            unfinite = isinstance(default, float) and not math.isfinite(default)  # not JSON
            if unfinite or (table.get("title") in _UNKNOWN and key in _UNKNOWN[table["title"]]):
                del entry["default"]
    return schema


def schema_text() -> str:
    """Return the schema as in ``docs/reference/sensor.schema.json``."""
    return json.dumps(sensor_schema(), indent=1, ensure_ascii=False, allow_nan=False) + "\n"


if __name__ == "__main__":
    print(schema_text(), end="")
