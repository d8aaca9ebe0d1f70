"""Choose and start Mitsuba's just-in-time backend, and never load a library that aborts the process.

Mitsuba's CPU variants compile with libLLVM, which Mitsuba's wheel does not contain. Dr.Jit rejects LLVM 14. It accepts
LLVM 15 and 16, and then *aborts the process* at the first render. Versions from 19 on work. Versions 17 and 18 are
untested and therefore rejected.

Candidates are the path that the user has set, or else the library that pip installed, then those of the system. The
version of a candidate is determined before Mitsuba may load it.

All of :mod:`mitsim.scene` takes ``mi`` and ``dr`` from this module, so that the variant is chosen before their first
use.
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

from characterisation.files.errors import InputError, MissingEnvironmentError
from characterisation.files.threads import asked_threads

LLVM_VARIABLE = "DRJIT_LIBLLVM_PATH"
LLVM_MINIMUM = 19

#: environment variable with the variant of a process and of the processes that it starts
VARIANT_VARIABLE = "MITSIM_VARIANT"
VARIANTS = ("cuda_ad_mono", "llvm_ad_mono")

#: folders of the system's libraries: Linux, macOS (Homebrew, MacPorts), LLVM's installer for Windows, and conda's
_SYSTEM_FOLDERS = (
    "/usr/lib/x86_64-linux-gnu",
    "/usr/lib/aarch64-linux-gnu",
    "/usr/lib64",
    "/usr/lib",
    "/usr/local/lib",
    "/opt/homebrew/opt/llvm/lib",
    "/usr/local/opt/llvm/lib",
    *(f"/opt/local/libexec/llvm-{version}/lib" for version in range(29, LLVM_MINIMUM - 1, -1)),
    f"{os.environ.get('PROGRAMFILES', 'C:/Program Files')}/LLVM/bin",
    f"{sys.prefix}/Library/bin",
    f"{sys.prefix}/lib",
)

#: name of LLVM's library with the C interface: Linux, macOS, Windows
_LIBRARY_NAME = re.compile(r"libLLVM([.-]\d[\w.]*)?(\.so[\d.]*|\.dylib)|LLVM-C\.dll")

# run in a child process: a broken library may end the process that loads it
_VERSION_SCRIPT = """
import ctypes, sys
library = ctypes.CDLL(sys.argv[1])
numbers = [ctypes.c_uint() for _ in range(3)]
library.LLVMGetVersion(*[ctypes.byref(n) for n in numbers])
print(numbers[0].value)
"""

#: time after which a library that does not load is given up [s]; chosen
_PATIENCE_S = 60.0

HELP = (
    f"no libLLVM of version {LLVM_MINIMUM} or later was found, and Mitsuba's CPU variants need one.\n"
    "On x86-64 Linux: pip install karellen-llvm-core. Elsewhere: install LLVM (Debian: apt-get install libllvm19; "
    "macOS: brew install llvm; Windows: winget install LLVM.LLVM, which brings LLVM-C.dll), or set "
    f"{LLVM_VARIABLE} to the path of its library. mitsim doctor lists what it finds."
)


@dataclass(frozen=True)
class Llvm:
    """A candidate libLLVM.

    ``path``; major ``version``, 0 if unknown; ``origin`` of the path, in words; ``fault``: why it cannot be used, empty
    if it can.
    """

    path: Path
    version: int
    origin: str
    fault: str = ""

    @property
    def usable(self) -> bool:
        """Whether Mitsuba may load it."""
        return self.version >= LLVM_MINIMUM and not self.fault


def find_llvm() -> list[Llvm]:
    """Return all candidates for libLLVM, in order of preference."""
    if chosen := os.environ.get(LLVM_VARIABLE):
        return [_inspect(Path(chosen), f"the environment variable {LLVM_VARIABLE}")]
    candidates = [_inspect(path, "pip package karellen-llvm-core") for path in _from_pip()]
    for folder in _SYSTEM_FOLDERS:
        names = [path for path in Path(folder).glob("*LLVM*") if _LIBRARY_NAME.fullmatch(path.name)]
        candidates += [_inspect(path, "system") for path in sorted(names, reverse=True)]
    unique: dict[Path, Llvm] = {}
    for candidate in candidates:
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
        return Llvm(path, int(match.group(1)), origin, f"older than {LLVM_MINIMUM}: it could abort the process")
    command = [sys.executable, "-c", _VERSION_SCRIPT, str(path)]
    try:
        process = subprocess.run(command, capture_output=True, text=True, timeout=_PATIENCE_S, check=False)
    except subprocess.TimeoutExpired:
        return Llvm(path, 0, origin, f"it does not load within {_PATIENCE_S:g} s")
    if process.returncode != 0:
        fault = (process.stderr.strip().splitlines() or ["it cannot be loaded"])[-1]
        return Llvm(path, 0, origin, fault.removeprefix("OSError: "))
    version = int(process.stdout)
    return Llvm(path, version, origin, "" if version >= LLVM_MINIMUM else f"older than {LLVM_MINIMUM}")


def cuda_devices() -> int:
    """Return the number of CUDA devices that the driver offers, 0 without a driver."""
    try:
        driver = ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")
        count = ctypes.c_int()
        if driver.cuInit(0) != 0 or driver.cuDeviceGetCount(ctypes.byref(count)) != 0:
            return 0
        return count.value
    except OSError:
        return 0


def choose_variant(requested: str | None = None) -> str:
    """Return the Mitsuba variant to run: the requested one, else CUDA if there is a device, else LLVM.

    Without a request, the environment variable :data:`VARIANT_VARIABLE` is one. Sets the environment variable
    ``LLVM_VARIABLE`` for LLVM. Raises InputError if the variant is not supported. Variants with colour or polarisation
    would need other materials. Raises MissingEnvironmentError if the variant cannot run on this machine.
    """
    where = "--variant"
    if requested is None and (asked := os.environ.get(VARIANT_VARIABLE)):
        requested, where = asked, VARIANT_VARIABLE
    if requested is not None and requested not in VARIANTS:
        raise InputError(where, "", repr(requested), ", ".join(VARIANTS))
    if requested == "cuda_ad_mono" and cuda_devices() == 0:
        raise MissingEnvironmentError("cuda_ad_mono was requested, but the NVIDIA driver offers no device")
    if requested == "cuda_ad_mono" or (requested is None and cuda_devices() > 0):
        return "cuda_ad_mono"
    candidates = find_llvm()
    best = next((c for c in candidates if c.usable), None)
    if best is None:
        inspected = "".join(f"\n  found: {c.path} ({c.fault or 'LLVM ' + str(c.version)})" for c in candidates)
        raise MissingEnvironmentError(HELP + inspected)
    os.environ[LLVM_VARIABLE] = str(best.path)
    return "llvm_ad_mono"


_active: str | None = None


def activate(requested: str | None = None) -> str:
    """Start Mitsuba in the requested variant, once per process, and return the name of the variant.

    It renders with ``OMP_NUM_THREADS`` threads, or with one for each core. Processes that this one starts run the same
    variant (:data:`VARIANT_VARIABLE`). Raises InputError if the process already runs another variant, or the variant is
    not supported. Raises MissingEnvironmentError if the variant cannot run on this machine.
    """
    global _active
    if _active is not None:
        if requested not in (None, _active):
            raise InputError("--variant", "", repr(requested), f"{_active}, which this process already runs")
        return _active
    variant = choose_variant(requested)
    import mitsuba as mi

    mi.set_variant(variant)
    if variant == "llvm_ad_mono":
        _check_loaded_library()
    mi.set_log_level(mi.LogLevel.Error)
    if count := asked_threads():
        limit_threads(count)
    _active = os.environ[VARIANT_VARIABLE] = variant
    return variant


def _check_loaded_library() -> None:
    """Reject the library that Dr.Jit chose by itself when a program imported it before mitsim chose one."""
    import drjit as dr

    version = ".".join(map(str, dr.detail.llvm_version()))
    if int(version.partition(".")[0]) < LLVM_MINIMUM:
        raise MissingEnvironmentError(
            f"this process has loaded LLVM {version}, which aborts it at the first render: mitsuba or drjit "
            "was imported before mitsim chose a library. Import them after mitsim has rendered, or start the program "
            f"with {LLVM_VARIABLE}={os.environ[LLVM_VARIABLE]}"
        )


def limit_threads(count: int) -> None:
    """Set the number of threads of Dr.Jit, so that several processes can share a machine.

    Threads without work look for it for a while before they sleep, and take time from other processes.
    """
    import drjit as dr

    dr.set_thread_count(count)


def __getattr__(name: str) -> Any:
    """Return ``mi`` or ``dr``; start the default variant if none is active."""
    if name == "mi":
        activate()
        import mitsuba

        return mitsuba
    if name == "dr":
        activate()
        import drjit

        return drjit
    raise AttributeError(name)
