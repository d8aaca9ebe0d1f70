"""Read a folder of images of any structured-light rig as a capture, with the code and the decoder of a sensor file.

Files are ordered by number: ``image_2.png`` comes before ``image_10.png``. Each page of a TIFF is an image. The sensor
file's ``[pattern]`` describes the images; an ``image_sequence`` lists them in any order.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from characterisation.files.errors import InputError
from characterisation.files.threads import in_threads
from mitsim.capture.capture import Capture
from mitsim.capture.decoding import Decoding
from mitsim.capture.grey_image import (
    CHANNELS,
    SUFFIXES,
    Image,
    bits_of,
    check_image_size,
    from_bit_0,
    is_colour,
    page_count,
    page_labels,
    read_pages,
)
from mitsim.sensor.camera import Camera
from mitsim.sensor.decoder_settings import DecoderSettings
from mitsim.sensor.light_code import LightCode, roles
from mitsim.sensor.projector_images import ProjectorImages, counted, described, gap_in
from mitsim.sensor.sensor import Sensor

Read = TypeVar("Read")


def read_image_folder(folder: str | Path, sensor: Sensor, channel: int = CHANNELS["green"]) -> Capture:
    """Read the images of one measurement.

    Without ``[images]`` in the sensor file, a rig of one camera uses all images in the folder. A rig of two cameras
    uses those in the subfolders named after the cameras, or those whose names begin with the cameras' names. Of colour
    images one ``channel`` is used.
    """
    folder, rig = Path(folder), sensor.rig
    code, decoder = sensor.pattern, sensor.settings
    projector_size = (sensor.projector.optics.width, sensor.projector.optics.height)
    if not isinstance(code, LightCode | ProjectorImages) or not isinstance(decoder, DecoderSettings):
        hint = "recordings of an Ensenso are imported without --sensor"
        raise InputError(f"sensor {sensor.name}", "technology", sensor.technology, "structured_light", hint)
    if not folder.is_dir():
        raise InputError(folder, "", "no such folder", "a folder of images")
    shown = code.count if isinstance(code, ProjectorImages) else len(roles(code, *projector_size))
    count = shown + sensor.ambient_image
    both = len(rig.cameras) == 2 and (decoder.triangulate == "cameras" or len(sensor.images or {}) == 2)
    used = list(rig.cameras) if both else list(rig.cameras)[:1]
    images: dict[str, Image] = {}
    files, names, colour, gaps = dict[str, list[str]](), {}, False, []
    for name in used:
        paths = _files(folder, sensor, name, len(used))
        counts = [page_count(path) for path in paths]
        if sum(counts) != count:
            found = f"{sum(counts)}, {paths[0].name} to {paths[-1].name}" if paths else "0"
            hint = advice_on_number(paths, name, count, sensor.ambient_image) if paths else _content(folder, used)
            raise InputError(folder, f"images of {name}", found, f"{count}, as the pattern of {sensor.name}", hint)
        if (gap := gap_in(paths)) and not isinstance((sensor.images or {}).get(name), list):
            gaps.append(f"images of {name}: {gap}")
        files[name] = _labels(paths, counts)
        images[name] = _stack(paths, counts, rig.cameras[name], channel)
        colour |= is_colour(paths[0])
        names[name] = _labels([path.relative_to(folder).as_posix() for path in paths], counts)
    too_large = sensor.bits is not None and any(int(stack.max()) >= 2**sensor.bits for stack in images.values())
    empty = 0
    if sensor.bits is None or too_large:
        images, empty = from_bit_0(images, sensor.bits)
    if sensor.bits is not None:
        for name, stack in images.items():
            _check_levels(stack, files[name], sensor.bits)
    decoding = Decoding(
        decoder=decoder,
        pattern=described(code),
        projector_size_px=projector_size if rig.projector is None else None,
        exposure_s=None if sensor.exposure.bracket else sensor.exposure.base_s,
        black_level_dn=sensor.imager.black_level,
        gamma=sensor.imager.gamma,
        ambient_image=sensor.ambient_image,
        near_mm=decoder.near_mm,
        far_mm=decoder.far_mm,
    )
    bits = sensor.bits or bits_of(images.values())
    by_levels = "the brightest pixel, since the sensor file has no imager.bits"
    records: dict[str, Any] = {
        "warnings": gaps,
        "channel": list(CHANNELS)[channel] if colour else "",
        "bits_from": by_levels if sensor.bits is None and bits > 8 else "",
        "empty_bits": empty,
    }
    return Capture(
        sensor=sensor.name,
        technology=sensor.technology,
        source="device",
        rig=rig,
        images=images,
        bits=bits,
        decoding=decoding,
        settings={"imported_from": folder.resolve().name, "files": names}
        | {name: value for name, value in records.items() if value},
    )


def at_size_of_images(folder: Path, read: Callable[[tuple[int, int] | None], Read]) -> Read:
    """Return what ``read`` makes of the size (width, height) [px] of a folder's images; of None without images.

    The first size that it accepts counts, since a thumbnail or a picture of the rig may be among the images. Raises
    InputError if it accepts none: its error for the largest.
    """
    faults: dict[tuple[int, int], InputError] = {}
    for size in _sizes(folder):
        try:
            return read(size)
        except InputError as error:
            faults[size] = error
    if faults:
        raise faults[max(faults)]
    return read(None)


def _sizes(folder: Path) -> Iterator[tuple[int, int]]:
    """Yield the size of an image in a folder or its subfolders, for each group of names alike but for their numbers."""
    groups = set[str]()
    for pattern in ("*", "*/*"):
        for path in sorted(folder.glob(pattern), key=counted):
            group = re.sub(r"\d+", "", str(path))
            if group not in groups and path.suffix.lower() in SUFFIXES and path.is_file():
                with suppress(InputError):
                    image = next(read_pages(path, channel=CHANNELS["green"]))
                    groups.add(group)
                    yield image.shape[1], image.shape[0]


def _files(folder: Path, sensor: Sensor, camera: str, cameras: int) -> list[Path]:
    """Return the image files of one camera, in order."""
    entry = (sensor.images or {}).get(camera)
    if isinstance(entry, list):
        missing = [name for name in entry if not (folder / name).is_file()]
        if missing:
            raise InputError(folder, missing[0], "no such file", f"the images listed in [images] of {sensor.name}")
        return [folder / name for name in entry]
    if entry is not None:
        if Path(entry).is_absolute() or ".." in Path(entry).parts:
            raise InputError(f"sensor {sensor.name}", f"images.{camera}", repr(entry), "a pattern inside the folder")
        paths = [path for path in folder.glob(entry) if path.is_file()]
        if not paths:
            hint = f"the folder has: {', '.join(sorted(path.name for path in folder.iterdir())[:6])}"
            raise InputError(folder, f"images.{camera}", f"no file that matches {entry!r}", "images", hint)
        return sorted(paths, key=counted)
    inside = folder / camera if cameras > 1 and (folder / camera).is_dir() else folder
    paths = [path for path in inside.iterdir() if path.suffix.lower() in SUFFIXES and path.is_file()]
    if cameras > 1 and inside == folder:
        paths = [path for path in paths if path.name.startswith(camera)]
    return sorted(paths, key=counted)


def _labels(files: Sequence[Path | str], counts: list[int]) -> list[str]:
    """Return the names of the images in files, with the number of the page in those of several."""
    return [label for file, count in zip(files, counts, strict=True) for label in page_labels(file, count)]


def _stack(files: list[Path], counts: list[int], camera: Camera, channel: int) -> Image:
    """Return the images (P, H, W) of one camera, of which each file has a number in ``counts``."""
    first, labels = next(read_pages(files[0], channel=channel)), _labels(files, counts)
    out = np.empty((len(labels), camera.height, camera.width), first.dtype)

    def read(index: int) -> None:
        for number, image in enumerate(read_pages(files[index], channel=channel), sum(counts[:index])):
            check_image_size(image, (camera.width, camera.height), labels[number], "as the calibration says")
            if image.dtype != first.dtype:
                allowed = f"{first.itemsize * 8}, as {files[0].name}"
                raise InputError(labels[number], "depth", f"{image.itemsize * 8} bits", allowed)
            out[number] = image

    in_threads(read, range(len(files)))
    return out


def _check_levels(stack: Image, files: list[str], bits: int) -> None:
    """Check that images (P, H, W) have the bits that the sensor file states."""
    for image, path in zip(stack, files, strict=True):
        if image.max() > 2**bits - 1:
            hint = "set imager.bits to the camera's output"
            raise InputError(path, "grey level", image.max(), f"0 to {2**bits - 1}, since imager.bits is {bits}", hint)
    if bits > 8 * stack.itemsize:
        hint = "set imager.bits to 8, or save the images with 16 bits"
        raise InputError(files[0], "depth", "8 bits", f"more: imager.bits is {bits}", hint)


def advice_on_number(files: list[Path], camera: str, count: int, ambient_image: bool) -> str:
    """Return advice on images of a camera that are not ``count``: by their names, else on the pattern."""
    if gap := gap_in(files):
        return gap
    shapes = Counter(re.sub(r"\d+", "*", path.name) for path in files)
    for shape, number in shapes.items():
        if number == count < len(files) and "*" in shape:
            strays = [path.name for path in files if re.sub(r"\d+", "*", path.name) != shape]
            return (
                f"{', '.join(strays[:4])} differs in name from the {count} images needed: write "
                f"{camera} = {shape!r} in [images] of the sensor file, or --images {camera}={shape!r}"
            )
    one_more = not ambient_image and len(files) == count + 1
    last = "write ambient_image = true, if the last has no light; or " if one_more else ""
    by_name = f"name the files in [images] of the sensor file, or by --images {camera}='PATTERN'"
    return f"{last}correct [pattern], or {by_name}"


def _content(folder: Path, cameras: list[str]) -> str:
    """Describe the content of a folder without images of a camera, and how to name them."""
    inside = sorted(path.name + "/" * path.is_dir() for path in folder.iterdir())
    there = f"the folder has: {', '.join(inside[:6])}" if inside else "the folder is empty"
    ways = f"name subfolders or files after {', '.join(cameras)}, or " if len(cameras) > 1 else ""
    return f"{there}. {ways}name the files in [images] of the sensor file, or by --images {cameras[0]}='PATTERN'"
