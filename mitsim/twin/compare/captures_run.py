"""Validate a simulated capture against a real one (``mitsim compare``).

Signal chain: capture folder -> settings of the decoder -> plane of the specimen -> twin, unless a simulated capture is
given (:mod:`mitsim.twin.compare.rebuild`) -> rows with verdicts (:mod:`mitsim.twin.compare.compare_captures`) ->
``comparison.json``, and what the page shows of both (:mod:`mitsim.report.capture_page`). The twin is kept in
``simulated/``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
from numpy.typing import NDArray

from characterisation.files.atomic_io import write_json
from characterisation.files.errors import InputError
from characterisation.point_cloud import Status
from characterisation.region_of_interest import Roi
from characterisation.words.numbers import NONE, rounded, two_digits
from characterisation.words.progress import say
from mitsim.capture.capture import Capture
from mitsim.capture.folder import read_capture, write_capture
from mitsim.decoding.cloud import Settings, decoder_settings, imager_of_bits, settings_in_words
from mitsim.sensor.fitted_to import recorded_in, shows_the_fit
from mitsim.sensor.imager import Imager
from mitsim.sensor.pattern import RandomDots
from mitsim.sensor.sensor import Sensor
from mitsim.twin.compare.compare_captures import ComparedRow, Comparison, compare_captures
from mitsim.twin.compare.plain_image import plain_image
from mitsim.twin.compare.rebuild import check_technology, projector_was_on, rebuild
from mitsim.twin.compare.specimen_patches import PATCH_PX, SpecimenPatches, reference_levels
from mitsim.twin.finish.electrons import sensor_of
from mitsim.twin.finish.find_specimen import MARGIN_PX, find_specimen, image_mask
from mitsim.twin.finish.specimen import Specimen

#: border of the picture around the specimen [px]
_BORDER_PX = 24


@dataclass(frozen=True)
class Shown:
    """One capture of the comparison, as drawn.

    ``name`` and ``source`` of the capture; ``image`` (h, w) [DN] around the specimen; ``levels`` (n,) number of its
    pixels at each grey level; ``residual`` (h, w) [mm] along the rays, NaN without a value; ``shares`` of the statuses
    [1].
    """

    name: str
    source: str
    image: NDArray[np.unsignedinteger[Any]]
    levels: NDArray[np.float64]
    residual: NDArray[np.float64]
    shares: Mapping[Status, float]


@dataclass(frozen=True)
class CaptureValidation:
    """The ``comparison`` of two captures, ``table``, ``preamble``, both ``sides``; ``fitted`` says if one is fitted."""

    comparison: Comparison
    table: str
    preamble: str
    sides: tuple[Shown, Shown]
    fitted: str


def validate_captures(
    real: Path,
    simulated: Path | None,
    output: Path,
    sensor: str | None,
    roi: Roi | None,
    projector: str | None,
    seed: int,
) -> CaptureValidation:
    """Compare a simulated capture with a real one, and write the numbers and the twin to a folder.

    Raises InputError if a folder is not a capture, the sensor is unknown or of another kind, no plane is visible, or
    the captures do not show the same specimen.

    Parameters
    ----------
    real, simulated
        Folder of the real capture, or of one of a maker's virtual camera; folder of the simulated one, None rebuilds
        ``real`` with a sensor.
    output, seed
        Folder for ``comparison.json`` and the twin; seed of the twin's noise and of the bootstrap.
    sensor, projector
        Preset or sensor file of the twin, None is the preset that ``real`` names; ``on`` or ``off``, None is what the
        settings of ``real`` say.
    roi
        Region of the reference image [px] that shows only the specimen; None is the plane of most points.
    """
    recorded = read_capture(real)
    if simulated is None and rendered_here(recorded):
        allowed = "device, replay, or simulated by a maker's virtual camera"
        raise InputError(real, "source", "a simulation of mitsim", allowed, "name SIMULATED to compare two simulations")
    twin_sensor = None if simulated is not None else sensor_of(recorded, sensor, real)
    if twin_sensor is not None:
        check_technology(recorded, twin_sensor, str(real))  # before the capture is decoded
    given = None if simulated is None else read_capture(simulated)
    on = projector_was_on(recorded, cast(Literal["on", "off"] | None, projector), str(real))
    settings, imager, decoder = _decoder(recorded, given, twin_sensor, on)
    recorded = _with_imager(recorded, imager)
    specimen = find_specimen(recorded, settings, roi, str(real))
    say(f"specimen: a plane at {specimen.distance:.0f} mm, with {specimen.off_plane:.2g} mm rms deviation")
    if given is not None:
        other, where = given, str(simulated)
    else:
        assert twin_sensor is not None
        where = str(output / "simulated")
        other = rebuild(recorded, twin_sensor, specimen, str(real), projector_on=on, seed=seed)
        other = replace(other, decoding=other.decoding.model_copy(update={"decoder": settings}))
        write_capture(other, where, overwrite=True)
        say(f"rebuilt: {where}")
    comparison = compare_captures(
        recorded, _with_imager(other, imager), specimen, settings, where, projector_on=on, seed=seed
    )
    table = comparison_table(comparison.rows, _whose(recorded))
    fitted = shows_the_fit(recorded_in(other.settings, where), recorded.images, other.sensor)
    write_json(output / "comparison.json", comparison.numbers() | {"fitted": fitted})
    shown = _shown(_whose(recorded), recorded, specimen, comparison.real)
    sides = shown, _shown("simulated", other, specimen, comparison.simulated)
    preamble = _preamble(recorded, other, specimen, comparison, real, on, decoder)
    preamble += f"\n**{fitted}.**\n" if fitted else ""
    return CaptureValidation(comparison, table, preamble, sides, fitted)


def _decoder(
    recorded: Capture, given: Capture | None, twin_sensor: Sensor | None, on: bool
) -> tuple[Settings, Imager | None, str]:
    """Return the settings that decode both captures, their imager, and whose they are, in words.

    Those of the simulated sensor, within the depths that ``recorded`` states: its decoder is part of it. If that takes
    other images than ``recorded`` has, those of ``recorded``: a matcher of four shifted patterns has 40 times the noise
    of another on one of them, and one of dots 20 times on a print with the projector off.
    """
    stated = recorded.decoding
    device = None if stated.near_mm is None or stated.far_mm is None else (stated.near_mm, stated.far_mm)
    range_mm = stated.range_mm or device
    if given is not None:
        settings, imager = decoder_settings(given, None, range_mm)
        return settings, imager, settings_in_words(given, settings)
    assert twin_sensor is not None
    count, pattern = len(next(iter(recorded.images.values()))), twin_sensor.pattern
    why = "" if on else f"that of {twin_sensor.name} is for images with the projector on"
    if isinstance(pattern, RandomDots) and pattern.frames != count:
        why = f"that of {twin_sensor.name} is for {pattern.frames} images, and the recording has {count}"
    if why:
        settings, imager = decoder_settings(recorded)
        return settings, imager, f"that of the recording, {settings.near_mm:g} to {settings.far_mm:g} mm; {why}"
    settings, imager = decoder_settings(recorded, twin_sensor, range_mm)
    return settings, imager, settings_in_words(recorded, settings, twin_sensor.name)


def rendered_here(capture: Capture) -> bool:
    """Return whether mitsim simulated a capture, as opposed to a maker's virtual camera."""
    return capture.source == "simulated" and {"exposure_rule", "noise", "seed"} <= set(capture.settings)


