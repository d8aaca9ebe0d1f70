"""Compute the light of a flat coupon as a function of its lobe width, and its derivative by automatic differentiation.

Signal chain: unit directions toward camera and light at each pixel -> Mitsuba's stock lobes of a machined metal, whose
parameters depend on one variable -> pi f [1] and its derivative, in one forward pass of Dr.Jit.

The radiance L of a pixel on a coupon is a product. L_1 = E / pi is the radiance of a Lambertian coupon of reflectance
1. It depends on projector, pattern, lenses and pose, and :mod:`mitsim.scene.light_transport.transport` renders it once.
The finish enters only by pi f, where f is the BRDF [1/sr] at parameter theta:

    L = L_1 pi f(theta; view, light)        dL/dtheta = L_1 pi df/dtheta

This holds if f is constant inside a pixel and across the two apertures. Forward mode is used because there is one
variable and one value per pixel. The lobes are ``roughconductor`` BSDFs in a ``blendbsdf`` and a ``coherent_blend``, as
in :func:`mitsim.scene.bsdf_descriptions.metal_bsdf`. Here no lobe is dropped, because the tree must not change with the
variable.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mitsim.scene import backend
from mitsim.scene.backend import dr, mi
from mitsim.scene.bsdf_descriptions import conductor_bsdf
from mitsim.scene.coherent_blend import NAME, NUMBERS, register_coherent_blend
from mitsim.scene.load import Scene, scene_from_dict
from mitsim.scene.surface.coherence import EVEN_FROM
from mitsim.scene.surface.scatter import Scatter

#: step of the central differences of the lobe's parameters (energy, coherence); the error is of the order of its square
_STEP = 1e-3

#: name of the incoherent lobe in the tree of BSDFs
_INCOHERENT = "lobe"

#: name of the coherent reflection in the tree of BSDFs
_MIRROR = "mirror"


def lambertian_coupon(width: float, height: float, wavelength_nm: float) -> Scene:
    """Return a scene with one white Lambertian coupon of reflectance 1.

    ``width`` and ``height`` are along x and y [mm]. The coupon lies in the plane z = 0, centred, with normal +z.
    """
    backend.activate()
    to_world = mi.ScalarTransform4f().scale([width / 2, height / 2, 1.0])
    white = {"type": "diffuse", "reflectance": {"type": "uniform", "value": 1.0}}
    return scene_from_dict({"coupon": {"type": "rectangle", "to_world": to_world, "bsdf": white}}, wavelength_nm)


class Directions:
    """Unit directions from points of a coupon, in its frame (z is the normal).

    ``view`` (N, 3) toward the camera and ``light`` (N, 3) toward the projector.

    Raises
    ------
    ValueError
        If the shapes differ or are not (N, 3).
    """

    def __init__(self, view: NDArray[np.floating], light: NDArray[np.floating]) -> None:
        if view.shape != light.shape or view.ndim != 2 or view.shape[1] != 3:
            raise ValueError(f"directions {view.shape} and {light.shape}: both must be (N, 3)")
        self.count = len(view)
        self.view, self.light = (mi.Vector3f(np.ascontiguousarray(d.T, np.float32)) for d in (view, light))
        #: whether the lobe's factor h is 1 for all pairs, with a margin for single precision
        self.even = bool(((view[:, 2] + light[:, 2]) / 2 > EVEN_FROM + 1e-6).all())


class SpecularLobe:
    """The specular light of a machined metal: all reflected light except the wide-angle share.

    ``index`` is n and k of the metal [1]. Each call gives the parameters of the lobes as a :class:`Scatter`.
    """

    def __init__(self, index: tuple[float, float]) -> None:
        backend.activate()
        register_coherent_blend()
        ggx, beckmann, mirror = (conductor_bsdf(name, (0.1, 0.1), index) for name in ("ggx", "beckmann", "beckmann"))
        incoherent = {"type": "blendbsdf", "weight": 0.5, "first": ggx, "second": beckmann}
        numbers = dict.fromkeys(NUMBERS, 0.0)
        tree = {"type": NAME, "phase_variance": 1.0, **numbers, "mirror": mirror, "lobe": incoherent}
        self._bsdf = mi.load_dict(tree, parallel=False, optimize=False)  # equal textures must not be merged
        self._parameters = mi.traverse(self._bsdf)

    def reflectance(self, scatter: Scatter, directions: Directions) -> NDArray[np.float64]:
        """Return pi f [1] of each pair of directions, (N,); 0 where one is below the surface."""
        numbers = _numbers(scatter, directions)
        self._set({name: mi.Float(dr.opaque(mi.Float, value)) for name, value in numbers.items()})
        return np.array(self._evaluate(directions), np.float64)

    def reflectance_and_slope(
        self, scatter_at: Callable[[float], Scatter], x: float, directions: Directions
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return pi f [1] at ``scatter_at(x)`` and its derivative by x, (N,) each.

        Dr.Jit differentiates pi f by the parameters of the lobes. The derivatives of these few parameters by x are
        central differences.
        """
        here, above, below = (_numbers(scatter_at(x + step), directions) for step in (0.0, _STEP, -_STEP))
        change = dr.opaque(mi.Float, 0.0)
        dr.enable_grad(change)
        self._set(
            {
                name: dr.opaque(mi.Float, value)
                + change * dr.opaque(mi.Float, (above[name] - below[name]) / (2 * _STEP))
                for name, value in here.items()
            }
        )
        value = self._evaluate(directions)
        dr.forward(change)
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
        value = self._bsdf.eval(mi.BSDFContext(), surface, directions.light)[0]  # f times the cosine toward the light
        above = (directions.view.z > 0) & (directions.light.z > 0)
        return dr.select(above, dr.pi * value / dr.maximum(directions.light.z, 1e-6), 0.0)


def _numbers(scatter: Scatter, directions: Directions) -> dict[str, float]:
    """Return the values of the parameters of the BSDF tree, by their names in Mitsuba.

    The coefficients of h take most of the time of a fit, so they are 0 where h is 1 whatever they are.
    """
    coefficients = (0.0, 0.0, 0.0) if directions.even else scatter.lobe_numbers
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
        **dict(zip(NUMBERS, coefficients, strict=True)),
    }
