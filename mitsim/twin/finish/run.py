"""Fit the finish of a coupon and the power of the projector to captures of the coupon.

Signal chain: capture folders, scene of the coupon -> its pose in each (:mod:`mitsim.twin.finish.find_specimen`)
-> views (:mod:`mitsim.twin.finish.observation`) -> fit (:mod:`mitsim.twin.finish.estimate`) -> alpha, Ra-equivalent,
power [W], residual. If the pattern is not that of the sensor file, its dots are compared, too
(:mod:`mitsim.twin.finish.dots`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from characterisation.files.atomic_io import json_values
from characterisation.files.errors import InputError
from characterisation.region_of_interest import Roi
from characterisation.words.progress import say, track
from mitsim.capture.calibration import calibration_table
from mitsim.capture.capture import Capture
from mitsim.capture.folder import read_capture
from mitsim.scene.coupons import CouponRecipe, load_sample
from mitsim.scene.light_transport.plain_scene import has_emitters
from mitsim.sensor.fitted_to import note_images
from mitsim.sensor.pattern import DotPattern
from mitsim.sensor.sensor import Sensor
from mitsim.twin.finish.dots import Dots, compare_dots
from mitsim.twin.finish.electrons import sensor_of
from mitsim.twin.finish.estimate import Fit, FittedQuantity, fit_views
from mitsim.twin.finish.find_specimen import find_coupon
from mitsim.twin.finish.finish import MetalFinish, metal_finish
from mitsim.twin.finish.observation import CouponCapture, CouponView, observe
from mitsim.twin.finish.posterior import FinishPosterior, finish_posterior
from mitsim.twin.finish.problem import Residual
from mitsim.twin.finish.specimen import Specimen
from mitsim.twin.finish.white_coupon import WhiteCouponRenderer

#: side of a block with a known pattern [px]: several times the length of the grain, which is under 1 px
KNOWN_BLOCK_PX = 8

#: side of a block with an unknown pattern [px]: its dots count as grain, whose length is about 2 px
UNKNOWN_BLOCK_PX = 32

DIFFUSE = "matt_white"


@dataclass(frozen=True)
class CouponFit:
    """A fit and its inputs; ``metal`` and ``posterior`` are None for a diffuse sheet.

    ``finish`` names metal and process, or the sheet. ``specimens`` are the coupon in the ``captures``. ``dots`` are
    compared by view if the pattern of a capture is not known to be that of the sensor file.
    """

    sensor: Sensor = field(repr=False)
    finish: str
    metal: MetalFinish | None = field(repr=False)
    fit: Fit
    dots: tuple[Dots, ...]
    captures: tuple[str, ...]
    specimens: tuple[Specimen, ...] = field(repr=False)
    block_px: int
    source: str
    pattern_unknown: bool
    posterior: FinishPosterior | None = None

    @property
    def alpha(self) -> tuple[float, float]:
        """Width alpha of the lobe as defined by Beckmann [1], and its standard uncertainty; NaN for a diffuse sheet."""
        return _exponential(self.fit.log_alpha)

    @property
    def roughness(self) -> tuple[float, float]:
        """Ra-equivalent [um] and its standard uncertainty; NaN if no Ra of the process has this lobe."""
        if self.metal is None or self.fit.log_alpha is None:
            return math.nan, math.nan
        return self.metal.roughness(self.alpha[0], self.fit.log_alpha.uncertainty)

    @property
    def power(self) -> tuple[float, float]:
        """Flux of the projector [W] and its standard uncertainty; for a diffuse sheet, both times its albedo."""
        relative, uncertainty = _exponential(self.fit.log_power)
        return relative * self.sensor.projector.flux, uncertainty * self.sensor.projector.flux

    @property
    def censored(self) -> float:
        """Share of the blocks on the coupon that were excluded for saturation [1]."""
        return 1.0 - self.fit.blocks / sum(residual.view.whole for residual in self.fit.residuals)

    @property
    def rms_dn(self) -> float:
        """Root mean square residual of all blocks [DN]."""
        return _pooled(self.fit.residuals, "rms_dn")

    @property
    def rms_in_noise(self) -> float:
        """Root mean square residual of all blocks in standard deviations of a block's noise [1]."""
        return _pooled(self.fit.residuals, "rms_in_noise")

    @property
    def worst(self) -> Residual:
        """Residuals of the view with the largest (chi-square - n) / sqrt(2 n), with n its number of blocks."""

        def excess(residual: Residual) -> float:
            blocks = residual.view.size
            return (float(residual.in_noise @ residual.in_noise) - blocks) / math.sqrt(2 * blocks)

        return max((residual for residual in self.fit.residuals if residual.view.size), key=excess)

    def numbers(self) -> dict[str, Any]:
        """Return the fit as JSON values, null for unknown ones; the keys are in docs/reference/formats/fit.md."""
        fit, (ra, ra_uncertainty) = self.fit, self.roughness
        document: dict[str, Any] = json_values(
            {
                "sensor": self.sensor.name,
                "source": self.source,
                "finish": self.finish,
                "captures": list(self.captures),
                "alpha": _uncertain(self.alpha, fit.log_alpha),
                "ra_equivalent_um": {
                    "value": ra,
                    "uncertainty": ra_uncertainty,
                    "range_um": list(self.metal.roughness_range) if self.metal else None,
                },
                "power_w": _uncertain(self.power, fit.log_power) | {"times_albedo": self.metal is None},
                "wide_angle_share": _linear(fit.wide_angle),
                "room_electrons_per_s": _linear(fit.ambient),
                "reduced_chi_square": fit.reduced_chi_square,
                "blocks": fit.blocks,
                "pixels": fit.pixels,
                "block_px": self.block_px,
                "grain": fit.grain,
                "neighbours_correlation": fit.neighbours,
                "alpha_at_limit": fit.at_limit,
                "left_out_share": self.censored,
                "residual_rms_dn": self.rms_dn,
                "residual_rms_in_noise": self.rms_in_noise,
                "unknowns_finish": None if self.posterior is None else {self.posterior.name: self.posterior.entries()},
                "dots": [asdict(dot) for dot in self.dots],
                "views": [_view_numbers(residual) for residual in fit.residuals],
            }
        )
        return document


