"""A stereo capture of which only one side is left, so that a fit cannot see what it is judged on.

python tests/benchmarks/half_capture.py CAPTURE OUT left|right COLUMN COLUMN

In the first and the second camera's images, all pixels beyond the two columns are set to 0: those to the right of them
if the left side is kept, else those to the left.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

from mitsim.capture.folder import read_capture, write_capture


def main(whole: Path, out: Path, side: str, columns: list[int]) -> None:
    """Write the half."""
    capture = read_capture(whole)
    images = {}
    for (name, stack), column in zip(capture.images.items(), columns, strict=True):
        images[name] = stack.copy()
        images[name][..., slice(column, None) if side == "left" else slice(None, column)] = 0
    write_capture(replace(capture, images=images), out)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3], [int(one) for one in sys.argv[4:]])
