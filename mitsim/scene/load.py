"""Load a scene: Mitsuba's geometry and materials, with the names that a measurement task uses.

Signal chain: scene XML, checked (:mod:`mitsim.scene.xml_check`) -> Mitsuba's parser, which makes BSDFs from finishes
(:mod:`mitsim.scene.materials`) -> shapes with their names, finishes and bounds.

The ``id`` of a shape in the XML is the name of a feature, and its BSDF is the finish. Lengths are in mm.

Everything is loaded in one thread, so that the values of a scene on the device are made, and waited for, in the order
of the program. Scenes are too small to gain from more threads.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from characterisation.files.errors import InputError, in_one_line, nearest
from mitsim.scene import backend
from mitsim.scene.materials import Finish, loading, register
from mitsim.scene.mirrored import face_normals_side
from mitsim.scene.scene_errors import explain_error
from mitsim.scene.surface.scatter import NOMINAL, Deviation
from mitsim.scene.xml_check import check_rotations, check_spectra, checked_trees
from mitsim.sensor.poses import as_pose
from mitsim.sensor.transforms import Transform

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_registered = False


@dataclass(frozen=True)
class Scene:
    """A loaded scene.

    - ``mitsuba``: the ``mi.Scene``.
    - ``names``: ids of the shapes, in Mitsuba's order.
    - ``finishes`` of the shapes; None for a stock BSDF, about which nothing is known.
    - ``bounds`` (2, 3): corners of the bounding box of all shapes but lamps [mm], world frame.
    - ``where``: file that it was loaded from, or a description.
    - ``parameters``: values given for its ``<default>`` elements.
    - ``changeable``: whether :meth:`deviated` can change every finish: none is nested in another BSDF or an instance.
    """

    mitsuba: Any = field(repr=False)
    names: tuple[str, ...]
    finishes: tuple[Finish | None, ...]
    bounds: NDArray[np.float64]
    where: str
    changeable: bool = False
    parameters: dict[str, str] = field(default_factory=dict)

    @property
    def shapes(self) -> list[Any]:
        """Mitsuba's shapes, in the order of ``names``."""
        return list(self.mitsuba.shapes())

    @property
    def has_lay(self) -> bool:
        """Return whether the lobe of some shape is wider along one direction of its surface than along the other."""
        lights = [None if finish is None else finish.light for finish in self.finishes]
        return any(light is not None and light.has_lay for light in lights)

    @property
    def centre(self) -> NDArray[np.float64]:
        """Centre of the bounding box, (3,) [mm]."""
        return np.asarray(self.bounds.mean(axis=0))

    def plot(self, ax: Axes | None = None, *, pose: Transform | ArrayLike | None = None) -> Axes:
        """Draw the shapes in colours with their names, to scale.

        Parameters
        ----------
        ax
            Axes to draw into; by default those of a new figure.
        pose
            ``world_from_sensor``, from :func:`mitsim.look_at`, or a (4, 4) matrix [mm]: draw what a sensor sees from
            there, along parallel rays. By default the view is from the front and above.

        Returns
        -------
        matplotlib.axes.Axes
            x is to the right and y up in the picture [mm].

        Raises
        ------
        InputError
            If the pose is not a rigid motion, or ``ax`` is something else.

        Examples
        --------
        >>> import mitsim as ms
        >>> scene = ms.load_scene("two_pillars.xml", ms.load_sensor("small.toml"))
        >>> axes = scene.plot(pose=ms.look_at((0, -300, 400)))
        >>> sorted(text.get_text() for text in axes.texts if text.get_text() in scene.names)
        ['pillar1', 'pillar1_top', 'pillar2', 'pillar2_top', 'plane']
        """
        # imported here because a scene alone needs neither matplotlib nor rays
        from mitsim.scene.picture import draw_scene

        seen_from = None if pose is None else as_pose(pose, "plot")
        return draw_scene(self.mitsuba, self.names, self.bounds, ax, seen_from)

    def deviated(self, deviation: Callable[[str], Deviation]) -> Scene:
        """Return the scene with finishes that deviate from their best estimates, by the ids of their BSDFs.

        Geometry is shared: the shapes get new BSDFs *in place*, so this scene must not be used afterwards other than by
        calling ``deviated`` again. A finish takes about a millisecond, and its numbers are inputs of kernels.
        """
        assert self.changeable
        made: dict[str, tuple[Any, Finish]] = {}
        finishes: list[Finish | None] = []
        for shape, finish in zip(self.shapes, self.finishes, strict=True):
            if finish is None or finish.deviated is None:
                finishes.append(finish)
                continue
            name = shape.bsdf().id()
            if name not in made:
                moved = replace(finish.deviated(deviation), deviated=finish.deviated)
                assert moved.description is not None
                made[name] = bsdf_of(moved.description, name), moved
            shape.set_bsdf(made[name][0])
            finishes.append(made[name][1])
        return replace(self, finishes=tuple(finishes))

    def only(self, *names: str) -> Scene:
        """Return a scene with these shapes alone, in the order given."""
        chosen, shapes = [self.names.index(name) for name in names], self.shapes
        part = backend.mi.load_dict(
            {"type": "scene", **{f"shape_{i}": shapes[i] for i in chosen}}, parallel=False, optimize=False
        )
        return Scene(
            part,
            names,
            tuple(self.finishes[i] for i in chosen),
            _part_bounds(part),
            self.where,
            parameters=self.parameters,
        )


