"""A scene: Mitsuba's geometry and materials, with the names that a measurement task uses.

A shape's ``id`` in the XML is the feature's name; its BSDF carries the finish. Lengths are mm.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mitsim.errors import InputError, nearest
from mitsim.scene import backend
from mitsim.scene.materials import Finish, loading, register
from mitsim.scene.scene_errors import explained
from mitsim.scene.xml_check import checked_xml
from mitsim.surface.scatter import NOMINAL, Deviation

_registered = False


@dataclass(frozen=True)
class Scene:
    """A loaded scene.

    ``mitsuba`` is the ``mi.Scene``; ``names`` the shape ids in order; ``finishes`` one per shape (None for a stock
    BSDF that we know nothing of); ``bounds`` (2, 3) [mm]; ``where`` the file it came from.
    """

    mitsuba: Any = field(repr=False)
    names: tuple[str, ...]
    finishes: tuple[Finish | None, ...]
    bounds: NDArray[np.float64]
    where: str

    @property
    def shapes(self) -> list[Any]:
        """Mitsuba's shapes, in the order of ``names``."""
        return list(self.mitsuba.shapes())

    @property
    def centre(self) -> NDArray[np.float64]:
        """Middle of the bounding box, (3,) [mm]."""
        return np.asarray(self.bounds.mean(axis=0))

    def only(self, *names: str) -> Scene:
        """The scene with nothing but some of its shapes, in the order given."""
        chosen, shapes = [self.names.index(name) for name in names], self.shapes
        alone = backend.mi.load_dict({"type": "scene", **{f"shape_{i}": shapes[i] for i in chosen}}, optimize=False)
        return Scene(alone, names, tuple(self.finishes[i] for i in chosen), bounds_of(alone), self.where)


def load_scene(
    path: str | Path,
    wavelength_nm: float,
    parameters: dict[str, str] | None = None,
    deviation: Deviation | Callable[[str], Deviation] = NOMINAL,
) -> Scene:
    """Read a scene XML for a sensor of one wavelength [nm].

    ``parameters`` set the ``<default>``s of the XML, as Mitsuba's ``-D name=value`` does. ``deviation`` moves every
    finish, or each by its BSDF's id, away from its best guess, by what is not known of it.

    Raises
    ------
    InputError
        If the file is missing, does not parse, uses something that Mitsuba does not know, or has a size that a part
        in mm cannot have.
    """
    path = Path(path)
    parameters = parameters or {}
    _check_xml(path, parameters)
    _prepare()
    with loading(wavelength_nm, str(path), path.parent, deviation) as learnt:
        try:
            scene = backend.mi.load_file(str(path), parallel=False, optimize=False, **parameters)
        except Exception as error:  # Mitsuba raises bare RuntimeErrors for whatever an author may do wrong
            told = InputError(path, "", _one_line(error), "a scene that Mitsuba 3 can load")
            raise learnt.fault or explained(told, path) from None
    return _wrap(scene, learnt.finishes, str(path))


def scene_from_dict(description: dict[str, Any], wavelength_nm: float, where: str = "scene") -> Scene:
    """Load a scene from Mitsuba's dictionary form; shapes are named by their keys."""
    _prepare()
    with loading(wavelength_nm, where) as learnt:
        scene = backend.mi.load_dict({"type": "scene", **description}, optimize=False)
    return _wrap(scene, learnt.finishes, where)


def flat_coupon(finish: Finish, half_size: float, turn_deg: float = 0.0) -> Scene:
    """A flat square in the plane z = 0, centred, in a finish that was loaded before; its side is 2 half_size [mm].

    ``turn_deg`` turns it about its normal, and its lay with it.
    """
    assert finish.description is not None
    _prepare()
    place = backend.mi.ScalarTransform4f().rotate([0, 0, 1], turn_deg).scale([half_size, half_size, 1])
    coupon = {"type": "rectangle", "to_world": place, "bsdf": finish.description}
    alone = backend.mi.load_dict({"type": "scene", "coupon": coupon}, optimize=False)
    return Scene(alone, ("coupon",), (finish,), bounds_of(alone), f"a coupon of {finish}")


def share_kernels(scene: Scene) -> Scene:
    """Keep the numbers of a scene's materials out of its kernels, and return it.

    A kernel that holds them as constants is compiled again for every other finish, which takes seconds; where several
    finishes of one part are rendered, this is quicker.
    """
    parameters = backend.mi.traverse(scene.mitsuba)
    for key in parameters.keys():  # noqa: SIM118 - not a dict
        value = parameters[key]
        if isinstance(value, backend.mi.Float) and len(value) == 1:  # the vertices of a mesh are of that type too
            parameters[key] = backend.dr.opaque(backend.mi.Float, float(value[0]))
    parameters.update()
    return scene


def _prepare() -> None:
    global _registered
    backend.activate()
    if not _registered:
        register()
        _registered = True


def bounds_of(one: Any) -> NDArray[np.float64]:
    """Bounds (2, 3) [mm] of a scene or a shape of Mitsuba's."""
    box = one.bbox()
    return np.array([np.ravel(box.min), np.ravel(box.max)], float).reshape(2, 3)


def _wrap(scene: Any, finishes: dict[str, Finish], where: str) -> Scene:
    shapes = list(scene.shapes())
    if not shapes:
        raise InputError(where, "shape", "no shape at all", "at least one shape to be seen")
    bounds = bounds_of(scene)
    size = float(np.linalg.norm(bounds[1] - bounds[0]))
    if not 1.0 <= size <= 1e5:
        hint = "lengths are in mm; a part modelled in metres needs <scale value='1000'/>"
        raise InputError(where, "shape", f"a scene {size:g} mm across", "1 mm to 100 m", hint)
    names = tuple(shape.id() or f"shape_{i}" for i, shape in enumerate(shapes))
    return Scene(scene, names, tuple(finishes.get(s.bsdf().id()) for s in shapes), bounds, where)


def _check_xml(path: Path, parameters: dict[str, str]) -> None:
    root = checked_xml(path)
    if root.tag != "scene":
        raise InputError(path, "", f"the root element <{root.tag}>", "<scene version='3.0.0'>")
    known = [str(d.get("name")) for d in root.iter("default")]
    for name in parameters:
        if name not in known:
            allowed = ", ".join(known) or "none: the scene has no <default>"
            raise InputError(path, name, "a parameter that the scene does not have", allowed, nearest(name, known))


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:400]
