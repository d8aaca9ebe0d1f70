"""Compare the pose of a coupon with the plane of the points that it gave.

Signal chain: points inside the outline of the coupon -> plane through most of them -> its tilt and offset against the
coupon. A map keeps its values by the pose: one that is wrong by 10 deg puts them 10 deg aside, and one that is wrong by
more than the depths of false points makes every point false. Poses of the inverse direction put most coupons out of the
image.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from characterisation.coupon.patches import Coupon
from characterisation.features.fits import fit_plane
from characterisation.features.robust_fit import FitError
from characterisation.point_cloud import PointCloud
from mitsim.scene.coupons import Sample
from mitsim.sensor.transforms import Transform

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


#: what an inverted pose should be
DIRECTION = "pose.json needs world_from_sensor, from the sensor to the coupon's frame, and seems to have its inverse"

#: decodes the part of a capture that shows a coupon
Decode = Callable[[Coupon], PointCloud]


@dataclass(frozen=True)
class _SeenPlane:
    """Tilt and offset [mm] of the plane of a coupon's points from the coupon at its pose, and whether it ``fits``."""

    tilt_deg: float
    offset: float
    fits: bool


def pose_doubt(cloud: PointCloud, decode: Decode, sample: Sample, sensor_from_coupon: Transform) -> str:
    """Return a warning if the points of a capture contradict the pose of its coupon, or "".

    ``cloud`` is that of the coupon at its pose; ``decode`` gives that of the same capture about a coupon elsewhere.
    """
    coupon, grid = sample.at(sensor_from_coupon), cloud.grid
    plane = _seen_plane(cloud, coupon)
    if plane is not None and plane.fits:
        return ""
    if fits_inverted(decode, sample, sensor_from_coupon):
        return f"the points lie in the plane of the coupon if its pose is inverted: {DIRECTION}"
    if plane is not None:
        return (
            f"the points lie in a plane {plane.tilt_deg:.1f} deg and {plane.offset:+.1f} mm from the coupon at its "
            "pose: check the pose, or give mitsim import the window of the coupon (--coupon)"
        )
    column, row = grid.project(coupon.centre)
    inside = 0 <= column < grid.width and 0 <= row < grid.height
    return "" if inside else "the coupon at its pose is outside the image: check the pose"


def fits(decode: Decode, coupon: Coupon) -> bool:
    """Return whether the points about a coupon lie in its plane."""
    plane = _seen_plane(decode(coupon), coupon)
    return plane is not None and plane.fits


def fits_inverted(decode: Decode, sample: Sample, sensor_from_coupon: Transform) -> bool:
    """Return whether the points lie in the plane of the coupon at the inverse of its pose, which is another place."""
    return may_be_inverted(sample, sensor_from_coupon) and fits(decode, sample.at(sensor_from_coupon.inverse()))


def may_be_inverted(sample: Sample, sensor_from_coupon: Transform) -> bool:
    """Return whether the coupon at the inverse of its pose faces the sensor, at a place that is another one."""
    coupon, inverted = sample.at(sensor_from_coupon), sample.at(sensor_from_coupon.inverse())
    apart = np.linalg.norm(coupon.centre - inverted.centre) > _APART * np.linalg.norm(coupon.centre)
    return bool(apart and inverted.normal @ inverted.centre < 0)


def _seen_plane(cloud: PointCloud, coupon: Coupon) -> _SeenPlane | None:
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
    return _SeenPlane(tilt, offset, not tilted and not aside)