def fit_captures(
    captures: Sequence[Path],
    sensor: str | None = None,
    scene: Path | None = None,
    parameters: dict[str, str] | None = None,
    block_px: int | None = None,
    roi: Roi | None = None,
) -> CouponFit:
    """Fit a coupon's finish and the projector's power to captures of it.

    Raises InputError if captures, sensor and scene do not fit each other, one is a copy of another, or too few blocks
    are left.

    Parameters
    ----------
    captures, sensor
        Folders; preset or path of a sensor file, by default the preset that the captures name.
    scene, parameters
        Scene file with size, metal and process of the coupon; its Ra sets only the prior of the finish. By default, the
        scene that the first capture names, with its parameters; those given here come first.
    block_px
        Side of a block [px]; by default :data:`KNOWN_BLOCK_PX`, or :data:`UNKNOWN_BLOCK_PX` for an unknown pattern.
    roi
        Region of the first camera's image [px] that shows only the coupon: its points give the plane, not the poses.
    """
    if not captures:
        raise InputError("CAPTURES", "", "none", "one capture folder or more")
    if len({path.resolve() for path in captures}) < len(captures):
        raise InputError("CAPTURES", "", "a folder twice", "each capture once", "the same noise twice is not a repeat")
    first = read_capture(captures[0])
    chosen = sensor_of(first, sensor, captures[0])
    path, values = (scene, {}) if scene else _own_scene(first, captures[0])
    recipe = CouponRecipe(str(path), tuple(sorted((values | (parameters or {})).items())), chosen.wavelength_nm)
    sample = load_sample(recipe)
    finish = sample.scene.finishes[0]
    assert finish is not None  # load_sample checks this
    metal = None if finish.name == DIFFUSE else metal_finish(finish, chosen.wavelength_nm, str(path))
    block = block_px or (KNOWN_BLOCK_PX if first.decoding.pattern == chosen.pattern else UNKNOWN_BLOCK_PX)

    views, dots, specimens = list[CouponView](), list[Dots](), list[Specimen]()
    calibration, unknown, digests = dict[str, Any](), False, dict[str, str]()
    for index, folder in enumerate(track(list(captures), "captures", len(captures))):
        capture = read_capture(folder)
        if capture.sensor != first.sensor:
            raise InputError(folder, "sensor", capture.sensor, f"{first.sensor}, as in {captures[0]}")
        note_images(digests, capture.images, folder)
        if calibration_table(capture.rig) != calibration:
            rig = replace(capture.rig, projector=chosen.rig.projector)  # recordings do not describe their projector
            renderer, calibration = WhiteCouponRenderer(replace(chosen, rig=rig)), calibration_table(capture.rig)
        pattern_known = capture.decoding.pattern == chosen.pattern
        unknown |= not pattern_known
        specimen = find_coupon(capture, renderer.sensor, (sample.width, sample.height), str(folder), roi)
        lit = capture.source != "simulated" or has_emitters(sample.scene)
        coupon_capture = CouponCapture(capture, specimen, index, str(folder))
        capture_views = observe(
            coupon_capture, renderer, block, pattern="mean" if pattern_known else "level", lit_room=lit
        )
        if not pattern_known and isinstance(chosen.pattern, DotPattern):
            dots += [compare_dots(view, renderer) for view in capture_views if view.size]
        views += capture_views
        specimens.append(specimen)
    if not sum(view.whole for view in views):
        why = "; ".join(dict.fromkeys(f"{view.camera} of {view.name}: {view.why_no_block}" for view in views[:4]))
        none = f"no block of {block} px on the coupon: {why}"
        hint = "give the region of the image that shows it: --window"
        raise InputError("captures", "images", none, "a coupon in the images", hint)
    say(f"fitting {sum(len(view.block) for view in views)} pixels in {sum(view.size for view in views)} blocks")
    fit, posterior = fit_views(views, metal), None
    if metal is not None and finish.scatter is not None:
        name = sample.scene.shapes[0].bsdf().id()
        posterior = finish_posterior(views, metal, finish.scatter, fit, name)
    return CouponFit(
        chosen,
        finish.name,
        metal,
        fit,
        tuple(dots),
        tuple(str(c) for c in captures),
        tuple(specimens),
        block,
        first.source,
        unknown,
        posterior,
    )


