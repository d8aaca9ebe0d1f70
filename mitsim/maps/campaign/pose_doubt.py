"""Compare the pose of a coupon with the plane of the points that it gave.

Signal chain: points inside the outline of the coupon -> plane through most of them -> its tilt and offset against the
coupon. A map keeps its values by the pose: one that is wrong by 10 deg puts them 10 deg aside, and one that is wrong by
more than the depths of false points makes every point false. Poses of the inverse direction put most coupons out of the
image.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

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

#: least distance between a coupon and the coupon at the inverse pose for the two to differ [share of the distance]
_APART = 0.05


@dataclass(frozen=True)
class SeenPlane:
    """Tilt and offset [mm] of the plane of a coupon's points from the coupon at its pose, and whether it ``fits``."""

    tilt_deg: float
    offset: float
    fits: bool

    @property
    def doubt(self) -> str:
        """A warning if it does not fit, or ""."""
        if self.fits:
            return ""
        return (
            f"the points lie in a plane {self.tilt_deg:.1f} deg and {self.offset:+.1f} mm from the coupon at its pose: "
            "check the pose, or give mitsim import the window of the coupon (--coupon)"
        )


def may_be_inverted(coupon: Coupon, inverted: Coupon) -> bool:
    """Return whether a coupon at the inverse pose faces the sensor, at another place than the coupon."""
    apart = np.linalg.norm(coupon.centre - inverted.centre) > _APART * np.linalg.norm(coupon.centre)
    return bool(apart and inverted.normal @ inverted.centre < 0)


def seen_plane(cloud: PointCloud, coupon: Coupon) -> SeenPlane | None:
    """Return the plane of the points of a coupon at its pose (both sensor frame); None without one."""
    axes = np.stack([coupon.across, np.cross(coupon.normal, coupon.across), coupon.normal])
    x, y, z = axes @ (cloud.points[cloud.valid].astype(float) - coupon.centre).T
    inside = (np.abs(x) < coupon.width / 2) & (np.abs(y) < coupon.height / 2)
    inside &= np.abs(z) < max(coupon.width, coupon.height)
    count = int(inside.sum())
    if count < _LEAST_POINTS:
        return None
    try:
        fit = fit_plane(np.stack([x, y, z], axis=1)[inside])
    except FitError:
        return None
    if fit.count < max(_LEAST_POINTS, _LEAST_SHARE * count):
        return None
    normal = fit.normal if fit.normal[2] > 0 else -fit.normal
    steep = max(float(normal[2]), 1e-9)
    slope, offset = math.hypot(*normal[:2]) / steep, float(normal @ fit.point) / steep  # at the coupon's centre
    tilt, half = math.degrees(math.atan(slope)), min(coupon.width, coupon.height) / 2
    noise = fit.residual_std
    tilted = tilt > _TILT_DEG and slope * half > noise
    aside = abs(offset) > max(_OFFSET * float(np.linalg.norm(coupon.centre)), noise)
    return SeenPlane(tilt, offset, not tilted and not aside)
