"""State the figures of a recorded cloud beside those of a simulated sensor before the same targets: ``--simulated``.

Signal chain: targets of the recorded cloud -> simulated clouds of the same targets
(:mod:`mitsim.twin.compare.target_twin`) -> the figures of both, with F and sigma of the planes -> one table.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from characterisation.coupon.patch_table import overall
from characterisation.coupon_cloud import measure_coupon
from characterisation.features.robust_fit import FitError
from characterisation.files.errors import InputError
from characterisation.point_cloud import PointCloud
from characterisation.region_of_interest import Roi
from characterisation.tasks.result import Result, failed
from characterisation.words.numbers import aligned
from characterisation.words.progress import say
from mitsim.cli.acceptance_request import figure_or_reason
from mitsim.decoding.input_clouds import InputCloud
from mitsim.decoding.measured_document import number_with_decimals, uncertainty_text
from mitsim.sensor.fitted_to import shows_the_fit


@dataclass(frozen=True)
class RecordedTarget:
    """A target: its ``shape``, its ``window`` [px] of the recorded grid, and the true ``distance`` [mm] of a plane."""

    shape: str
    window: Roi | None
    distance: float | None = None


#: ratio to the other value below which a value is the rounding of sums, as the sigma of a patch in one step of a coarse
#: depth image is, 2e-13 mm [chosen: far above 1e-13, far below any ratio of two sensors]
_ROUNDING = 1e-9

#: figures of one target in a window of a cloud
Figures = Callable[[PointCloud, str, Roi | None], list[Result]]


def beside_simulated(
    input_cloud: InputCloud, targets: Mapping[str, RecordedTarget], sensor: str, figures: Figures, seed: int
) -> tuple[list[Result], list[Result]]:
    """Return the figures of every target in the recorded and in the simulated cloud, in the same order.

    Raises InputError if the sensor is not known, or does not see a target.
    """
    from mitsim.sensor.preset import load_sensor
    from mitsim.twin.compare.target_twin import seen_target, simulated_target

    recorded = input_cloud.cloud
    if recorded.grid.height == 1:
        raise InputError("--simulated", "", "a cloud without a grid", "a cloud with rows and columns")
    preset = load_sensor(sensor)
    preset.require("simulation")
    if input_cloud.capture is None and preset.fitted_to:
        names = ", ".join(fit.name for fit in preset.fitted_to[:3]) + ", ..." * (len(preset.fitted_to) > 3)
        doubt = f"{preset.name} was fitted to {names}: if {input_cloud.path} is of one of these, this shows the fit"
    else:
        images = input_cloud.capture.images if input_cloud.capture else {}
        doubt = shows_the_fit(preset.fitted_to, images, preset.name)
    if doubt:
        say(f"warning: {doubt}")
    real: list[Result] = []
    twin: list[Result] = []
    for name, target in targets.items():
        real += _with_coupon(recorded, name, target, target.window, figures)
        try:
            seen = seen_target(target.shape, target.window, recorded, name, target.distance)
            say(f"simulating {preset.name} before {name}")
            cloud, window = simulated_target(seen, recorded, preset, name, seed)
        except FitError as error:
            twin += [failed(result.name, result.unit, f"no twin: {error}") for result in real[len(twin) :]]
            continue
        twin += _with_coupon(cloud, name, target, window, figures)
    return real, twin


def _with_coupon(
    cloud: PointCloud, name: str, target: RecordedTarget, window: Roi | None, figures: Figures
) -> list[Result]:
    """Return F and sigma of a plane, before its other figures."""
    results = figures(cloud, name, window)
    if target.shape != "plane":
        return results
    region = None if window is None else (window.left, window.top, window.width, window.height)
    try:
        pooled = overall(measure_coupon(cloud, window=region))
    except InputError as error:
        return [failed(f"{name} F", "1", str(error)), failed(f"{name} sigma", "mm", str(error)), *results]
    few = "too few points in every disc"
    return [
        figure_or_reason(f"{name} F", "1", pooled.fraction, few, uncertainty=pooled.fraction_error),
        figure_or_reason(f"{name} sigma", "mm", pooled.sigma, few, uncertainty=pooled.sigma_error),
        *results,
    ]


def beside_table(recorded: Sequence[Result], simulated: Sequence[Result], sensor: str) -> str:
    """Return the table of both, with the ratio of simulated to recorded where both have a value other than 0."""
    rows = [["measurement", "recorded", "u", sensor, "u", "unit", "simulated / recorded"]]
    for result, other in zip(recorded, simulated, strict=True):
        both = result.possible and other.possible and abs(result.value) > _ROUNDING * abs(other.value)
        ratio = other.value / result.value if both else math.nan
        numbers = [
            text
            for one in (result, other)
            for text in (number_with_decimals(one.value, one.uncertainty), uncertainty_text(one.uncertainty))
        ]
        reason = result.reason or other.reason
        row = [result.name, *numbers, result.unit, f"{ratio:.3g}" if math.isfinite(ratio) else "-"]
        rows.append([*row, *([f"not possible: {reason}"] if reason else [])])
    return "\n".join(aligned(rows))
