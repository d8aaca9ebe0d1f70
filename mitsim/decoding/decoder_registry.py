"""Register how the captures of each technology become clouds: one entry of :data:`TECHNOLOGIES` for each.

An entry has two functions. One prepares the geometry of a rig once, the other
decodes images to a cloud. The first four technologies decode raw images. For the last three the device has measured a
map, which is converted.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from characterisation.files.errors import InputError
from characterisation.point_cloud import PointCloud
from characterisation.region_of_interest import Roi
from mitsim.capture.capture import Capture
from mitsim.capture.decoding import SETTINGS_OF, Settings
from mitsim.decoding.device_maps import (
    DeviceMapGeometry,
    MapName,
    camera_map_geometry,
    decode_device_map,
    disparity_map_geometry,
)
from mitsim.decoding.grey_levels import MeasuredNoise
from mitsim.decoding.grid_cloud import empty_cloud
from mitsim.decoding.image_context import ImageContext
from mitsim.decoding.matching.reference_matching import (
    ReferenceGeometry,
    decode_reference,
    reference_geometry,
    unknown_mask,
)
from mitsim.decoding.matching.stereo import decode_stereo
from mitsim.decoding.matching.stereo_geometry import StereoGeometry, stereo_geometry
from mitsim.decoding.structured_light.decoder import decode_structured_light
from mitsim.decoding.structured_light.geometry import StructuredLightGeometry, structured_light_geometry
from mitsim.decoding.structured_light.projector_coordinate import ProjectorCoordinate
from mitsim.decoding.structured_light.smoothing import smoothed_along_rays
from mitsim.decoding.structured_light.two_cameras import decode_structured_light_stereo
from mitsim.decoding.time_of_flight import TimeOfFlightGeometry, decode_time_of_flight, time_of_flight_geometry
from mitsim.sensor.camera import Rig
from mitsim.sensor.decoder_settings import DecoderSettings
from mitsim.sensor.image_role import Axis
from mitsim.sensor.imager import Imager
from mitsim.sensor.light_code import LightCode, axes, has_fringes, roles
from mitsim.sensor.matcher import MatcherSettings
from mitsim.sensor.modulation import AmplitudeModulation, TimeOfFlightSettings
from mitsim.sensor.pattern import DotPattern
from mitsim.sensor.projector_images import ImagesDescription, ProjectorImages

#: range of depths to search if neither a preset nor the recording gives one [mm]
DEFAULT_RANGE_MM = (300.0, 2000.0)

#: range of depths to accept from a device's own map if none is given: everything [mm]
DEVICE_RANGE_MM = (1e-3, 1e6)

Geometry = StereoGeometry | ReferenceGeometry | StructuredLightGeometry | TimeOfFlightGeometry | DeviceMapGeometry
Pattern = DotPattern | LightCode | AmplitudeModulation | ProjectorImages | ImagesDescription

#: projector coordinates of structured light, of whole images, by camera and axis
Coordinates = Mapping[str, Mapping[Axis, ProjectorCoordinate]]


@dataclass(frozen=True)
class Images:
    """The images of a capture, ready to be decoded."""

    capture: Capture  # the capture
    #: (P, H, W) images [DN] of each camera, that of the reference camera first. Exposures of a bracket are merged
    stacks: dict[str, NDArray[np.unsignedinteger[Any]]]
    full_scale: float  # value of a saturated pixel [DN]
    imager: Imager | MeasuredNoise | None  # the imager, or the noise measured in the images; None if neither is known
    roi: Roi | None  # region of the cloud's grid to decode; None for all
    read_out: dict[str, Roi]  # region that was read out of each camera, without cameras that were read out completely
    #: projector coordinates that structured light was decoded to before; None if it is not decoded yet
    coordinates: Coordinates | None = None
    share: float = 1.0  # as in :class:`mitsim.decoding.image_context.ImageContext`

    @property
    def reference(self) -> tuple[str, NDArray[np.unsignedinteger[Any]]]:
        """Name and stack of the reference camera. Raises InputError if it has no images."""
        (name,) = self._first(1)
        return name, self.stacks[name]

    def pair(self) -> tuple[str, str]:
        """Return the names of the two cameras that are matched. Raises InputError if one of them has no images."""
        first, second = self._first(2)
        return first, second

    def _first(self, count: int) -> list[str]:
        names = list(self.capture.rig.cameras)[:count]
        if missing := [name for name in names if name not in self.stacks]:
            found, allowed = f"none of {', '.join(missing)}", f"images of {' and '.join(names)}"
            raise InputError("capture", "images", found, allowed)
        return names

    def context(self, roi: Roi | None) -> ImageContext:
        """Return the properties of the images for a decoder of a region of the cloud's grid; None for the whole."""
        regions = [self.read_out.get(name) for name in list(self.stacks)[:2]]
        read_out = (regions[0], regions[-1] if len(regions) > 1 else None)
        capture = self.capture
        return ImageContext(capture.sensor, capture.source, self.full_scale, self.imager, roi, read_out, self.share)

    def raw_region(self) -> tuple[Roi | None, bool]:
        """Return the region of the reference camera's raw image to decode, and whether any of it was read out."""
        region = self.read_out.get(self.reference[0])
        if region is None or self.roi is None:
            return region or self.roi, True
        overlap = region.overlap(self.roi)
        return overlap, overlap is not None

    def first_images(self, count: int, camera: str | None = None) -> NDArray[np.unsignedinteger[Any]]:
        """Return the first ``count`` images of a camera, by default the reference; InputError if there are fewer."""
        name = camera or self.reference[0]
        stack = self.stacks[name]
        if len(stack) < count:
            raise InputError("capture", "images", f"{len(stack)} of {name}", f"{count}, as the pattern has")
        return stack[:count]


