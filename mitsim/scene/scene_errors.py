"""Translate Mitsuba's error messages about a scene: place, value found, values allowed, nearest valid name.

Mitsuba names the error and the place, but not the valid values. Messages that are not recognised are passed on
unchanged.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

from characterisation.files.errors import InputError, nearest

#: properties of the Mitsuba plugins that parts use (Mitsuba's documentation, version 3.9), to suggest the nearest name
_SHAPE = "to_world flip_normals"
_MESH = f"filename face_normals flip_tex_coords {_SHAPE}"
_PROPERTIES: dict[str, tuple[str, ...]] = {
    plugin: tuple(names.split())
    for plugin, names in {
        "rectangle": _SHAPE,
        "disk": _SHAPE,
        "cube": _SHAPE,
        "sphere": f"center radius {_SHAPE}",
        "cylinder": f"p0 p1 radius {_SHAPE}",
        "ply": _MESH,
        "obj": _MESH,
        "diffuse": "reflectance",
        "twosided": "",
        "blendbsdf": "weight",
        "mask": "opacity",
        "conductor": "material eta k specular_reflectance",
        "roughconductor": "material eta k specular_reflectance distribution alpha alpha_u alpha_v sample_visible",
        "dielectric": "int_ior ext_ior specular_reflectance specular_transmittance",
        "roughdielectric": "int_ior ext_ior distribution alpha alpha_u alpha_v",
        "plastic": "diffuse_reflectance nonlinear int_ior ext_ior specular_reflectance",
        "roughplastic": "diffuse_reflectance nonlinear int_ior ext_ior specular_reflectance "
        "distribution alpha sample_visible",
        "principled": "base_color roughness anisotropic metallic specular clearcoat clearcoat_gloss "
        "sheen sheen_tint spec_tint spec_trans flatness eta",
    }.items()
}
_PLUGINS = [*_PROPERTIES, "machined_metal", "matt_white", "gloss_paint", "powder_coat"]


def explain_error(error: InputError, path: Path) -> InputError:
    """Return an error that quotes Mitsuba in the form of our own errors, or unchanged if its text is not recognised."""
    text = str(error.found)
    line = match[1] if (match := re.search(r"\(line (\d+)", text)) else ""
    where = f"{path}: line {line}" if line else str(path)
    if match := re.search(r'unreferenced propert(?:y|ies) in (\w+) plugin of type "(\w+)": - \w+ "([^"]+)"', text):
        kind, plugin, name = match.groups()
        properties = list(_PROPERTIES.get(plugin, ()))
        allowed = ", ".join(properties) or f"the properties that Mitsuba's manual has for {plugin}"
        return InputError(where, f"{kind} {plugin}: {name}", "an unknown property", allowed, nearest(name, properties))
    if match := re.search(r'Plugin "([^"]+)" not found', text):
        allowed = ", ".join(_PLUGINS) + " and the other plugins of Mitsuba 3"
        hint = "mitsim part turns an STL, STEP or other CAD file into a scene" if match[1] in ("stl", "step") else ""
        return InputError(where, "type", repr(match[1]), allowed, hint or nearest(match[1], _PLUGINS))
    if match := re.search(r'loading \w+ file "([^"]+)": file not found', text):
        file = Path(match[1])
        folder = (path.parent / _name_in_xml(path, file.name)).parent
        files = sorted(p.name for p in folder.glob(f"*{file.suffix}")) if folder.is_dir() else []
        allowed = f"a {file.suffix} file beside the scene"
        return InputError(where, "filename", f"{file.name!r}, which does not exist", allowed, nearest(file.name, files))
    if match := re.search(r'duplicate ID: "([^"]+)" \(previous was at .*?\(line (\d+)', text):
        found = f"a second object of the id {match[1]!r} (the first is in line {match[2]})"
        return InputError(where, "id", found, "one id for one object", "a shape's id is the name of its feature")
    if match := re.search(r'reference to "([^"]+)"', text):
        objects = ElementTree.parse(path).getroot().iter()
        ids = [str(e.get("id")) for e in objects if e.get("id") and e.tag != "ref"]
        return InputError(where, "ref", repr(match[1]), f"ids in the file: {', '.join(ids)}", nearest(match[1], ids))
    return error


def _name_in_xml(path: Path, name: str) -> str:
    """Return the path of a file as the XML has it; Mitsuba reports only its last part."""
    names = [str(e.get("value")) for e in ElementTree.parse(path).getroot().iter("string")]
    return next((candidate for candidate in names if Path(candidate).name == name), name)
