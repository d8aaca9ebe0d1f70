"""Processes that a test may kill or starve, forked from one that has imported the program; each saves 2 s of imports.

The first process starts a server that imports :data:`PRELOADED` and renders nothing; every process is a fork of it.
It has its own memory, files, limits and signals, as a command that a user starts.
"""

from __future__ import annotations

import multiprocessing
import os
import runpy
import sys
import tempfile
from collections.abc import Callable
from multiprocessing import forkserver
from multiprocessing.context import ForkServerProcess
from pathlib import Path
from typing import Any
from unittest import mock

ROOT = Path(__file__).resolve().parents[1]

#: what most commands and scripts import; Dr.Jit is not started, since a fork would lack its threads
PRELOADED = [
    "tests.maps.campaign.known_clouds",
    "mitsim.cli",
    "mitsim.study.many_captures",
    "mitsim.report.figures",
    "trimesh.exchange.load",
    "dask.array",  # xarray imports it
]

_CONTEXT = multiprocessing.get_context("forkserver") if sys.platform != "win32" else None


class QuickProcess:
    """A script or module with arguments in a process of its own; its output goes to a file."""

    def __init__(self, *command: object, limits: Callable[[], object] | None = None) -> None:
        _start_server()
        assert _CONTEXT is not None
        handle, name = tempfile.mkstemp(suffix=".stderr")
        os.close(handle)
        self._said = Path(name)
        self._process: ForkServerProcess = _CONTEXT.Process(
            target=_run, args=(list(map(str, command)), str(self._said), dict(os.environ), limits), daemon=True
        )
        self._process.start()

    @property
    def pid(self) -> int:
        return self._process.pid or 0

    @property
    def said(self) -> str:
        """What it has printed by now, on both streams."""
        return self._said.read_text()

    @property
    def running(self) -> bool:
        return self._process.exitcode is None

    def kill(self) -> None:
        """As ``kill -9``; returns once it is gone."""
        self._process.kill()
        self._process.join()
        self._said.unlink()

    def wait(self, timeout: float = 300) -> tuple[int, str]:
        """Wait for the end; return the exit code and all that was printed."""
        self._process.join(timeout)
        code = self._process.exitcode
        if code is None:
            self._process.kill()
            raise TimeoutError(f"not at its end after {timeout} s: {self._said.read_text()}")
        said = self._said.read_text()
        self._said.unlink()
        return code, said


def _start_server() -> None:
    """Start the server that every process is a fork of, unless it runs already."""
    assert _CONTEXT is not None
    _CONTEXT.set_forkserver_preload(PRELOADED)
    # the server gets its modules by the environment: Python 3.11 does not hand it sys.path
    path = [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
    with mock.patch.dict(os.environ, {"PYTHONPATH": os.pathsep.join(path)}):
        forkserver.ensure_running()


def _run(command: list[str], said: str, environment: dict[str, str], limits: Any) -> None:
    """What the fork does: the script as ``python script arguments``, or ``-m module arguments``."""
    with Path(said).open("w", encoding="utf-8") as file:
        for stream in (sys.stdout, sys.stderr):
            os.dup2(file.fileno(), stream.fileno())
    os.environ.clear()
    os.environ.update(environment)
    os.chdir(ROOT)
    if limits is not None:
        limits()
    if command[0] == "-m":
        sys.argv = ["mitsim", *command[2:]]
        runpy.run_module(command[1], run_name="__main__", alter_sys=True)
    else:
        sys.argv = command
        runpy.run_path(command[0], run_name="__main__")
