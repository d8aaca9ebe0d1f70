"""Another number of threads of Dr.Jit, for tests of images that must not depend on it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from mitsim.scene.backend import dr, limit_threads


@contextmanager
def threads(count: int) -> Iterator[None]:
    """Render with ``count`` threads."""
    before = dr.thread_count()
    limit_threads(count)
    try:
        yield
    finally:
        limit_threads(before)
