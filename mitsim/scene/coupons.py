"""Coupons: flat samples of one finish, read from the scenes that describe them.

A coupon is a scene with one flat shape in the plane z = 0, centred, with its normal along +z. *Variants* show the
uncertainty of a finish: the same coupon with its lobe one sigma narrower and wider, and with its wide-angle share at
its low and high end.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field, replace
from pathlib import Path

from characterisation.coupon.patches import Coupon
from characterisation.files.errors import InputError
from characterisation.maps.building import Variant
from characterisation.maps.light import Light
from mitsim.scene.load import Scene, load_scene
from mitsim.scene.surface.scatter import NOMINAL, Deviation
from mitsim.sensor.transforms import Transform

#: variants that are shown in addition to a sample, for its spread
VARIANTS: dict[Variant, Deviation] = {
    ("alpha", "low"): Deviation(alpha=-1.0),
    ("alpha", "high"): Deviation(alpha=1.0),
    ("wide_angle", "low"): Deviation(wide_angle=-1.0),
    ("wide_angle", "high"): Deviation(wide_angle=1.0),
}


@dataclass(frozen=True)
class CouponRecipe:
    """Description of a coupon as plain values, which can be sent to another process."""

    scene: str
    parameters: tuple[tuple[str, str], ...]
    wavelength_nm: float
    deviation: Deviation = NOMINAL

    def moved(self, deviation: Deviation) -> CouponRecipe:
        """Return the same coupon with a deviation of its finish."""
        return replace(self, deviation=deviation)


@dataclass(frozen=True)
class Sample:
    """A coupon to show: its scene, size [mm] and finish; ``origin`` is the text of everything it was made from.

    ``light`` are the optical numbers of its finish.
    """

    recipe: CouponRecipe
    scene: Scene = field(repr=False)
    width: float
    height: float
    finish: str
    roughness: float
    origin: str = field(repr=False)
    light: Light | None = field(default=None, repr=False)

    def label(self) -> str:
        """Return text such as ``aluminium/ground Ra 0.37`` or ``matt_white``."""
        return self.finish if math.isnan(self.roughness) else f"{self.finish} Ra {self.roughness:g}"

    def at(self, sensor_from_coupon: Transform) -> Coupon:
        """Return the coupon at its pose in the sensor frame."""
        axes = sensor_from_coupon.rotation
        return Coupon(sensor_from_coupon.translation, axes[:, 2], axes[:, 0], self.width, self.height)


def load_sample(recipe: CouponRecipe, asked: tuple[Path, str] | None = None) -> Sample:
    """Load a coupon from its recipe; ``asked`` is the file and field that name it, for error messages.

    Raises InputError if the scene is not a coupon.
    """
    path, where = asked or (Path(recipe.scene), "")
    scene = load_scene(recipe.scene, recipe.wavelength_nm, dict(recipe.parameters), recipe.deviation)
    finish = scene.finishes[0]
    if len(scene.names) != 1 or finish is None:
        found = f"{len(scene.names)} shapes" if finish else "a BSDF without a known finish"
        allowed = "one flat shape with a BSDF of mitsim (machined_metal, matt_white, gloss_paint, powder_coat)"
        raise InputError(path, where, found, allowed)
    (x0, y0, z0), (x1, y1, z1) = scene.bounds
    if max(abs(z0), abs(z1)) > 1e-3 * (x1 - x0) or abs(x0 + x1) + abs(y0 + y1) > 1e-3 * (x1 - x0):
        allowed = "a flat shape in the plane z = 0, centred, normal +z"
        raise InputError(path, where, "a coupon at another place", allowed)
    # the scatter represents files that the scene names, a trace or a height map, and the deviation
    origin = Path(scene.where).read_text(encoding="utf-8") + json.dumps(dict(recipe.parameters), sort_keys=True)
    origin += repr(finish.scatter)
    return Sample(recipe, scene, float(x1 - x0), float(y1 - y0), finish.name, finish.roughness, origin, finish.light)
