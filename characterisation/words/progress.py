"""Progress of long steps on stderr: on a terminal a bar with the remaining time, elsewhere a line from time to time."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence, Sized
from typing import TypeVar

Item = TypeVar("Item")

#: time between lines without a terminal [s]
_LINE_EVERY_S = 10.0

#: items that were finished within this time of one another count as finished together [s]
_TOGETHER_S = 0.2

_quiet = False


def be_quiet(quiet: bool = True) -> None:
    """Switch progress off or on; results, warnings and errors are still printed."""
    global _quiet
    _quiet = quiet


def track(items: Iterable[Item], label: str, total: int | None = None) -> Iterator[Item]:
    """Iterate over ``items`` and show the progress."""
    if total is None and isinstance(items, Sized):
        total = len(items)
    if _quiet:
        yield from items
    elif sys.stderr.isatty():
        yield from _bar(items, label, total)
    else:
        yield from _lines(items, label, total)


def track_if_long(items: Sequence[Item], label: str) -> Iterator[Item]:
    """Iterate over items that usually take no time, and show progress only after :data:`_LINE_EVERY_S`."""
    return _lines(items, label, len(items), say_progress)


def say(text: str) -> None:
    """Print a message on stderr."""
    print(text, file=sys.stderr, flush=True)


def say_progress(text: str) -> None:
    """Print progress on stderr, unless the user asked for quiet."""
    if not _quiet:
        say(text)


def _bar(items: Iterable[Item], label: str, total: int | None) -> Iterator[Item]:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeElapsedColumn, TimeRemainingColumn

    columns = (BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), "left", TimeRemainingColumn())
    with Progress("{task.description:<28}", *columns, console=Console(stderr=True)) as progress:
        yield from progress.track(items, total=total, description=label)


def time_left(finished_s: Sequence[float], total: int) -> str:
    """Return the time that the rest of ``total`` items will take, in words, from the times when others were finished.

    ``finished_s`` (n,) are sorted, from the start [s]. The time to the first items contains what is prepared once, such
    as kernels and light paths, and workers return several items at once. Therefore the first items that came together
    only bound the time.
    """
    remaining, done = total - len(finished_s), len(finished_s)
    first = sum(moment - finished_s[0] <= _TOGETHER_S for moment in finished_s)
    if done == first:
        return f"at most {finished_s[-1] / done * remaining:.0f} s left"
    return f"{(finished_s[-1] - finished_s[0]) / (done - first) * remaining:.0f} s left"


def _lines(items: Iterable[Item], label: str, total: int | None, report: Callable[[str], None] = say) -> Iterator[Item]:
    start = last = time.monotonic()
    finished: list[float] = []
    for item in items:
        yield item
        now = time.monotonic()
        finished.append(now - start)
        if now - last >= _LINE_EVERY_S and len(finished) != total:
            left = f", {time_left(finished, total)}" if total else ""
            report(f"{label}: {len(finished)}/{total or '?'}{left}")
            last = now
    if report is say:
        say(f"{label}: {len(finished)} done in {time.monotonic() - start:.1f} s")
