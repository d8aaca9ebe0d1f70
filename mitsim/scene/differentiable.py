"""The light of a flat coupon as a function of its lobe's width, with its derivative by automatic differentiation.

Signal chain: unit directions toward camera and lamp at every pixel -> Mitsuba's stock lobes of a machined metal, their
numbers attached to one variable -> pi f [1] and its derivative, in one forward pass of Dr.Jit.

On a coupon the radiance L of a pixel is the product of two things. L_1 = E / pi is what a Lambertian coupon of
reflectance 1 would send there: projector, pattern, lenses and pose are in it, and it is rendered once, by
:mod:`mitsim.scene.light_transport.transport`. The finish is in pi f alone, f being its BRDF [1/sr]:

    L = L_1 pi f(theta; view, lamp)        dL/dtheta = L_1 pi df/dtheta

That holds as far as f does not vary inside a pixel and across the two apertures. Forward mode, because there is one
variable and a value for every pixel. The lobes are ``roughconductor`` under a ``blendbsdf`` and a
``coherent_blend``, as :func:`mitsim.scene.bsdf_descriptions.metal_bsdf` makes them, but never fewer: the tree must not
change with the variable.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mitsim.scene import backend
from mitsim.scene.backend import dr, mi
from mitsim.scene.coherent_blend import NAME, NUMBERS, register_coherent_blend
from mitsim.scene.load import Scene, scene_from_dict
from mitsim.surface.scatter import Scatter

#: step of the variable over which the lobe's own numbers (energy, coherence) are differenced; their error is its square
_STEP = 1e-3

_INCOHERENT, _MIRROR = "lobe", "mirror"


def lambertian_coupon(width: float, height: float, wavelength_nm: float) -> Scene:
    """A flat coupon [mm] in the plane z = 0, centred, normal +z, that reflects all light evenly."""
    backend.activate()
    place = mi.ScalarTransform4f().scale([width / 2, height / 2, 1.0])
    white = {"type": "diffuse", "reflectance": {"type": "uniform", "value": 1.0}}
    return scene_from_dict({"coupon": {"type": "rectangle", "to_world": place, "bsdf": white}}, wavelength_nm)


class Directions:
    """Unit directions (N, 3) from points of a coupon toward the camera and the lamp, in its frame (z the normal)."""

    def __init__(self, view: NDArray[np.floating], lamp: NDArray[np.floating]) -> None:
        if view.shape != lamp.shape or view.ndim != 2 or view.shape[1] != 3:
            raise ValueError(f"directions {view.shape} and {lamp.shape}: both must be (N, 3)")
        self.count = len(view)
        self.view, self.lamp = (mi.Vector3f(np.ascontiguousarray(d.T, np.float32)) for d in (view, lamp))


class SpecularLobe:
    """The specular light of a machined metal, all but its wide-angle share.

    ``index`` (n, k) of the metal. What the lobe is made of comes with each call, as a :class:`Scatter`.
    """

    def __init__(self, index: tuple[float, float]) -> None:
        backend.activate()

        def lobe(distribution: str) -> dict[str, Any]:
            return {
                "type": "roughconductor",
                "distribution": distribution,
                "alpha_u": 0.1,
                "alpha_v": 0.1,
                "eta": index[0],
                "k": index[1],
                "specular_reflectance": {"type": "uniform", "value": 1.0},
            }

        register_coherent_blend()
        incoherent = {"type": "blendbsdf", "weight": 0.5, "first": lobe("ggx"), "second": lobe("beckmann")}
        numbers = dict.fromkeys(NUMBERS, 0.0)
        tree = {"type": NAME, "phase_variance": 1.0, **numbers, "mirror": lobe("beckmann"), "lobe": incoherent}
        self._bsdf = mi.load_dict(tree, optimize=False)  # equal textures must stay two
        self._parameters = mi.traverse(self._bsdf)

    def reflectance(self, scatter: Scatter, directions: Directions) -> NDArray[np.float64]:
        """Pi f [1] of every pair of directions, (N,); 0 where either lies below the surface."""
        self._set({name: mi.Float(dr.opaque(mi.Float, value)) for name, value in _numbers(scatter).items()})
        return np.array(self._evaluate(directions), np.float64)

    def reflectance_and_slope(
        self, scatter_at: Callable[[float], Scatter], x: float, directions: Directions
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Pi f [1] at ``scatter_at(x)``, and its derivative by x, both (N,).

        Dr.Jit differentiates what Mitsuba does with the lobe's numbers; how these follow from x, a few scalars, is
        differenced.
        """
        here, above, below = (_numbers(scatter_at(x + step)) for step in (0.0, _STEP, -_STEP))
        moved = dr.opaque(mi.Float, 0.0)
        dr.enable_grad(moved)
        self._set(
            {
                name: dr.opaque(mi.Float, value)
                + moved * dr.opaque(mi.Float, (above[name] - below[name]) / (2 * _STEP))
                for name, value in here.items()
            }
        )
        value = self._evaluate(directions)
        dr.forward(moved)
        slope = dr.grad(value)
        dr.eval(value, slope)
        return np.array(dr.detach(value), np.float64), np.array(slope, np.float64)

    def _set(self, numbers: dict[str, Any]) -> None:
        for name, value in numbers.items():
            self._parameters[name] = value
        self._parameters.update()

    def _evaluate(self, directions: Directions) -> Any:
        surface = dr.zeros(mi.SurfaceInteraction3f, directions.count)
        surface.wi = directions.view
        value = self._bsdf.eval(mi.BSDFContext(), surface, directions.lamp)[0]  # with the cosine of the lamp
        above = (directions.view.z > 0) & (directions.lamp.z > 0)
        return dr.select(above, dr.pi * value / dr.maximum(directions.lamp.z, 1e-6), 0.0)


def _numbers(scatter: Scatter) -> dict[str, float]:
    """What the tree's parameters are set to, by Mitsuba's names for them."""
    ggx, beckmann = f"{_INCOHERENT}.bsdf_0", f"{_INCOHERENT}.bsdf_1"
    (ggx_u, ggx_v), (mirror_u, mirror_v) = scatter.ggx_alpha, scatter.coherent_alpha
    return {
        f"{ggx}.alpha_u.value": ggx_u,
        f"{ggx}.alpha_v.value": ggx_v,
        f"{ggx}.specular_reflectance.value": scatter.energy_factor[0],
        f"{beckmann}.alpha_u.value": scatter.alpha_u,
        f"{beckmann}.alpha_v.value": scatter.alpha_v,
        f"{beckmann}.specular_reflectance.value": scatter.energy_factor[1],
        f"{_INCOHERENT}.weight.value": scatter.beckmann,
        f"{_MIRROR}.alpha_u.value": mirror_u,
        f"{_MIRROR}.alpha_v.value": mirror_v,
        "phase_variance": scatter.phase_variance,
        **dict(zip(NUMBERS, scatter.lobe_numbers, strict=True)),
    }
