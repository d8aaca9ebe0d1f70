"""Choose and start Mitsuba's just-in-time backend, without ever loading a library that would abort the process.

Mitsuba's CPU variants compile with a libLLVM that its wheel does not bring. LLVM 14 is refused by Dr.Jit, LLVM 15
and 16 are accepted and then *kill the process* at the first render; 19 and later work (17 and 18 were not tried, so
they are not trusted). The library is looked for in this order: a path that the user has set, the one that pip
installed beside us, the system's. Its version is read before it is allowed near Mitsuba.

Everything in :mod:`mitsim.scene` takes ``mi`` and ``dr`` from here, so that the choice is made once, first.
"""

from __future__ import annotations

import ctypes
import importlib.metadata
import os
import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mitsim.errors import InputError, MissingEnvironmentError

LLVM_VARIABLE = "DRJIT_LIBLLVM_PATH"
LLVM_MINIMUM = 19
VARIANTS = ("cuda_ad_mono", "llvm_ad_mono")

_SYSTEM_FOLDERS = (
    "/usr/lib/x86_64-linux-gnu",
    "/usr/lib/aarch64-linux-gnu",
    "/usr/lib64",
    "/usr/lib",
    "/usr/local/lib",
    "/opt/homebrew/opt/llvm/lib",
    "/usr/local/opt/llvm/lib",
)

# run in a child: a library that cannot be loaded, or that is broken, must not take us with it
_ASK_VERSION = """
import ctypes, sys
library = ctypes.CDLL(sys.argv[1])
numbers = [ctypes.c_uint() for _ in range(3)]
library.LLVMGetVersion(*[ctypes.byref(n) for n in numbers])
print(numbers[0].value)
"""

HELP = (
    f"no libLLVM of version {LLVM_MINIMUM} or later was found, and Mitsuba's CPU variants need one.\n"
    "On x86-64 Linux: pip install karellen-llvm-core. Elsewhere install LLVM (Debian: apt-get install libllvm19; "
    f"macOS: brew install llvm) or set {LLVM_VARIABLE} to its library; mitsim doctor tells what it sees."
)


@dataclass(frozen=True)
class Llvm:
    """A libLLVM that was found: its path, major version (0 if it cannot be told) and where it came from."""

    path: Path
    version: int
    origin: str
    fault: str = ""

    @property
    def usable(self) -> bool:
        """Whether Mitsuba may load it."""
        return self.version >= LLVM_MINIMUM and not self.fault


def find_llvm() -> list[Llvm]:
    """All libLLVM candidates, in the order in which they would be taken."""
    if given := os.environ.get(LLVM_VARIABLE):
        return [_inspect(Path(given), f"the environment variable {LLVM_VARIABLE}")]
    found = [_inspect(path, "pip package karellen-llvm-core") for path in _from_pip()]
    for folder in _SYSTEM_FOLDERS:
        found += [_inspect(path, "system") for path in sorted(Path(folder).glob("libLLVM*"), reverse=True)]
    unique: dict[Path, Llvm] = {}
    for candidate in found:
        unique.setdefault(candidate.path.resolve(), candidate)
    return list(unique.values())


def _from_pip() -> list[Path]:
    try:
        files = importlib.metadata.files("karellen-llvm-core") or []
    except importlib.metadata.PackageNotFoundError:
        return []
    paths = [Path(str(f.locate())) for f in files if re.fullmatch(r"libLLVM\.so\.[\d.]+", f.name)]
    return [path for path in paths if path.exists()]


def _inspect(path: Path, origin: str) -> Llvm:
    if not path.exists():
        return Llvm(path, 0, origin, "no such file")
    match = re.search(r"libLLVM[.-](?:so\.)?(\d+)", path.resolve().name)
    if match and int(match.group(1)) < LLVM_MINIMUM:
        return Llvm(path, int(match.group(1)), origin, f"older than {LLVM_MINIMUM}: it would abort the process")
    if origin == "system" and not match:
        return Llvm(path, 0, origin, "version not told by its name")
    asked = subprocess.run(
        [sys.executable, "-c", _ASK_VERSION, str(path)], capture_output=True, text=True, timeout=60, check=False
    )
    if asked.returncode != 0:
        fault = (asked.stderr.strip().splitlines() or ["it cannot be loaded"])[-1]
        return Llvm(path, 0, origin, fault.removeprefix("OSError: "))
    version = int(asked.stdout)
    return Llvm(path, version, origin, "" if version >= LLVM_MINIMUM else f"older than {LLVM_MINIMUM}")


def cuda_devices() -> int:
    """How many CUDA devices the driver offers; 0 without a driver."""
    try:
        driver = ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")
        count = ctypes.c_int()
        if driver.cuInit(0) != 0 or driver.cuDeviceGetCount(ctypes.byref(count)) != 0:
            return 0
        return count.value
    except OSError:
        return 0


def choose_variant(wanted: str | None = None) -> str:
    """The Mitsuba variant to run: the one asked for, else CUDA where there is a device, else LLVM.

    Raises
    ------
    InputError
        For a variant that we do not support (colour and polarised variants would need other materials).
    MissingEnvironmentError
        If the variant cannot run on this machine.
    """
    if wanted is not None and wanted not in VARIANTS:
        raise InputError("--variant", "", repr(wanted), ", ".join(VARIANTS))
    if wanted == "cuda_ad_mono" and cuda_devices() == 0:
        raise MissingEnvironmentError("cuda_ad_mono was asked for, but the NVIDIA driver offers no device")
    if wanted == "cuda_ad_mono" or (wanted is None and cuda_devices() > 0):
        return "cuda_ad_mono"
    candidates = find_llvm()
    best = next((c for c in candidates if c.usable), None)
    if best is None:
        seen = "".join(f"\n  seen: {c.path} ({c.fault or 'LLVM ' + str(c.version)})" for c in candidates)
        raise MissingEnvironmentError(HELP + seen)
    os.environ[LLVM_VARIABLE] = str(best.path)
    return "llvm_ad_mono"


_active: str | None = None


def activate(wanted: str | None = None) -> str:
    """Start Mitsuba once, in the variant asked for; returns its name. Later calls must not ask for another."""
    global _active
    if _active is not None:
        if wanted not in (None, _active):
            raise InputError("--variant", "", repr(wanted), f"{_active}, which this process already runs")
        return _active
    variant = choose_variant(wanted)
    import mitsuba as mi

    mi.set_variant(variant)
    mi.set_log_level(mi.LogLevel.Error)
    _active = variant
    return variant


def active() -> str | None:
    """The variant that this process runs, None before one was chosen."""
    return _active


def limit_threads(count: int) -> None:
    """Have Dr.Jit compute in so many threads: what one of several processes of a machine may take."""
    import drjit as dr

    dr.set_thread_count(count)


def __getattr__(name: str) -> Any:
    """Give ``mi`` and ``dr``, starting the default variant if none was chosen yet."""
    if name == "mi":
        activate()
        import mitsuba

        return mitsuba
    if name == "dr":
        activate()
        import drjit

        return drjit
    raise AttributeError(name)