@dataclass(frozen=True)
class Technology:
    """How the captures of one kind of sensor become clouds."""

    #: kinds of pattern that a capture must name; empty if the decoder does not need one
    patterns: tuple[type[Pattern], ...]
    #: function from rig, settings and pattern to the geometry that is prepared once
    geometry: Callable[[Rig, Any, Any], Geometry]
    #: function from images, geometry, settings and pattern to a cloud
    decode: Callable[[Images, Any, Any, Any], PointCloud]
    range_mm: tuple[float, float] = DEFAULT_RANGE_MM  # default range of depths to search [mm]
    #: whether the device has measured the points. Of a sensor's settings only the range is then used
    from_device: bool = False


def _stereo(images: Images, geometry: StereoGeometry, settings: MatcherSettings, pattern: None) -> PointCloud:
    # the ambient image is the last one; SGBM uses one frame
    ambient = images.capture.decoding.ambient_image
    left, right = (images.stacks[name][: len(images.stacks[name]) - ambient] for name in images.pair())
    if settings.method == "sgbm":
        left, right = left[:1], right[:1]
    return decode_stereo(left, right, geometry, settings, images.context(images.roi))


def _reference_geometry(
    rig: Rig, settings: MatcherSettings, pattern: DotPattern | ProjectorImages | ImagesDescription
) -> ReferenceGeometry:
    if isinstance(pattern, ImagesDescription):
        raise unknown_mask()
    if settings.reference_mm is None:
        raise InputError(
            "matcher settings",
            "reference_mm",
            "none",
            "the depth of the reference plane",
            "decode with the sensor's own file: --sensor",
        )
    return reference_geometry(rig, pattern, settings.reference_mm)


def _reference(
    images: Images, geometry: ReferenceGeometry, settings: MatcherSettings, pattern: DotPattern | ImagesDescription
) -> PointCloud:
    # a capture states the mask of the device that took it, which the device knows
    return decode_reference(images.first_images(1), geometry.showing(pattern), settings, images.context(images.roi))


def projector_size(capture: Capture) -> tuple[int, int]:
    """Return the width and height of the pattern of a structured-light capture [px].

    Raises InputError if the capture has neither a projector nor its size.
    """
    projector = capture.rig.projector
    if projector is not None:
        return projector.width, projector.height
    size = capture.decoding.projector_size_px
    if size is None:
        raise InputError("rig", "projector", "none", "a projector, or at least the size of its pattern")
    return size


def _structured_light_geometry(rig: Rig, settings: DecoderSettings, code: LightCode) -> Geometry:
    if settings.triangulate == "cameras":
        return stereo_geometry(rig)
    return structured_light_geometry(rig, next(iter(rig.cameras)), code, settings.near_mm, settings.far_mm)


