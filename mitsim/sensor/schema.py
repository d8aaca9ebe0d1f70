"""Make the JSON schema of the sensor TOML file, for editors: ``python -m mitsim.sensor.schema > sensor.schema.json``.

The schema is derived from :class:`~mitsim.sensor.sensor_file.SensorFile`, so it has every key, its type and its limits.
Keys that only simulation needs are optional, as in the file of a recorded rig. The schema does not express conditions
between keys; ``mitsim`` itself checks those.
"""

from __future__ import annotations

import json
import math
from typing import Any

from mitsim.sensor.sensor_file import SensorFile

#: keys, by table, that a calibration file may contain instead or that only simulation needs
_OPTIONAL = {
    "OpticsTable": ("width", "height", "focal_px", "principal_px"),
    "ProjectorTable": ("width", "height", "focal_px", "principal_px", "flux_w"),
    "ImagerTable": ("pixel_um", "quantum_efficiency", "full_well_e", "read_noise_e", "f_number"),
    "DecoderSettings": ("near_mm", "far_mm"),
    "MatcherSettings": ("near_mm", "far_mm"),
}
_OPTIONAL_TABLES = ("cameras", "wavelength_nm", "working_range_mm", "projector", "imager", "pattern", "exposure")


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
    schema["required"] = [key for key in schema["required"] if key not in _OPTIONAL_TABLES]
    for table in schema["$defs"].values():
        for entry in table.get("properties", {}).values():
            if entry.get("default") in (math.inf, -math.inf):
                del entry["default"]  # infinity is not JSON
    return schema


def schema_text() -> str:
    """Return the schema as in ``docs/reference/sensor.schema.json``."""
    return json.dumps(sensor_schema(), indent=1, ensure_ascii=False, allow_nan=False) + "\n"


if __name__ == "__main__":
    print(schema_text(), end="")
