"""Check a scene XML before Mitsuba parses it, because some content ends the process or stops it; list its files.

Mitsuba crashes on nesting thousands deep and on bitmaps without a file. BSDFs nested in BSDFs take minutes, and reading
a pipe waits forever.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib.metadata
import math
import re
import stat
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from characterisation.files.checked_files import is_file, read_bounded
from characterisation.files.errors import InputError, nearest

#: largest XML [bytes]
LARGEST_XML = 16 * 1024**2

#: most elements of one XML
MOST_ELEMENTS = 200_000

#: deepest nesting of elements; Mitsuba crashes at some thousands
DEEPEST = 40

#: deepest nesting of BSDFs, which take minutes beyond
DEEPEST_BSDF = 6

#: largest file that a scene may refer to [bytes]
LARGEST_NAMED_FILE = 1024**3

#: longest name of a file that a scene may refer to [characters]; PATH_MAX of Linux
LARGEST_NAME = 4096

#: plugins that read a file; not all of them check that it exists
_FILE_PLUGINS = {"bitmap", "envmap", "gridvolume", "measured", "ply", "obj", "serialized"}

#: plugins of spectra that Mitsuba cannot evaluate with one wavelength
_OF_WAVELENGTHS = {"irregular", "regular", "blackbody", "discrete"}

#: plugins of metals, of which Mitsuba knows the index of refraction as a function of the wavelength
_CONDUCTORS = {"conductor", "roughconductor"}

#: deepest chain of includes; a longer one is taken for a cycle
_MOST_INCLUDES = 16

#: largest deviation of the length of an axis from 1: 5 um in 100 mm
_UNIT = 5e-5

_ENCODING = re.compile(rb"""^[^>]*?encoding\s*=\s*["']([^"']*)["']""")


def checked_trees(path: Path, parameters: Mapping[str, str] | None = None) -> list[ElementTree.Element]:
    """Read a scene XML and its includes, reject what Mitsuba cannot handle, and return their root elements.

    ``parameters`` replace the values of ``<default>`` elements, of which names of files may consist. Raises InputError
    if a file is missing, does not parse, is not UTF-8, or is too large or too deeply nested. Also if it refers to
    something that is not a regular file.
    """
    return [root for _, root in _with_includes(path, dict(parameters or {}))]


def check_rotations(path: Path, trees: Sequence[ElementTree.Element], parameters: Mapping[str, str]) -> None:
    """Check that every rotation is about a unit vector: Mitsuba 3.9 scales and shears shapes by others.

    Raises InputError for the first that is not, with the unit vector.
    """
    elements, values = _elements(trees, parameters)
    for element in elements:
        if element.tag != "rotate":
            continue
        words = element.get("value", " ".join(element.get(axis, "0") for axis in "xyz"))
        try:
            axis = [float(word) for word in _filled_in(words, values).replace(",", " ").split()]
        except ValueError:
            continue  # Mitsuba reports it
        length = math.hypot(*axis)
        if abs(length - 1) > _UNIT and 0 < length < math.inf:
            unit = " ".join(f'{name}="{component / length:.7g}"' for name, component in zip("xyz", axis, strict=False))
            raise InputError(path, "rotate", f"an axis of length {length:.6g}", f"a unit vector: {unit}")


def check_spectra(
    path: Path, trees: Sequence[ElementTree.Element], parameters: Mapping[str, str], wavelength_nm: float
) -> None:
    """Check that every spectrum is one number: with one wavelength Mitsuba takes the luminance of other spectra.

    ``path``, ``trees``, ``parameters``: the scene, from :func:`checked_trees`, and the values of its parameters.
    ``wavelength_nm``: of the sensor. Raises InputError for the first that is not, with its value at the wavelength if
    the scene states it.
    """
    elements, values = _elements(trees, parameters)
    for element in elements:
        text, name = _filled_in(element.get("value", ""), values), element.get("name", "")
        if element.tag == "bsdf" and element.get("type") in _CONDUCTORS:
            _check_conductor(path, element, values, wavelength_nm)
        found = element.get("filename") or (element.get("type") if element.get("type") in _OF_WAVELENGTHS else "")
        if element.tag != "spectrum" or not (found or ":" in text):
            continue
        allowed = f"one number, its value at the sensor's wavelength, {wavelength_nm:g} nm"
        with contextlib.suppress(ValueError):
            pairs = np.array([pair.split(":") for pair in text.replace(",", " ").split()], float)
            if pairs.size and pairs[0, 0] <= wavelength_nm <= pairs[-1, 0]:
                allowed += f': value="{np.interp(wavelength_nm, *pairs.T):.6g}"'
        raise InputError(path, f"spectrum {name}".strip(), repr(found or text), allowed)


def _check_conductor(path: Path, element: ElementTree.Element, values: Mapping[str, str], wavelength_nm: float) -> None:
    """Check that a BSDF of a metal names no material, whose index of refraction is a function of the wavelength."""
    given = {child.get("name"): _filled_in(child.get("value", ""), values) for child in element}
    material = given.get("material", "none")
    if material == "none":
        return
    index = [_index_of_refraction(material, part, wavelength_nm) for part in ("eta", "k")]
    spectra = "the spectra eta and k"
    if None not in index:
        spectra = " ".join(
            f'<spectrum name="{name}" value="{value:.4g}"/>' for name, value in zip(("eta", "k"), index, strict=True)
        )
    allowed = f'<string name="material" value="none"/> with {spectra} at {wavelength_nm:g} nm; or a machined_metal'
    raise InputError(path, "material", repr(material), allowed)


def _index_of_refraction(material: str, part: str, wavelength_nm: float) -> float | None:
    """Return ``eta`` or ``k`` of a metal in Mitsuba's tables; None if they lack it, or the wavelength."""
    table = importlib.metadata.distribution("mitsuba").locate_file(f"mitsuba/data/ior/{material}.{part}.spd")
    if not (material.isidentifier() and is_file(Path(str(table)))):
        return None
    nm, value = np.loadtxt(str(table), comments="#").T
    return float(np.interp(wavelength_nm, nm, value)) if nm[0] <= wavelength_nm <= nm[-1] else None


