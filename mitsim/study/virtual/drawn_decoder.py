"""Draw a decoder that a maker may have built, within the ranges of ``[unknowns.decoder]``.

Signal chain: settings of the sensor file, seed of a day -> method, windows, penalties, limits and filters -> settings
that decode the captures of that day. All settings of a day are drawn, whether the drawn method uses them or not: then
two days that differ in one choice share all others.

:func:`decoder_numbers` states the drawn settings as numbers for a regression.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from characterisation.files.errors import InputError
from mitsim.capture.decoding import Settings
from mitsim.sensor.decoder_settings import DecoderSettings
from mitsim.sensor.matcher import SGBM_LARGEST_COST, MatcherSettings, sgbm_cost
from mitsim.sensor.sensor import Sensor
from mitsim.sensor.unknowns import DecoderUnknowns

Choice = TypeVar("Choice")


def decoder_is_drawn(sensor: Sensor, unknowns: DecoderUnknowns) -> bool:
    """Return whether any setting of a sensor's decoder is drawn."""
    return not unknowns.known and bool(sensor.settings.level_key)


def drawn_decoder(sensor: Sensor, unknowns: DecoderUnknowns, seed: int) -> Settings:
    """Return the settings of the decoder of a seed; those of the sensor file for the seed 0.

    One camera and its reference, and several frames, keep to the methods that can decode them.
    """
    settings = sensor.settings
    if seed == 0 or not decoder_is_drawn(sensor, unknowns):
        return settings
    draw = _Draw(np.random.default_rng(np.random.SeedSequence([seed, _STREAM])))
    factor = draw.log_between(unknowns.thresholds)
    level = getattr(settings, settings.level_key) * factor
    if isinstance(settings, DecoderSettings):
        smoothing = draw.one_of(unknowns.smoothings_px, settings.smoothing_px)
        return settings.model_copy(update={settings.level_key: level, "smoothing_px": smoothing})
    if not isinstance(settings, MatcherSettings):
        return settings.model_copy(update={settings.level_key: level})
    return MatcherSettings.model_validate(
        settings.model_dump() | _matcher(sensor, settings, unknowns, draw, factor) | {settings.level_key: level}
    )


def check_decoder(sensor: Sensor, unknowns: DecoderUnknowns, where: str | Path) -> None:
    """Check that the costs of OpenCV's SGBM hold every decoder that can be drawn; InputError at ``where``."""
    settings = sensor.settings
    if not isinstance(settings, MatcherSettings) or not decoder_is_drawn(sensor, unknowns):
        return
    block = max(unknowns.blocks_px, default=settings.block_size)
    cap = max(unknowns.prefilter_caps, default=settings.prefilter_cap)
    p2 = unknowns.p1[1] * unknowns.p2_over_p1[1]
    if "sgbm" in _methods(sensor, settings, unknowns) and sgbm_cost(block, p2, cap) > SGBM_LARGEST_COST:
        raise InputError(
            where,
            "unknowns.decoder: blocks_px, p1, p2_over_p1, prefilter_caps",
            f"a block of {block} px with p2 of {p2:g} and a cap of {cap}, as they can be drawn together",
            f"block^2 (p2 + cap / 2) of at most {SGBM_LARGEST_COST} for method sgbm, whose costs have 16 bits",
            "leave out large blocks, or lower the upper ends of p1 and p2_over_p1",
        )


#: part of the seeds of this module's random numbers
_STREAM = 9


class _Draw:
    """Random choices, of which each takes one random number."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng

    def one_of(self, choices: Sequence[Choice], otherwise: Choice) -> Choice:
        """Return one of the choices; ``otherwise`` if there are none."""
        number = float(self._rng.random())
        return choices[int(number * len(choices))] if choices else otherwise

    def between(self, ends: tuple[float, float]) -> float:
        """Return a number from a range, uniform."""
        return ends[0] + float(self._rng.random()) * (ends[1] - ends[0])

    def log_between(self, ends: tuple[float, float]) -> float:
        """Return a number from a range over 0, whose logarithm is uniform."""
        number = math.exp(self.between((math.log(ends[0]), math.log(ends[1]))))
        return min(max(number, ends[0]), ends[1])


def _methods(sensor: Sensor, settings: MatcherSettings, unknowns: DecoderUnknowns) -> list[str]:
    """Return the methods that are drawn, those that can decode the sensor's images."""
    pair = sensor.technology == "active_stereo"
    able = [name for name in unknowns.methods if pair and (name != "sgbm" or sensor.frames == 1)]
    return [*able] or [settings.method]


