"""Pages of runs without the pictures of the map and the measurements, which take 4 s, for tests that read no page."""

from __future__ import annotations

from contextlib import AbstractContextManager
from unittest import mock


def without_pictures() -> AbstractContextManager[object]:
    """Let ``mitsim run`` write its page without these pictures; tests/report holds what they show."""
    return mock.patch.multiple("mitsim.report.page", map_pictures=_none, measurement_pictures=_none)


def _none(*_: object) -> list[object]:
    return []
