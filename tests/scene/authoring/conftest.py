"""What several tests of authoring need."""

from __future__ import annotations

import subprocess

import pytest

from mitsim.scene.authoring import read_step, step_worker


def convert_here(command, path, check):
    """What :func:`read_step.run_worker` does, in this process."""
    *_, worker, path, out = command[:6]
    assert worker == step_worker.__name__
    step_worker.convert(path, out, *map(float, command[6:]))
    return subprocess.CompletedProcess(command, 0, "", "")


@pytest.fixture
def step_here(monkeypatch):
    """Sound STEP files are converted in this process, which wrote them and so has OpenCASCADE already.

    The fixtures of modules, and the tests of files that OpenCASCADE cannot read, start the process that users start.
    """
    monkeypatch.setattr(read_step, "run_worker", convert_here)