def _own_scene(capture: Capture, folder: Path) -> tuple[Path, dict[str, str]]:
    """Return the scene that a capture was rendered of, and the values of its ``<default>`` elements."""
    named, values = capture.settings.get("scene"), capture.settings.get("scene_parameters", {})
    if not isinstance(values, dict) or not all(isinstance(value, str) for value in values.values()):
        raise InputError(folder / "settings.json", "scene_parameters", repr(values), "a table of texts")
    if isinstance(named, str) and Path(named).is_file():
        return Path(named), values
    found, hint = repr(named) if named else "nothing", "give the scene of the coupon: --scene scenes/coupon/coupon.xml"
    raise InputError(folder / "settings.json", "scene", found, "an existing scene file", hint)


def _exponential(parameter: FittedQuantity | None) -> tuple[float, float]:
    """Return value and standard uncertainty of a quantity whose logarithm was fitted."""
    if parameter is None:
        return math.nan, math.nan
    value = math.exp(parameter.value)
    return value, value * parameter.uncertainty


def _uncertain(pair: tuple[float, float], parameter: FittedQuantity | None) -> dict[str, Any]:
    relative = (math.nan, math.nan) if parameter is None else (parameter.by_covariance, parameter.by_jackknife)
    names = ("value", "uncertainty", "relative_by_covariance", "relative_by_jackknife")
    return dict(zip(names, (*pair, *relative), strict=True))


def _linear(parameter: FittedQuantity | None) -> dict[str, Any] | None:
    if parameter is None:
        return None
    names = ("value", "uncertainty", "by_covariance", "by_jackknife")
    return {name: getattr(parameter, name) for name in names}


def _view_numbers(residual: Residual) -> dict[str, Any]:
    view = residual.view
    low, high = np.degrees(view.off_mirror()) if view.size else (math.nan, math.nan)
    return {
        "capture": view.name,
        "camera": view.camera,
        "exposure_s": view.exposure_s,
        "blocks": view.size,
        "left_out_share": view.censored,
        "half_vector_deg": [float(low), float(high)],
        "rms_dn": residual.rms_dn,
        "rms_relative": residual.rms_relative,
        "rms_in_noise": residual.rms_in_noise,
        "off_plane_mm": view.specimen.off_plane,
    }


def _pooled(residuals: Sequence[Residual], name: str) -> float:
    pairs = [(residual.view.size, getattr(residual, name)) for residual in residuals if residual.view.size]
    return math.sqrt(sum(size * rms**2 for size, rms in pairs) / sum(size for size, _ in pairs))