def _with_imager(capture: Capture, imager: Imager | None) -> Capture:
    """Return a capture that states the imager by which both are judged, as ``mitsim decode`` would the first."""
    known = imager_of_bits(capture, imager)
    return replace(capture, decoding=capture.decoding.model_copy(update={"imager": known}))


def _whose(recorded: Capture) -> str:
    """Return the name of the given capture's side: real, or the simulation of a maker's virtual camera."""
    return "maker's simulation" if recorded.source == "simulated" else "real"


def comparison_table(rows: tuple[ComparedRow, ...], first: str = "real") -> str:
    """Return a Markdown table with a row for each quantity; ``first`` names the column of the given capture."""
    lines = [
        f"| quantity | unit | {first} | simulated | difference | u | margin | verdict |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for row in rows:
        decimals = _decimals(row)
        difference = rounded(row.difference, decimals)
        if row.difference > 0 and difference != NONE:
            difference = f"+{difference}"
        word = f"**{row.verdict}**" if row.verdict == "differs" else row.verdict
        lines.append(
            f"| {row.quantity} | {row.unit} | {rounded(row.real, decimals)} | {rounded(row.simulated, decimals)} "
            f"| {difference} | {two_digits(row.uncertainty)} | {two_digits(row.margin)} | {word}: {row.why} |"
        )
    return "\n".join(lines) + "\n"


def _decimals(row: ComparedRow) -> int:
    """Return the number of decimals that shows two digits of the uncertainty, 1 to 4."""
    if not row.uncertainty > 0:
        return 3
    return int(np.clip(1 - np.floor(np.log10(row.uncertainty)), 1, 4))


def _preamble(
    real: Capture, simulated: Capture, specimen: Specimen, comparison: Comparison, where: Path, on: bool, decoder: str
) -> str:
    rebuilt = simulated.settings.get("rebuilt", {})
    power = rebuilt.get("power_times_reflectance_w")
    serial = f" (serial {real.serial})" if real.serial else ""
    words = [
        f"{_whose(real).capitalize()}: `{where}`, {real.sensor}{serial}, source {real.source}. Simulated: "
        f"{simulated.sensor}, source {simulated.source}. Projector {'on' if on else 'off'}. "
        f"Decoder of both: {decoder}.",
        f"Specimen: a plane at {specimen.distance:.0f} mm; the cloud deviates by {rounded(specimen.off_plane, 2)} mm "
        f"rms. Patches of {PATCH_PX} px: {comparison.image_patches} of the image, {comparison.cloud_patches} of the "
        f"cloud; a margin of {MARGIN_PX:g} px inside the specimen's outline is excluded. Contrast in windows of "
        f"{comparison.window_px} px. Grey levels are those of {plain_image(real).name}.",
    ]
    if power is not None:
        words.append(f"Power times reflectance, fitted to the median grey level: {power:.3g} W.")
    if not rebuilt:
        words.append("The simulated capture was given by the user.")
    return "\n\n".join(words) + "\n"


def _shown(name: str, capture: Capture, specimen: Specimen, patches: SpecimenPatches) -> Shown:
    mask = image_mask(specimen, capture.rig.reference)
    ends = (np.flatnonzero(mask.any(axis=axis))[[0, -1]].tolist() for axis in (1, 0))
    cut = tuple(slice(max(first - _BORDER_PX, 0), last + _BORDER_PX) for first, last in ends)
    roi = Roi.around(patches.on_grid) or Roi(0, 0, 1, 1)
    totals = patches.status.sum(axis=0)
    shares = {status: float(totals[status] / totals.sum()) for status in Status if totals[status] > 0}
    return Shown(
        f"{name}: {capture.sensor}",
        capture.source,
        reference_levels(capture)[cut],
        np.asarray(patches.levels.sum(axis=0)),
        patches.residual[roi.slices],
        shares,
    )
