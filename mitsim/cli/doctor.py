"""Check this machine, ``mitsim doctor``: find packages, libraries and devices, and say how to install missing ones."""

from __future__ import annotations

import ctypes.util
import importlib.metadata
import json as json_module
import os
import platform
import subprocess
import sys
from dataclasses import asdict, dataclass
from typing import Literal

import typer

from characterisation.files.errors import MissingEnvironmentError
from characterisation.words.version import __version__
from mitsim.cli import options
from mitsim.scene import backend

Verdict = Literal["ok", "missing", "absent"]

_PACKAGES = (
    "mitsuba drjit numpy scipy xarray netCDF4 opencv-contrib-python-headless trimesh pydantic typer rich jinja2 "
    "matplotlib OpenEXR"
)
_OPTIONAL = {
    "pyserial": "pan-tilt tables",
    "depthai": "Luxonis cameras",
    "ensenso-nxlib": "Ensenso cameras (with the maker's SDK)",
    "mcap-protobuf-support": "recordings of DepthAI",
    "cadquery-ocp-novtk": "mitsim part of STEP files",
    "pypcd4": "mitsim export to PCD",
    "pye57": "mitsim export to E57",
    "rosbags": "recordings of ROS, mitsim export to ROS 2",
    "rerun-sdk": "mitsim export to Rerun",
    "pygltflib": "mitsim export to glTF",
    "usd-core": "mitsim export to USD",
}
#: where the newest release is not the right one, or one package is not enough
_FIXES = {
    "cadquery-ocp-novtk": 'pip install "cadquery-ocp-novtk<8"',
    "mcap-protobuf-support": "pip install 'mitsim[recordings]'",
}

_TRIAL = """
import sys
from mitsim.scene import backend
backend.activate(sys.argv[1])
dr, mi = backend.dr, backend.mi
assert abs(float(dr.sum(dr.minimum(dr.arange(mi.Float, 8), 3.0))[0]) - 18.0) < 1e-6
"""

#: time after which a trial kernel that does not end is given up [s]; chosen
_PATIENCE_S = 300.0


@dataclass(frozen=True)
class MachineFinding:
    """One line of the report. ``absent`` things are optional; ``missing`` ones stop mitsim from working."""

    what: str
    verdict: Verdict
    detail: str
    fix: str = ""


def doctor(json: options.Json = False) -> None:
    """Check this machine: list what is present, what is missing, and how to fix it.

    Exit code 3 if something that mitsim needs is missing.

    Example: mitsim doctor
    """
    findings = [*_software(), *_renderer(), *_optional()]
    if json:
        print(json_module.dumps([asdict(finding) for finding in findings], indent=2))
    else:
        for finding in findings:
            print(f"{finding.verdict:8} {finding.what:32} {finding.detail}")
            if finding.fix:
                print(f"{'':8} {'':32} -> {finding.fix}")
    if any(finding.verdict == "missing" for finding in findings):
        raise typer.Exit(3)


def _software() -> list[MachineFinding]:
    out = [
        MachineFinding("mitsim", "ok", __version__),
        MachineFinding("python", "ok", f"{platform.python_version()} on {platform.platform()}, {os.cpu_count()} cores"),
    ]
    for name in _PACKAGES.split():
        missing = MachineFinding(name, "missing", "not installed", f"pip install {name}")
        out.append(MachineFinding(name, "ok", version) if (version := _version(name)) else missing)
    return out


def _renderer() -> list[MachineFinding]:
    out = []
    for candidate in backend.find_llvm():
        detail = f"{candidate.version or 'unknown version'}, {candidate.origin}: {candidate.path}"
        unused = ("absent", f"{detail}: not used, {candidate.fault}", _library_fix(candidate))
        out.append(MachineFinding("libLLVM", *(("ok", detail) if candidate.usable else unused)))
    devices = backend.cuda_devices()
    no_device = MachineFinding("GPU", "absent", "no CUDA device: rendering runs on the CPU")
    out.append(MachineFinding("GPU", "ok", f"{devices} CUDA device(s)") if devices else no_device)
    try:
        variant = backend.choose_variant()
    except MissingEnvironmentError as error:
        return [*out, MachineFinding("renderer", "missing", "no Mitsuba variant can run", str(error))]
    # in a separate process: a library that aborts ends its process
    command = [sys.executable, "-c", _TRIAL, variant]
    try:
        trial = subprocess.run(command, capture_output=True, text=True, timeout=_PATIENCE_S, check=False)
        if trial.returncode == 0:
            return [*out, MachineFinding("renderer", "ok", f"{variant}, a trial kernel ran")]
        reason = (trial.stderr.strip().splitlines() or [f"it ended with code {trial.returncode}"])[-1]
    except subprocess.TimeoutExpired:
        reason = f"a trial kernel did not end within {_PATIENCE_S:g} s"
    return [*out, MachineFinding("renderer", "missing", f"{variant} failed: {reason}", backend.HELP)]


def _library_fix(candidate: backend.Llvm) -> str:
    for library in ("libz", "libatomic"):
        if library in candidate.fault:
            return f"install {library} (Debian: apt-get install {'zlib1g' if library == 'libz' else 'libatomic1'})"
    return ""


def _optional() -> list[MachineFinding]:
    out = []
    for name, use in _OPTIONAL.items():
        version = _version(name)
        fix = "" if version else _FIXES.get(name, f"pip install {name}")
        out.append(MachineFinding(name, "ok" if version else "absent", f"{version or 'not installed'}: for {use}", fix))
    library = ctypes.util.find_library("NxLib64")
    detail = library or "not installed: only for live Ensenso cameras; recordings are read without it"
    out.append(MachineFinding("NxLib", "ok" if library else "absent", detail))
    return out


def _version(name: str) -> str:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return ""
