"""Fit sensor parameters to one capture of projected dots on a sheet.

Signal chain: capture -> plane and bend of the sheet -> features over the field (:mod:`mitsim.twin.sensor.figures`) ->
power, room light, dots, noise and corner losses by simulated moments (:mod:`mitsim.twin.sensor.moments`,
:mod:`mitsim.twin.sensor.parameters`) with the forward model (:mod:`mitsim.twin.sensor.specimen_simulator`).

The six terms of room light may not explain the level and contrast over the field within chance. The mean square of the
remainder is then added to the covariance of these terms, and the fit is repeated. It is also repeated without the
parameters that are not determined, until all are; full well and read noise are then held at the file's values, and
their priors enter the uncertainties of all others. If the misfit is still significant, the covariance is scaled by the
reduced chi-square (Birge, Phys. Rev. 40 (1932) 207).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from characterisation.files.arrays import Floats
from characterisation.files.errors import InputError
from mitsim.capture.capture import Capture
from mitsim.sensor.pattern import DotPattern
from mitsim.sensor.sensor import Sensor
from mitsim.twin.compare.specimen_patches import contrast_window
from mitsim.twin.finish.find_specimen import MARGIN_PX, image_mask
from mitsim.twin.finish.specimen import Specimen
from mitsim.twin.sensor.estimate import scaled, unscaled
from mitsim.twin.sensor.figures import TERMS, SpecimenField, field_figures
from mitsim.twin.sensor.moments import MomentFit, Prior, match_moments
from mitsim.twin.sensor.parameters import (
    CORNER_BLUR,
    FLUX,
    FULL_WELL,
    READ_NOISE,
    SMOOTHING,
    Parameter,
    room_parameters,
    with_room,
)
from mitsim.twin.sensor.specimen_simulator import SpecimenSimulator
from mitsim.twin.sensor.verdict import CHANCE

#: side of a patch [px]; chosen
PATCH_PX = 40

#: least number of patches of a capture; chosen
FEWEST_PATCHES = 8

#: keys of the parameters that are held if they are not determined
NOISE_KEYS = {FULL_WELL.key, READ_NOISE.key}

_ALONE = ("crossings", "sharpness", "noise in the dark half", "noise in the bright half", "grain")

#: initial room light as a share of the projector's; chosen
_FIRST_ROOM = 0.2

#: step of the derivatives of the file's numbers, in standard uncertainties; chosen
_DIFFERENCE = 0.3

#: least significance of a smoothing, in standard uncertainties; chosen
_SURE = 2.0


@dataclass(frozen=True)
class DotsFit:
    """Result of the fit of ``parameters`` to one capture, started at ``sensor``."""

    sensor: Sensor
    parameters: tuple[Parameter, ...]
    moment_fit: MomentFit
    patches: int  # number of patches seen
    uneven: float  # standard deviation of the field's terms that no parameter explains [1]
    #: parameters that the capture does not determine; they keep the sensor's own values
    undetermined: tuple[Parameter, ...] = ()
    worst: str = ""
    #: root mean square over the patches of log(recorded / simulated), smooth over the field, of the feature ``worst``,
    #: which differs most
    misfit: float = 0.0

    def with_values(self, theta: Floats) -> Sensor:
        """Return the sensor with the varied numbers (k,) inserted."""
        return with_values(self.sensor, self.parameters, theta)

    def in_file_units(self) -> tuple[Floats, Floats]:
        """Return the numbers (k,) in the file's units and their uncertainties, by numerical derivatives."""
        theta, spread = self.moment_fit.values, np.sqrt(np.diag(self.moment_fit.covariance))

        def numbers(at: Floats) -> Floats:
            sensor = self.with_values(at)
            return np.array([scaled(parameter.read(sensor), parameter.scale) for parameter in self.parameters])

        jacobian = np.empty((len(theta), len(theta)))
        for index, parameter in enumerate(self.parameters):
            step = _DIFFERENCE * spread[index] * np.array([-1, 1])
            ends = np.clip(theta[index] + step, parameter.low, parameter.high)
            low, high = (np.where(np.arange(len(theta)) == index, end, theta) for end in ends)
            jacobian[:, index] = (numbers(high) - numbers(low)) / max(float(ends[1] - ends[0]), 1e-12)
        values = [unscaled(x, p.scale) for x, p in zip(numbers(theta), self.parameters, strict=True)]
        return np.array(values), np.sqrt(np.diag(jacobian @ self.moment_fit.covariance @ jacobian.T))


