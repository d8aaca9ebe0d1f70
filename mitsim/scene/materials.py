"""Materials that a scene's author names as on a drawing: metal, process and Ra, or paint and gloss.

Signal chain: properties of a BSDF in the XML, checked -> :class:`~mitsim.scene.surface.scatter.Scatter`
(:mod:`mitsim.scene.surface`) -> description of a Mitsuba BSDF (:mod:`mitsim.scene.bsdf_descriptions`) -> BSDF, and its
:class:`Finish`.

Four types of BSDF are added to Mitsuba:

- ``machined_metal``: ``roughconductor`` lobes and a diffuse wide-angle share. The coherent share of a metal grows with
  the angle of incidence, which no stock BSDF can express: :mod:`mitsim.scene.coherent_blend`.
- ``gloss_paint``: ``roughplastic``.
- ``powder_coat``: ``diffuse``, blended with a dielectric lobe.
- ``matt_white``: ``diffuse``.

A factory *returns* such a BSDF, so ``mi.load_file`` loads a scene once :func:`register` was called. Performance maps
are queried by the finish.
"""

from __future__ import annotations

import itertools
import math
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from characterisation.files.errors import InputError, nearest
from characterisation.maps.light import Light
from mitsim.scene.bsdf_descriptions import diffuse_bsdf, gloss_paint_bsdf, metal_bsdf, powder_coat_bsdf
from mitsim.scene.surface.machined import machined
from mitsim.scene.surface.machined_face import MachinedFace
from mitsim.scene.surface.measured import HeightMap, Profile, read_height_map, read_profile
from mitsim.scene.surface.metals import CONSTANTS, refractive_index
from mitsim.scene.surface.microfacet import fresnel
from mitsim.scene.surface.paint import ALPHA_RANGE, matt_white, paint
from mitsim.scene.surface.processes import PROCESSES
from mitsim.scene.surface.scatter import NOMINAL, Deviation, Scatter
from mitsim.scene.surface.surface_light import USUAL_REFLECTANCE, surface_light


@dataclass(frozen=True)
class Finish:
    """Material of a surface, as performance maps distinguish it.

    - ``name`` of the family: ``matt_white``, ``aluminium/ground``.
    - ``roughness``: Ra [um]; NaN if it has no meaning.
    - ``scatter`` at the wavelength of the sensor. This and the next two do not count in comparisons.
    - ``light``: the part of the scattering that a map stores.
    - ``description`` of the BSDF for Mitsuba.
    - ``deviated``: returns the finish for a function from the id of its BSDF to its deviation from the best estimate.
    - ``under``: the family under a spray; "" without one.
    """

    name: str
    roughness: float
    scatter: Scatter | None = field(default=None, compare=False, repr=False)
    light: Light | None = field(default=None, compare=False, repr=False)
    description: dict[str, Any] | None = field(default=None, compare=False, repr=False)
    deviated: Callable[[Callable[[str], Deviation]], Finish] | None = field(default=None, compare=False, repr=False)
    under: str = field(default="", compare=False, repr=False)

    def __str__(self) -> str:
        return self.name if math.isnan(self.roughness) else f"{self.name} Ra {self.roughness:g} um"


@dataclass
class Loading:
    """State while one scene is loaded."""

    wavelength_nm: float = 850.0
    where: str = "scene"  # the scene's file, for messages
    folder: Path = field(default_factory=Path)  # to which the file names of materials are relative
    #: of a finish from its best estimate, by the id of its BSDF
    deviation: Callable[[str], Deviation] = lambda _: NOMINAL
    sprayed: bool = False  # whether every finish is under a matt white spray
    finishes: dict[str, Finish] = field(default_factory=dict)  # loaded so far, by the id of the BSDF
    #: first error of the author. It is kept here because Mitsuba replaces our exceptions by its own
    fault: InputError | None = None
    #: numbers of BSDFs without an id of their own. They start anew, so that another loading of the scene gives each the
    #: same id
    unnamed: Iterator[int] = field(default_factory=itertools.count)


# state of scenes that a program loads by Mitsuba itself: nobody asks for their finishes
_OUTSIDE = Loading()

# not a context variable: Mitsuba itself makes BSDFs in threads of its own
_current = _OUTSIDE
_lock = threading.Lock()


