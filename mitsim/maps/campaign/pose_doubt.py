"""Compare the pose of a coupon with the plane of the points that it gave.

Signal chain: points inside the outline of the coupon -> plane through most of them -> its tilt and offset against the
coupon. A map keeps its values by the pose: one that is wrong by 10 deg puts them 10 deg aside, and one that is wrong by
more than the depths of false points makes every point false.
"""

from __future__ import annotations

import math

import numpy as np

from characterisation.coupon.patches import Coupon
from characterisation.features.fits import fit_plane
from characterisation.features.robust_fit import FitError
from characterisation.point_cloud import PointCloud

#: largest tilt that raises no doubt [deg]; a sensor's own is smaller; chosen
_TILT_DEG = 5.0

#: largest offset that raises no doubt [share of the distance]; a sensor's own is smaller; chosen
_OFFSET = 0.01

#: least number of points of the plane, so that their noise tilts it by far less than the limit; chosen
_LEAST_POINTS = 500

#: least share of the points inside the outline that lie in the plane: most of them; chosen
_LEAST_SHARE = 0.5


def pose_doubt(cloud: PointCloud, coupon: Coupon) -> str:
    """Return a warning if a cloud shows a plane that is not the coupon at its pose (both sensor frame), or ""."""
    axes = np.stack([coupon.across, np.cross(coupon.normal, coupon.across), coupon.normal])
    x, y, z = axes @ (cloud.points[cloud.valid].astype(float) - coupon.centre).T
    inside = (np.abs(x) < coupon.width / 2) & (np.abs(y) < coupon.height / 2)
    inside &= np.abs(z) < max(coupon.width, coupon.height)
    count = int(inside.sum())
    if count < _LEAST_POINTS:
        return ""
    try:
        fit = fit_plane(np.stack([x, y, z], axis=1)[inside])
    except FitError:
        return ""
    if fit.count < max(_LEAST_POINTS, _LEAST_SHARE * count):
        return ""
    normal = fit.normal if fit.normal[2] > 0 else -fit.normal
    steep = max(float(normal[2]), 1e-9)
    slope, offset = math.hypot(*normal[:2]) / steep, float(normal @ fit.point) / steep  # at the coupon's centre
    tilt, half = math.degrees(math.atan(slope)), min(coupon.width, coupon.height) / 2
    noise = fit.residual_std
    tilted = tilt > _TILT_DEG and slope * half > noise
    if not tilted and abs(offset) <= max(_OFFSET * float(np.linalg.norm(coupon.centre)), noise):
        return ""
    return (
        f"the points lie in a plane {tilt:.1f} deg and {offset:+.1f} mm from the coupon at its pose: check the pose, "
        "or give mitsim import the window of the coupon (--coupon)"
    )
