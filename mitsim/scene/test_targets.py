"""Make simple scenes to test a sensor with: a plate, a ball, and a ball on a plate, in any size and finish."""

from __future__ import annotations

from typing import Any

from mitsim.scene import backend
from mitsim.scene.load import Scene, scene_from_dict

#: finishes, by their names in data sheets
FINISHES: dict[str, dict[str, Any]] = {
    "matt white": {"type": "matt_white"},
    "ground aluminium Ra 0.4": {"type": "machined_metal", "metal": "aluminium", "process": "ground", "Ra": 0.4},
    "polished aluminium Ra 0.09": {"type": "machined_metal", "metal": "aluminium", "process": "polished", "Ra": 0.09},
}


def plate(size_mm: float, finish: str, wavelength_nm: float) -> Scene:
    """Return a square plate in the plane z = 0, centred, with normal +z."""
    return _scene({"plate": _square(size_mm, finish)}, finish, wavelength_nm)


def ball(radius_mm: float, finish: str, wavelength_nm: float) -> Scene:
    """Return a ball about the origin."""
    return _scene({"ball": {"type": "sphere", "radius": radius_mm, "bsdf": FINISHES[finish]}}, finish, wavelength_nm)


def ball_on_plate(radius_mm: float, size_mm: float, finish: str, wavelength_nm: float) -> Scene:
    """Return a ball on a square plate in the plane z = 0, both of one finish.

    Parameters
    ----------
    radius_mm, size_mm
        Of the ball, and side of the plate.
    finish
        One of :data:`FINISHES`.
    wavelength_nm
        Of the sensor.

    See Also
    --------
    ball : without the plate
    plate : without the ball
    """
    sphere = {"type": "sphere", "radius": radius_mm, "center": [0.0, 0.0, radius_mm], "bsdf": FINISHES[finish]}
    return _scene({"plate": _square(size_mm, finish), "ball": sphere}, finish, wavelength_nm)


def _square(size_mm: float, finish: str) -> dict[str, Any]:
    backend.activate()
    to_world = backend.mi.ScalarTransform4f().scale([size_mm / 2, size_mm / 2, 1])
    return {"type": "rectangle", "to_world": to_world, "bsdf": FINISHES[finish]}


def _scene(shapes: dict[str, Any], finish: str, wavelength_nm: float) -> Scene:
    return scene_from_dict(shapes, wavelength_nm, f"{' and '.join(shapes)}, {finish}")
