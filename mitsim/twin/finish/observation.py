"""Average the pixels of a coupon in blocks, for comparison with those of a white coupon.

Signal chain: images [DN] -> photo-electrons, by the inverse response curve -> mean of the images, minus the scene's own
light -> pixels on the coupon -> blocks.

Signal chain of the comparison: radiance L_1 of a white coupon at the same pose, through the same lenses
(:mod:`mitsim.twin.finish.white_coupon`) -> electrons per unit of pi f and of relative power. Directions toward camera
and projector are computed at every pixel.

- **Low pass.** Only the mean over the images of a capture is compared.
- **Light of the room.** A simulated scene without an ambient image is dark. The scene of a device is not. There the
  room adds an unknown radiance that is uniform over the coupon; the lens reduces it toward the corners.
- **Censoring.** A block with a saturated pixel in any image is excluded, with its eight neighbours. Near full scale,
  saturation removes the bright half of grain and noise, so the mean of a block would be too low.

The noise of a pixel is that of :mod:`mitsim.twin.finish.electrons`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from characterisation.files.arrays import Floats
from characterisation.files.errors import InputError
from characterisation.region_of_interest import Roi
from mitsim.capture.capture import Capture
from mitsim.sensor.camera import Camera
from mitsim.sensor.imager import Imager
from mitsim.sensor.modulation import AmplitudeModulation
from mitsim.twin.finish.electrons import PixelNoise, chip_of, linearised, pixel_noise
from mitsim.twin.finish.specimen import Specimen
from mitsim.twin.finish.white_coupon import Pattern, WhiteCouponRenderer, coupon_roi

#: margin inside the coupon's edge that its blur may reach [px]
_EDGE_PX = 5.0
#: least share of a block's pixels on the coupon
_BLOCK_SHARE = 0.5
#: least light of a pixel relative to the brightest; with less, the projector does not reach it
_UNLIT = 1e-3


@dataclass(frozen=True)
class CouponView:
    """A coupon in the images of one camera at one exposure: N pixels in ``size`` blocks."""

    capture: int  # index of the capture
    name: str  # its name in messages; ``camera``; ``exposure_s`` [s]
    camera: str
    exposure_s: float
    #: ``columns``, ``rows`` (N,) [px] in the camera's image
    columns: NDArray[np.int64]
    rows: NDArray[np.int64]
    block: NDArray[np.int64]  # (N,) index of each pixel's block
    width: int  # side of a block [px]
    grid: NDArray[np.int64]  # (size, 2) row and column of each block
    electrons: Floats = field(repr=False)  # (N,) [e-]: mean over the images
    unit: Floats = field(repr=False)  # (N,) [e-]: electrons for pi f = 1 at the power of the sensor file
    #: (N,) [s]: electrons from the light of the room, over its e-/s in the middle of the image. It is 0 if there is
    #: none, or if it was subtracted
    ambient: Floats = field(repr=False)
    #: ``toward_camera``, ``toward_projector`` (N, 3): unit directions, in the frame of the coupon
    toward_camera: Floats = field(repr=False)
    toward_projector: Floats = field(repr=False)
    noise: PixelNoise = field(repr=False)  # of a pixel's mean
    whole: int  # number of blocks on the coupon, saturated ones included; the coupon is the ``specimen``
    specimen: Specimen = field(repr=False)
    why_no_block: str = ""  # reason why there is no block on the coupon, "" otherwise

    @property
    def size(self) -> int:
        """Number of blocks."""
        return len(self.grid)

    @property
    def censored(self) -> float:
        """Share of the blocks that are excluded for saturation [1]."""
        return 1.0 - self.size / self.whole if self.whole else 0.0

    def means(self, values: Floats) -> Floats:
        """Return the mean of pixel values (N,) in each block, (size,)."""
        return np.asarray(np.bincount(self.block, values, self.size) / self.counts)

    @property
    def counts(self) -> Floats:
        """Number of pixels of each block, (size,)."""
        return np.bincount(self.block, minlength=self.size).astype(float)

    def off_mirror(self) -> tuple[float, float]:
        """Return the least and largest angle between half vector and normal [rad], over the pixels."""
        half = self.toward_camera + self.toward_projector
        angle = np.arccos(np.clip(half[:, 2] / np.linalg.norm(half, axis=1), -1.0, 1.0))
        return float(angle.min()), float(angle.max())


@dataclass(frozen=True)
class CouponCapture:
    """A capture of a coupon, its ``specimen``; the ``index`` of the capture, and its name ``where`` in messages."""

    capture: Capture
    specimen: Specimen
    index: int
    where: str


def observe(
    coupon_capture: CouponCapture,
    renderer: WhiteCouponRenderer,
    block_px: int,
    *,
    pattern: Pattern,
    lit_room: bool = False,
) -> list[CouponView]:
    """Return the view of a coupon by every camera at every exposure; the renderer has the cameras of the capture.

    ``pattern`` is ``mean`` if the capture has the sensor's own pattern, otherwise ``level``. In a ``lit_room`` the
    images contain other light than that of the projector. Raises InputError if the capture is one of time of flight or
    has no images, or its exposures or its number of images are wrong.
    """
    sensor, capture, specimen = renderer.sensor, coupon_capture.capture, coupon_capture.specimen
    where, projector = coupon_capture.where, specimen.world_from_sensor.points(sensor.projector.optics.centre)
    if isinstance(sensor.pattern, AmplitudeModulation):
        raise InputError(where, "technology", capture.technology, "images of light, not of its correlation")
    if not capture.images:
        raise InputError(where, "images", "none", "images of the coupon")
    exposures, ambient = capture.decoding.exposures_s, capture.decoding.ambient_image
    if not exposures or min(exposures) <= 0:
        found = repr(capture.decoding.exposure_s)
        raise InputError(where, "settings.exposure_s", found, "the exposure [s] of every image")
    views = []
    for name, stack in capture.images.items():
        if len(stack) % len(exposures) or len(stack) // len(exposures) <= ambient:
            allowed = f"as many at each of {len(exposures)} exposures"
            raise InputError(where, "images", f"{len(stack)} of {name}", allowed)
        camera = sensor.rig.cameras[name]
        roi, centre = coupon_roi(camera, specimen), specimen.world_from_sensor.points(camera.centre)
        white = renderer.white(specimen, name, roi, pattern)
        inside, points = _pixels_inside(specimen, camera, roi, white, capture.decoding.read_out.get(name))
        loss, count = renderer.corner_loss(name), len(stack) // len(exposures)
        for number, seconds in enumerate(exposures):
            images = stack[number * count : (number + 1) * count, *roi.slices]
            chip = chip_of(capture, sensor.imager, where)
            rows, columns, block, grid, whole = _blocks(inside, images, chip, block_px)
            levels = linearised(images[:, rows, columns], chip)
            room_s = float(seconds) if lit_room and not ambient else 0.0
            illumination = np.ones(len(rows)) if loss is None else loss[roi.slices][rows, columns].astype(float)
            views.append(
                CouponView(
                    coupon_capture.index,
                    where,
                    name,
                    float(seconds),
                    columns + roi.left,
                    rows + roi.top,
                    block,
                    block_px,
                    grid,
                    levels[:-1].mean(axis=0) - levels[-1] if ambient else levels.mean(axis=0),
                    white[rows, columns] * float(seconds),
                    illumination * room_s,
                    _directions(points[rows, columns], centre),
                    _directions(points[rows, columns], projector),
                    pixel_noise(sensor.imager, chip, count - ambient, float(seconds), ambient),
                    whole,
                    specimen,
                    "" if whole else _why_no_block(inside, points, white, specimen, block_px),
                )
            )
    return views


def _pixels_inside(
    specimen: Specimen, camera: Camera, roi: Roi, white: Floats, read_out: Roi | None
) -> tuple[NDArray[np.bool_], Floats]:
    """Return the lit pixels (h, w) inside the coupon's edge, and where all rays meet its plane (h, w, 3) [mm]."""
    pose = specimen.world_from_sensor
    centre, (columns, rows) = pose.points(camera.centre), roi.pixels()
    rays = camera.rays(np.stack([columns, rows], axis=-1).astype(float))
    rays = pose.directions(camera.sensor_from_camera.directions(rays))
    down = rays[..., 2] < -1e-6
    reach = np.where(down, -centre[2] / np.where(down, rays[..., 2], -1.0), 0.0)
    points = centre + reach[..., None] * rays
    focal = float(np.sqrt(camera.matrix[0, 0] * camera.matrix[1, 1]))
    footprint = reach / (focal * np.where(down, -rays[..., 2], 1.0))
    inside = down & (white > _UNLIT * white.max())
    inside[inside] = specimen.contains(points[inside][:, :2], _EDGE_PX * footprint[inside])
    if read_out is not None:
        inside &= (columns >= read_out.left) & (columns < read_out.right)
        inside &= (rows >= read_out.top) & (rows < read_out.bottom)
    return inside, points


