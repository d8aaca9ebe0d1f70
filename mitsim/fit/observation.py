"""Blocks of pixels on a coupon in a capture, beside those that a white coupon would have shown.

Signal chain: images [DN] -> photo-electrons, by the imager's curve undone -> mean of the images, less the scene's own
light -> the pixels inside the coupon -> blocks. Beside it: radiance L_1 of a white coupon at the same pose, through the
same lenses (:mod:`mitsim.fit.white_coupon`) -> electrons per unit of pi f and of relative power; directions toward
camera and lamp at every pixel.

**Low pass.** Only the mean over the images of a capture is compared.

**Light of the room.** A simulated scene without an ambient image is dark. A device's is not: there the room adds a
radiance that is the same all over the coupon, of unknown size, less the lens's loss toward the corners.

**Censoring.** A block with a saturated pixel in any image is left out, and so are its eight neighbours: next to the
limit, saturation cuts off the bright half of grain and noise, so their mean would be too dark.

The noise of a pixel is that of :mod:`mitsim.fit.electrons`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from mitsim.capture.capture import Capture
from mitsim.errors import InputError
from mitsim.fit.electrons import PixelNoise, chip_of, linearised, pixel_noise
from mitsim.fit.place import Place
from mitsim.fit.white_coupon import Bench, Pattern, coupon_roi
from mitsim.sensor.camera import Camera
from mitsim.sensor.imager import Imager
from mitsim.sensor.modulation import AmplitudeModulation
from mitsim.sensor.preset import Sensor
from mitsim.sensor.roi import Roi

Floats = NDArray[np.float64]

#: pixels beside the coupon's edge that its blur may reach
_EDGE_PX = 5.0
#: a block must have this share of its pixels inside the coupon
_BLOCK_SHARE = 0.5
#: light of a pixel relative to the brightest under which the projector does not reach it
_UNLIT = 1e-3


@dataclass(frozen=True)
class View:
    """A coupon as one camera saw it at one exposure: N pixels in ``size`` blocks.

    ``capture`` index and ``name`` of the capture, ``camera``, ``exposure_s``; ``columns``, ``rows`` (N,) [px];
    ``block`` (N,) index of the block, ``size`` of them, each ``width`` pixels wide and at ``grid`` (size, 2), row and
    column in blocks; ``electrons`` (N,) [e-] mean over the images; ``unit`` (N,) [e-] that pi f = 1 would give at the
    file's power; ``ambient`` (N,) [s] what light of the room that gives the middle of the image 1 e-/s would add, 0
    where there is none or it was taken off; ``view``, ``lamp`` (N, 3) unit directions in the coupon's frame; ``noise``
    of the imager; ``whole`` blocks on the coupon, of which the share ``censored`` is left out; ``place`` of the coupon;
    ``nothing``: why there is no block, "" if there are any.
    """

    capture: int
    name: str
    camera: str
    exposure_s: float
    columns: NDArray[np.int64]
    rows: NDArray[np.int64]
    block: NDArray[np.int64]
    width: int
    grid: NDArray[np.int64]
    electrons: Floats = field(repr=False)
    unit: Floats = field(repr=False)
    ambient: Floats = field(repr=False)
    view: Floats = field(repr=False)
    lamp: Floats = field(repr=False)
    noise: PixelNoise = field(repr=False)
    whole: int
    place: Place = field(repr=False)
    nothing: str = ""

    @property
    def size(self) -> int:
        """How many blocks there are."""
        return len(self.grid)

    @property
    def censored(self) -> float:
        """Share of the blocks that saturation leaves out."""
        return 1.0 - self.size / self.whole if self.whole else 0.0

    def means(self, values: Floats) -> Floats:
        """Mean over the pixels of each block, (size,)."""
        return np.asarray(np.bincount(self.block, values, self.size) / self.counts)

    @property
    def counts(self) -> Floats:
        """Pixels of each block, (size,)."""
        return np.bincount(self.block, minlength=self.size).astype(float)

    def off_mirror(self) -> tuple[float, float]:
        """Smallest and largest angle between the half vector and the normal [rad], over the pixels."""
        half = self.view + self.lamp
        angle = np.arccos(np.clip(half[:, 2] / np.linalg.norm(half, axis=1), -1.0, 1.0))
        return float(angle.min()), float(angle.max())


@dataclass(frozen=True)
class CouponCapture:
    """A capture of a coupon: its ``place``, the ``index`` of the capture among several, ``where`` it is in messages."""

    capture: Capture
    place: Place
    index: int
    where: str


def observe(
    taken: CouponCapture, bench: Bench, block_px: int, *, pattern: Pattern, lit_room: bool = False
) -> list[View]:
    """Every camera's view of a coupon, at every exposure.

    ``pattern`` is ``mean`` if the capture has the sensor's own, else ``level``; ``lit_room`` if the images have other
    light than the projector's.

    Raises
    ------
    InputError
        If the capture is of another kind than can be compared, or says too little of how it was taken.
    """
    sensor, capture, place, where = bench.sensor, taken.capture, taken.place, taken.where
    if isinstance(sensor.pattern, AmplitudeModulation):
        raise InputError(where, "technology", capture.technology, "images of light, not of its correlation")
    if not capture.images:
        raise InputError(where, "images", "none", "images of the coupon")
    exposures = capture.settings.get("exposure_s")
    exposures = exposures if isinstance(exposures, list) else [exposures]
    if not exposures or not all(isinstance(e, int | float) and e > 0 for e in exposures):
        raise InputError(where, "settings.exposure_s", repr(exposures), "the exposure [s] of every image")
    ambient = bool(capture.settings.get("ambient_image", False))
    views = []
    for name, stack in capture.images.items():
        if len(stack) % len(exposures) or len(stack) // len(exposures) <= ambient:
            raise InputError(
                where, "images", f"{len(stack)} of {name}", f"as many at each of {len(exposures)} exposures"
            )
        camera = sensor.rig.cameras[name]
        roi = coupon_roi(camera, place)
        white = bench.white(place, name, roi, pattern)
        loss = bench.corner_loss(name)
        seen = _Seen.of(camera, place, sensor, roi, _read_out(capture, name), white, loss)
        each = len(stack) // len(exposures)
        shown = stack[:, *roi.slices]
        for number, seconds in enumerate(exposures):
            images = shown[number * each : (number + 1) * each]
            chip = chip_of(capture, sensor.imager, where)
            noise = pixel_noise(sensor.imager, chip, each - ambient, float(seconds), ambient)
            blocks = _Blocks.of(seen, images, chip, block_px)
            lit, dark = (images[:-1], images[-1]) if ambient else (images, None)
            frames = _Frames(lit, dark, chip, float(seconds), float(seconds) if lit_room and not ambient else 0.0)
            views.append(_view(taken, name, seen, blocks, frames, noise))
    return views


@dataclass(frozen=True)
class _Seen:
    """A coupon in a region (h, w) of a camera's image: which pixels are inside, where they meet the plane.

    ``white`` (h, w) [e-/s] of a white coupon; ``loss`` (h, w) of the lens toward the corners; centres of camera and
    lamp in the coupon's frame [mm].
    """

    roi: Roi
    inside: NDArray[np.bool_]
    points: Floats
    white: Floats
    loss: Floats
    camera_centre: Floats
    lamp_centre: Floats

    @classmethod
    def of(
        cls,
        camera: Camera,
        place: Place,
        sensor: Sensor,
        roi: Roi,
        read_out: Roi | None,
        white: Floats,
        corner_loss: NDArray[np.float32] | None,
    ) -> _Seen:
        pose = place.world_from_sensor
        centre, lamp = pose.points(camera.centre), pose.points(sensor.projector.optics.centre)
        columns, rows = roi.pixels()
        rays = camera.rays(np.stack([columns, rows], axis=-1).astype(float))
        rays = pose.directions(camera.sensor_from_camera.directions(rays))
        down = rays[..., 2] < -1e-6
        reach = np.where(down, -centre[2] / np.where(down, rays[..., 2], -1.0), 0.0)
        points = centre + reach[..., None] * rays
        focal = float(np.sqrt(camera.matrix[0, 0] * camera.matrix[1, 1]))
        footprint = reach / (focal * np.where(down, -rays[..., 2], 1.0))
        inside = down & (white > _UNLIT * white.max())
        inside[inside] = place.holds(points[inside][:, :2], _EDGE_PX * footprint[inside])
        if read_out is not None:
            inside &= (columns >= read_out.left) & (columns < read_out.right)
            inside &= (rows >= read_out.top) & (rows < read_out.bottom)
        loss = np.ones(white.shape) if corner_loss is None else corner_loss[rows, columns].astype(float)
        return cls(roi, inside, points, white, loss, centre, lamp)

    def toward(self, centre: Floats, rows: NDArray[np.int64], columns: NDArray[np.int64]) -> Floats:
        """Unit directions (N, 3) from the points of some pixels toward a place."""
        out = centre - self.points[rows, columns]
        return np.asarray(out / np.linalg.norm(out, axis=1, keepdims=True))


@dataclass(frozen=True)
class _Blocks:
    """The pixels of a region that are compared: ``rows``, ``columns`` (N,) in it, ``block`` (N,), ``grid`` (B, 2)."""

    rows: NDArray[np.int64]
    columns: NDArray[np.int64]
    block: NDArray[np.int64]
    grid: NDArray[np.int64]
    width: int
    whole: int

    @classmethod
    def of(cls, seen: _Seen, images: NDArray[np.unsignedinteger[Any]], chip: Imager, width: int) -> _Blocks:
        rows, columns = np.nonzero(seen.inside)
        shape = tuple(-(-size // width) for size in seen.inside.shape)
        number = (rows // width) * shape[1] + columns // width
        held = np.bincount(number, minlength=shape[0] * shape[1]) >= _BLOCK_SHARE * width**2
        bright_rows, bright_columns = np.nonzero((images >= chip.full_scale).any(axis=0) & seen.inside)
        saturated = np.zeros(shape, bool)
        saturated[bright_rows // width, bright_columns // width] = True
        used = held & ~ndimage.binary_dilation(saturated, np.ones((3, 3), bool)).ravel()
        kept = used[number]
        labels, block = np.unique(number[kept], return_inverse=True)
        grid = np.stack(np.divmod(labels, shape[1]), axis=1)
        return cls(rows[kept], columns[kept], block.reshape(-1), grid, width, int(held.sum()))


@dataclass(frozen=True)
class _Frames:
    """Images of one camera at one exposure, of its region.

    ``lit`` (F, h, w) [DN]; ``dark`` (h, w) with the projector off, None without such an image; ``chip`` that took them;
    ``seconds`` of exposure, ``room_seconds`` in which light of the room is in them, 0 if there is none.
    """

    lit: NDArray[np.unsignedinteger[Any]]
    dark: NDArray[np.unsignedinteger[Any]] | None
    chip: Imager
    seconds: float
    room_seconds: float

    def electrons(self, rows: NDArray[np.int64], columns: NDArray[np.int64]) -> Floats:
        """Mean photo-electrons (N,) of some pixels, less those of the dark image."""
        mean = linearised(self.lit[:, rows, columns], self.chip).mean(axis=0)
        return np.asarray(mean if self.dark is None else mean - linearised(self.dark[rows, columns], self.chip))


def _view(taken: CouponCapture, camera: str, seen: _Seen, blocks: _Blocks, frames: _Frames, noise: PixelNoise) -> View:
    rows, columns, place = blocks.rows, blocks.columns, taken.place
    return View(
        taken.index,
        taken.where,
        camera,
        frames.seconds,
        columns + seen.roi.left,
        rows + seen.roi.top,
        blocks.block,
        blocks.width,
        blocks.grid,
        frames.electrons(rows, columns),
        seen.white[rows, columns] * frames.seconds,
        seen.loss[rows, columns] * frames.room_seconds,
        seen.toward(seen.camera_centre, rows, columns),
        seen.toward(seen.lamp_centre, rows, columns),
        noise,
        blocks.whole,
        place,
        "" if blocks.whole else _why_nothing(seen, place, blocks.width),
    )


def _why_nothing(seen: _Seen, place: Place, width: int) -> str:
    """Why a camera has no block on a coupon, in words."""
    met = np.isfinite(seen.points).all(axis=-1) & place.holds(
        seen.points[..., :2].reshape(-1, 2), np.zeros(seen.points[..., 0].size)
    ).reshape(seen.points.shape[:2])
    if not met.any():
        return "the coupon is not in the image: its pose, or the plane that was found, lies elsewhere"
    lit = seen.white > _UNLIT * max(float(seen.white.max()), np.finfo(float).tiny)
    if not (met & lit).any():
        return "the projector of the sensor file does not light the coupon"
    if not seen.inside.any():
        return f"within {2 * _EDGE_PX:g} px the coupon has two edges: it is too small, or was not read out"
    inside = int(seen.inside.sum())
    return f"its {inside} pixels, {_EDGE_PX:g} px inside the edge, fill half of no block of {width} x {width} px"


def _read_out(capture: Capture, camera: str) -> Roi | None:
    """Region of a camera's image that was read out, None for the whole image."""
    region = capture.settings.get("read_out", {}).get(camera)
    return None if region is None else Roi(*region)
