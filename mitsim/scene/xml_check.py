"""What a scene XML may be, checked before Mitsuba parses it: some of what it may hold ends the process instead.

Nesting thousands deep and bitmaps without a file crash Mitsuba; BSDFs within BSDFs take minutes; a pipe is waited for.
"""

from __future__ import annotations

import re
import stat
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

from characterisation.checked_files import read_bounded
from mitsim.errors import InputError, nearest

#: of one XML [bytes]; elements in it, and how deep they and BSDFs may be nested
LARGEST_XML, MOST_ELEMENTS, DEEPEST, DEEPEST_BSDF = 16 * 1024**2, 200_000, 40, 6

#: of a file that a scene names [bytes]
LARGEST_NAMED_FILE = 1024**3

#: plugins that read a file, which not all of them check
_READ_A_FILE = {"bitmap", "envmap", "gridvolume", "measured", "ply", "obj", "serialized"}

#: files that include one another this often are a circle
_MOST_INCLUDES = 16

_ENCODING = re.compile(rb"""^[^>]*?encoding\s*=\s*["']([^"']*)["']""")


def checked_xml(path: Path, inside: int = 0) -> ElementTree.Element:
    """Read the XML of a scene, or one that it includes, and refuse what Mitsuba would not survive.

    Raises
    ------
    InputError
        If it is missing, does not parse, is no UTF-8, is too large or nested too deep, or names a file that is none.
    """
    there = _beside(path)
    data = read_bounded(path, "a Mitsuba scene XML", nearest(path.name, there), LARGEST_XML)
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
    bsdfs: dict[ElementTree.Element, int] = {}
    for parent in root.iter():
        for child in parent:
            bsdfs[child] = bsdfs.get(parent, 0) + (child.tag == "bsdf")
            if bsdfs[child] > DEEPEST_BSDF:
                raise InputError(path, "bsdf", f"BSDFs within BSDFs, over {DEEPEST_BSDF} deep", f"up to {DEEPEST_BSDF}")
    for element in root.iter():
        names = [str(one.get("value")) for one in element.findall("string") if one.get("name") == "filename"]
        if element.get("type") in _READ_A_FILE and not names:
            raise InputError(
                path, f"{element.tag} {element.get('type')}", "no filename", "<string name='filename' value='...'/>"
            )
        for name in names:
            _check_named(path, name)
        if element.tag == "include":
            if inside >= _MOST_INCLUDES:
                raise InputError(path, "include", f"files that include one another over {_MOST_INCLUDES} deep", "fewer")
            checked_xml(path.parent / str(element.get("filename")), inside + 1)
    return root


def _parsed(path: Path, text: str) -> ElementTree.Element:
    """The root element, read by events, so that depth and number are known before a tree is walked."""
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
        raise InputError(path, "", f"XML that does not parse ({error})", "well-formed XML") from None
    if root is None:
        raise InputError(path, "", "XML that does not parse (no element found)", "well-formed XML")
    return root


def _check_named(path: Path, name: str) -> None:
    """Refuse a pipe, a device and a huge file; Mitsuba tells of one that is missing."""
    try:
        about = (path.parent / name).stat()
    except (OSError, ValueError):
        return
    if not stat.S_ISREG(about.st_mode) or about.st_size > LARGEST_NAMED_FILE:
        found = f"{name!r}, " + ("no plain file" if not stat.S_ISREG(about.st_mode) else f"{about.st_size} bytes")
        raise InputError(path, "filename", found, f"a file of up to {LARGEST_NAMED_FILE} bytes")


def _beside(path: Path) -> list[str]:
    try:
        return sorted(one.name for one in path.parent.iterdir() if one.suffix == ".xml")
    except (OSError, ValueError):
        return []
