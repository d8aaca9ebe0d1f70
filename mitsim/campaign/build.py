"""What software a process runs: versions and a digest of mitsim's own files, to be compared between machines.

Two processes of one build make the same bytes of the same shot (on one kind of processor); of two builds nobody knows.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import platform
from functools import lru_cache
from pathlib import Path

import characterisation
import mitsim

#: packages that have a hand in what a capture shows or what is measured in it
_PACKAGES = ("mitsuba", "drjit", "numpy", "scipy", "opencv-contrib-python-headless", "xarray")

#: files that decide nothing of a capture: what Python compiled, and maps, which are read and not run
_LEFT_OUT = (".pyc", ".pyo", ".nc")


@lru_cache(maxsize=1)
def own_build() -> dict[str, str]:
    """Versions by name, and ``source``, a digest of all files of mitsim and characterisation as they lie here."""
    found = {"mitsim": mitsim.__version__, "source": _source(), "python": platform.python_version()}
    for name in _PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "none"
    return found


def differences(mine: dict[str, str], theirs: dict[str, str]) -> str:
    """Everything in which two builds differ, in words; empty if in nothing.

    Python itself may differ: it has no hand in a number.
    """
    out = []
    for name, here in mine.items():
        there = theirs.get(name, "unknown")
        if name == "python" or there == here:
            continue
        out.append("other source files" if name == "source" else f"{name} {there} in place of {here}")
    return ", ".join(out)


def _source() -> str:
    """Sixteen hexadecimal digits of the paths and contents of all files of both packages."""
    digest = hashlib.sha256()
    for package in (characterisation, mitsim):
        root = Path(str(package.__file__)).parent
        for path in sorted(root.rglob("*")):
            if path.is_file() and path.suffix not in _LEFT_OUT:
                data = path.read_bytes()
                digest.update(f"{root.name}/{path.relative_to(root).as_posix()} {len(data)}\n".encode())
                digest.update(data)
    return digest.hexdigest()[:16]