def with_values(sensor: Sensor, parameters: Sequence[Parameter], theta: Floats) -> Sensor:
    """Return the sensor with varied numbers (k,) of parameters inserted."""
    for parameter, value in zip(parameters, theta, strict=True):
        sensor = parameter.put(sensor, float(value))
    return sensor


@dataclass(frozen=True)
class DotDraws:
    """Simulated dots that a fit compares with: their ``number`` and ``seed``."""

    number: int = 3
    seed: int = 1


_DRAWS = DotDraws()


def fit_dots(
    capture: Capture,
    sensor: Sensor,
    specimen: Specimen,
    parameters: Sequence[Parameter],
    where: str,
    *,
    room: Sequence[float] | None = None,
    draws: DotDraws = _DRAWS,
) -> DotsFit:
    """Fit parameters to one capture of dots on a sheet, in messages ``where``.

    ``sensor`` has the capture's own cameras and exposure, from :func:`mitsim.twin.compare.rebuild.like`. ``parameters``
    are to vary or held, without those of the room unless it is known: ``room`` has its six terms of the irradiance
    [W/mm^2], which are fitted if None. Raises InputError if too little of the sheet is visible.
    """
    name, camera = next(iter(capture.rig.cameras.items()))
    field = SpecimenField.of(camera, image_mask(specimen, camera, MARGIN_PX), PATCH_PX)
    if len(field.corners) < FEWEST_PATCHES:
        seen = f"{len(field.corners)} patches of {PATCH_PX} px of it"
        raise InputError(where, "specimen", seen, f"{FEWEST_PATCHES} or more", "a larger --window, or a nearer view")
    window, black = contrast_window(capture, specimen), sensor.imager.black_level
    real = field_figures(capture.images[name][0][field.roi.slices].astype(float), field, window, black)
    simulator = SpecimenSimulator(sensor, specimen, field.roi)
    unit = simulator.projector_irradiance(sensor, draws.seed)
    free_parameters = list(parameters)
    if room is None:
        free_parameters += room_parameters(unit / sensor.projector.flux)
    sensor = with_room(sensor, [_FIRST_ROOM * unit, 0.0, 0.0, 0.0, 0.0, 0.0] if room is None else list(room))
    terms = TERMS if np.isfinite(real.coefficients[1, 0]) else TERMS[:1]
    names = [(figure, term) for figure in ("level", "contrast") for term in terms]
    names += [(alone, "1") for alone in _ALONE]
    spatial, count = np.array([term != "1" for _, term in names]), len(names)
    if CORNER_BLUR in free_parameters:
        names += [("sharpness", term) for term in terms if term != "1"]
        spatial = np.append(spatial, np.zeros(len(names) - len(spatial), bool))
    wanted, covariance = real.of(names)

    def simulate(theta: Floats, number: int) -> tuple[Floats, Floats]:
        other = _with_other_dots(with_values(sensor, free_parameters, theta), number)
        levels = simulator.levels(other, 1000 * draws.seed + number)
        return field_figures(levels.astype(float), field, window, black).of(names)

    start = np.array([parameter.get(sensor) for parameter in free_parameters])
    if FLUX in free_parameters:
        start[free_parameters.index(FLUX)] += wanted[0] - simulate(start, 0)[0][0]
    moment_fit = match_moments(wanted, covariance, simulate, _prior(free_parameters, start), draws.number, where)
    uneven = 0.0
    if _misses(moment_fit) and spatial.sum() > 0:
        off = wanted - np.mean([simulate(moment_fit.values, number)[0] for number in range(draws.number)], axis=0)
        excess = float(np.mean(off[spatial] ** 2 - np.diag(covariance)[spatial]))
        uneven = float(np.sqrt(max(excess, 0.0)))
        covariance = covariance + np.diag(np.where(spatial, uneven**2, 0.0))
    undetermined: list[Parameter] = []
    settled = uneven == 0
    while True:
        known = np.array([_is_determined(moment_fit, index, one) for index, one in enumerate(free_parameters)])
        dropped = [parameter for parameter, is_known in zip(free_parameters, known, strict=True) if not is_known]
        if settled and not dropped:
            break
        # without it no parameter explains the variation of sharpness
        if CORNER_BLUR in dropped:
            names, spatial = names[:count], spatial[:count]
            wanted, covariance = real.of(names)
            covariance = covariance + np.diag(np.where(spatial, uneven**2, 0.0))
        undetermined += dropped
        kept = np.array([p.key in NOISE_KEYS or is_known for p, is_known in zip(free_parameters, known, strict=True)])
        again_from = np.where(known, moment_fit.values, start)[kept]
        free_parameters = [
            parameter if is_known else replace(parameter, held=True)
            for parameter, is_known, is_kept in zip(free_parameters, known, kept, strict=True)
            if is_kept
        ]
        start = start[kept]
        again = _prior(free_parameters, start, again_from)
        moment_fit = match_moments(wanted, covariance, simulate, again, draws.number, f"{where}, once more")
        settled = True
    if _misses(moment_fit):
        wider = moment_fit.covariance * moment_fit.chi_square / max(moment_fit.freedom, 1)
        moment_fit = replace(moment_fit, covariance=wider)
    misfits = field_misfits(names, moment_fit.off, field.basis)
    worst = max(misfits, key=lambda figure: misfits[figure])
    return DotsFit(
        sensor,
        tuple(free_parameters),
        moment_fit,
        len(field.corners),
        uneven,
        tuple(undetermined),
        worst,
        misfits[worst],
    )


