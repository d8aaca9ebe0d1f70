"""Find triangles of a mesh file that trimesh would pass over or misplace, and objects that are no part.

- glTF: compressed, sparse, normalised or morphed positions, fans, instances in an extension, skins (glTF 2.0, sections
  3.6 and 3.7).
- 3MF: support structures and modifiers, as ``type`` of their object (3MF Core Specification 1.3, section 4.1); objects
  of one number in several files (3MF Production Extension 1.1), which trimesh takes for one object.
"""

from __future__ import annotations

import json
import re
import zipfile
from pathlib import Path
from typing import Any

GLTF = (".glb", ".gltf")

#: extensions of glTF that hold triangles or their places
_EXTENSIONS = (
    "KHR_draco_mesh_compression",
    "EXT_meshopt_compression",
    "KHR_meshopt_compression",
    "EXT_mesh_gpu_instancing",
)
#: number of glTF's mode of triangles that share their first corner
_FAN = 6

#: objects of a 3MF model that are no part; numbers of its objects; a component in another file of the package
_NO_PART = re.compile(rb"<(?:\w+:)?object\b[^>]*\stype\s*=\s*[\"'](solidsupport|support|other)[\"']")
_NUMBER = re.compile(rb"<(?:\w+:)?object\b[^>]*\sid\s*=\s*[\"'](\d+)")
_ELSEWHERE = re.compile(rb"<(?:\w+:)?component\b[^>]*\s\w+:path\s*=")


def unread(path: Path) -> str:
    """Return what a mesh file holds beyond the triangles that trimesh reads; empty for nothing, or a damaged file."""
    kind = path.suffix.lower()
    try:
        if kind in GLTF:
            return _of_gltf(_gltf_document(path))
        if kind == ".3mf":
            with zipfile.ZipFile(path) as package:
                models = [package.read(name) for name in package.namelist() if name.lower().endswith(".model")]
            return _of_3mf(models)
    except Exception:  # damaged files raise any exception here, and the reader of triangles reports them
        return ""
    return ""


def _of_3mf(models: list[bytes]) -> str:
    text = b"\n".join(models)
    if found := _NO_PART.search(text):
        return f"an object of the type {found[1].decode()}"
    numbers = _NUMBER.findall(text)
    mixed = _ELSEWHERE.search(text) and len(set(numbers)) < len(numbers)
    return "objects of one number in several files of the package" if mixed else ""


def _gltf_document(path: Path) -> dict[str, Any]:
    """Return the JSON of a glTF file, without its triangles."""
    with path.open("rb") as file:
        head = file.read(20)
        # of a binary file it is the first chunk, whose length the head states
        rest = file.read(int.from_bytes(head[12:16], "little")) if head[:4] == b"glTF" else head + file.read()
    document: dict[str, Any] = json.loads(rest)
    return document


def _of_gltf(document: dict[str, Any]) -> str:
    used = [name for name in _EXTENSIONS if name in document.get("extensionsUsed", ())]
    meshes, nodes = document.get("meshes", []), document.get("nodes", [])
    primitives = [primitive for mesh in meshes for primitive in mesh["primitives"]]
    numbers = [primitive["attributes"]["POSITION"] for primitive in primitives]
    places = [document["accessors"][number] for number in numbers]
    indices = [document["accessors"][primitive["indices"]] for primitive in primitives if "indices" in primitive]
    found = {
        f"the extension {used[0] if used else ''}": bool(used),
        "sparse accessors": any("sparse" in accessor for accessor in places + indices),
        "normalised positions": any(accessor.get("normalized") for accessor in places),
        "fans of triangles": any(primitive.get("mode") == _FAN for primitive in primitives),
        "morphed meshes": any(any(one.get("weights", ())) for one in meshes + nodes),
        "skinned meshes": any("skin" in node for node in nodes),
    }
    return next((words for words, there in found.items() if there), "")
