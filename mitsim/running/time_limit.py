"""Bound the time of a command: a limit that its steps ask whether to go on, and a first Ctrl-C that ends it in order.

Signal chain: --minutes -> :class:`TimeLimit` of the command -> a part of it for each step -> the loops of the step stop
after the item at hand, and the command writes what it has.
"""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

from characterisation.words.progress import say

Item = TypeVar("Item")

#: whether the user has asked the command to end
_stopped = False


class OutOfTimeError(Exception):
    """Time ended within a step that has no result before its end."""


class TimeLimit:
    """A moment at which work has to end; ``seconds`` after ``began`` (monotonic clock), None for no limit."""

    def __init__(self, seconds: float | None = None, began: float | None = None) -> None:
        self.began = time.monotonic() if began is None else began
        self.end = None if seconds is None else self.began + seconds

    @property
    def elapsed(self) -> float:
        """Return the time since the start [s]."""
        return time.monotonic() - self.began

    @property
    def left(self) -> float:
        """Return the time that is left [s]: infinite without a limit, 0 after the end or a stop by the user."""
        if _stopped:
            return 0.0
        return float("inf") if self.end is None else max(0.0, self.end - time.monotonic())

    def over(self) -> bool:
        """Return whether time is over or the user has stopped the command."""
        return self.left <= 0.0

    def part(self, share: float = 1.0, reserve: float = 0.0) -> TimeLimit:
        """Return a limit of ``share`` of the time that is left but for ``reserve`` [s]; no limit has none."""
        if self.end is None:
            return TimeLimit()
        return TimeLimit(share * max(0.0, self.left - reserve))


def in_time(items: Iterable[Item], over: Callable[[], bool], least: int = 1) -> Iterator[Item]:
    """Yield items until time is over, but at least some: a consumer that works ahead begins none after that."""
    for done, item in enumerate(items):
        if done >= least and over():
            return
        yield item


def stopped_by_user() -> bool:
    """Return whether the user has asked the command to end."""
    return _stopped


@contextmanager
def ending_in_order() -> Iterator[None]:
    """Let the first Ctrl-C end all limits, so that the command writes what it has; the second one stops it at once."""
    global _stopped
    _stopped = False
    if threading.current_thread() is not threading.main_thread():
        yield  # only the main thread receives signals
        return

    def stop(_number: int, _frame: Any) -> None:
        global _stopped
        if _stopped:
            raise KeyboardInterrupt
        _stopped = True
        say("stopping, and writing what there is; Ctrl-C again stops at once")

    before = signal.signal(signal.SIGINT, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
        _stopped = False
