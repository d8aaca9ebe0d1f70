"""From which cost of a pixel the 16-bit costs of OpenCV's SGBM overflow.

    python tests/benchmarks/sgbm_overflow.py

Two images of random grey levels, one shifted by 20 px, with and without a blur of 1.5 px, are matched with blocks of
5 to 31 px, penalties p2 of 8 to 280 and caps of 15 to 127. A setting fails if less than 97 % of the disparities are
within 1 px. Sums overflow at a cost of (32767 / block^2 - p2) / cap of a pixel over the cap: printed for the smallest
block that fails, and for the largest before it. `SGBM_COST_PER_CAP` refuses what fails if it exceeds the first number
of every row.
"""

from __future__ import annotations

import cv2
import numpy as np

SHIFT, DISPARITIES = 20, 64


def right_share(left: np.ndarray, right: np.ndarray, block: int, p2: int, cap: int) -> float:
    """Return the share of disparities within 1 px of the shift."""
    area = block * block
    matcher = cv2.StereoSGBM.create(
        0, DISPARITIES, block, P1=min(8, p2) * area, P2=p2 * area, preFilterCap=cap, uniquenessRatio=5
    )
    disparity = matcher.compute(left, right) / 16
    return float((np.abs(disparity[20:-20, DISPARITIES + 16 : -16] - SHIFT) < 1).mean())


def main() -> None:
    """Print a row for each penalty and cap that fails at some block."""
    whole = np.random.default_rng(1).integers(0, 256, (120, 400)).astype(np.uint8)
    blurred = cv2.normalize(cv2.GaussianBlur(whole, (0, 0), 1.5), None, 0, 255, cv2.NORM_MINMAX)
    for name, image in (("sharp", whole), ("blurred", blurred)):
        left, right = np.ascontiguousarray(image[:, :-SHIFT]), np.ascontiguousarray(image[:, SHIFT:])
        for p2 in (8, 32, 100, 280):
            for cap in (15, 63, 127):
                shares = {block: right_share(left, right, block, p2, cap) for block in range(5, 32, 2)}
                first = next((block for block, share in shares.items() if share < 0.97), None)
                if first is None:
                    continue
                works, fails = ((32767 / block**2 - p2) / cap for block in (first - 2, first))
                print(
                    f"{name:<8} p2 {p2:>3} cap {cap:>3}: {first:>2} px fails; cost per cap {fails:5.2f} to {works:5.2f}"
                )


if __name__ == "__main__":
    main()
