"""Coupons: flat samples of one finish, read from the scenes that describe them.

A coupon is a scene with one flat shape in the plane z = 0, centred, its normal along +z. What is not known of a finish
is shown by *variants*: the same coupon with its lobe one sigma narrower and wider, and with its wide-angle share at its
low and high end.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field, replace
from pathlib import Path

from characterisation.coupon.patches import Coupon
from characterisation.maps.light import Light
from characterisation.maps.performance_map import Variant
from mitsim.errors import InputError
from mitsim.scene.load import Scene, load_scene
from mitsim.sensor.transforms import Transform
from mitsim.surface.scatter import NOMINAL, Deviation

#: what is shown besides a sample for its spread
VARIANTS: dict[Variant, Deviation] = {
    ("alpha", "low"): Deviation(alpha=-1.0),
    ("alpha", "high"): Deviation(alpha=1.0),
    ("wide_angle", "low"): Deviation(wide_angle=-1.0),
    ("wide_angle", "high"): Deviation(wide_angle=1.0),
}


@dataclass(frozen=True)
class CouponRecipe:
    """What a coupon is made of: plain values, which can be sent to another process and be read there."""

    scene: str
    parameters: tuple[tuple[str, str], ...]
    wavelength_nm: float
    deviation: Deviation = NOMINAL

    def moved(self, deviation: Deviation) -> CouponRecipe:
        """The same coupon with what is not known of its finish moved."""
        return replace(self, deviation=deviation)


@dataclass(frozen=True)
class Sample:
    """A coupon ready to be shown: its scene, size [mm] and finish; ``origin`` is all that it was made from.

    ``light``: what light sees of its finish.
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
        """``aluminium/ground Ra 0.37`` or ``matt_white``."""
        return self.finish if math.isnan(self.roughness) else f"{self.finish} Ra {self.roughness:g}"

    def at(self, sensor_from_coupon: Transform) -> Coupon:
        """The coupon where it stands in the sensor frame."""
        axes = sensor_from_coupon.rotation
        return Coupon(sensor_from_coupon.translation, axes[:, 2], axes[:, 0], self.width, self.height)


def load_sample(recipe: CouponRecipe, asked: tuple[Path, str] | None = None) -> Sample:
    """Make a coupon by its recipe; ``asked`` is the file and field that name it, for a complaint.

    Raises
    ------
    InputError
        If the scene is not a coupon.
    """
    path, where = asked or (Path(recipe.scene), "")
    scene = load_scene(recipe.scene, recipe.wavelength_nm, dict(recipe.parameters), recipe.deviation)
    finish = scene.finishes[0]
    if len(scene.names) != 1 or finish is None:
        found = f"{len(scene.names)} shapes" if finish else "a BSDF of no known finish"
        raise InputError(
            path,
            where,
            found,
            "one flat shape with a BSDF of mitsim's own (machined_metal, matt_white, gloss_paint, powder_coat)",
        )
    (x0, y0, z0), (x1, y1, z1) = scene.bounds
    if max(abs(z0), abs(z1)) > 1e-3 * (x1 - x0) or abs(x0 + x1) + abs(y0 + y1) > 1e-3 * (x1 - x0):
        raise InputError(path, where, "a coupon elsewhere", "a flat shape in the plane z = 0, centred, normal +z")
    # the scatter stands for files that the scene names, a trace or a height map, and for the deviation
    origin = Path(scene.where).read_text(encoding="utf-8") + json.dumps(dict(recipe.parameters), sort_keys=True)
    origin += repr(finish.scatter)
    return Sample(recipe, scene, float(x1 - x0), float(y1 - y0), finish.name, finish.roughness, origin, finish.light)
