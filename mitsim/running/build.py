"""Software build of a process: versions, and a digest of mitsim's files, to compare between machines.

Two processes with the same build compute the same bytes from the same shot, on one kind of processor. Different builds
may differ.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import platform
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path

from characterisation.words.version import __version__

#: packages whose files make up the build
_OWN = ("characterisation", "mitsim")

#: packages that can influence a capture or its metrics
_PACKAGES = ("mitsuba", "drjit", "numpy", "scipy", "opencv-contrib-python-headless", "xarray")

#: files without influence on a capture: compiled Python, and maps, which are data
_LEFT_OUT = (".pyc", ".pyo", ".nc")


@lru_cache(maxsize=1)
def own_build() -> dict[str, str]:
    """Return versions by name, and ``source``, a digest of all installed files of mitsim and characterisation."""
    versions = {"mitsim": __version__, "source": _source(), "python": platform.python_version()}
    for name in _PACKAGES:
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            versions[name] = "none"
    return versions


def differences(build: dict[str, str], other: dict[str, str]) -> str:
    """Return all differences between two builds in words; empty if there are none.

    The version of Python may differ, since it does not influence any number.
    """
    out = []
    for name, version in build.items():
        other_version = other.get(name, "unknown")
        if name == "python" or other_version == version:
            continue
        out.append("other source files" if name == "source" else f"{name} {other_version} in place of {version}")
    return ", ".join(out)


def _source() -> str:
    """Return sixteen hexadecimal digits of the paths and contents of all files of both packages."""
    digest = hashlib.sha256()
    for package in _OWN:
        spec = find_spec(package)
        assert spec is not None and spec.submodule_search_locations
        root = Path(spec.submodule_search_locations[0])
        for path in sorted(root.rglob("*")):
            if path.is_file() and path.suffix not in _LEFT_OUT:
                data = path.read_bytes()
                digest.update(f"{root.name}/{path.relative_to(root).as_posix()} {len(data)}\n".encode())
                digest.update(data)
    return digest.hexdigest()[:16]
