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
from mitsim.sensor.imager import Imager
from mitsim.sensor.modulation import AmplitudeModulation
from mitsim.sensor.sensor import Sensor
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
    """Return the view of a coupon by every camera at every exposure.

    Raises InputError if the capture is one of time of flight or has no images, or its exposures or its number of images
    are wrong.

    ``coupon_capture``, ``renderer``: capture, and the coupon in it; renders the white coupon, its sensor has the
    cameras of the capture. ``block_px``: side of a block [px]. ``pattern``, ``lit_room``: ``mean`` if the capture has
    the sensor's own pattern, otherwise ``level``; whether the images contain other light than that of the projector.
    """
    sensor, capture, specimen, where = (
        renderer.sensor,
        coupon_capture.capture,
        coupon_capture.specimen,
        coupon_capture.where,
    )
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
            raise InputError(
                where, "images", f"{len(stack)} of {name}", f"as many at each of {len(exposures)} exposures"
            )
        roi = coupon_roi(sensor.rig.cameras[name], specimen)
        white = renderer.white(specimen, name, roi, pattern)
        region = _CouponRegion.of(specimen, sensor, name, roi, white, capture.decoding.read_out.get(name))
        loss, count = renderer.corner_loss(name), len(stack) // len(exposures)
        for number, seconds in enumerate(exposures):
            images = stack[number * count : (number + 1) * count, *roi.slices]
            chip = chip_of(capture, sensor.imager, where)
            blocks = _Blocks.of(region.inside, images, chip, block_px)
            rows, columns = blocks.rows, blocks.columns
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
                    blocks.block,
                    block_px,
                    blocks.grid,
                    levels[:-1].mean(axis=0) - levels[-1] if ambient else levels.mean(axis=0),
                    white[rows, columns] * float(seconds),
                    illumination * room_s,
                    region.toward(region.camera_centre, rows, columns),
                    region.toward(region.projector_centre, rows, columns),
                    pixel_noise(sensor.imager, chip, count - ambient, float(seconds), ambient),
                    blocks.whole,
                    specimen,
                    "" if blocks.whole else _why_no_block(region, specimen, block_px),
                )
            )
    return views


@dataclass(frozen=True)
class _CouponRegion:
    """A coupon in a region (h, w) of a camera's image."""

    inside: NDArray[np.bool_]  # (h, w) pixels on the coupon, inside its edge
    points: Floats  # (h, w, 3) [mm]: where the view rays meet the plane, in the frame of the coupon
    white: Floats  # (h, w) [e-/s] of a white coupon
    #: ``camera_centre``, ``projector_centre`` (3,) [mm]: centres of camera and projector, in the frame of the coupon
    camera_centre: Floats
    projector_centre: Floats

    @classmethod
    def of(
        cls, specimen: Specimen, sensor: Sensor, name: str, roi: Roi, white: Floats, read_out: Roi | None
    ) -> _CouponRegion:
        """Intersect the view rays of a region with the plane of the coupon, and select the pixels inside its edge.

        ``read_out`` is the region that the camera ``name`` read out, None for the whole image.
        """
        camera = sensor.rig.cameras[name]
        pose = specimen.world_from_sensor
        centre, projector_centre = pose.points(camera.centre), pose.points(sensor.projector.optics.centre)
        columns, rows = roi.pixels()
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
        return cls(inside, points, white, centre, projector_centre)

    def toward(self, centre: Floats, rows: NDArray[np.int64], columns: NDArray[np.int64]) -> Floats:
        """Return unit directions (N, 3) from the points of pixels toward a ``centre`` (3,) [mm]."""
        out = centre - self.points[rows, columns]
        return np.asarray(out / np.linalg.norm(out, axis=1, keepdims=True))


@dataclass(frozen=True)
class _Blocks:
    """The pixels of a region that are compared: ``rows``, ``columns`` (N,) in it, ``block`` (N,), ``grid`` (B, 2).

    ``whole``: number of blocks on the coupon, saturated ones included.
    """

    rows: NDArray[np.int64]
    columns: NDArray[np.int64]
    block: NDArray[np.int64]
    grid: NDArray[np.int64]
    whole: int

    @classmethod
    def of(cls, inside: NDArray[np.bool_], images: NDArray[Any], chip: Imager, width: int) -> _Blocks:
        """Group the pixels on the coupon in blocks of ``width`` px, without saturated blocks and their neighbours."""
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
        grid = np.stack(np.divmod(labels, shape[1]), axis=1)
        return cls(rows[kept], columns[kept], block.reshape(-1), grid, int(held.sum()))


def _why_no_block(region: _CouponRegion, specimen: Specimen, width: int) -> str:
    """Return the reason why a camera has no block on a coupon, in words."""
    met = np.isfinite(region.points).all(axis=-1) & specimen.contains(
        region.points[..., :2].reshape(-1, 2), np.zeros(region.points[..., 0].size)
    ).reshape(region.points.shape[:2])
    if not met.any():
        return "the coupon is not in the image: its pose, or the plane of its cloud, is elsewhere"
    lit = region.white > _UNLIT * max(float(region.white.max()), np.finfo(float).tiny)
    if not (met & lit).any():
        return "the projector of the sensor file does not illuminate the coupon"
    if not region.inside.any():
        return f"within {2 * _EDGE_PX:g} px the coupon has two edges: it is too small, or was not read out"
    inside = int(region.inside.sum())
    return f"its {inside} pixels, {_EDGE_PX:g} px inside the edge, fill half of no block of {width} x {width} px"
