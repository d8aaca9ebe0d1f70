"""Tell from the words of a calibration to which lens model its coefficients belong.

Programs state the model as a text (``camera_model: KANNALA_BRANDT``), as a mark (``fisheye_model: 1`` of OpenCV's
sample), or by a number that only one model has: ``xi`` of the unified model (``cv2.omnidir``). The same coefficients in
another model give another camera without any other sign, so a model that OpenCV lacks is never taken for one of its
own.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from characterisation.files.errors import InputError
from mitsim.sensor.calibration_numbers import vector

#: names under which maps state the model of a lens
LENS_MODELS = (
    *("camera_model", "distortion_model", "distortion_type", "camera_type", "lens_model"),
    *("model_type", "model", "type"),
)

#: names, in small letters and without underscores, of marks that are true of a fisheye lens
_MARKS = ("fisheyemodel", "isfisheye", "usefisheye", "fisheye")

#: names of the mirror parameter of the unified model, of one camera or of each of two
_MIRROR = re.compile(r"xi_?(?:\d|left|right)?", re.IGNORECASE)

#: coefficients of a lens of eight, in OpenCV's order
_RATIONAL = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")

#: OpenCV's lens models by the names that programs give them, as :func:`_word` returns them
_MODELS = {
    **dict.fromkeys(
        (
            *("plumb_bob", "radtan", "radial_tangential", "radialtangential", "rational_polynomial", "brown_conrady"),
            *("none", "pinhole", "perspective", "opencv", "full_opencv", "pinhole_radtan", "pinhole_radtan8"),
        ),
        "perspective",
    ),
    **dict.fromkeys(
        (
            *("equidistant", "equi", "fisheye", "opencv_fisheye", "opencvfisheye", "kb", "kb4", "kb8"),
            *("kannala_brandt", "kannala_brandt4", "kannala_brandt8", "kannala_brandt_8"),
            *("kannalabrandt", "kannalabrandt4", "kannalabrandt8", "pinhole_equi", "pinhole_equidistant"),
            *("fisheye_equidistant", "equidistant_fisheye"),
        ),
        "fisheye",
    ),
}

#: parts of names of other models, and short names that stand alone; other texts may name a device
_OTHER = re.compile(
    r"fisheye|kannala|equidist|omnidir|unified|double_?sphere|scaramuzza|ocam|division|thin_prism|stereographic"
    r"|equisolid|orthographic|cylindric|equirectangular|catadioptric|field_of_view"
    r"|^(?:pinhole_)?(?:omni|mei|ucm|eucm|ds|fov|atan|equi|kb\d*|spherical)(?:_(?:radtan|equi|fov|none))?$"
)

#: models of librealsense that are OpenCV's only if all coefficients are zero
_OF_ZEROS = ("inverse_brown_conrady", "modified_brown_conrady", "ftheta", "f_theta")

#: models of librealsense in the order of their numbers (``rs2_distortion``)
_OF_LIBREALSENSE = (
    *("none", "modified_brown_conrady", "inverse_brown_conrady", "ftheta", "brown_conrady"),
    "kannala_brandt4",
)


def is_fisheye(table: dict[str, Any]) -> bool:
    """Return whether a map states OpenCV's fisheye model."""
    return any(model == "fisheye" for _, _, model in _stated(table, straight=False))


def lens_model(
    table: dict[str, Any], where: str | Path, model: str | None = None, straight: bool = False
) -> str | None:
    """Return ``perspective`` or ``fisheye`` if a table states the lens model; None if it does not.

    ``table``, ``where``, ``model``: table of the calibration file, file that messages name, and model that the sensor
    file gives. ``straight``: whether all coefficients are zero, so that the distortion model does not matter. Raises
    InputError if the model is none of OpenCV's, or contradicts ``model``.
    """
    stated = list(_stated(table, straight))
    for name, text, found in stated:
        if found == "other" and model is None:
            hint = 'if the coefficients are OpenCV\'s, say so in a sensor file: model = "perspective" or "fisheye"'
            raise InputError(where, name, repr(text), f"OpenCV's models: {', '.join(_MODELS)}", hint)
    models = {found for _, _, found in stated} - {"other"}
    stated_model = "fisheye" if "fisheye" in models else next(iter(models), None)
    if model is not None and stated_model is not None and stated_model != model:
        raise InputError(
            where, "model", repr(model), f"{stated_model}, which the calibration states", "leave out model"
        )
    return stated_model


