"""Compare the pose of a coupon with the plane of the points that it gave.

Signal chain: points inside the outline of the coupon -> plane through most of them -> its tilt and offset against the
coupon. A map keeps its values by the pose: one that is wrong by 10 deg puts them 10 deg aside, and one that is wrong by
more than the depths of false points makes every point false.
"""

from __future__ import annotations

import math

import numpy as np

from characterisation.coupon.patches import Coupon
from characterisation.point_cloud import PointCloud

#: largest tilt [deg] and offset [share of the distance] that raise no doubt; a sensor's own errors are smaller
_TILT_DEG, _OFFSET = 5.0, 0.01

#: least number of points of the plane, and least share of those inside the outline
_LEAST, _MOST = 500, 0.5


def pose_doubt(cloud: PointCloud, coupon: Coupon) -> str:
    """Return a warning if a cloud shows a plane that is not the coupon at its pose (both sensor frame), or ""."""
    axes = np.stack([coupon.across, np.cross(coupon.normal, coupon.across), coupon.normal])
    x, y, z = axes @ (cloud.points[cloud.valid].astype(float) - coupon.centre).T
    inside = (np.abs(x) < coupon.width / 2) & (np.abs(y) < coupon.height / 2)
    inside &= np.abs(z) < max(coupon.width, coupon.height)
    x, y, z = x[inside], y[inside], z[inside]
    if len(z) < _LEAST:
        return ""
    terms, kept = np.stack([np.ones_like(x), x, y], axis=1), np.ones(len(z), bool)
    for _ in range(4):
        plane = np.linalg.lstsq(terms[kept], z[kept], rcond=None)[0]
        off = np.abs(z - terms @ plane)
        kept = off <= 4 * float(np.median(off))
    if kept.sum() < max(_LEAST, _MOST * len(z)):
        return ""
    noise, slope = float(np.std((z - terms @ plane)[kept])), float(np.hypot(*plane[1:]))
    tilt, half = math.degrees(math.atan(slope)), min(coupon.width, coupon.height) / 2
    tilted = tilt > _TILT_DEG and slope * half > noise
    if not tilted and abs(plane[0]) <= max(_OFFSET * float(np.linalg.norm(coupon.centre)), noise):
        return ""
    return (
        f"the points lie in a plane {tilt:.1f} deg and {plane[0]:+.1f} mm from the coupon at its pose: check the pose, "
        "or give mitsim import the window of the coupon (--coupon)"
    )
