"""What several tests of authoring need."""

from __future__ import annotations

import subprocess
from types import SimpleNamespace

import pytest

from mitsim.scene.authoring import read_step, step_worker


def convert_here(command, **_):
    """What the command of :func:`read_step.read_step` does, in this process."""
    _, worker, path, out, *numbers = command
    assert worker == step_worker.__file__
    step_worker.convert(path, out, *map(float, numbers))
    return subprocess.CompletedProcess(command, 0, b"", b"")


@pytest.fixture
def step_here(monkeypatch):
    """Sound STEP files are converted in this process, which wrote them and so has OpenCASCADE already.

    The fixtures of modules, and the tests of files that OpenCASCADE cannot read, start the process that users start.
    """
    here = SimpleNamespace(run=convert_here, TimeoutExpired=subprocess.TimeoutExpired)
    monkeypatch.setattr(read_step, "subprocess", here)