def _structured_light(
    images: Images, geometry: StereoGeometry | StructuredLightGeometry, settings: DecoderSettings, code: LightCode
) -> PointCloud:
    unsmoothed = _structured_light_cloud(images, geometry, settings, code)
    cloud = smoothed_along_rays(unsmoothed, settings.smoothing_px)
    if cloud.sigma is not None and not any(has_fringes(code, axis) for axis in axes(code)):
        return replace(cloud, sigma=unsmoothed.sigma)  # the errors of a Gray code are those of whole stripes
    in_imager = isinstance(images.imager, Imager) and images.imager.smoothing_px > 0
    # one alone averages independent pixels; two, neighbours that share pixels: their mean has more noise
    averaged = (isinstance(geometry, StereoGeometry), in_imager, settings.smoothing_px > 0)
    return replace(cloud, sigma=None) if sum(averaged) > 1 else cloud


def _structured_light_cloud(
    images: Images, geometry: StereoGeometry | StructuredLightGeometry, settings: DecoderSettings, code: LightCode
) -> PointCloud:
    size, coordinates = projector_size(images.capture), images.coordinates or {}
    count = len(roles(code, *size))
    if isinstance(geometry, StereoGeometry):
        names, context = images.pair(), images.context(images.roi)
        first, second = (images.first_images(count, name) for name in names)
        before = [coordinates[name] for name in names] if coordinates else None
        return decode_structured_light_stereo((first, second), geometry, code, settings, size, context, before)
    stack = images.first_images(count)
    roi, any_read_out = images.raw_region()
    if not any_read_out:
        return empty_cloud(geometry, images.capture.sensor, images.capture.source)
    decoded = coordinates.get(images.reference[0])
    return decode_structured_light(stack, geometry, code, settings, images.context(roi), decoded)


def _time_of_flight(
    images: Images, geometry: TimeOfFlightGeometry, settings: TimeOfFlightSettings, code: AmplitudeModulation
) -> PointCloud:
    stack = images.first_images(code.count)
    roi, any_read_out = images.raw_region()
    if not any_read_out:
        return empty_cloud(geometry, images.capture.sensor, images.capture.source)
    return decode_time_of_flight(stack, geometry, code, settings, images.context(roi))


def _device_technology(name: MapName, prepare: Callable[[Rig], DeviceMapGeometry]) -> Technology:
    """Return the technology of a device's map ``name``, within the range of any settings."""

    def decode(images: Images, geometry: DeviceMapGeometry, settings: Settings, pattern: None) -> PointCloud:
        capture = images.capture
        if name not in capture.derived:
            raise InputError(
                f"capture of {capture.sensor}",
                "derived",
                ", ".join(capture.derived) or "no map",
                f"a map of {name}, since its technology is {capture.technology}",
            )
        return decode_device_map(
            name,
            capture.derived[name],
            geometry,
            (settings.near_mm, settings.far_mm),
            sensor=capture.sensor,
            source=capture.source,
            roi=images.roi,
        )

    return Technology((), lambda rig, settings, pattern: prepare(rig), decode, DEVICE_RANGE_MM, True)


TECHNOLOGIES: dict[str, Technology] = {
    "active_stereo": Technology((), lambda rig, settings, pattern: stereo_geometry(rig), _stereo),
    "reference_stereo": Technology(
        (*get_args(DotPattern), ProjectorImages, ImagesDescription), _reference_geometry, _reference
    ),
    "structured_light": Technology(
        get_args(LightCode),
        _structured_light_geometry,
        _structured_light,
    ),
    "time_of_flight": Technology(
        (AmplitudeModulation,),
        lambda rig, settings, code: time_of_flight_geometry(rig, settings.near_mm, settings.far_mm),
        _time_of_flight,
    ),
    "depth_map": _device_technology("depth", camera_map_geometry),
    "disparity_map": _device_technology("disparity", disparity_map_geometry),
    "point_map": _device_technology("points", camera_map_geometry),
}


def technology_of(name: str) -> Technology:
    """Return the entry of a technology. Raises InputError if there is none of this name."""
    if name not in TECHNOLOGIES:
        raise InputError("capture", "technology", repr(name), ", ".join(TECHNOLOGIES))
    return TECHNOLOGIES[name]


def accepted_settings(name: str) -> tuple[type[Settings], ...]:
    """Return the types of settings that a technology decodes with; a device's map uses only the range of any."""
    return get_args(Settings) if technology_of(name).from_device else (SETTINGS_OF[name],)
