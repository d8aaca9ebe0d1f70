"""A small sensor of dots with everything known, and units of it drawn at random before a sheet."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from unittest import mock

import numpy as np

from mitsim.capture.capture import Capture
from mitsim.capture.simulated.rendering import Rendering
from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.scene.load import scene_from_dict
from mitsim.sensor.camera import Camera, Rig
from mitsim.sensor.preset import load_sensor
from mitsim.sensor.sensor import Sensor
from mitsim.sensor.sensor_file import RoomTable
from mitsim.sensor.transforms import Transform, look_at
from mitsim.twin.finish.specimen import Specimen, known_specimen
from mitsim.twin.sensor import dots
from mitsim.twin.sensor.dots import DotDraws, DotsFit
from mitsim.twin.sensor.estimate import scaled
from mitsim.twin.sensor.parameters import (
    FLUX,
    FULL_WELL,
    PROJECTOR_CORNER,
    READ_NOISE,
    SMOOTHING,
    Parameter,
    pattern_parameters,
)

DISTANCE, HALF = 450.0, 300.0


def optics(width: int, height: int, focal: float, across: float) -> Camera:
    matrix = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1.0]])
    return Camera(matrix, np.zeros(5), width, height, Transform(np.eye(3), np.array([across, 0.0, 0.0])))


@cache
def small_sensor() -> Sensor:
    """Two cameras of 320 x 240 px and a projector between them, dots of some 4 px; exposure fixed."""
    preset = load_sensor("ensenso-n35")
    cameras = {"left": optics(320, 240, 400.0, 0.0), "right": optics(320, 240, 400.0, 60.0)}
    projector = replace(
        preset.projector, optics=optics(600, 480, 600.0, 30.0), corner_illumination=0.3, black_level=0.1
    )
    imager = replace(
        preset.imager,
        companding=(),
        bits=8,
        full_well=15000,
        read_noise=30.0,
        dsnu=0.0,
        prnu=0.0,
        black_level=8.0,
        blur_px=0.3,
    )
    pattern = preset.pattern.model_copy(update={"shifts_px": [], "run_length_px": 5.5, "blur_px": 0.9, "seed": 1})
    exposure = replace(preset.exposure, rule="fixed", base_s=3e-4, control=None, bracket=None)
    return replace(
        preset,
        name="small",
        rig=Rig(cameras, projector.optics),
        projector=projector,
        imager=imager,
        pattern=pattern,
        exposure=exposure,
        linewidth_nm=None,
        focus_mm=None,
        working_range_mm=(400.0, 500.0),
    )


POSE = look_at((30.0, 20.0, DISTANCE), (0.0, 10.0, 0.0), (0.0, 1.0, 0.0), 0.0)


def unit(seed: int) -> Sensor:
    """One unit in one room, drawn."""
    rng = np.random.default_rng(seed)
    sensor = small_sensor()
    pattern = sensor.pattern.model_copy(
        update={
            "run_length_px": 5.5 * rng.uniform(0.85, 1.2),
            "blur_px": 0.9 * rng.uniform(0.8, 1.3),
            "seed": 100 + seed,
        }
    )
    lamp = replace(sensor.projector, flux=rng.uniform(0.7, 1.1), corner_illumination=rng.uniform(0.2, 0.5))
    chip = replace(sensor.imager, full_well=15000 * rng.uniform(0.7, 1.3), read_noise=30 * rng.uniform(0.7, 1.4))
    room = RoomTable(
        irradiance_w_mm2=rng.uniform(0.3, 0.9) * 1e-6,
        gradient=tuple(rng.normal(0, 0.5, 2)),
        curvature=tuple(rng.normal(0, 0.7, 3)),
    )
    return replace(sensor, pattern=pattern, projector=lamp, imager=chip, room=room)


def specimen() -> Specimen:
    """Of the sheet, as large as the view."""
    return known_specimen(POSE, 2 * HALF, 2 * HALF)


@cache
def sheet():
    from mitsim.scene import backend

    backend.activate()
    size = backend.mi.ScalarTransform4f().scale([HALF, HALF, 1])
    shape = {"type": "rectangle", "to_world": size, "bsdf": {"type": "matt_white", "reflectance": 0.85}}
    return scene_from_dict({"sheet": shape}, small_sensor().wavelength_nm)


def capture_of(sensor: Sensor, seed: int) -> Capture:
    one = replace(sensor, rig=Rig({"left": sensor.rig.cameras["left"]}, sensor.rig.projector))
    return SimulatedSensor(one).capture(sheet(), POSE, rendering=Rendering(samples=16), seed=seed)


def parameters(smoothing: bool = False) -> list[Parameter]:
    return [
        FULL_WELL,
        READ_NOISE,
        *([SMOOTHING] if smoothing else []),
        FLUX,
        *pattern_parameters(small_sensor()),
        PROJECTOR_CORNER,
    ]


def small_fit(
    capture: Capture,
    sensor: Sensor,
    at: Specimen,
    varied: list[Parameter],
    draws: DotDraws,
    room: list[float] | None = None,
) -> DotsFit:
    """The fit in patches of 24 px, since the images are small."""
    with mock.patch.multiple(dots, PATCH_PX=24, MARGIN_PX=2.0):
        return dots.fit_dots(capture, sensor, at, varied, "unit", room=room, draws=draws)


def standard_errors(seed: int, draws: int = 3) -> tuple[DotsFit, dict[str, float]]:
    """Fit one unit; errors of all determined numbers, in the file's units, over their standard uncertainties."""
    truth = unit(seed)
    # which dots the unit has is not known to the fit: another draw of them each time
    other = small_sensor().pattern.model_copy(update={"seed": 50_000 + 37 * seed})
    sensor = replace(small_sensor(), pattern=other)
    found = small_fit(capture_of(truth, seed), sensor, specimen(), parameters(), DotDraws(draws, 7 + seed))
    values, spreads = found.in_file_units()
    errors = {}
    for parameter, value, spread in zip(found.parameters, values, spreads, strict=True):
        true = parameter.read(truth)
        off = scaled(value, parameter.scale) - scaled(true, parameter.scale)
        errors[parameter.key] = float(off / spread)
    return found, errors