def _elements(
    trees: Sequence[ElementTree.Element], parameters: Mapping[str, str]
) -> tuple[list[ElementTree.Element], dict[str, str]]:
    """Return all elements of some trees, and the values of their parameters."""
    elements = [element for root in trees for element in root.iter()]
    return elements, {str(e.get("name")): str(e.get("value")) for e in elements if e.tag == "default"} | dict(
        parameters
    )


def _scene_files(path: Path, parameters: Mapping[str, str]) -> list[Path]:
    """Return every file that determines a scene: its XML first, then includes, meshes, textures and spectra.

    ``parameters`` replace the values of ``<default>`` elements. Names are relative to the folder of the scene or to a
    ``<path>`` of it, else to the working folder, as for Mitsuba. A missing file is left out, since Mitsuba reports it.
    """
    trees = _with_includes(path, dict(parameters))
    elements, values = _elements([root for _, root in trees], parameters)
    folders = [path.parent]
    folders += [path.parent / _filled_in(str(e.get("value")), values) for e in elements if e.tag == "path"]
    files = dict.fromkeys(file for file, _ in trees)
    for element in elements:
        name = _filled_in(str(element.get("value" if element.tag == "string" else "filename", "")), values)
        beside = [folder / name for folder in folders if name and is_file(folder / name)]
        files |= dict.fromkeys(beside or ([Path(name)] if is_file(name) else []))
    return list(files)


def named_digests(path: Path, parameters: Mapping[str, str]) -> list[str]:
    """Return the SHA-256 of every file that a scene names, without the XML itself.

    A mesh may change while the text of the scene stays the same.
    """
    digests = []
    for file in _scene_files(path, parameters)[1:]:
        with file.open("rb") as stream:
            digests.append(hashlib.file_digest(stream, "sha256").hexdigest())
    return digests


def _filled_in(text: str, values: Mapping[str, str]) -> str:
    """Return an attribute with the values of its parameters, each written as ``$name``."""
    for _ in range(_MOST_INCLUDES if "$" in text else 0):  # a value may name another parameter
        for name in sorted(values, key=len, reverse=True):
            text = text.replace(f"${name}", values[name])[:LARGEST_NAME]
    return text