@contextmanager
def loading(
    wavelength_nm: float,
    where: str,
    folder: str | Path = ".",
    deviation: Deviation | Callable[[str], Deviation] = NOMINAL,
    sprayed: bool = False,
) -> Iterator[Loading]:
    """Make BSDFs for one wavelength [nm] inside this block; yield the state, which collects the finishes.

    Only one block is active at a time; others wait.

    ``wavelength_nm``, ``where``, ``folder``: as in :class:`Loading`. ``deviation``: of all finishes, or a function from
    the id of a BSDF to its deviation. ``sprayed``: as in :class:`Loading`.
    """
    global _current
    with _lock:
        deviation_of = deviation if callable(deviation) else lambda _: deviation
        before, _current = _current, Loading(wavelength_nm, where, Path(folder), deviation_of, sprayed)
        try:
            yield _current
        finally:
            _current = before


_METAL_KEYS = (
    "metal process Ra Rq Rdq RSm profile profile_along height_map spacing_um gloss alpha alpha_u alpha_v lay "
    "nose_radius_mm feed_marks alpha_factor wide_angle_share"
)


def _machined_metal(props: Any) -> Any:
    where = _where(props)
    _only_known(props, where, _METAL_KEYS.split())

    def number(key: str, low: float, high: float, unit: str) -> float | None:
        return _number_within(props, where, key, None, low, high, unit) if key in props else None

    face = MachinedFace(
        metal=_choice(props, where, "metal", "aluminium", list(CONSTANTS)),
        process=_choice(props, where, "process", "ground", list(PROCESSES)) if "process" in props else None,
        Ra=number("Ra", 0.005, 10.0, "um"),
        Rq=number("Rq", 0.005, 20.0, "um"),
        Rdq=number("Rdq", 0.001, 1.0, ""),
        RSm=number("RSm", 1.0, 1000.0, "um"),
        profile=_profile(props, where, "profile"),
        profile_along=_profile(props, where, "profile_along"),
        height_map=_height_map(props, where),
        gloss=number("gloss", 1.0, 2000.0, "GU"),
        alpha=number("alpha", 0.002, 0.5, ""),
        alpha_u=number("alpha_u", 0.002, 0.5, ""),
        alpha_v=number("alpha_v", 0.002, 0.5, ""),
        lay=_choice(props, where, "lay", "none", ["u", "v", "none"]) if "lay" in props else None,  # type: ignore[arg-type]
        nose_radius=number("nose_radius_mm", 0.05, 10.0, "mm"),
        feed_marks=_choice(props, where, "feed_marks", "blurred", ["blurred", "resolved"])
        if "feed_marks" in props
        else None,
        alpha_factor=_number_within(props, where, "alpha_factor", 1.0, 0.1, 10.0, ""),
        wide_angle=number("wide_angle_share", 0.0, 1.0, ""),
    )
    return _make_bsdf(props, partial(_metal_finish, face, where, _current.wavelength_nm))


def _metal_finish(face: MachinedFace, where: str, wavelength_nm: float, deviation: Deviation) -> Finish:
    scatter = machined(face, wavelength_nm, where, deviation)
    index = refractive_index(face.metal, wavelength_nm)
    reflectance = float(fresnel(1.0, *index))
    reflected = deviation.reflected(reflectance)
    name = f"{face.metal}/{face.process_or_default}"
    light = surface_light("metal", reflectance * reflected, scatter, name, face.roughness, wavelength_nm)
    return Finish(name, face.roughness, scatter, light, metal_bsdf(index, scatter, reflected))


def _matt_white(props: Any) -> Any:
    where = _where(props)
    _only_known(props, where, ("reflectance",))
    reflectance = _number_within(props, where, "reflectance", USUAL_REFLECTANCE["matt_white"], 0.01, 0.99, "")
    return _make_bsdf(props, partial(_white_finish, reflectance, _current.wavelength_nm))


def _white_finish(reflectance: float, wavelength_nm: float, deviation: Deviation) -> Finish:
    reflectance *= deviation.reflected(reflectance)
    scatter = matt_white()
    light = surface_light("matt", reflectance, scatter, "matt_white", math.nan, wavelength_nm)
    return Finish("matt_white", math.nan, scatter, light, diffuse_bsdf(reflectance))


def _paint(kind: str, greatest: float, describe: Callable[[float, Scatter], dict[str, Any]]) -> Callable[[Any], Any]:
    def make(props: Any) -> Any:
        where = _where(props)
        _only_known(props, where, ("reflectance", "gloss", "alpha"))
        reflectance = _number_within(props, where, "reflectance", USUAL_REFLECTANCE[kind], 0.01, greatest, "")
        gloss = _number_within(props, where, "gloss", None, 0.5, 100.0, "GU") if "gloss" in props else None
        alpha = _number_within(props, where, "alpha", None, *ALPHA_RANGE[kind], "") if "alpha" in props else None
        wavelength_nm = _current.wavelength_nm

        def finish(deviation: Deviation) -> Finish:
            scatter = paint(kind, reflectance, gloss, alpha, where, deviation)
            reflected = min(reflectance * deviation.reflected(reflectance), greatest)
            light = surface_light(kind, reflected, scatter, kind, math.nan, wavelength_nm)
            return Finish(kind, math.nan, scatter, light, describe(reflected, scatter))

        return _make_bsdf(props, finish)

    return make


