"""Format a virtual calibration as text for the terminal."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mitsim.study.calibration.virtual_calibration import VirtualCalibration

#: a normal distribution has 95 % within this many sigma
_INSIDE = 1.959964


def calibration_table(found: VirtualCalibration) -> str:
    """Return board, noise, standard deviations and accuracy, one per line."""
    views = found.views
    camera = [view.camera_px for view in views]
    lines = [
        f"{found.sensor.name}: board of {found.board}; "
        f"{len(views)} poses, {sum(len(each.corners) for each in views)} corners",
        f"noise of a corner: {min(camera):.3f} to {max(camera):.3f} px in a camera",
    ]
    if "projector" in found.eyes:
        lines[-1] += f", {max(view.coordinate_px for view in views):.2g} px of the projector's own"
    lines += ["", f"{'parameter':<28} {'one sigma':>10}"]
    lines += [
        f"{name:<28} {sigma:>10.3g}"
        for name, sigma in zip(found.covariance.names, found.covariance.one_sigma, strict=True)
    ]
    alone, drifted = found.accuracy.numbers(), found.accuracy_drifted.numbers()
    rows = {
        "ball bar, SD, one sigma [mm]": "sphere_spacing_sigma_mm",
        "  relative to its length": "sphere_spacing_relative",
        "ball bar, worst of seven, 95 % [mm]": "sphere_spacing_95_mm",
        "flatness, worst of five, median [mm]": "flatness_median_mm",
        "flatness, worst of five, 95 % [mm]": "flatness_95_mm",
        "distance, one sigma [mm]": "depth_sigma_mm",
    }
    lines += [
        "",
        f"at {alone['middle_mm']:.0f} mm, over a diagonal of {alone['diagonal_mm']:.0f} mm: true points, no noise",
    ]
    lines += [f"{'':<40} {'calibration':>12} {'and drift':>12}"]
    lines += [f"{what:<40} {alone[key]:>12.3g} {drifted[key]:>12.3g}" for what, key in rows.items()]
    return "\n".join(lines) + "\n"


def coverage_table(names: tuple[str, ...], scores: NDArray[np.float64]) -> str:
    """Return the share of simulated calibrations within the stated 95 %, by parameter and overall.

    ``scores`` (count, n): errors over one sigma.
    """
    inside = np.abs(scores) <= _INSIDE
    lines = [f"{'parameter':<28} {'inside 95 %':>12} {'rms / sigma':>12}"]
    lines += [
        f"{name:<28} {share:>12.3f} {spread:>12.3f}"
        for name, share, spread in zip(names, inside.mean(axis=0), np.sqrt((scores**2).mean(axis=0)), strict=True)
    ]
    lines += [f"{'all of ' + str(len(scores)) + ' calibrations':<28} {inside.mean():>12.3f}"]
    return "\n".join(lines) + "\n"
