"""Pages of runs without pictures, which take 5 s, for tests that look at none."""

from __future__ import annotations

from contextlib import AbstractContextManager
from unittest import mock

from mitsim.report.style import Picture


def without_pictures() -> AbstractContextManager[object]:
    """Let the page of a run be written without pictures; tests/report holds what they show."""
    return mock.patch.multiple(
        "mitsim.report.page",
        map_pictures=lambda *_: [],
        measurement_pictures=lambda *_: [],
        cloud_picture=lambda *_: Picture("", ""),
        camera_view=lambda *_: {"images": [], "caption": ""},
    )
