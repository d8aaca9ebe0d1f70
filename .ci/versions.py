"""Install the lowest or the newest allowed version of every dependency in a fresh environment, and try mitsim there.

    python .ci/versions.py lowest
    python .ci/versions.py newest --python python3.12 --python python3.13

``lowest`` pins each dependency of pyproject.toml, those of the extras too, to the version behind its ``>=``; ``newest``
takes what pip takes. Packages that these bring along are pip's choice. Then ``.ci/smoke.py`` runs in that environment.
Each ``--python`` is tried in turn; the lowest versions have wheels for Python 3.11 only, the newest for 3.11 to 3.13.
The table of what was installed goes to stdout. It takes the network, 3 GB of disk, and some minutes. Exit code 1 if
something cannot be installed or does not work.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]

#: extras that users install; ``test`` holds tools of ours
EXTRAS = ("step", "recordings", "hardware", "cluster", "export")


def requirements() -> list[str]:
    """Every requirement of the project and its extras, once."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = [one for extra in EXTRAS for one in project["optional-dependencies"][extra]]
    return list(dict.fromkeys([*project["dependencies"], *extras]))


def name_of(requirement: str) -> str:
    """Name of a requirement as pip writes it."""
    found = re.match(r"[A-Za-z0-9._-]+", requirement)
    assert found is not None
    return re.sub(r"[-_.]+", "-", found[0]).lower()


def lowest(requirement: str) -> str:
    """The requirement at its lowest allowed version, with its marker."""
    wanted, mark, marker = requirement.partition(";")
    found = re.search(r"(>=|==)\s*([0-9][A-Za-z0-9.]*)", wanted)
    if found is None:
        raise SystemExit(f"{requirement}: no lowest version: say >= in pyproject.toml")
    return f"{name_of(wanted)}=={found[2]}{mark}{marker}"


def main() -> int:
    """Install, try, and tell."""
    asked = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    asked.add_argument("which", choices=("lowest", "newest"))
    asked.add_argument(
        "--python", action="append", help="interpreter to try, by its name or path; repeatable; default: this one"
    )
    asked.add_argument("--folder", type=Path, help="where to make the environment, kept; default: a temporary one")
    given = asked.parse_args()
    tried = [trial(given.which, python, given.folder) for python in given.python or [sys.executable]]
    return max(tried)


def trial(which: str, interpreter: str, folder: Path | None) -> int:
    """Install and try with one Python; return 1 if something cannot be installed or does not work."""
    with tempfile.TemporaryDirectory(prefix="mitsim-versions-") as temporary:
        place = (folder or Path(temporary)) / f"{which}-{Path(interpreter).name}"
        if subprocess.run([interpreter, "-m", "venv", "--clear", place], check=False).returncode:
            return 1
        python = place / ("Scripts" if sys.platform == "win32" else "bin") / "python"
        wanted = requirements()
        pins = [lowest(one) for one in wanted] if which == "lowest" else wanted
        install = [python, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--only-binary", ":all:"]
        if subprocess.run([*install, *pins], check=False).returncode:
            print(f"{which}, {interpreter}: cannot be installed", file=sys.stderr)
            return 1
        build = [one for one in install if one not in ("--only-binary", ":all:")]
        if subprocess.run([*build, "--no-deps", str(ROOT)], check=False).returncode:
            return 1
        listed = subprocess.run([python, "-m", "pip", "list", "--format", "json"], capture_output=True, check=True)
        versions = {name_of(one["name"]): one["version"] for one in json.loads(listed.stdout)}
        for one in wanted:
            print(f"{name_of(one)}\t{versions.get(name_of(one), 'not on this machine')}")
        code = subprocess.run([python, ROOT / ".ci" / "smoke.py"], cwd=place, check=False).returncode
        words = "all tried" if code == 0 else "something does not work"
        print(f"{which} allowed versions, {interpreter}: {words}")
        return int(code != 0)


if __name__ == "__main__":
    sys.exit(main())