def _directions(points: Floats, centre: Floats) -> Floats:
    """Return unit directions (N, 3) from points toward a centre (3,)."""
    out = centre - points
    return np.asarray(out / np.linalg.norm(out, axis=1, keepdims=True))


def _blocks(
    inside: NDArray[np.bool_], images: NDArray[Any], chip: Imager, width: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], int]:
    """Group the pixels on the coupon in blocks of ``width`` px, without saturated blocks and their neighbours.

    Returns rows, columns and block (N,) of the pixels, grid (B, 2), and the number of blocks with the saturated ones.
    """
    rows, columns = np.nonzero(inside)
    shape = tuple(-(-size // width) for size in inside.shape)
    number = (rows // width) * shape[1] + columns // width
    held = np.bincount(number, minlength=shape[0] * shape[1]) >= _BLOCK_SHARE * width**2
    bright_rows, bright_columns = np.nonzero((images >= chip.full_scale).any(axis=0) & inside)
    saturated = np.zeros(shape, bool)
    saturated[bright_rows // width, bright_columns // width] = True
    used = held & ~ndimage.binary_dilation(saturated, np.ones((3, 3), bool)).ravel()
    kept = used[number]
    labels, block = np.unique(number[kept], return_inverse=True)
    return rows[kept], columns[kept], block.reshape(-1), np.stack(np.divmod(labels, shape[1]), axis=1), int(held.sum())


def _why_no_block(inside: NDArray[np.bool_], points: Floats, white: Floats, specimen: Specimen, width: int) -> str:
    on_coupon = specimen.contains(points[..., :2].reshape(-1, 2), np.zeros(inside.size)).reshape(inside.shape)
    met = np.isfinite(points).all(axis=-1) & on_coupon
    if not met.any():
        return "the coupon is not in the image: its pose, or the plane of its cloud, is elsewhere"
    if not (met & (white > _UNLIT * max(float(white.max()), np.finfo(float).tiny))).any():
        return "the projector of the sensor file does not illuminate the coupon"
    if not inside.any():
        return f"within {2 * _EDGE_PX:g} px the coupon has two edges: it is too small, or was not read out"
    pixels = f"its {int(inside.sum())} pixels, {_EDGE_PX:g} px inside the edge"
    return f"{pixels}, fill half of no block of {width} x {width} px"
