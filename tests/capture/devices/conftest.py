"""Emulated stages for the tests of this folder."""

from __future__ import annotations

import pytest

from tests.capture.devices.emulator_process import start_emulator


@pytest.fixture
def emulate(tmp_path):
    """Start emulators that end with the test: ``emulate("ptu", "silence@2", tcp=True)``."""
    running = []

    def start(kind, *faults, **options):
        running.append(start_emulator(tmp_path / str(len(running)), kind, *faults, **options))
        return running[-1]

    yield start
    for emulator in running:
        emulator.end()
