"""A projector's focus from blurs by depth that are known."""

from __future__ import annotations

import numpy as np
import pytest

from mitsim.twin.sensor.defocus import _fitted


@pytest.mark.parametrize(("aperture", "focus"), [(30.0, 3450.0), (12.0, 800.0)])
def test_aperture_and_focus_come_back(aperture, focus):
    rng, focal, still = np.random.default_rng(3), 1900.0, 0.65
    depth = rng.uniform(0.8 * focus, 1.1 * focus, 400)
    disc = aperture * focal * np.abs(1 / depth - 1 / focus)  # a disc's deviation along an axis: a quarter of it
    blur = np.hypot(still, disc / 4) + rng.normal(0, 0.03, 400)
    blur[::23] += 1.5  # walls that are no walls
    found = _fitted(np.stack([depth, blur], axis=1), focal)
    assert found[0] == pytest.approx(still, abs=0.03)
    assert found[1] == pytest.approx(aperture, rel=0.08)
    assert found[2] == pytest.approx(focus, rel=0.01)
