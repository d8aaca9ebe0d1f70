"""Materials that a scene's author names by what is written on the drawing: metal, process, Ra.

Two BSDF types are added to Mitsuba. ``machined_metal`` becomes stock ``roughconductor`` lobes whose width follows
from Ra (see :mod:`mitsim.scene.roughness`), plus a wide-angle share; ``matt_white`` becomes a stock ``diffuse``. A
factory *returns* the stock object, so rendering costs nothing extra and a scene loads with plain ``mi.load_file``
once this module is imported.

What a BSDF was made from is remembered as a :class:`Finish`, by which performance maps are looked up.
"""

from __future__ import annotations

import itertools
import math
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from mitsim.errors import InputError, nearest
from mitsim.scene.metals import CONSTANTS, normal_reflectance, refractive_index
from mitsim.scene.roughness import PROCESSES, scatter

#: width of the mirror-like part: form error and waviness of a real face, and the apertures of camera and projector.
#: A true mirror would be black under a point-like projector. Assumed.
ALPHA_COHERENT = 0.005

#: share of the light that leaves at wide angles, per um of Ra, and its largest value. An engineering
#: prior of ours: a polished face scatters little at wide angles, a dull one much.
WIDE_ANGLE_PER_UM, WIDE_ANGLE_LARGEST = 0.25, 0.30


@dataclass(frozen=True)
class Finish:
    """What a surface is made of, as far as a performance map cares.

    ``name`` is the family (``matt_white``, ``aluminium/ground``); ``roughness`` Ra [um], NaN where it has no meaning.
    """

    name: str
    roughness: float

    def __str__(self) -> str:
        return self.name if math.isnan(self.roughness) else f"{self.name} Ra {self.roughness:g} um"


@dataclass
class Loading:
    """What is going on while one scene loads: for which wavelength, from where, and what came of it.

    ``finishes`` by BSDF id; ``fault`` the first thing that the author got wrong, because Mitsuba turns an exception
    of ours into a text of its own.
    """

    wavelength_nm: float = 850.0
    where: str = "scene"
    finishes: dict[str, Finish] = field(default_factory=dict)
    fault: InputError | None = None


# Mitsuba makes BSDFs on threads of its own, so a context variable would not reach them
_now = Loading()
_one_at_a_time = threading.Lock()
_anonymous = itertools.count()


@contextmanager
def loading(wavelength_nm: float, where: str) -> Iterator[Loading]:
    """Within this block BSDFs are made for one wavelength [nm]; yields what is learnt on the way."""
    global _now
    with _one_at_a_time:
        before, _now = _now, Loading(wavelength_nm, where)
        try:
            yield _now
        finally:
            _now = before


_METAL_KEYS = ("metal", "process", "Ra", "alpha_factor", "wide_angle_share")


def _machined_metal(props: Any) -> Any:
    where = f"{_now.where}: bsdf {props.id()!r}" if props.id() else f"{_now.where}: a bsdf"
    _only(props, where, _METAL_KEYS)
    metal = _choice(props, where, "metal", "aluminium", list(CONSTANTS))
    process = _choice(props, where, "process", "ground", list(PROCESSES))
    roughness = _number(props, where, "Ra", None, 0.005, 10.0, "um")
    factor = _number(props, where, "alpha_factor", 1.0, 0.1, 10.0, "")
    default_share = min(WIDE_ANGLE_PER_UM * roughness, WIDE_ANGLE_LARGEST)
    share = _number(props, where, "wide_angle_share", default_share, 0.0, 1.0, "")
    return _remember(
        props,
        metal_bsdf(metal, process, roughness, _now.wavelength_nm, factor, share),
        Finish(f"{metal}/{process}", roughness),
    )


def metal_bsdf(
    metal: str, process: str, roughness_um: float, wavelength_nm: float, alpha_factor: float, wide_angle_share: float
) -> dict[str, Any]:
    """Mitsuba description of a machined metal: up to two incoherent lobes, a coherent one, a wide-angle share.

    All lobes have the same complex index, so blending them keeps the energy; ``blendbsdf`` gives its weight to the
    second child.
    """
    light = scatter(roughness_um, process, wavelength_nm, alpha_factor)
    eta, k = refractive_index(metal, wavelength_nm)

    def lobe(distribution: str, alpha: float) -> dict[str, Any]:
        return {"type": "roughconductor", "distribution": distribution, "alpha": alpha, "eta": eta, "k": k}

    def blend(first: dict[str, Any], second: dict[str, Any], weight: float) -> dict[str, Any]:
        if weight < 1e-3:
            return first
        if weight > 1 - 1e-3:
            return second
        return {"type": "blendbsdf", "weight": weight, "first": first, "second": second}

    incoherent = blend(lobe("ggx", light.alpha_ggx), lobe("beckmann", light.alpha), light.beckmann)
    mirror = lobe("beckmann", ALPHA_COHERENT)
    specular = blend(incoherent, mirror, light.coherent if light.coherent > 0.005 else 0.0)
    wide = {"type": "diffuse", "reflectance": {"type": "uniform", "value": normal_reflectance(metal, wavelength_nm)}}
    return blend(specular, wide, wide_angle_share)


def _matt_white(props: Any) -> Any:
    where = f"{_now.where}: bsdf {props.id()!r}" if props.id() else f"{_now.where}: a bsdf"
    _only(props, where, ("reflectance",))
    reflectance = _number(props, where, "reflectance", 0.85, 0.01, 0.99, "")
    description = {"type": "diffuse", "reflectance": {"type": "uniform", "value": reflectance}}
    return _remember(props, description, Finish("matt_white", math.nan))


def _remember(props: Any, description: dict[str, Any], finish: Finish) -> Any:
    from mitsim.scene.backend import mi

    bsdf = mi.load_dict(description)
    bsdf.set_id(props.id() or f"finish_{next(_anonymous)}")
    _now.finishes[bsdf.id()] = finish
    return bsdf


def register() -> None:
    """Tell Mitsuba of our BSDF types; to be called once the variant is set."""
    from mitsim.scene.backend import mi

    mi.register_bsdf("machined_metal", _telling(_machined_metal))
    mi.register_bsdf("matt_white", _telling(_matt_white))


def _telling(factory: Callable[[Any], Any]) -> Callable[[Any], Any]:
    def make(props: Any) -> Any:
        try:
            return factory(props)
        except InputError as fault:
            _now.fault = _now.fault or fault
            raise

    return make


def _only(props: Any, where: str, known: tuple[str, ...]) -> None:
    for key in props.keys():  # noqa: SIM118 - not a dict
        if key not in known:
            raise InputError(where, str(key), "an unknown property", ", ".join(known), nearest(str(key), list(known)))


def _choice(props: Any, where: str, key: str, default: str, known: list[str]) -> str:
    value = props.get(key, default)
    if value not in known:
        raise InputError(where, key, repr(value), ", ".join(known), nearest(str(value), known))
    return str(value)


def _number(
    props: Any, where: str, key: str, default: float | None, low: float, high: float, unit: str
) -> float:  # fmt: skip
    allowed = f"a number from {low:g} to {high:g} {unit}".rstrip()
    value = props.get(key, default)
    if value is None:
        raise InputError(where, key, "nothing", allowed)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(where, key, repr(value), allowed, f'write <float name="{key}" value="..."/>')
    if not low <= value <= high:
        raise InputError(where, key, f"{value:g}", allowed)
    return float(value)
