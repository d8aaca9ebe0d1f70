"""Where the recordings made by others lie; they are no part of the project."""

import os
from pathlib import Path

import pytest

REAL_DATA = Path(os.environ.get("MITSIM_REAL_DATA") or Path(__file__).resolve().parents[2].parent / "shared" / "real")


def pytest_runtest_setup(item):
    """Skip from one place, so that one line of the summary stands for all."""
    if item.get_closest_marker("real") and not REAL_DATA.is_dir():
        pytest.skip(f"no recordings in {REAL_DATA}: set MITSIM_REAL_DATA, see docs/how-to/real-captures.md")


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Folder of real recordings: ``MITSIM_REAL_DATA``, else ``../shared/real`` beside the repository."""
    return REAL_DATA
