"""Read the measurements that the command line requests without a task: windows, plates, a difference.

Signal chain: texts of the options -> windows and plates, checked -> results and a picture of each cloud.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from characterisation.acceptance import cloud_difference
from characterisation.acceptance.cloud_difference import Difference
from characterisation.files.documents import checked_name
from characterisation.files.errors import InputError
from characterisation.region_of_interest import Roi
from characterisation.tasks.result import Result, failed
from characterisation.tasks.windows import PairKind, Shape, WindowPlan, measure_windows, window_slices
from characterisation.words.progress import track_if_long
from mitsim.decoding.input_clouds import InputCloud
from mitsim.decoding.plate import Plate, image_on_grid, measure_plate

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: directions of a difference: along the view rays, or along the surface normal; ``auto`` depends on the grids
DIRECTIONS = ("auto", "rays", "surface")

_WINDOW_SYNTAX = "NAME=COLUMN,ROW,WIDTH,HEIGHT [px], or NAME alone"
_PLATE_SYNTAX = "NAME=COLUMN,ROW,WIDTH,HEIGHT,PITCH, or NAME=PITCH [mm]"


@dataclass(frozen=True)
class Request:
    """Measurements that the options request.

    - ``plan``: features in windows, and angles and distances between them.
    - ``plates`` of dots by name.
    - ``by``: direction of a difference, one of :data:`DIRECTIONS`.
    - ``window`` of the difference [px], None for the whole grid.
    - ``has_reference``: whether there is a reference cloud for a difference.
    """

    plan: WindowPlan
    plates: Mapping[str, Plate]
    by: str
    window: Roi | None
    has_reference: bool

    @property
    def empty(self) -> bool:
        """Whether no measurement is requested."""
        return not (self.plan.features or self.plates or self.has_reference)

    def measure(
        self, input_cloud: InputCloud, reference: InputCloud | None, frame: NDArray[np.float64] | None = None
    ) -> tuple[list[Result], Callable[[], Figure]]:
        """Return the results of a cloud, and a function that draws its picture.

        ``frame`` (4, 4), from the sensor frame, is that of positions and directions. Raises InputError if a window does
        not lie in the cloud's grid, or dots are requested of a cloud without images.
        """
        cloud = input_cloud.cloud
        results = measure_windows(cloud, self.plan, frame)
        if self.plates:
            if input_cloud.capture is None or not input_cloud.capture.images:
                allowed = "a capture folder, whose images show the dots"
                hint = "give the capture folder, which the command decodes: mitsim measure CAPTURE --dots ..."
                raise InputError(input_cloud.path, "", "a cloud without images", allowed, hint)
            image = image_on_grid(input_cloud.capture, cloud.grid)
            for name, plate in self.plates.items():
                results += measure_plate(name, plate, cloud, image)
        boxes = self._boxes()
        if reference is None:
            return results, lambda: _figures().distance_figure(cloud, boxes)
        values = self._difference(input_cloud, reference)
        given = int(cloud.valid[window_slices(self.window, cloud, "difference")].sum())
        difference = cloud_difference.distribution(values, given)
        shown = values, difference, boxes, self.window
        return results + _difference_results(difference), lambda: _figures().difference_figure(*shown)

    def _difference(self, input_cloud: InputCloud, reference: InputCloud) -> NDArray[np.float64]:
        """Return the difference (H, W) [mm] of a cloud from the reference, NaN outside the window."""
        cloud, other = input_cloud.cloud, reference.cloud
        inside = window_slices(self.window, cloud, "difference")
        out = np.full(cloud.status.shape, np.nan)
        if self.by == "rays" or (self.by == "auto" and cloud.grid.same_rays(other.grid)):
            out[inside] = cloud_difference.difference_along_rays(cloud, other, inside)
        else:
            progress = partial(track_if_long, label="difference, blocks of points")
            out[inside] = cloud_difference.difference_to_surface(cloud, other, inside, progress)
        return out

    def _boxes(self) -> dict[str, Roi]:
        windows = {name: window for name, (_, window) in self.plan.features.items()}
        windows |= {name: plate.window for name, plate in self.plates.items()}
        return {name: roi for name, roi in windows.items() if roi is not None}


def _figures() -> ModuleType:
    """Return the module that draws; Matplotlib takes longer to import than a window to measure."""
    from mitsim.report import measured_figures

    return measured_figures


def read_request(
    features: Mapping[str, Sequence[str]],
    between: Mapping[str, Sequence[str]],
    plates: Sequence[str],
    bright: bool,
    against: Path | None,
    by: str,
    window: tuple[int, int, int, int] | None,
) -> Request:
    """Read the texts of options into a request; raise InputError with the option and the allowed form.

    ``features`` are texts by shape, ``between`` by kind of measurement. ``bright``: whether dots are brighter than the
    plate. ``against``, ``by`` and ``window`` [px] are of a difference: its reference cloud, direction and window.
    """
    named: dict[str, tuple[Shape, Roi | None]] = {}
    for shape, texts in features.items():
        for text in texts:
            name, region, _ = parse_window(f"--{shape}", text, (0, 4), _WINDOW_SYNTAX, named)
            named[name] = cast(Shape, shape), region
    pairs: list[tuple[PairKind, str, str]] = []
    for kind, texts in between.items():
        for text in texts:
            names = [word.strip() for word in text.split(",")]
            if len(names) != 2 or not all(names):
                raise InputError(f"--{kind}", "", repr(text), "NAME,NAME of two features")
            pairs.append((cast(PairKind, kind), names[0], names[1]))
    named_plates: dict[str, Plate] = {}
    for text in plates:
        name, region, pitch = parse_window("--dots", text, (1, 5), _PLATE_SYNTAX, {**named, **named_plates})
        if pitch is None or not 0 < pitch < 1e4:
            raise InputError("--dots", "", repr(text), f"{_PLATE_SYNTAX}, the pitch over 0 and under 10000")
        named_plates[name] = Plate(region, pitch, not bright)
    if by not in DIRECTIONS:
        raise InputError("--by", "", repr(by), ", ".join(DIRECTIONS))
    if against is None and (by != "auto" or window is not None):
        raise InputError("--by" if window is None else "--window", "", "no --against", "--against CLOUD")
    region = _window("--window", str(window), window or (), "COLUMN ROW WIDTH HEIGHT")
    plan = WindowPlan(named, pairs)
    plan.check()
    return Request(plan, named_plates, by, region, against is not None)


def _difference_results(difference: Difference) -> list[Result]:
    """Return the results of a difference, without uncertainties, because its points are not independent."""
    counts = difference.count, difference.points_given
    values = {
        "mean": difference.mean,
        "median": difference.median,
        "standard deviation": difference.deviation,
        "robust deviation": difference.robust_deviation,
        "2.5 %": difference.low,
        "97.5 %": difference.high,
    }
    if difference.count < 2:
        reason = f"only {difference.count} of {difference.points_given} points have a counterpart in the reference"
        return [failed(f"difference {name}", "mm", reason, *counts) for name in values]
    return [Result(f"difference {name}", "mm", value, math.nan, "none", *counts) for name, value in values.items()]


def parse_window(
    option: str, text: str, counts: tuple[int, ...], allowed: str, used_names: Mapping[str, object]
) -> tuple[str, Roi | None, float | None]:
    """Return name, window and length of a text such as ``name=200,150,300,200,600``.

    ``counts`` are the allowed numbers of numbers: four are the window [px], one more or one alone is the length. The
    window is None for the whole grid, the length None without one. ``allowed`` is the form for the error. Raises
    InputError if the text has another form, the name is in use, or the window is not one.
    """
    name, _, numbers_text = text.partition("=")
    try:
        numbers = [float(word) for word in numbers_text.split(",")] if numbers_text.strip() else []
    except ValueError:
        numbers = [float("nan")]
    if not name.strip() or "," in name or len(numbers) not in counts or not np.isfinite(numbers).all():
        raise InputError(option, "", repr(text), allowed)
    try:
        name = checked_name(name.strip())
    except ValueError as error:
        raise InputError(option, "", repr(name.strip()), str(error)) from None
    if name in used_names:
        raise InputError(option, "", f"{name!r} a second time", "a different name for each feature")
    length = numbers.pop() if len(numbers) in (1, 5) else None
    return name, _window(option, text, numbers, allowed), length


def _window(option: str, text: str, numbers: Sequence[float], allowed: str) -> Roi | None:
    """Return the window of four numbers [px]; no numbers give None, the whole grid."""
    if not numbers:
        return None
    column, row, width, height = (int(number) for number in numbers)
    if min(column, row) < 0 or min(width, height) < 1 or any(number != int(number) for number in numbers):
        raise InputError(option, "", repr(text), f"{allowed}: whole pixels, width and height over 0")
    return Roi(column, row, width, height)
