"""Requests of the command line to measure without a task: windows, plates, a difference.

Signal chain: texts of the options -> windows and plates, checked -> results and a picture of each cloud.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from characterisation.acceptance.cloud_difference import (
    Difference,
    difference_along_rays,
    difference_to_surface,
    distribution,
    same_grid,
)
from characterisation.documents import checked_name
from characterisation.errors import InputError
from mitsim.measuring.clouds import GivenCloud
from mitsim.measuring.plate import Plate, image_on_grid, measure_plate
from mitsim.measuring.result import Result, failed
from mitsim.measuring.windows import Between, Shape, WindowPlan, measure_windows, window_slices
from mitsim.report.measured_figures import difference_figure, distance_figure
from mitsim.sensor.roi import Roi

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: ways to take a difference
WAYS = ("auto", "rays", "surface")

_WINDOW, _PLATE = (
    "NAME=COLUMN,ROW,WIDTH,HEIGHT [px], or NAME alone",
    "NAME=COLUMN,ROW,WIDTH,HEIGHT,PITCH, or NAME=PITCH [mm]",
)


@dataclass(frozen=True)
class Asked:
    """Features in windows, ``plates`` by name, and the difference from a reference ``by`` a way, in a ``window``."""

    plan: WindowPlan
    plates: Mapping[str, Plate]
    by: str
    window: Roi | None
    differs: bool

    @property
    def empty(self) -> bool:
        """Whether nothing is asked for."""
        return not (self.plan.features or self.plates or self.differs)

    def measured(self, given: GivenCloud, reference: GivenCloud | None) -> tuple[list[Result], Callable[[], Figure]]:
        """Results of a cloud, and what draws its picture.

        Raises
        ------
        InputError
            If a window lies outside of the cloud, or dots are asked of a cloud without images.
        """
        cloud = given.cloud
        results = measure_windows(cloud, self.plan)
        if self.plates:
            if given.capture is None or not given.capture.images:
                raise InputError(
                    given.path,
                    "",
                    "a cloud without images",
                    "a capture folder, whose images show the dots",
                    "mitsim measure CAPTURE --dots ... decodes it",
                )
            image = image_on_grid(given.capture, cloud.grid)
            for name, plate in self.plates.items():
                results += measure_plate(name, plate, cloud, image)
        boxes = self._boxes()
        if reference is None:
            return results, lambda: distance_figure(cloud, boxes)
        values = self._difference(given, reference)
        found = distribution(values, int(cloud.valid[window_slices(self.window, cloud, "difference")].sum()))
        return results + _of_difference(found), lambda: difference_figure(values, found, boxes, self.window)

    def _difference(self, given: GivenCloud, reference: GivenCloud) -> NDArray[np.float64]:
        cloud, other = given.cloud, reference.cloud
        rays = self.by == "rays" or (self.by == "auto" and same_grid(cloud.grid, other.grid))
        values = difference_along_rays(cloud, other) if rays else difference_to_surface(cloud, other)
        out = np.full(values.shape, np.nan)
        inside = window_slices(self.window, cloud, "difference")
        out[inside] = values[inside]
        return out

    def _boxes(self) -> dict[str, Roi]:
        windows = {name: window for name, (_, window) in self.plan.features.items()}
        windows |= {name: plate.window for name, plate in self.plates.items()}
        return {name: one for name, one in windows.items() if one is not None}


def read_asked(
    features: Mapping[str, Sequence[str]],
    between: Mapping[str, Sequence[str]],
    plates: Sequence[str],
    bright: bool,
    against: Path | None,
    by: str,
    window: tuple[int, int, int, int] | None,
) -> Asked:
    """Read the texts of options: ``features`` by shape, ``between`` by angle or distance, ``plates``.

    Raises
    ------
    InputError
        If one does not make sense; the option and what is allowed are named.
    """
    named: dict[str, tuple[Shape, Roi | None]] = {}
    for shape, texts in features.items():
        for text in texts:
            name, numbers = named_numbers(f"--{shape}", text, (0, 4), _WINDOW)
            named_once(f"--{shape}", name, named)
            named[name] = cast(Shape, shape), window_of(f"--{shape}", text, numbers, _WINDOW)
    pairs: list[tuple[Between, str, str]] = []
    for kind, texts in between.items():
        for text in texts:
            names = [one.strip() for one in text.split(",")]
            if len(names) != 2 or not all(names):
                raise InputError(f"--{kind}", "", repr(text), "NAME,NAME of two features")
            pairs.append((cast(Between, kind), names[0], names[1]))
    known: dict[str, Plate] = {}
    for text in plates:
        name, numbers = named_numbers("--dots", text, (1, 5), _PLATE)
        named_once("--dots", name, {**named, **known})
        if not 0 < numbers[-1] < 1e4:
            raise InputError("--dots", "", repr(text), f"{_PLATE}, the pitch over 0")
        known[name] = Plate(window_of("--dots", text, numbers[:-1], _PLATE), numbers[-1], not bright)
    if by not in WAYS:
        raise InputError("--by", "", repr(by), ", ".join(WAYS))
    if against is None and (by != "auto" or window is not None):
        raise InputError("--by" if window is None else "--window", "", "no --against", "--against CLOUD")
    numbers = [] if window is None else list(map(float, window))
    region = window_of("--window", str(window), numbers, "COLUMN ROW WIDTH HEIGHT")
    plan = WindowPlan(named, pairs)
    plan.check()
    return Asked(plan, known, by, region, against is not None)


def _of_difference(found: Difference) -> list[Result]:
    """Results of a difference; without uncertainties, for its points are not independent."""
    result = partial(Result, unit="mm", points=found.count, points_given=found.asked)
    values = {
        "mean": found.mean,
        "median": found.median,
        "standard deviation": found.deviation,
        "robust deviation": found.robust_deviation,
        "2.5 %": found.low,
        "97.5 %": found.high,
    }
    if found.count < 2:
        reason = f"{found.count} of {found.asked} points have a counterpart"
        return [failed(f"difference {what}", "mm", reason, found.count, found.asked) for what in values]
    return [result(f"difference {what}", value=value) for what, value in values.items()]


def named_numbers(option: str, text: str, counts: tuple[int, ...], allowed: str) -> tuple[str, list[float]]:
    """Return name and numbers of ``name=1,2,3``; ``counts`` are the allowed numbers of numbers.

    Raises
    ------
    InputError
        Naming the option, and what is allowed.
    """
    name, _, rest = text.partition("=")
    try:
        numbers = [float(one) for one in rest.split(",")] if rest.strip() else []
    except ValueError:
        numbers = [float("nan")]
    if not name.strip() or len(numbers) not in counts or not np.isfinite(numbers).all():
        raise InputError(option, "", repr(text), allowed)
    try:
        return checked_name(name.strip()), numbers
    except ValueError as error:
        raise InputError(option, "", repr(name.strip()), str(error)) from None


def window_of(option: str, text: str, numbers: Sequence[float], allowed: str) -> Roi | None:
    """Return the window of four numbers, None of no numbers: the whole grid.

    Raises
    ------
    InputError
        If they are no window.
    """
    if not numbers:
        return None
    column, row, width, height = (int(one) for one in numbers)
    if min(column, row) < 0 or min(width, height) < 1 or any(one != int(one) for one in numbers):
        raise InputError(option, "", repr(text), f"{allowed}: whole pixels, width and height over 0")
    return Roi(column, row, width, height)


def named_once(option: str, name: str, known: Mapping[str, object]) -> None:
    """Check that a name is not among those ``known``.

    Raises
    ------
    InputError
        If it is.
    """
    if name in known:
        raise InputError(option, "", f"{name!r} a second time", "a name of its own for each feature")
