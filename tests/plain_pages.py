"""Pages of runs without the pictures of maps, measurements and clouds, which take 5 s, for tests that read no page."""

from __future__ import annotations

from contextlib import AbstractContextManager
from unittest import mock

from markupsafe import Markup

from mitsim.report.style import Picture


def without_pictures() -> AbstractContextManager[object]:
    """Let ``mitsim run`` write its page without these pictures; tests/report holds what they show."""
    return mock.patch.multiple(
        "mitsim.report.page", map_pictures=_none, measurement_pictures=_none, cloud_picture=_empty
    )


def _none(*_: object) -> list[object]:
    return []


def _empty(*_: object) -> Picture:
    return Picture(Markup(), "")