def _with_includes(
    path: Path, values: dict[str, str], include_depth: int = 0
) -> list[tuple[Path, ElementTree.Element]]:
    """Return path and checked root element of a scene XML, then those of its includes.

    ``values`` of parameters get those of the file's ``<default>`` elements that they lack. ``include_depth`` is the
    number of includes that lead to this file.
    """
    xml_files = _xml_files_beside(path)
    data = read_bounded(path, "a Mitsuba scene XML", nearest(path.name, xml_files), LARGEST_XML)
    declared = _ENCODING.match(data[:200].removeprefix(b"\xef\xbb\xbf")) if data.lstrip()[:5] != b"<scene" else None
    if declared is not None and declared[1].decode("ascii", "replace").lower() not in ("utf-8", "utf8", "us-ascii"):
        raise InputError(
            path, "encoding", declared[1].decode("ascii", "replace")[:40], "UTF-8", "save the scene as UTF-8"
        )
    try:
        text = data.decode("utf-8")
    except UnicodeDecodeError as error:
        found = f"text that is not UTF-8 (byte {error.start})"
        raise InputError(path, "encoding", found, "UTF-8", "save the scene as UTF-8") from None
    if "\0" in text:
        raise InputError(path, "", "a null character", "text")
    root = _parsed(path, text)
    trees = [(path, root)]
    values |= {str(e.get("name")): str(e.get("value")) for e in root.iter("default")} | values
    bsdfs: dict[ElementTree.Element, int] = {}
    for parent in root.iter():
        for child in parent:
            bsdfs[child] = bsdfs.get(parent, 0) + (child.tag == "bsdf")
            if bsdfs[child] > DEEPEST_BSDF:
                raise InputError(path, "bsdf", f"BSDFs within BSDFs, over {DEEPEST_BSDF} deep", f"up to {DEEPEST_BSDF}")
    for element in root.iter():
        names = [str(string.get("value")) for string in element.findall("string") if string.get("name") == "filename"]
        if element.get("type") in _FILE_PLUGINS and not names:
            raise InputError(
                path, f"{element.tag} {element.get('type')}", "no filename", "<string name='filename' value='...'/>"
            )
        for name in names:
            _check_named(path, _filled_in(name, values))
        if element.tag == "include":
            if include_depth >= _MOST_INCLUDES:
                raise InputError(path, "include", f"files that include one another over {_MOST_INCLUDES} deep", "fewer")
            included = path.parent / _filled_in(str(element.get("filename")), values)
            trees += _with_includes(included, values, include_depth + 1)
    return trees


def _parsed(path: Path, text: str) -> ElementTree.Element:
    """Return an XML text's root, parsed as events: depth and number of elements are checked on the way."""
    reader: Any = ElementTree.XMLPullParser(("start", "end"))
    depth = count = 0
    root: ElementTree.Element | None = None
    try:
        for start in range(0, len(text), 1 << 16):
            reader.feed(text[start : start + (1 << 16)])
            for event, element in reader.read_events():
                root = element if root is None else root
                depth += 1 if event == "start" else -1
                count += event == "start"
                if depth > DEEPEST or count > MOST_ELEMENTS:
                    found = f"elements nested over {DEEPEST} deep" if depth > DEEPEST else f"over {count - 1} elements"
                    raise InputError(path, "", found, f"up to {DEEPEST} deep, {MOST_ELEMENTS} elements")
        reader.close()
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        if isinstance(error, InputError):
            raise
        is_study = path.suffix.lower() == ".toml"
        hint = "name the scene of the study here; `mitsim run` and `mitsim study` take the study" if is_study else ""
        raise InputError(path, "", f"XML that does not parse ({error})", "well-formed XML", hint) from None
    if root is None:
        raise InputError(path, "", "XML that does not parse (no element found)", "well-formed XML")
    return root


def _check_named(path: Path, name: str) -> None:
    """Reject a pipe, a device and a huge file. Mitsuba itself reports a missing file."""
    try:
        status = (path.parent / name).stat()
    except (OSError, ValueError):
        return
    if not stat.S_ISREG(status.st_mode) or status.st_size > LARGEST_NAMED_FILE:
        found = f"{name!r}, " + (
            "not a regular file" if not stat.S_ISREG(status.st_mode) else f"{status.st_size} bytes"
        )
        raise InputError(path, "filename", found, f"a file of up to {LARGEST_NAMED_FILE} bytes")


def _xml_files_beside(path: Path) -> list[str]:
    """Return the names of the XML files in the same folder, to suggest one of them."""
    try:
        return sorted(file.name for file in path.parent.iterdir() if file.suffix.lower() == ".xml")
    except (OSError, ValueError):
        return []
