"""The licences of all that mitsim installs, as a table; exit code 1 if one is not on the list of what may come in.

    python .ci/licences.py > docs/reference/licences.md

Walks from pyproject.toml over what each installed package says that it needs. A licence is read off the package's own
metadata (``License-Expression``, else classifiers, else ``License``); for those whose metadata says nothing or too
little it stands in :data:`READ`, with where it was read.
"""

from __future__ import annotations

import importlib.metadata
import re
import sys
import tomllib
from collections.abc import Mapping
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[1]

#: extras that users install; ``test`` holds tools of ours, of which nothing is shipped
EXTRAS = ("step", "recordings", "hardware", "cluster", "export")

#: what may come in: permissive; weak copyleft where a library is linked dynamically and can be exchanged
ALLOWED = frozenset(
    {
        "0BSD",
        "Apache-2.0",
        "BSD-2-Clause",
        "BSD-3-Clause",
        "BSL-1.0",
        "CC0-1.0",
        "HPND",
        "ISC",
        "MIT",
        "MIT-CMU",
        "MPL-2.0",
        "PSF-2.0",
        "Zlib",
        "TOST-1.0",
        "Apache-2.0 WITH LLVM-exception",
        "LGPL-2.1-only WITH OCCT-exception-1.0",
        "LGPL-2.1-or-later",
    }
)

#: licences of packages whose metadata does not say enough: SPDX expression, and where it was read
READ: dict[str, tuple[str, str]] = {
    "openexr": ("BSD-3-Clause", "LICENSE.md in the wheel"),
    "usd-core": ("TOST-1.0", "Tomorrow Open Source Technology License: Apache-2.0 but for its trademark clause"),
    "cadquery-ocp-novtk": (
        "Apache-2.0 AND LGPL-2.1-only WITH OCCT-exception-1.0",
        "the binding; OpenCASCADE, which is linked dynamically",
    ),
    "apsw": ("Zlib", "LICENSE in the wheel, which allows any licence that OSI approves"),
    "karellen-llvm-core": ("Apache-2.0 WITH LLVM-exception", "LICENSE.TXT of LLVM"),
    "pye57": ("MIT AND BSL-1.0 AND Apache-2.0", "itself, libE57Format, Xerces"),
    "opencv-contrib-python-headless": ("Apache-2.0 AND LGPL-2.1-or-later", "OpenCV; FFmpeg, a library beside it"),
    "matplotlib": ("PSF-2.0", "its own text after the Python licence"),
}

#: what classifiers and old ``License`` fields are in SPDX
SPDX = {
    "apache software license": "Apache-2.0",
    "apache 2.0": "Apache-2.0",
    "apache license 2.0": "Apache-2.0",
    "apache license, version 2.0": "Apache-2.0",
    "apache-2": "Apache-2.0",
    "apache": "Apache-2.0",
    "apache license version 2.0": "Apache-2.0",
    "apache license v2.0": "Apache-2.0",
    "bsd license": "BSD-3-Clause",
    "bsd": "BSD-3-Clause",
    "bsd 3-clause": "BSD-3-Clause",
    "new bsd": "BSD-3-Clause",
    "bsd 3-clause license": "BSD-3-Clause",
    "3-clause bsd license": "BSD-3-Clause",
    "bsd-3": "BSD-3-Clause",
    "simplified bsd": "BSD-2-Clause",
    "mit license": "MIT",
    "the mit license": "MIT",
    "expat": "MIT",
    "python software foundation license": "PSF-2.0",
    "mozilla public license 2.0 (mpl 2.0)": "MPL-2.0",
    "isc license (iscl)": "ISC",
    "historical permission notice and disclaimer (hpnd)": "HPND",
    "boost software license 1.0 (bsl-1.0)": "BSL-1.0",
    "the unlicense (unlicense)": "Unlicense",
}


def closure() -> dict[str, set[str]]:
    """Installed packages that mitsim and its extras need, each with who needs it (``mitsim``, an extra, a package)."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    waiting = [("mitsim", Requirement(one)) for one in project["dependencies"]]
    for extra in EXTRAS:
        waiting += [(f"mitsim[{extra}]", Requirement(one)) for one in project["optional-dependencies"][extra]]
    found: dict[str, set[str]] = {}
    while waiting:
        by, wanted = waiting.pop()
        if wanted.marker is not None and not any(wanted.marker.evaluate({"extra": e}) for e in ("", *wanted.extras)):
            continue
        name = canonicalize_name(wanted.name)
        known = name in found
        try:
            about = importlib.metadata.distribution(name)
        except importlib.metadata.PackageNotFoundError:
            continue
        found.setdefault(name, set()).add(by)
        if not known:
            for line in about.requires or ():
                needed = Requirement(line)
                extras = wanted.extras or {""}
                if needed.marker is None or any(needed.marker.evaluate({"extra": e}) for e in extras):
                    waiting.append((name, needed))
    return found


def licence_of(name: str) -> str:
    """SPDX expression of an installed package, empty if its metadata does not say."""
    if name in READ:
        return READ[name][0]
    about = importlib.metadata.metadata(name)
    if expression := about.get("License-Expression"):
        return str(expression).strip()
    told = [
        line.rpartition(" :: ")[2]
        for line in about.get_all("Classifier") or ()
        if line.startswith("License :: OSI Approved ::")
    ]
    told = told or [str(about.get("License") or "").strip().splitlines()[0]] if about.get("License") or told else []
    return " AND ".join(SPDX.get(one.lower(), one) for one in told)


def parts(expression: str) -> set[str]:
    """Licences that an SPDX expression asks for all of; of a choice, the first that may come in."""
    expression = expression.replace("(", "").replace(")", "")
    out = set()
    for one in re.split(r"\s+AND\s+", expression):
        choices = [each.strip() for each in re.split(r"\s+OR\s+", one)]
        out.add(next((each for each in choices if each in ALLOWED), choices[0]))
    return out


def refused() -> dict[str, str]:
    """Packages of the closure with a licence that may not come in, or that is not known."""
    found = {name: licence_of(name) for name in closure()}
    return {name: licence or "not known" for name, licence in found.items() if not licence or parts(licence) - ALLOWED}


def table(packages: Mapping[str, str]) -> str:
    """Return packages and their licences as a Markdown table: a row for each licence."""
    licences = sorted(set(packages.values()))
    rows = [
        f"| {licence or 'not known'} | {', '.join(name for name, own in sorted(packages.items()) if own == licence)} |"
        for licence in licences
    ]
    return "\n".join(["| licence | packages |", "|---|---|", *rows])


PAGE = """# Licences

The packages that mitsim and its extras install, with their dependencies, without the tools of the tests and vendors'
SDKs that `pip` does not install (NxLib). The tests compare every installed package with this list, and reject licences
that are neither permissive nor weak copyleft (MPL-2.0, LGPL-2.1) of dynamically linked libraries that users can
replace.

Licences are SPDX names, from the metadata of each package, or from the source that `.ci/licences.py` records. The
wheels of NumPy, SciPy and OpenCV also contain libgfortran, whose GCC runtime exception allows distribution with any
software.

"""


def main() -> int:
    """Print the page, and tell what is refused."""
    print(PAGE + table({name: licence_of(name) for name in closure()}))
    wrong = refused()
    for name, licence in wrong.items():
        print(f"{name}: {licence}, which is not on the list of what may come in", file=sys.stderr)
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
