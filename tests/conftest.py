"""Things that many tests need."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mitsim.sensor.preset import Sensor, load_sensor

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def scenes() -> Path:
    """The folder of authored scenes."""
    return ROOT / "scenes"


@pytest.fixture(scope="session")
def n10() -> Sensor:
    """The Ensenso N10 preset."""
    return load_sensor("ensenso-n10")


@pytest.fixture
def rng() -> np.random.Generator:
    """A generator with a fixed seed."""
    return np.random.default_rng(20181016)
