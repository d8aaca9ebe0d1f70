"""The backend is chosen with care: a library that would abort is never loaded, and a machine without one is told."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from characterisation.files.errors import InputError, MissingEnvironmentError
from mitsim.scene import backend
from tests.render_threads import threads


def test_a_usable_library_is_here():
    assert any(candidate.usable for candidate in backend.find_llvm())


@pytest.mark.parametrize("name", ["libLLVM-15.so.1", "libLLVM.so.16.0", "libLLVM-14.so", "libLLVM.so.18.1"])
def test_versions_that_abort_are_not_even_opened(tmp_path, monkeypatch, name):
    """The file is not a library at all: were it opened, the fault would be another."""
    (tmp_path / name).write_bytes(b"not a library")
    monkeypatch.setenv(backend.LLVM_VARIABLE, str(tmp_path / name))
    (found,) = backend.find_llvm()
    assert not found.usable
    assert "older than 19" in found.fault


def test_a_broken_library_is_told(tmp_path, monkeypatch):
    (tmp_path / "libLLVM.so.21").write_bytes(b"not a library")
    monkeypatch.setenv(backend.LLVM_VARIABLE, str(tmp_path / "libLLVM.so.21"))
    (found,) = backend.find_llvm()
    assert not found.usable
    assert found.fault


def test_a_library_that_never_loads_is_told(tmp_path, monkeypatch):
    (tmp_path / "libLLVM.so.21").write_bytes(b"")
    monkeypatch.setenv(backend.LLVM_VARIABLE, str(tmp_path / "libLLVM.so.21"))
    monkeypatch.setattr(backend, "_VERSION_SCRIPT", "import time; time.sleep(70)")
    monkeypatch.setattr(backend, "_PATIENCE_S", 0.3, raising=False)
    (found,) = backend.find_llvm()
    assert (found.usable, found.fault) == (False, "it does not load within 0.3 s")


def test_none_at_all_gives_two_lines_of_help(tmp_path, monkeypatch):
    monkeypatch.setenv(backend.LLVM_VARIABLE, str(tmp_path / "nothing.so"))
    monkeypatch.setattr(backend, "cuda_devices", lambda: 0)
    with pytest.raises(MissingEnvironmentError) as caught:
        backend.choose_variant()
    lines = str(caught.value).splitlines()
    assert "libLLVM" in lines[0]
    assert "pip install karellen-llvm-core" in lines[1]
    assert "nothing.so" in lines[2]


def test_a_machine_with_none_ends_with_code_3(tmp_path, scenes):
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "mitsim",
            "render",
            str(scenes / "coupon/coupon.xml"),
            "--position",
            "0",
            "0",
            "500",
            "-o",
            str(tmp_path / "capture"),
        ],
        env={**os.environ, backend.LLVM_VARIABLE: str(tmp_path / "nothing.so"), "CUDA_VISIBLE_DEVICES": ""},
        capture_output=True,
        text=True,
        check=False,
    )
    if backend.cuda_devices():
        pytest.skip("a GPU is here: mitsim does not need libLLVM")
    assert done.returncode == 3
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "capture").exists()


@pytest.mark.parametrize("asked", [1, 3])
def test_it_renders_with_as_many_threads_as_the_environment_asks_for(monkeypatch, asked):
    monkeypatch.setenv("OMP_NUM_THREADS", str(asked))
    variant = backend.activate()
    with threads(2):
        monkeypatch.setattr(backend, "_active", None)  # as in a new process
        assert backend.activate(variant) == variant
        assert backend.dr.thread_count() == asked


@pytest.mark.parametrize("said", [False, True])
def test_a_library_that_a_program_loaded_before_is_told(said):
    """Dr.Jit takes the library of the system, such as LLVM 15, as soon as it is imported."""
    if backend.cuda_devices():
        pytest.skip("a GPU is here: mitsim does not need libLLVM")
    if sys.platform != "linux":
        pytest.skip("the library that Dr.Jit takes by itself is known on Linux alone")
    backend.activate()
    environment = {name: value for name, value in os.environ.items() if said or name != backend.LLVM_VARIABLE}
    alone = "import drjit; from mitsim.scene import backend; {}; print(*drjit.detail.llvm_version())"
    scripts = (alone.format("import mitsuba; mitsuba.set_variant('llvm_ad_mono')"), alone.format("backend.activate()"))
    taken, done = (
        subprocess.run([sys.executable, "-c", one], env=environment, capture_output=True, text=True, check=False)
        for one in scripts
    )
    usable = taken.returncode == 0 and int(taken.stdout.split()[0]) >= backend.LLVM_MINIMUM
    assert usable or not said
    assert done.returncode == (0 if usable else 1), done.stderr
    assert usable or "was imported before mitsim chose a library" in done.stderr or "llvm" in taken.stderr.lower()


def test_unknown_variants_are_refused():
    with pytest.raises(InputError, match="cuda_ad_mono, llvm_ad_mono"):
        backend.choose_variant("scalar_rgb")


def test_a_process_runs_one_variant():
    assert backend.activate() == backend.activate()
    other = next(v for v in backend.VARIANTS if v != backend.activate())
    with pytest.raises(InputError, match="already runs"):
        backend.activate(other)


@pytest.mark.parametrize(
    ("name", "found"),
    [
        ("libLLVM.dylib", True),  # Homebrew: its name does not state its version
        ("LLVM-C.dll", True),  # Windows
        ("libLLVM.so.20.1", True),
        ("libLLVM-20.so", True),
        ("libLLVMSupport.a", False),
        ("libLLVM-20.so.txt", False),
    ],
)
def test_libraries_of_macos_and_windows_are_found_and_asked_for_their_version(tmp_path, monkeypatch, name, found):
    monkeypatch.delenv(backend.LLVM_VARIABLE, raising=False)
    monkeypatch.setattr(backend, "_SYSTEM_FOLDERS", (str(tmp_path),))
    monkeypatch.setattr(backend, "_from_pip", list)
    monkeypatch.setattr(backend, "_VERSION_SCRIPT", "print(20)")  # in place of loading it
    (tmp_path / name).write_bytes(b"")
    assert [(one.path.name, one.version, one.usable) for one in backend.find_llvm()] == [(name, 20, True)] * found
