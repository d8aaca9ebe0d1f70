"""Show a fit: its table, remarks, and a figure with image, model and residuals of the worst view."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from characterisation.plots.style import FIELD, drawing
from characterisation.words.numbers import percent, two_digits
from mitsim.twin.finish.run import CouponFit

#: least range of the residual's colours, in standard deviations
_LEAST_REACH = 3.0

#: correlation of neighbouring blocks above which a remark is printed: the model is then incomplete
_ALIKE = 0.3


def fit_table(coupon_fit: CouponFit) -> str:
    """Return the fitted quantities, one line for each, then one line for each view, with cells separated by tabs."""
    fit, lines = coupon_fit.fit, []
    if fit.log_alpha is not None:
        spread = f"covariance {percent(fit.log_alpha.by_covariance)}, jackknife {percent(fit.log_alpha.by_jackknife)}"
        lines += [("alpha", _with(*coupon_fit.alpha), spread)]
        lines += [("Ra-equivalent [um]", _with(*coupon_fit.roughness), coupon_fit.finish)]
    relative = coupon_fit.power[0] / coupon_fit.sensor.projector.flux
    times = "" if coupon_fit.metal else ", times albedo"
    lines += [("projector power [W]" + times, _with(*coupon_fit.power), f"{relative:.3f} of the sensor file's")]
    if fit.wide_angle is not None:
        lines += [("wide-angle share", _with(fit.wide_angle.value, fit.wide_angle.uncertainty), "")]
    if fit.ambient is not None:
        lines += [("light of the room [e-/s]", _with(fit.ambient.value, fit.ambient.uncertainty), "")]
    for dots in coupon_fit.dots:
        contrasts = f"contrast {dots.contrast:.2f}, file's {dots.file_contrast:.2f}"
        words = f"by its dots: blur {dots.blur_px:.2f} px, {contrasts}"
        lines += [(f"power by {dots.camera}{times}", f"{dots.power * coupon_fit.sensor.projector.flux:.3f}", words)]
    lines += [
        ("reduced chi-square", f"{fit.reduced_chi_square:.3f}", f"{fit.blocks} blocks of {coupon_fit.block_px} px"),
        ("residual rms [DN]", f"{coupon_fit.rms_dn:.3g}", f"{coupon_fit.rms_in_noise:.2f} standard deviations"),
        ("grain", f"{fit.grain:.3f}", f"neighbouring blocks correlate by {fit.neighbours:.2f}"),
        ("left out, saturated", f"{100 * coupon_fit.censored:.1f} %", ""),
    ]
    text = "".join("\t".join(line).rstrip("\t") + "\n" for line in lines)
    text += "\ncapture\tcamera\texposure [s]\thalf vector [deg]\tresidual [DN]\tin noise\tleft out\n"
    for residual in fit.residuals:
        view = residual.view
        seen, missed = "none", "none\tnone"
        if view.size:
            low, high = np.degrees(view.off_mirror())
            seen, missed = f"{low:.0f} to {high:.0f}", f"{residual.rms_dn:.3g}\t{residual.rms_in_noise:.2f}"
        text += f"{Path(view.name).name}\t{view.camera}\t{view.exposure_s:.3g}\t{seen}\t{missed}\t"
        text += f"{100 * view.censored:.0f} %\n"
    return text


def remarks(coupon_fit: CouponFit) -> list[str]:
    """Return remarks that limit the use of the results."""
    fit, lines = coupon_fit.fit, []
    if coupon_fit.metal is not None and fit.log_alpha is not None:
        low, high = coupon_fit.metal.alpha_range
        if fit.at_limit:
            lines.append("alpha reached the end of its range: these poses do not determine the width of the lobe")
        elif fit.log_alpha.uncertainty > 0.3:
            lines.append("alpha is very uncertain: use poses closer to the mirror direction, or shorter exposures")
        if math.isnan(coupon_fit.roughness[0]):
            ends = " to ".join(f"{end:g}" for end in np.round(coupon_fit.metal.roughness_range, 3))
            of_ra = f"alpha {low:.3f} to {high:.3f}, of Ra {ends} um"
            lines.append(f"no Ra-equivalent: {coupon_fit.finish} has {of_ra}")
    if fit.reduced_chi_square > 2:
        lines.append("the residuals exceed the noise: uncertainties are increased accordingly, but the bias is unknown")
    if fit.neighbours > _ALIKE:
        lines.append("residuals of neighbouring blocks are correlated: light, form or lobe differ from the model")
    if coupon_fit.pattern_unknown:
        lines.append("the pattern is not known to be that of the sensor file: block means were compared, not dots")
    if scatters := [one.off_plane for one in coupon_fit.specimens if not math.isnan(one.off_plane)]:
        by = f"{max(scatters):.2g} mm"
        lines.append(f"the place of the coupon is the plane of its cloud, which scatters by up to {by} about it")
    return lines


def fit_figure(coupon_fit: CouponFit) -> Figure:
    """Draw image and model of the worst view [DN over black], and its residuals in standard deviations of a block."""
    worst = coupon_fit.worst
    view, gain = worst.view, worst.view.noise.gain
    image, model = _picture(coupon_fit, view.electrons * gain), _picture(coupon_fit, worst.pixels * gain)
    residual = _picture(coupon_fit, worst.in_noise[view.block])
    bright = float(np.nanpercentile(image, 99.5))
    reach = max(_LEAST_REACH, float(np.nanpercentile(np.abs(residual), 99)))
    with drawing():
        ratio = image.shape[0] / image.shape[1]
        figure = Figure((9.6, 3.1 * ratio + 1.1), layout="constrained")
        panels = np.asarray(figure.subplots(1, 3))
        kept: dict[str, Any] = {"vmin": 0, "vmax": bright, "cmap": "gray"}
        shown = [
            (image, "image", kept, "DN over black"),
            (model, "model", kept, "DN over black"),
            (residual, "image less model, by block", {"vmin": -reach, "vmax": reach, "cmap": "RdBu_r"}, "of its noise"),
        ]
        for axes, (values, title, colours, unit) in zip(panels, shown, strict=True):
            drawn = axes.imshow(values, **colours)
            axes.set(facecolor=FIELD, title=title, xticks=[], yticks=[])
            figure.colorbar(drawn, ax=axes, orientation="horizontal", label=unit, fraction=0.06, pad=0.03)
        where = f"{Path(view.name).name}, {view.camera} ({coupon_fit.source})"
        size = f"{worst.rms_dn:.2g} DN rms, {worst.rms_in_noise:.2g} standard deviations"
        figure.suptitle(f"{where}: residual {size}", fontsize=10)
    return figure


def _picture(coupon_fit: CouponFit, values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return values (N,) of the worst view's pixels as an image, NaN where no pixel was compared."""
    view = coupon_fit.worst.view
    low = view.rows.min(), view.columns.min()
    out = np.full((int(np.ptp(view.rows)) + 1, int(np.ptp(view.columns)) + 1), np.nan)
    out[view.rows - low[0], view.columns - low[1]] = values
    return out


def _with(value: float, uncertainty: float) -> str:
    """Return a value with the decimals of its uncertainty, which is rounded to two digits."""
    if not math.isfinite(value):
        return "none"
    if not math.isfinite(uncertainty) or uncertainty <= 0:
        return f"{value:.4g}"
    spread = two_digits(uncertainty)
    return f"{value:.{len(spread.partition('.')[2])}f} +- {spread}"
