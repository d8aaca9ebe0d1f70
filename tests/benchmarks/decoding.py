"""How fast codes of light become coordinates and clouds, beside OpenCV's own decoders and plain numpy.

python tests/benchmarks/decoding.py [rounds]

All rows of one table run in turns, round after round, so that a slow moment of the machine falls on all of them.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable

import cv2
import numpy as np

from mitsim.decoding.image_context import ImageContext
from mitsim.decoding.structured_light.decoder import decode_coordinates, decode_structured_light
from mitsim.decoding.structured_light.geometry import structured_light_geometry
from mitsim.decoding.structured_light.phase_shift import fit_phases
from mitsim.sensor.camera import Camera, Rig
from mitsim.sensor.decoder_settings import DecoderSettings
from mitsim.sensor.light_code import GrayCode, PhaseShift, roles, value
from mitsim.sensor.transforms import Transform

WIDTH, HEIGHT = 752, 480
PROJECTOR = (1024, 768)
SETTINGS = DecoderSettings(near_mm=400, far_mm=900)
PHASE = PhaseShift(periods_px=[1100, 150, 20], steps=8)
GRAY = GrayCode()
SHARE = 16  # OpenCV decodes pixel by pixel: it is asked every 16th of them each way, and its time multiplied


def a_rig() -> Rig:
    """Camera and projector with distorted lenses."""

    def optics(width: int, height: int, focal: float, distortion: list[float], place: Transform) -> Camera:
        matrix = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
        return Camera(matrix, np.array(distortion), width, height, place)

    eye = optics(WIDTH, HEIGHT, 850, [-0.18, 0.12, 0.001, -0.0005, -0.02], Transform.identity())
    place = Transform.from_degrees([0.5, -14, 0.4], [170, 3, -5])
    return Rig({"eye": eye}, optics(*PROJECTOR, 1040, [0.08, -0.1, -0.0005, 0.0007, 0.03], place))


def a_stack(rig: Rig, code: PhaseShift | GrayCode) -> np.ndarray:
    """8-bit images (P, H, W) of a tilted plane at 600 mm."""
    eye, projector, n = rig.cameras["eye"], rig.projector, np.array([0.2, 0.1, -1.0])
    assert projector is not None
    rays = eye.rays(eye.pixel_grid())
    u = projector.project(rays * (600 * n[2] / (rays @ n))[..., None])[..., 0]
    images = [20 + 200 * value(code, role, u) for role in roles(code, *PROJECTOR)]
    noise = np.random.default_rng(1).normal(0, 1, (len(images), HEIGHT, WIDTH))
    return np.clip(np.rint(np.stack(images) + noise), 0, 255).astype(np.uint8)


def naive_phase(stack: np.ndarray) -> np.ndarray:
    """Three wrapped phases, unwrapped from the longest period down, with whole-image numpy."""
    images = stack.reshape(3, 8, HEIGHT, WIDTH).astype(np.float64)
    delta = 2 * np.pi * np.arange(8) / 8
    along, across = (np.einsum("k,nkij->nij", f(delta), images) for f in (np.cos, np.sin))
    cycles = np.mod(np.arctan2(across, along) / (2 * np.pi), 1)
    modulation = 2 / 8 * np.sqrt(along**2 + across**2)
    place = cycles[0] * PHASE.periods_px[0]
    for each, period in zip(cycles[1:], PHASE.periods_px[1:], strict=True):
        place = (np.rint(place / period - each) + each) * period
    return np.where((modulation.min(axis=0) > 2) & (stack.max(axis=0) < 255), place - 0.5, np.nan)


def naive_gray(stack: np.ndarray) -> np.ndarray:
    """Bits against their inverses, with whole-image numpy."""
    images = stack.astype(np.int32)
    bits = (images[2::2] > images[3::2]).astype(np.int32)
    binary = np.bitwise_xor.accumulate(bits, axis=0)
    number = np.tensordot(2 ** np.arange(len(bits))[::-1], binary, 1)
    return np.where(images[0] - images[1] > 4, number, np.nan)


def opencv_gray_pixels(stack: np.ndarray) -> Callable[[], object]:
    """``GrayCodePattern.getProjPixel`` for a share of the pixels; it wants both axes, so rows repeat the columns."""
    pattern = cv2.structured_light.GrayCodePattern.create(PROJECTOR[0], PROJECTOR[0])
    images = list(stack[2:]) * 2
    return lambda: [pattern.getProjPixel(images, x, y) for y in range(0, HEIGHT, SHARE) for x in range(0, WIDTH, SHARE)]


def opencv_phase(stack: np.ndarray) -> Callable[[], object]:
    """``SinusoidalPattern``: phase map of three images of one period (all it takes), unwrapped in space."""
    parameters = cv2.structured_light_SinusoidalPattern_Params()
    parameters.width, parameters.height = PROJECTOR
    parameters.methodId = cv2.structured_light.PSP
    parameters.nbrOfPeriods = 51
    pattern = cv2.structured_light.SinusoidalPattern.create(parameters)
    three = [np.ascontiguousarray(stack[index]) for index in (16, 18, 21)]

    def run() -> object:
        wrapped, mask = pattern.computePhaseMap(three)
        return pattern.unwrapPhaseMap(wrapped, (WIDTH, HEIGHT), shadowMask=mask)

    return run


def main() -> None:
    """Time everything and print the table."""
    rounds = int(sys.argv[1]) if len(sys.argv) > 1 else 15
    rig = a_rig()
    phase, gray = a_stack(rig, PHASE), a_stack(rig, GRAY)
    deep = phase.astype(np.uint16) * 16
    shifts = [2 * np.pi * np.arange(8) / 8] * 3
    geometry = structured_light_geometry(rig, "eye", PHASE, SETTINGS.near_mm, SETTINGS.far_mm)
    about = ImageContext("drawn", "simulated", 255)
    runs: dict[str, tuple[Callable[[], object], float]] = {
        "24 phase images, phase and modulation": (lambda: fit_phases(phase, shifts), 1),
        "24 phase images, coordinate": (
            lambda: decode_coordinates(phase, PHASE, PROJECTOR, SETTINGS, full_scale=255),
            1,
        ),
        "24 phase images of 12 bit, coordinate": (
            lambda: decode_coordinates(deep, PHASE, PROJECTOR, SETTINGS, full_scale=4095),
            1,
        ),
        "24 phase images, cloud": (lambda: decode_structured_light(phase, geometry, PHASE, SETTINGS, about), 1),
        "24 phase images, plain numpy, coordinate": (lambda: naive_phase(phase), 1),
        "3 phase images, OpenCV, spatially unwrapped": (opencv_phase(phase), 1),
        "22 Gray images, coordinate": (lambda: decode_coordinates(gray, GRAY, PROJECTOR, SETTINGS, full_scale=255), 1),
        "22 Gray images, cloud": (lambda: decode_structured_light(gray, geometry, GRAY, SETTINGS, about), 1),
        "22 Gray images, plain numpy, coordinate": (lambda: naive_gray(gray), 1),
        "20 Gray images, OpenCV getProjPixel": (opencv_gray_pixels(gray), SHARE**2 / 2),
        "geometry, once for a rig": (
            lambda: structured_light_geometry(rig, "eye", PHASE, SETTINGS.near_mm, SETTINGS.far_mm),
            1,
        ),
    }
    ours = decode_coordinates(phase, PHASE, PROJECTOR, SETTINGS, full_scale=255)["columns"].value
    assert np.nanmax(np.abs(ours - naive_phase(phase))) < 1e-3
    bits = decode_coordinates(gray, GRAY, PROJECTOR, SETTINGS, full_scale=255)["columns"].value
    assert np.mean(np.abs(bits - naive_gray(gray)) <= 0.5) > 0.999

    times: dict[str, list[float]] = {name: [] for name in runs}
    for number in range(rounds + 1):
        for name, (run, factor) in runs.items():
            if factor == 1 or number < 3:
                before = time.perf_counter()
                run()
                times[name].append((time.perf_counter() - before) * factor)
    print(f"{WIDTH} x {HEIGHT} pixels, medians of {rounds} rounds in turns")
    for name, taken in times.items():
        print(f"{name:46} {1e3 * statistics.median(taken[1:]):9.1f} ms")


if __name__ == "__main__":
    main()