def load_scene(
    path: str | Path,
    wavelength_nm: float,
    parameters: dict[str, str] | None = None,
    deviation: Deviation | Callable[[str], Deviation] = NOMINAL,
    sprayed: bool = False,
) -> Scene:
    """Load a scene XML for a sensor of one wavelength [nm].

    Parameters
    ----------
    path, wavelength_nm
        The scene XML, and the wavelength at which its materials are evaluated.
    parameters
        Values for the ``<default>`` elements of the XML, as by Mitsuba's option ``-D name=value``.
    deviation
        Deviation of all finishes from their best estimates, or a function from the id of a BSDF to its deviation.
    sprayed
        Whether every finish is under a matt white spray.

    Raises
    ------
    InputError
        If the file is missing or does not parse, if Mitsuba rejects its content, or if a part in mm cannot have its
        size.

    See Also
    --------
    scene_from_dict : from a dictionary
    """
    path = Path(path)
    parameters = parameters or {}
    _check_xml(path, parameters, wavelength_nm)
    _prepare()
    with loading(wavelength_nm, str(path), path.parent, deviation, sprayed) as state:
        try:
            scene = backend.mi.load_file(str(path), parallel=False, optimize=False, **parameters)
        except Exception as error:  # Mitsuba raises plain RuntimeErrors for errors in the file
            mitsuba_error = InputError(path, "", in_one_line(error, 400), "a scene that Mitsuba 3 can load")
            raise state.fault or explain_error(mitsuba_error, path) from None
    return replace(_wrap(scene, state.finishes, str(path)), parameters=parameters)


def scene_from_dict(description: dict[str, Any], wavelength_nm: float, where: str = "scene") -> Scene:
    """Load a scene from a dictionary in Mitsuba's form; its keys are the names of the shapes.

    ``description``, ``wavelength_nm``: shapes and emitters by name, and wavelength at which the materials are evaluated
    [nm]. ``where``: description of the scene, for messages. Raises InputError if there is no shape, a part in mm cannot
    have the size, or a finish is not possible.
    """
    _prepare()
    with loading(wavelength_nm, where) as state:
        try:
            scene = backend.mi.load_dict({"type": "scene", **description}, parallel=False, optimize=False)
        except Exception:
            if state.fault is not None:  # Mitsuba wraps it in an error of its own
                raise state.fault from None
            raise
    return _wrap(scene, state.finishes, where)


def flat_coupon(finish: Finish, half_size: float) -> Scene:
    """Return a scene with a square coupon in a finish that was loaded before.

    The coupon lies in the plane z = 0, centred. Its side is 2 ``half_size`` [mm].
    """
    assert finish.description is not None
    _prepare()
    to_world = backend.mi.ScalarTransform4f().scale([half_size, half_size, 1])
    coupon = {"type": "rectangle", "to_world": to_world, "bsdf": finish.description}
    loaded = backend.mi.load_dict({"type": "scene", "coupon": coupon}, parallel=False, optimize=False)
    _share_kernels(loaded)
    return Scene(loaded, ("coupon",), (finish,), bounds_of(loaded), f"a coupon of {finish}")


def bsdf_of(description: dict[str, Any], name: str = "") -> Any:
    """Return the BSDF of a description, whose numbers are inputs of kernels."""
    bsdf = backend.mi.load_dict(description, parallel=False)
    bsdf.set_id(name)
    _share_kernels(bsdf)
    return bsdf


def _share_kernels(scene: Any) -> None:
    """Make the numbers of materials and the transforms of shapes inputs of a scene's kernels, not constants in them.

    With constants, Dr.Jit compiles a kernel for each finish and each size of a coupon, which takes seconds.

    A shape computes the inverse of its transform anew. The inverse that Mitsuba 3.9.1 makes of a rotation about a
    vector that is not a unit vector is wrong, and a rectangle that is called directly would lose a part.
    """
    parameters = backend.mi.traverse(scene)
    for key in parameters.keys():  # noqa: SIM118 - not a dict
        value = parameters[key]
        if isinstance(value, backend.mi.Float) and len(value) == 1:  # a mesh's vertices have this type too
            parameters[key] = backend.dr.opaque(backend.mi.Float, float(value[0]))
        elif isinstance(value, backend.mi.Transform4f):
            backend.dr.make_opaque(value)
            parameters[key] = value
    parameters.update()