def _matcher(
    sensor: Sensor, settings: MatcherSettings, unknowns: DecoderUnknowns, draw: _Draw, factor: float
) -> dict[str, Any]:
    """Return the drawn settings of a matcher, without its least contrast."""
    method = draw.one_of(_methods(sensor, settings, unknowns), settings.method)
    # the sensor's own block suits the density of its pattern, if its method is correlation; 5 px suits the others
    own_block = settings.block_size if settings.method == "correlation" else 5
    least, most = (own_block * factor_of_block for factor_of_block in unknowns.block_factor)
    blocks = {
        "sgbm": draw.one_of(unknowns.blocks_px, settings.block_size),
        "census": draw.one_of(unknowns.sums_px, 1),
        "correlation": draw.one_of([size for size in range(3, 33, 2) if least <= size <= most], own_block),
    }
    p1, ratio = draw.log_between(unknowns.p1), draw.log_between(unknowns.p2_over_p1)
    uniqueness = round(draw.between(unknowns.uniqueness_percent))
    if method == "correlation":  # it compares other numbers than costs
        default = settings.uniqueness_percent if settings.method == "correlation" else 15
        uniqueness = min(round(default * factor), 100)
    foreign = {"sgbm": ("parabola", "equiangular"), "census": ("method", "opencv"), "correlation": ("opencv",)}[method]
    sub_pixel = draw.one_of([fit for fit in unknowns.sub_pixel if fit not in foreign], "method")
    return {
        "method": method,
        "block_size": max(blocks[method], 3 if method != "census" else 1),
        "census_window_px": draw.one_of(unknowns.census_windows_px, settings.census_window_px),
        "p1": p1,
        "p2": min(p1 * ratio, unknowns.p1[1] * unknowns.p2_over_p1[1]),
        "uniqueness_percent": uniqueness,
        "left_right_px": draw.between(unknowns.left_right_px),
        "contrast_window_px": draw.one_of(unknowns.contrast_windows_px, settings.contrast_window_px),
        "prefilter_cap": draw.one_of(unknowns.prefilter_caps, settings.prefilter_cap),
        "mode": draw.one_of(unknowns.modes, settings.mode),
        "sub_pixel": sub_pixel,
        "median_px": draw.one_of(unknowns.medians_px, settings.median_px),
        "speckle_px": draw.one_of(unknowns.speckles_px, settings.speckle_px),
        "disparity_step": draw.one_of(unknowns.disparity_steps_px, settings.disparity_step),
    }


def decoder_numbers(settings: Settings) -> dict[str, float]:
    """Return what :func:`drawn_decoder` draws by fixed names: choices 0 or 1; sizes, penalties, levels as logs."""
    level = math.log(max(getattr(settings, settings.level_key), 1e-9)) if settings.level_key else 0.0
    if isinstance(settings, DecoderSettings):
        return {"level": level, "smoothing": settings.smoothing_px}
    if not isinstance(settings, MatcherSettings):
        return {"level": level}
    return {
        "level": level,
        "census": float(settings.method == "census"),
        "correlation": float(settings.method == "correlation"),
        "support": math.log(settings.support_px),
        "p1": math.log(max(settings.p1, 1e-9)),
        "p2_over_p1": math.log(max(settings.p2, 1e-9) / max(settings.p1, 1e-9)),
        "uniqueness": float(settings.uniqueness_percent),
        "left_right": settings.left_right_px,
        "contrast": float(settings.method == "sgbm" and settings.contrast_window_px > 0),
        "cap": float(settings.prefilter_cap),
        "one_pass": float(settings.method != "correlation" and settings.mode != "hh"),
        "three_paths": float(settings.method != "correlation" and settings.mode == "3way"),
        "equiangular": float(settings.sub_pixel == "equiangular"),
        "parabola": float(settings.method == "correlation" and settings.sub_pixel == "parabola"),
        "opencv": float(settings.sub_pixel == "opencv"),
        "median": float(settings.median_px),
        "speckle": float(settings.speckle_px > 0),
        "step": settings.disparity_step,
    }
