"""Process images in blocks of pixels, on several threads.

Signal chain: pixels of an image -> blocks that fit into the processor's cache -> consecutive blocks for each thread.
"""

from __future__ import annotations

from collections.abc import Callable

from characterisation.files.threads import in_threads, thread_count

#: pixels of a block: as float32, the images of one period take half a megabyte
BLOCK = 16384


def in_blocks(work: Callable[[list[slice]], None], count: int) -> None:
    """Call ``work`` on each thread with slices that cover ``count`` pixels; results do not depend on the threads."""
    blocks = [slice(start, start + BLOCK) for start in range(0, count, BLOCK)]
    workers = max(min(thread_count(), len(blocks) // 2), 1)
    in_threads(work, [blocks[len(blocks) * k // workers : len(blocks) * (k + 1) // workers] for k in range(workers)])


def row_bands(height: int, width: int) -> list[slice]:
    """Return bands of rows of an image that stay in the processor's cache."""
    band = max(1, BLOCK // width)
    return [slice(top, top + band) for top in range(0, height, band)]