def _prepare() -> None:
    global _registered
    backend.activate()
    if not _registered:
        register()
        _registered = True


def bounds_of(scene_object: Any) -> NDArray[np.float64]:
    """Return the corners (2, 3) of the bounding box [mm] of a Mitsuba scene or shape."""
    box = scene_object.bbox()
    return np.array([np.ravel(box.min), np.ravel(box.max)], float).reshape(2, 3)


def _part_bounds(scene: Any) -> NDArray[np.float64]:
    """Return the :func:`bounds_of` all shapes but lamps, or of lamps if there is nothing else."""
    shapes = list(scene.shapes())
    corners = np.stack([bounds_of(shape) for shape in [s for s in shapes if not s.is_emitter()] or shapes])
    return np.stack([corners[:, 0].min(axis=0), corners[:, 1].max(axis=0)])


def _wrap(scene: Any, finishes: dict[str, Finish], where: str) -> Scene:
    shapes = list(scene.shapes())
    if not shapes:
        raise InputError(where, "shape", "no shape at all", "at least one shape to be seen")
    bounds = _part_bounds(scene)
    size = float(np.linalg.norm(bounds[1] - bounds[0]))
    if not 1.0 <= size <= 1e5:
        for shape in shapes:
            if not np.isfinite(bounds_of(shape)).all():
                allowed = "finite lengths [mm]; of a cylinder, p0 and p1 that differ"
                raise InputError(where, f"shape {shape.id()}", "a place or size that is not a number", allowed)
        hint = "lengths are in mm; a part modelled in metres needs <scale value='1000'/>"
        raise InputError(where, "shape", f"a scene {size:g} mm across", "1 mm to 100 m", hint)
    face_normals_side(scene)
    _share_kernels(scene)
    names = tuple(shape.id() or f"shape_{i}" for i, shape in enumerate(shapes))
    for name, shape in zip(names, shapes, strict=True):
        _check_round(where, name, shape)
    on_shapes = [shape.bsdf().id() for shape in shapes]
    nested = {name for shape in shapes for name in _ids_inside(shape.bsdf())}
    changeable = all(shape.class_name() != "Instance" for shape in shapes) and not nested & set(finishes)
    return Scene(scene, names, tuple(finishes.get(name) for name in on_shapes), bounds, where, changeable)


def _ids_inside(bsdf: Any) -> list[str]:
    """Return the ids of the BSDFs inside a BSDF."""
    first, *inside = backend.mi.traverse(bsdf).hierarchy
    assert first is bsdf
    return [node.id() for node in inside if isinstance(node, backend.mi.BSDF)]


def _check_round(where: str, name: str, shape: Any) -> None:
    """Reject a sphere or cylinder whose section is an ellipse: Mitsuba draws a circle, but samples the ellipse."""
    kind = shape.class_name()
    if kind not in ("Sphere", "Cylinder"):
        return
    axes = np.array(backend.mi.traverse(shape)["to_world"].matrix, float).reshape(4, 4)[:3, :3]
    products = axes.T @ axes
    if kind == "Cylinder":  # its length is independent
        products[2, 2] = products[0, 0]
    if np.abs(products - products[0, 0] * np.eye(3)).max() > 1e-4 * products[0, 0]:
        found = f"a {kind.lower()} that to_world scales unequally or shears"
        raise InputError(where, f"shape {name}", found, "a circular section", "mesh other forms: mitsim part")


def _check_xml(path: Path, parameters: dict[str, str], wavelength_nm: float) -> None:
    if str(path) != str(path).encode("utf-8", "ignore").decode():
        hint = "rename the file or its folder, or start mitsim in this folder"
        raise InputError(path, "", "a path that is not UTF-8", "one that Mitsuba 3 can open", hint)
    root, *_ = trees = checked_trees(path, parameters)
    if root.tag != "scene":
        raise InputError(path, "", f"the root element <{root.tag}>", "<scene version='3.0.0'>")
    names = [str(d.get("name")) for d in root.iter("default")]
    for name in parameters:
        if name not in names:
            allowed = ", ".join(names) or "none: the scene has no <default>"
            raise InputError(path, name, "a parameter that the scene does not have", allowed, nearest(name, names))
    check_rotations(path, trees, parameters)
    check_spectra(path, trees, parameters, wavelength_nm)
