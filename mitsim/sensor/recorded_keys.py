"""Complete the sensor file of a recorded rig with placeholders for keys that only simulation needs.

An existing rig has its own light, imager and exposure. Reading and triangulating its images does not need a description
of these. :func:`for_recordings` completes a table so that it passes the same checks as every sensor file. The
placeholders are never used (:mod:`mitsim.sensor.recorded_rig`).
"""

from __future__ import annotations

from typing import Any

from characterisation.files.documents import missing_keys
from mitsim.sensor.sensor_file import SensorFile

#: the table that describes a technology's decoder
_DECODERS = {"structured_light": "decoder", "active_stereo": "matcher"}

#: Default depths [mm] of decoding a code: the full allowed working range. A code is unambiguous at every depth; the
#: range only rejects points.
ANY_DEPTH_MM = (50.0, 20000.0)

#: default depths [mm] of a matcher, which searches all of them
PAIR_DEPTH_MM = (300.0, 2000.0)

_IMAGER = {"pixel_um": 5.0, "quantum_efficiency": 0.5, "full_well_e": 1e4, "read_noise_e": 10.0, "f_number": 8.0}
_OPTICS = {"focal_px": [1e3, 1e3], "principal_px": [0.0, 0.0]}


def for_recordings(table: dict[str, Any]) -> dict[str, Any]:
    """Return a sensor file's table with placeholders for all keys that reading and decoding do not need."""
    technology = table.get("technology")
    coded = technology == "structured_light"
    ranged = table.get("working_range_mm", ANY_DEPTH_MM if coded else PAIR_DEPTH_MM)
    out: dict[str, Any] = {"wavelength_nm": 550.0, "working_range_mm": list(ANY_DEPTH_MM)} | table
    out.setdefault("exposure", {"rule": "fixed", "exposure_s": 1.0})
    out["imager"] = _filled(table.get("imager", {}), _IMAGER)
    projector: dict[str, Any] = {"flux_w": 1.0}
    decoder = _DECODERS.get(str(technology))
    if decoder and isinstance(ranged, list | tuple) and len(ranged) == 2:
        out[decoder] = _filled(table.get(decoder, {}), {"near_mm": ranged[0], "far_mm": ranged[1]})
    if between_cameras(table):
        projector |= _OPTICS
    if technology == "active_stereo":
        projector |= _OPTICS | {"width": 16, "height": 16}
        out.setdefault("pattern", {"kind": "random_dots", "run_length_px": 10.0})
    out["projector"] = _filled(table.get("projector", {}), projector)
    return out


def lacking_keys(table: dict[str, Any]) -> list[str]:
    """Return the keys that a table lacks for simulation, including those of its decoder."""
    decoder = _DECODERS.get(str(table.get("technology")))
    return missing_keys({decoder: {}} | table if decoder else table, SensorFile)


def between_cameras(table: dict[str, Any]) -> bool:
    """Return whether two cameras measure and the projector only provides a code, according to a table."""
    decoder = table.get("decoder")
    return isinstance(decoder, dict) and decoder.get("triangulate") == "cameras"


def _filled(given: Any, values: dict[str, Any]) -> Any:
    return values | given if isinstance(given, dict) else given
