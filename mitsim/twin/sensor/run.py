"""Run ``mitsim fit sensor``: from captures of a flat object and a sensor file to the file of one unit in its room.

Signal chain: captures, sorted (:mod:`mitsim.twin.sensor.input_captures`) -> repeats and dark captures: photon transfer
(:mod:`mitsim.twin.sensor.photon_transfer`) -> projector off: light of the room (:mod:`mitsim.twin.sensor.room`) ->
dots: the remaining parameters (:mod:`mitsim.twin.sensor.dots`) -> row errors (:mod:`mitsim.twin.sensor.rows`) ->
several captures combined (:mod:`mitsim.twin.sensor.estimate`) -> the sensor file (:mod:`mitsim.twin.sensor.write`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from importlib.resources import files
from pathlib import Path
from typing import Any

from characterisation.files.errors import InputError
from characterisation.region_of_interest import Roi
from characterisation.words.progress import say
from mitsim.decoding.cloud import decoder_settings
from mitsim.sensor.fitted_to import FittedCapture, images_digest
from mitsim.sensor.light_code import LightCode
from mitsim.sensor.pattern import DotPattern
from mitsim.sensor.preset import load_sensor
from mitsim.sensor.sensor import Sensor
from mitsim.twin.compare.rebuild import like
from mitsim.twin.finish.find_specimen import find_specimen
from mitsim.twin.finish.specimen import Specimen
from mitsim.twin.sensor.dots import NOISE_KEYS, DotDraws, DotsFit, fit_dots
from mitsim.twin.sensor.estimate import FittedKey, Undetermined, pooled
from mitsim.twin.sensor.input_captures import InputCapture, read_input_captures, repeats
from mitsim.twin.sensor.noise import ImagerFit, fit_imager, unseparated, without_fixed_pattern
from mitsim.twin.sensor.parameters import (
    BLACK_LEVEL,
    CORNER_BLUR,
    FLUX,
    FULL_WELL,
    PROJECTOR_CORNER,
    READ_NOISE,
    ROOM_LEVEL,
    SMOOTHING,
    Parameter,
    pattern_parameters,
)
from mitsim.twin.sensor.room import RoomFit, fit_room
from mitsim.twin.sensor.rows import row_turns
from mitsim.twin.sensor.stripes import fit_stripes, focused
from mitsim.twin.sensor.verdict import DotAgreement, Verdict, verdict_of


@dataclass(frozen=True)
class SensorFit:
    """``estimates`` of a fit, numbers left ``undetermined``, and ``agreements`` of each capture with the simulation."""

    sensor: Sensor = field(repr=False)
    input_captures: tuple[InputCapture, ...] = field(repr=False)
    estimates: tuple[FittedKey, ...]
    undetermined: tuple[Undetermined, ...]
    agreements: tuple[DotAgreement, ...] = ()

    @property
    def fitted_to(self) -> tuple[FittedCapture, ...]:
        """Return the captures of this fit and of the one that it starts from, each once."""
        captures = [
            FittedCapture(name=source.name, images_sha256=images_digest(source.capture.images))
            for source in self.input_captures
        ]
        return tuple({capture.images_sha256: capture for capture in (*self.sensor.fitted_to, *captures)}.values())

    @property
    def count_in_words(self) -> str:
        """Return how many numbers the captures determine, and how many they do not, as the table says of each."""
        fitted = sum(estimate.determined for estimate in self.estimates)
        others = len(self.estimates) - fitted + len(self.undetermined)
        return f"{fitted} fitted parameters, {others} not determined"

    @property
    def verdict(self) -> Verdict:
        """Return whether the fitted file reproduces the captures."""
        return verdict_of(self.agreements)


def fit_sensor(
    captures: Sequence[Path],
    sensor: str | Path,
    *,
    off: Sequence[Path] = (),
    dark: Sequence[Path] = (),
    roi: Roi | None = None,
    seed: int = 1,
    draws: int = 3,
) -> SensorFit:
    """Fit a sensor file to captures of a flat object.

    Raises InputError if captures and sensor do not belong together, or too little is visible.

    Parameters
    ----------
    captures, off, dark
        Folders, whose settings state whether the projector was on; with the projector off; with all light off.
    sensor
        Preset or file that starts the fit.
    roi
        Region of the first camera's image that shows the specimen, in all of them; all that is flat if left out.
    seed, draws
        Selects the noise of the simulations, and their number.
    """
    chosen = load_sensor(sensor)
    input_captures = read_input_captures(captures, off, dark, chosen)
    groups = repeats(input_captures)
    first = groups[0][0]
    base = _check_exposure(like(first.capture, chosen, first.name), first)
    told = ", ".join(f"{g[0].name} {g[0].kind}" + (f" x {len(g)}" if len(g) > 1 else "") for g in groups)
    say(f"captures: {len(input_captures)}: {told}")
    lit = [group[0] for group in groups if group[0].kind != "dark"]
    off_captures, on_captures = ([source for source in lit if source.kind == kind] for kind in ("off", "on"))
    specimens = _specimens(on_captures, off_captures, roi)
    imager = fit_imager(groups, base, specimens)
    estimates = list(imager.estimates)
    base = replace(base, imager=imager.imager)
    room = fit_room(off_captures, base, specimens) if off_captures and on_captures else None
    dots = _dots(on_captures, base, specimens, imager, room, DotDraws(draws, seed))
    shared, undetermined = _combined_estimates(dots, base, imager, room)
    by_dots = {estimate.key for estimate in shared}
    estimates += [estimate for estimate in room.estimates if estimate.key not in by_dots] if room is not None else []
    estimates += shared
    if isinstance(base.pattern, LightCode):
        coded: list[FittedKey] = []
        for source in on_captures:
            capture_sensor = replace(like(source.capture, base, source.name), imager=base.imager)
            coded += fit_stripes(source, capture_sensor, specimens[source.name])
        keys = {estimate.key for estimate in estimates}  # repeats and the dark before a single image
        estimates += [estimate for estimate in pooled(focused(coded)) if estimate.key not in keys]
    if not imager.repeated and any(estimate.key in NOISE_KEYS for estimate in estimates):
        undetermined += unseparated(chosen.imager)
    turned, assumed, method = list[FittedKey](), chosen.unknowns.calibration, "row errors over the field"
    for source in lit:
        settings, _ = decoder_settings(source.capture)
        turns = row_turns(source.capture, settings, specimens[source.name], (assumed.row_mrad, assumed.roll_mrad))
        for key, pair in turns.items():
            turned.append(FittedKey(f"misalignment.{key}", *pair, "mrad", (source.name,), method))
    estimates += pooled(turned)
    agreements = tuple(
        DotAgreement(name, fit.moment_fit.chi_square, fit.moment_fit.freedom, fit.misfit, fit.worst)
        for name, fit in dots.items()
    )
    return SensorFit(base, tuple(input_captures), tuple(estimates), tuple(undetermined), agreements)


def sensor_path(name: str | Path) -> Path:
    """Return the file of a preset, or the path of a file."""
    if Path(name).suffix.lower() == ".toml":
        return Path(name)
    return Path(str(files("mitsim.sensor") / "presets" / f"{name}.toml"))


def _check_exposure(sensor: Sensor, source: InputCapture) -> Sensor:
    if sensor.exposure.base_s is None:
        found, path = repr(source.capture.decoding.exposure_s), source.folder / "settings.json"
        allowed = "the exposure [s], since the sensor file has automatic exposure"
        raise InputError(path, "exposure_s", found, allowed)
    return sensor


def _specimen(source: InputCapture, roi: Roi | None) -> Specimen:
    settings, _ = decoder_settings(source.capture)
    specimen = find_specimen(source.capture, settings, roi, source.name)
    bend = "flat" if specimen.bend is None else f"bent by {specimen.bend.rms:.2g} mm rms"
    say(f"{source.name}: a sheet at {specimen.distance:.0f} mm, {bend}")
    return specimen


def _specimens(on: list[InputCapture], off: list[InputCapture], roi: Roi | None) -> dict[str, Specimen]:
    """Return the specimen of each lit capture; that of the first with the projector on for one without a plane.

    Without the projector's dots, a plain sheet has no points.
    """
    specimens = {source.name: _specimen(source, roi) for source in on}
    for source in off:
        try:
            specimens[source.name] = _specimen(source, roi)
        except InputError:
            if not on or source.image.shape != on[0].image.shape:
                raise
            specimens[source.name] = specimens[on[0].name]
            say(f"{source.name}: no plane without the projector; its sheet is taken to be where {on[0].name} shows it")
    return specimens


def _dots(
    input_captures: list[InputCapture],
    base: Sensor,
    specimens: dict[str, Specimen],
    imager: ImagerFit,
    room: RoomFit | None,
    draws: DotDraws,
) -> dict[str, DotsFit]:
    if not isinstance(base.pattern, DotPattern):
        return {}
    parameters = _held_noise(imager, base) if imager.known else [FULL_WELL, READ_NOISE, SMOOTHING]
    parameters += [FLUX, *pattern_parameters(base), PROJECTOR_CORNER, CORNER_BLUR]
    if room is not None:
        parameters.append(BLACK_LEVEL)
        if room.terms[0] > 0:
            parameters.append(ROOM_LEVEL.held_within(room.estimates[0].uncertainty / room.terms[0]))
    out = {}
    for source in input_captures:
        sensor = replace(like(source.capture, base, source.name), imager=base.imager, room=base.room)
        if not imager.known:
            sensor = replace(sensor, imager=without_fixed_pattern(sensor.imager))
        specimen, terms = specimens[source.name], None if room is None else room.terms
        sensor = _check_exposure(sensor, source)
        dots_fit = fit_dots(source.capture, sensor, specimen, parameters, source.name, room=terms, draws=draws)
        if not imager.known and {parameter.key for parameter in dots_fit.undetermined} >= NOISE_KEYS:
            # the noise stays that of the file, and so does the fixed pattern beside it
            sensor = replace(sensor, imager=base.imager)
            dot_parameters = [replace(p, held=p.key in NOISE_KEYS or p.held) for p in parameters]
            dots_fit = fit_dots(source.capture, sensor, specimen, dot_parameters, source.name, room=terms, draws=draws)
            dots_fit = replace(dots_fit, undetermined=(FULL_WELL, READ_NOISE, *dots_fit.undetermined))
        out[source.name], fit = dots_fit, dots_fit.moment_fit
        say(
            f"{source.name}: {dots_fit.patches} patches, chi-square {fit.chi_square:.1f} of {fit.freedom}, "
            f"unevenness beyond the model {100 * dots_fit.uneven:.1f} %"
        )
    return out


def _held_noise(fit: ImagerFit, sensor: Sensor) -> list[Parameter]:
    """Return full well and read noise, held within the uncertainties of their estimates."""
    held = []
    for parameter, name in ((FULL_WELL, "full_well"), (READ_NOISE, "read_noise")):
        for estimate in (one for one in fit.estimates if one.key == parameter.key):
            changed: dict[str, Any] = {name: estimate.value + estimate.uncertainty}
            other = replace(fit.imager, **changed)
            change = parameter.get(replace(sensor, imager=other)) - parameter.get(sensor)
            held.append(parameter.held_within(abs(change)))
    return held


def _combined_estimates(
    dots: dict[str, DotsFit], base: Sensor, imager: ImagerFit, room: RoomFit | None
) -> tuple[list[FittedKey], list[Undetermined]]:
    """Combine the estimates of all captures of dots key by key, and list the keys that none determines."""
    estimates, undetermined, parameters = list[FittedKey](), list(imager.undetermined), dict[str, Parameter]()
    for name, fit in dots.items():
        values, spreads = fit.in_file_units()
        determined = fit.moment_fit.determined.tolist()
        rows = zip(fit.parameters, values.tolist(), spreads.tolist(), determined, strict=True)
        for parameter, value, spread, known in rows:
            if parameter.held and parameter.key != ROOM_LEVEL.key:
                continue
            how = ((name,), "figures of the dots over the field", parameter.scale)
            # the room stays in the fit; others are left out where they are not determined, or are significant
            known = known or parameter.held or not parameter.key.startswith("room.")
            estimates.append(FittedKey(parameter.key, value, spread, parameter.unit, *how, known))
        free = [parameter for parameter in fit.parameters if not parameter.held]
        parameters |= {parameter.key: parameter for parameter in (*free, *fit.undetermined)}
    keys = {estimate.key for estimate in estimates}
    left = [parameter for parameter in parameters.values() if parameter.key not in keys]
    left += [BLACK_LEVEL] * (room is None and bool(dots))
    undetermined += [Undetermined(parameter.key, parameter.read(base), parameter.determined_by) for parameter in left]
    return pooled(estimates, common=True), undetermined
