"""Estimate a projector's depth of focus and aperture from one capture of stripes.

Signal chain: decoded points -> depth in front of the projector, block by block -> modulation of stripes by width ->
blur s [projector px] of every block (:func:`modulation`) -> least squares on

    s^2(z) = s_0^2 + (a f |1/z - 1/z_f| / 4)^2

with a the diameter of the lens's aperture, z_f the depth of sharp focus, and s_0 all blur that does not change with
depth, including the camera's. A point at depth z receives light from a disc of diameter a f |1/z - 1/z_f| px. The
standard deviation of the disc along one axis is a quarter of its diameter (:mod:`mitsim.sensor.projector`). Points
beside the specimen are used too: a larger range of depths separates s_0 and a better.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from characterisation.files.arrays import Floats
from mitsim.decoding.cloud import capture_cloud, decoder_settings
from mitsim.sensor.imager import Imager
from mitsim.twin.sensor.input_captures import InputCapture

#: terms of the series
_HARMONICS = np.arange(1, 40, 2)

#: side of a block [px]; chosen
_BLOCK_PX = 32

#: least share of a block's pixels that are decoded; chosen
_LEAST_SHARE = 0.15

#: largest relative spread of depths in a block, whose blur is one number; chosen
_DEEP = 0.025

#: largest relative standard deviation of white levels in a block; chosen
_EVEN = 0.12

#: least white minus black [DN of 8 bit]; below, rounding raises the modulation of fine stripes
_LEAST_DN = 50.0

#: widest stripes used [projector px]: wider ones hardly tell the blur; chosen
_WIDEST_PX = 40.0

#: least number of blocks; chosen
_FEWEST = 60

#: parts of the jackknife; chosen
_PARTS = 20

#: blur residual [px] beyond which a block loses weight as an outlier
_SOFT_PX = 0.1


def modulation(blur: float, width: Floats) -> Floats:
    """Return the mean modulation of stripes of a width (...) [px] after a Gaussian blur [px], 1 for sharp ones.

        mean |on - off| / (white - black) = (8 / pi^2) sum over odd n of exp(-pi^2 s^2 n^2 / (2 w^2)) / n^2

    with s the standard deviation of the blur and w the width of a stripe: the Fourier series of a square wave after a
    Gaussian blur. The reflectance of a print cancels in the ratio.
    """
    w = np.asarray(width, float)[..., None]
    fall = np.exp(-((np.pi * blur * _HARMONICS / w) ** 2) / 2)
    return np.asarray((fall / _HARMONICS**2).sum(axis=-1) / (1.0 / _HARMONICS**2).sum())


def fitted_blur(width: Floats, ratio: Floats) -> float:
    """Return the blur [px] of stripes (n,) [px] with modulation (n,), up to a common loss by far scattered light."""
    fit = least_squares(
        lambda x: x[1] * modulation(float(x[0]), width) - ratio, [1.0, 0.9], bounds=([0.05, 0.3], [20.0, 1.0])
    )
    return float(fit.x[0])


@dataclass(frozen=True)
class Defocus:
    """Constant blur ``still_px`` [projector px], ``aperture_mm``, ``focus_mm`` and their covariance (3, 3)."""

    still_px: float
    aperture_mm: float
    focus_mm: float
    covariance: Floats


def fit_defocus(
    source: InputCapture, chip: Imager, white: Floats, black: Floats, pairs: Floats, widths: Floats
) -> Defocus | None:
    """Fit the focus of a capture's projector; None if there are too few blocks.

    ``white`` and ``black`` (H, W) are images of full light and of no light [e-], ``pairs`` (n, 2, H, W) those of
    stripes of ``widths`` (n,) [projector px] and of their inverses [e-], all by the imager ``chip``.
    """
    projector = source.capture.rig.projector
    assert projector is not None
    settings, _ = decoder_settings(source.capture)
    points = capture_cloud(source.capture, settings).points.astype(float)
    depth = projector.sensor_from_camera.inverse().points(points.reshape(-1, 3)).reshape(points.shape)[..., 2]
    fine = widths < _WIDEST_PX
    difference = np.abs(pairs[fine, 0] - pairs[fine, 1])
    least = _LEAST_DN * (2**source.capture.bits - 1) / 255 / chip.gain
    rows = []
    for top in range(0, white.shape[0] - _BLOCK_PX + 1, _BLOCK_PX):
        for left in range(0, white.shape[1] - _BLOCK_PX + 1, _BLOCK_PX):
            part = np.s_[top : top + _BLOCK_PX, left : left + _BLOCK_PX]
            depths, level = depth[part][np.isfinite(depth[part])], white[part]
            if len(depths) < _LEAST_SHARE * _BLOCK_PX**2 or level.std() > _EVEN * level.mean():
                continue
            near, middle, far = np.percentile(depths, [10, 50, 90])
            modulated = float((level - black[part]).mean())
            if far - near > _DEEP * middle or modulated < least:
                continue
            ratio = difference[:, *part].mean(axis=(1, 2)) / modulated
            rows.append((middle, fitted_blur(widths[fine], ratio)))
    table = np.array(rows).reshape(-1, 2)
    if len(table) < _FEWEST:
        return None
    focal = float(projector.matrix[0, 0])
    values = _fitted(table, focal)
    # neighbouring blocks are correlated: the jackknife leaves out runs of them
    parts = np.array_split(np.arange(len(table)), _PARTS)
    replicates = np.array([_fitted(np.delete(table, part, axis=0), focal) for part in parts])
    off = replicates - replicates.mean(axis=0)
    return Defocus(float(values[0]), float(values[1]), float(values[2]), (_PARTS - 1) / _PARTS * off.T @ off)


def _fitted(table: Floats, focal: float) -> Floats:
    """Fit constant blur, aperture and focus to depths and blurs (n, 2)."""
    depth, blur = table.T

    def off(x: Floats) -> Floats:
        return np.asarray(np.hypot(x[0], x[1] * focal * (1 / depth - 1 / x[2]) / 4) - blur)

    low, high = float(depth.min()), float(depth.max())
    starts = (low, float(np.median(depth)), high)
    fits = [
        least_squares(
            off,
            [max(float(np.median(blur)), 0.05), 20.0, start],
            loss="soft_l1",
            f_scale=_SOFT_PX,
            bounds=([0.0, 0.0, low / 2], [20.0, 500.0, 2 * high]),
            x_scale=[0.1, 10.0, 100.0],
        )
        for start in starts
    ]
    return np.asarray(min(fits, key=lambda fit: fit.cost).x)