def of_single_numbers(value: Any, sources: str, fisheye: bool, where: str | Path) -> Any:
    """Return coefficients that stand as single numbers; k1 to k4 alone are those of a fisheye lens.

    ``value``: the coefficients in the order of a perspective lens, or four of a fisheye lens. ``sources``: their names
    in the file, with commas between them. ``fisheye``: whether the lens is a fisheye. ``where``: the file, for
    messages. Raises InputError if k4 has no model.
    """
    names = [source.rpartition(".")[2].lower().replace("_", "") for source in sources.split(", ")]
    if len(value) != 8 or set(names) - set(_RATIONAL):  # two lists, or a model that is whole
        return value
    if fisheye and set(names) <= {"k1", "k2", "k3", "k4"}:
        return value[[0, 1, 4, 5]]
    check_fourth(names, [value[_RATIONAL.index(name)] for name in names], fisheye, where)
    return value


def check_fourth(names: Sequence[str], values: Sequence[float], fisheye: bool, where: str | Path) -> None:
    """Check that k4 is that of a fisheye lens, or that of OpenCV's rational lens, which has k5 and k6 too.

    ``names``, ``values``: the coefficients of a lens by name. ``fisheye``: whether the lens is a fisheye. ``where``:
    the file, for messages. Raises InputError if it is neither: the same number means another camera in other programs.
    """
    named = dict(zip(names, values, strict=True))
    if fisheye or not named.get("k4") or {"k5", "k6"} & set(named):
        return
    hint = (
        'of a fisheye lens, say so in a sensor file: [calibration] with model = "fisheye"; a k4 of r^8 (Metashape) is '
        "in no lens of OpenCV"
    )
    allowed = "k1 to k6 of OpenCV's rational lens, or k1 to k4 of a stated fisheye lens"
    raise InputError(where, ", ".join(names), f"k4 of {named['k4']:g} without k5 and k6", allowed, hint)


def _stated(table: dict[str, Any], straight: bool) -> Iterator[tuple[str, Any, str]]:
    """Yield the names, texts and models of what a table states: ``perspective``, ``fisheye`` or ``other``."""
    for name, value in table.items():
        if name.lower().replace("_", "") in _MARKS and isinstance(value, bool | int | float) and value in (0, 1):
            yield name, value, "fisheye" if value else "perspective"
        if _MIRROR.fullmatch(name) and (mirror := vector(value, 1)) is not None and mirror[0]:
            yield name, float(mirror[0]), "other"
    for name in LENS_MODELS:
        text = table.get(name)
        word = _word(name, text, "ppx" in table)
        if word in _MODELS:
            yield name, text, _MODELS[word]
        elif word in _OF_ZEROS or (word and name in ("distortion_model", "distortion_type")):
            if not straight or _OTHER.search(word):
                yield name, text, "other"
        elif _OTHER.search(word):
            yield name, text, "other"


def _word(name: str, text: Any, of_librealsense: bool) -> str:
    """Return the name of a model in small letters, joined by underscores; empty of what is none."""
    if isinstance(text, int | float | np.number) and not isinstance(text, bool):
        if name == "distortion_type":
            return {0: "perspective", 1: "fisheye"}.get(int(text), str(text))  # MC-Calib
        known = of_librealsense and name == "model" and 0 <= text < len(_OF_LIBREALSENSE)
        return _OF_LIBREALSENSE[int(text)] if known else ""
    if not isinstance(text, str):
        return ""
    word = re.sub(r"[^a-z0-9]+", "_", text.lower()).strip("_")
    return word.removeprefix("rs2_").removeprefix("distortion_")  # as librealsense and its wrappers write it
