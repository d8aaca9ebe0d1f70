"""Convert a focal length in mm and a pixel pitch in um, as data sheets give them, to a focal length in pixels.

In ``[cameras.NAME]`` and ``[projector]`` the keys ``focal_mm`` and ``pixel_um`` replace ``focal_px``. A missing
``principal_px`` is the centre of the image:

    f [px] = 1000 f [mm] / p [um],    c = ((width - 1) / 2, (height - 1) / 2)

since pixel centres lie at integers. A camera's ``pixel_um`` may stand in ``[imager]`` alone. The nominal focal length
of a real lens is accurate to a few percent; a calibration is better.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from characterisation.files.errors import InputError

#: common misnomers of the focal length and the pixel pitch, and the correct keys
_MEANT = {
    "focal": "focal_px",
    "f_px": "focal_px",
    "focal_length_px": "focal_px",
    "focal_length": "focal_mm, or focal_px",
    "focal_length_mm": "focal_mm",
    "f_mm": "focal_mm",
    "lens_mm": "focal_mm",
    "pixel_size_um": "pixel_um",
    "pixel_pitch_um": "pixel_um",
    "pitch_um": "pixel_um",
}


def with_lenses(path: Path, table: dict[str, Any]) -> dict[str, Any]:
    """Return a sensor file's table with ``focal_px`` and ``principal_px`` in place of lenses in mm.

    Raises InputError if a focal length is not a length, has no pixel pitch, or stands beside ``focal_px``; or a key is
    a misnomer.
    """
    imager = table.get("imager")
    shared = imager.get("pixel_um") if isinstance(imager, dict) else None
    out = dict(table)
    cameras = table.get("cameras")
    if isinstance(cameras, dict):
        out["cameras"] = {name: _lens(path, f"cameras.{name}", eye, shared) for name, eye in cameras.items()}
    if "projector" in table:
        out["projector"] = _lens(path, "projector", table["projector"], None)
    return out


def _lens(path: Path, field: str, eye: Any, shared: Any) -> Any:
    if not isinstance(eye, dict):
        return eye
    for key, meant in _MEANT.items():
        if key in eye:
            allowed = "the keys in docs/reference/formats"
            raise InputError(path, f"{field}.{key}", "an unknown key", allowed, f"write {meant}")
    if "focal_mm" not in eye:
        return eye
    if "focal_px" in eye:
        raise InputError(path, f"{field}.focal_mm", "focal_mm beside focal_px", "one of the two")
    pixel = eye.get("pixel_um", shared)
    if pixel is None:
        hint = "or focal_px in place of focal_mm"
        raise InputError(path, f"{field}.pixel_um", "nothing", "the pixel pitch that belongs to focal_mm, in um", hint)
    focal, pitch = _pair(path, f"{field}.focal_mm", eye["focal_mm"]), _pair(path, f"{field}.pixel_um", pixel)
    made = {key: value for key, value in eye.items() if key not in ("focal_mm", "pixel_um")}
    made["focal_px"] = [1000.0 * f / p for f, p in zip(focal, pitch, strict=True)]
    sizes = [made.get(key) for key in ("width", "height")]
    if "principal_px" not in made and all(isinstance(size, int) for size in sizes):
        made["principal_px"] = [(size - 1) / 2 for size in sizes if isinstance(size, int)]
    return made


def _pair(path: Path, field: str, value: Any) -> tuple[float, float]:
    """Return one length as a pair, or the pair along x and y."""
    values = value if isinstance(value, list) else [value, value]
    numbers = [
        number for number in values if isinstance(number, int | float) and not isinstance(number, bool) and number > 0
    ]
    if len(values) != 2 or len(numbers) != 2:
        raise InputError(path, field, repr(value), "a number over 0, or two of them along x and y")
    return float(numbers[0]), float(numbers[1])
