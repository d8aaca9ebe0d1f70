"""Say for which systems and Pythons every dependency has a wheel, so that pip alone installs mitsim there.

    python .ci/wheels.py

Asks the package index, as pip does for another system (``--platform``, ``--python-version``); nothing is installed. A
table in Markdown goes to stdout: a row for each requirement, a column for each system, in each cell the Pythons with a
wheel. Requirements that their own marker keeps to Linux are left out. It takes the network, and some minutes. Exit code
1 if a dependency (not one of an extra) lacks a wheel somewhere.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import tomllib
from concurrent.futures import ThreadPoolExecutor

from versions import ROOT, name_of, requirements

PYTHONS = ("3.11", "3.12", "3.13")

#: tags that pip would accept on each system, the newest first
SYSTEMS = {
    "Windows, x86-64": ["win_amd64"],
    "macOS, Apple silicon": [f"macosx_{major}_0_arm64" for major in range(15, 10, -1)],
    "macOS, Intel": [f"macosx_{major}_0_x86_64" for major in range(15, 10, -1)] + ["macosx_10_15_x86_64"],
}


def has_wheel(wanted: list[str], tags: list[str], python: str) -> bool:
    """Return whether every requirement has a wheel there."""
    with tempfile.TemporaryDirectory() as folder:
        call = [sys.executable, "-m", "pip", "install", "--dry-run", "--ignore-installed", "--no-deps", "--quiet"]
        call += [
            "--disable-pip-version-check",
            "--only-binary",
            ":all:",
            "--python-version",
            python,
            "--target",
            folder,
        ]
        call += [part for tag in tags for part in ("--platform", tag)]
        return subprocess.run([*call, *wanted], capture_output=True, check=False, timeout=900).returncode == 0


def main() -> int:
    """Ask for all at once, then one by one where a wheel is missing, and print the table."""
    wanted = [one.partition(";")[0].strip() for one in requirements() if "Linux" not in one.partition(";")[2]]
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    needed = {name_of(one) for one in project["dependencies"]}
    table: dict[str, dict[str, list[str]]] = {one: {system: [] for system in SYSTEMS} for one in wanted}
    places = [(system, python) for system in SYSTEMS for python in PYTHONS]
    with ThreadPoolExecutor(4) as pool:
        whole = list(pool.map(lambda at: has_wheel(wanted, SYSTEMS[at[0]], at[1]), places))
        for (system, python), every in zip(places, whole, strict=True):
            single = [True] * len(wanted) if every else pool.map(
                lambda one, at=(system, python): has_wheel([one], SYSTEMS[at[0]], at[1]), wanted
            )  # fmt: skip
            for one, there in zip(wanted, single, strict=True):
                table[one][system] += [python] if there else []
    print(f"| package | {' | '.join(SYSTEMS)} |\n|---|{'---|' * len(SYSTEMS)}")
    missing = False
    for one, cells in sorted(table.items(), key=lambda row: (name_of(row[0]) not in needed, name_of(row[0]))):
        words = ["all" if len(some) == len(PYTHONS) else ", ".join(some) or "none" for some in cells.values()]
        missing |= name_of(one) in needed and set(words) != {"all"}
        optional = "" if name_of(one) in needed else " (optional)"
        print(f"| {name_of(one)}{optional} | {' | '.join(words)} |")
    return int(missing)


if __name__ == "__main__":
    sys.exit(main())
