"""Take images of the user's own as the pattern of a projector: a new light code, or a dot mask.

Signal chain: a folder of PNG files in the order of the numbers in their names, or an array -> values 0..1 relative to
white -> the same projector as for mitsim's codes: response curve, black level, optics.

mitsim projects the images and does not know what they mean. Two cameras that match dots need no meaning. A coordinate
of the projector comes from the user's own decoder (:mod:`mitsim.decoding.own_code`).
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from characterisation.files.checked_files import read_bounded
from characterisation.files.documents import Document
from characterisation.files.errors import InputError
from characterisation.words.progress import say
from mitsim.sensor.matcher import MatcherSettings
from mitsim.sensor.png import decode_png

Pattern = TypeVar("Pattern")

#: largest number of images: they take a kernel that grows with them (20 s for 128)
MOST_IMAGES = 256

#: largest number of pixels of all images, which take 2 GB in single precision
MOST_VALUES = 500_000_000


class ImageFolder(Document):
    """Images of one's own in the sensor file: the PNG files of a ``folder``, relative to the sensor file."""

    kind: Literal["images"]
    folder: str = Field(min_length=1, max_length=1000)


class ImagesDescription(Document):
    """What a capture says of own images: how many, and the SHA-256 of their values."""

    kind: Literal["images"]
    count: int = Field(ge=1, le=MOST_IMAGES)
    sha256: str = Field(pattern="^[0-9a-f]{64}$")


@dataclass(frozen=True)
class ProjectorImages:
    """Images of a projector, one for each image of a measurement. Equal images are equal, wherever they come from.

    ``values`` (P, H, W) in projector pixels: floats 0..1 relative to white, or uint8 or uint16 of which the largest
    number is white.
    """

    values: NDArray[Any] = field(repr=False, compare=False)
    count: int
    sha256: str
    kind: Literal["images"] = "images"

    @classmethod
    def of(cls, values: NDArray[Any]) -> ProjectorImages:
        """Describe checked images."""
        digest = hashlib.sha256(str(values.shape).encode())
        for image in values:
            digest.update(_relative(image).tobytes())
        return cls(values, len(values), digest.hexdigest())

    @property
    def frames(self) -> int:
        """Return the number of images of a measurement, as of a pattern of dots."""
        return self.count

    @property
    def description(self) -> ImagesDescription:
        """Return the description of the images that a capture keeps."""
        return ImagesDescription(kind=self.kind, count=self.count, sha256=self.sha256)

    def patterns(self) -> NDArray[np.float32]:
        """Return the images (P, H, W), values 0..1."""
        return _relative(self.values)


def described(pattern: Pattern | ProjectorImages) -> Pattern | ImagesDescription:
    """Return a pattern as a capture states it: own images by their description."""
    return pattern.description if isinstance(pattern, ProjectorImages) else pattern


def checked_images(images: ArrayLike, width: int, height: int, where: str) -> ProjectorImages:
    """Return images as the pattern of a projector.

    ``images``: (P, H, W), or (H, W) for one: uint8, uint16 or bool, or floats 0..1. ``width``, ``height``: of the
    projector [px]. ``where``: what names the images in messages. Raises InputError if they have another size or type,
    are too many, or a value is not between 0 and 1.
    """
    values = np.asarray(images)
    if values.ndim == 2:
        values = values[None]
    if values.ndim != 3 or values.shape[1:] != (height, width) or not len(values):
        hint = "one value for each projector pixel: change the images, or width and height of [projector]"
        raise InputError(where, "images", f"shape {values.shape}", f"(images, {height}, {width})", hint)
    if len(values) > MOST_IMAGES or values.size > MOST_VALUES:
        found = f"{len(values)} images of {width} x {height} px"
        raise InputError(where, "images", found, f"up to {MOST_IMAGES} images and {MOST_VALUES:,} pixels in all")
    if values.dtype == np.bool_:
        values = values.astype(np.float32)
    if values.dtype not in (np.uint8, np.uint16, np.float32, np.float64):
        allowed = "uint8 or uint16, whose largest number is white, or floats 0 to 1"
        raise InputError(where, "images", f"values of {values.dtype}", allowed)
    if values.dtype.kind == "f":
        if not (values.min() >= 0 and values.max() <= 1):  # false for NaN, too
            raise InputError(where, "images", f"{values.min():g} to {values.max():g}", "values from 0 to 1, white")
        values = values.astype(np.float32)
    return ProjectorImages.of(np.array(values))  # a copy: the caller may change the array