def _make_bsdf(props: Any, finish_of: Callable[[Deviation], Finish]) -> Any:
    """Make a finish's BSDF and store the finish by its id, or by its number in the shape, fixed over loadings."""
    from mitsim.scene.backend import mi

    name = props.id()
    while not name or name in _current.finishes:
        name = f"{props.id() or 'finish'}_{next(_current.unnamed)}"
    under = finish_of(NOMINAL).name if _current.sprayed else ""
    if under:
        finish_of = partial(_white_finish, USUAL_REFLECTANCE["matt_white"], _current.wavelength_nm)

    def deviated(deviation: Callable[[str], Deviation]) -> Finish:
        return finish_of(deviation(name))

    finish = deviated(_current.deviation)
    bsdf = mi.load_dict(finish.description, parallel=False)
    bsdf.set_id(name)
    if _current is not _OUTSIDE:
        _current.finishes[name] = replace(finish, deviated=deviated, under=under)
    return bsdf


def register() -> None:
    """Register the four types of BSDF with Mitsuba; call it after the variant is chosen."""
    from mitsim.scene.backend import mi

    mi.register_bsdf("machined_metal", _keeping_fault(_machined_metal))
    mi.register_bsdf("matt_white", _keeping_fault(_matt_white))
    mi.register_bsdf("gloss_paint", _keeping_fault(_paint("gloss_paint", 0.95, gloss_paint_bsdf)))
    mi.register_bsdf("powder_coat", _keeping_fault(_paint("powder_coat", 0.85, powder_coat_bsdf)))


def _keeping_fault(factory: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Wrap a factory so that its first error is kept in the state."""

    def make(props: Any) -> Any:
        try:
            return factory(props)
        except InputError as fault:
            _current.fault = _current.fault or fault
            raise

    return make


def _where(props: Any) -> str:
    return f"{_current.where}: bsdf {props.id()!r}" if props.id() else f"{_current.where}: a bsdf"


def _profile(props: Any, where: str, key: str) -> Profile | None:
    path = _path(props, where, key, "a CSV of columns x and z")
    return None if path is None else read_profile(path, where, key)


def _height_map(props: Any, where: str) -> HeightMap | None:
    path = _path(props, where, "height_map", "a .npy or CSV of heights in um")
    if path is None:
        if "spacing_um" in props:
            raise InputError(where, "spacing_um", "spacing_um without height_map", "both or neither")
        return None
    spacing = _number_within(props, where, "spacing_um", None, 0.01, 50.0, "um")
    return read_height_map(path, spacing, where)


def _path(props: Any, where: str, key: str, allowed: str) -> Path | None:
    if key not in props:
        return None
    value = props.get(key)
    if not isinstance(value, str) or not value:
        raise InputError(where, key, repr(value), allowed, f'write <string name="{key}" value="..."/>')
    return _current.folder / value


def _only_known(props: Any, where: str, names: Sequence[str]) -> None:
    """Raise :class:`InputError` if a BSDF has a property that is not ``names``."""
    for key in props.keys():  # noqa: SIM118 - not a dict
        if key not in names:
            raise InputError(where, str(key), "an unknown property", ", ".join(names), nearest(str(key), list(names)))


def _choice(props: Any, where: str, key: str, default: str, choices: list[str]) -> str:
    """Return a text property of a BSDF; raise :class:`InputError` if it is not one of ``choices``."""
    value = props.get(key, default)
    if value not in choices:
        raise InputError(where, key, repr(value), ", ".join(choices), nearest(str(value), choices))
    return str(value)


def _number_within(
    props: Any, where: str, key: str, default: float | None, low: float, high: float, unit: str
) -> float:
    """Return a numeric property of a BSDF; raise :class:`InputError` if it is not within the limits, ``unit`` in words.

    ``default`` is for a BSDF without the property; None if it is required.
    """
    allowed = f"a number from {low:g} to {high:g} {unit}".rstrip()
    value = props.get(key, default)
    if value is None:
        raise InputError(where, key, "nothing", allowed)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(where, key, repr(value), allowed, f'write <float name="{key}" value="..."/>')
    if not low <= value <= high:
        raise InputError(where, key, f"{value:g}", allowed)
    return float(value)
