"""The picture of two captures side by side."""

from __future__ import annotations

import numpy as np
import pytest

from characterisation.point_cloud import Status
from mitsim.report.capture_page import capture_figure
from mitsim.twin.compare.captures_run import Shown


def test_the_residuals_of_a_narrow_window_lie_below_its_image(rng):
    """Before, the scale of colours drew them to the right end of their column."""
    levels = np.bincount(rng.integers(0, 255, 1000), minlength=256)
    image = rng.integers(0, 255, (230, 100))
    side = Shown("real: a", "device", image, levels, rng.normal(size=(230, 100)), {Status.VALID: 1.0})
    figure = capture_figure(side, side)
    figure.draw_without_rendering()
    boxes = [axes.get_position() for axes in figure.axes[:4]]
    for above, below in ((0, 2), (1, 3)):
        middles = [(boxes[one].x0 + boxes[one].x1) / 2 for one in (above, below)]
        assert middles[0] == pytest.approx(middles[1], abs=0.02)