def field_misfits(names: Sequence[tuple[str, str]], off: Floats, basis: Floats) -> dict[str, float]:
    """Return the root mean square over the patches of each feature's difference.

    ``off`` (n,) are differences of the coefficients of features and terms, ``basis`` (P, 6) the terms at the patches.
    """
    over_field = dict[str, Floats]()
    for (figure, term), value in zip(names, off, strict=True):
        over_field[figure] = over_field.get(figure, np.zeros(len(basis))) + value * basis[:, TERMS.index(term)]
    return {figure: float(np.sqrt(np.mean(values**2))) for figure, values in over_field.items()}


def _misses(moment_fit: MomentFit) -> bool:
    return bool(moment_fit.chi_square > chi2.isf(CHANCE, max(moment_fit.freedom, 1)))


def _is_determined(moment_fit: MomentFit, index: int, parameter: Parameter) -> bool:
    """Return whether a parameter stays in the fit: held ones, the room's, and significant smoothing or corner blur."""
    if parameter.held or parameter.key.startswith("room."):
        return True
    if parameter is SMOOTHING or parameter is CORNER_BLUR:
        return bool(moment_fit.values[index] > _SURE * np.sqrt(moment_fit.covariance[index, index]))
    return bool(moment_fit.determined[index])


def _prior(parameters: Sequence[Parameter], middle: Floats, first: Floats | None = None) -> Prior:
    spread, step, low, high = (
        np.array([getattr(parameter, name) for parameter in parameters]) for name in ("spread", "step", "low", "high")
    )
    return Prior(middle, spread, step, low, high, first, np.array([parameter.held for parameter in parameters]))


def _with_other_dots(sensor: Sensor, number: int) -> Sensor:
    """Return the sensor with other random dots of the same kind, because the real pattern is unknown."""
    pattern = sensor.pattern
    if number == 0 or not isinstance(pattern, DotPattern):
        return sensor
    return replace(sensor, pattern=pattern.model_copy(update={"seed": pattern.seed + 7919 * number}))