def allowed_images(
    pattern: ProjectorImages, technology: str, matcher: MatcherSettings | None, where: str
) -> ProjectorImages:
    """Return images of the user's own, checked against what a sensor can project and decode.

    ``pattern``: the images. ``technology``, ``matcher``: of the sensor. ``where``: what names the images in messages.
    Raises InputError if the technology has a pattern of its own, or the matcher takes one image only.
    """
    if technology == "time_of_flight":
        raise InputError(where, "pattern", f"images, for {technology}", "images for sensors that project a pattern")
    if technology == "reference_stereo" and pattern.count > 1:
        raise InputError(where, "pattern", f"{pattern.count} images, for {technology}", "one, the mask of its dots")
    if pattern.count > 1 and matcher is not None and matcher.method == "sgbm":
        hint = 'set method = "correlation" in [matcher], which matches all images at once, or "census"'
        raise InputError(where, "pattern", f"{pattern.count} images, for matcher.method {matcher.method}", "one", hint)
    return pattern


def read_images(folder: Path, width: int, height: int) -> ProjectorImages:
    """Read a folder's PNG files by the numbers in their names; InputError if none, damaged, or of unequal kinds."""
    if not folder.is_dir():
        raise InputError(folder, "", "no such folder", "a folder of PNG images, relative to the sensor file")
    paths = sorted((path for path in folder.iterdir() if path.suffix.lower() == ".png"), key=counted)
    if not paths:
        raise InputError(folder, "", "no PNG image", f"images of {width} x {height} px, as the projector has")
    if len(paths) > MOST_IMAGES or len(paths) * width * height > MOST_VALUES:
        found = f"{len(paths)} images of {width} x {height} px"
        raise InputError(folder, "", found, f"up to {MOST_IMAGES} images and {MOST_VALUES:,} pixels in all")
    if gap := gap_in(paths):
        say(f"{folder}: {gap} among {len(paths)} images")
    images = [decode_png(read_bounded(path), path) for path in paths]
    for path, image in zip(paths, images, strict=True):
        if image.shape != (height, width):
            found = f"{image.shape[1]} x {image.shape[0]} px"
            raise InputError(path, "size", found, f"{width} x {height} px, as [projector] of the sensor file has")
        if image.dtype != images[0].dtype:
            found, allowed = (f"{8 * array.itemsize} bits" for array in (image, images[0]))
            raise InputError(path, "depth", found, f"{allowed}, as {paths[0].name}")
    return checked_images(np.stack(images), width, height, str(folder))


def counted(path: Path) -> tuple[Any, ...]:
    """Return a key that sorts names with numbers by value: ``image_2.png`` before ``image_10.png``."""
    parts = re.split(r"(\d+)", path.as_posix().lower())
    return tuple((int(part), "") if part.isascii() and part.isdigit() else (-1, part) for part in parts)


def gap_in(files: Sequence[Path]) -> str:
    """Return which numbers are missing in a series of files whose names differ in their last number; empty if none.

    If at least as many numbers are missing as there are files, they are no count.
    """
    matches = [re.fullmatch(r"(.*?)(\d+)(\D*)", path.name) for path in files]
    numbers = sorted({int(match.group(2)) for match in matches if match})
    if len(numbers) < len(files) or not numbers or not 0 < numbers[-1] - numbers[0] + 1 - len(numbers) < len(numbers):
        return ""
    gaps = sorted(set(range(numbers[0], numbers[-1] + 1)) - set(numbers))
    return f"number {', '.join(map(str, gaps[:5]))} is missing"


def _relative(values: NDArray[Any]) -> NDArray[np.float32]:
    """Return values relative to white."""
    if values.dtype.kind == "f":
        return np.asarray(values, np.float32)
    return np.asarray(values / np.float32(np.iinfo(values.dtype).max), np.float32)
