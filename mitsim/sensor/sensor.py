"""Describe a sensor: its rig, projector, imager, pattern, exposure rule and decoder.

:func:`mitsim.sensor.preset.load_sensor` makes one of a TOML file.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from characterisation.files.documents import missing_error
from characterisation.files.errors import InputError
from mitsim.sensor.camera import Camera, Rig
from mitsim.sensor.decoder_settings import DecoderSettings
from mitsim.sensor.exposure import ExposurePolicy
from mitsim.sensor.fitted_to import FittedCapture
from mitsim.sensor.imager import Imager, electrons_per_radiance
from mitsim.sensor.light_code import LightCode, patterns, roles
from mitsim.sensor.matcher import MatcherSettings
from mitsim.sensor.modulation import AmplitudeModulation, TimeOfFlightSettings
from mitsim.sensor.pattern import DotPattern, dot_frames
from mitsim.sensor.projector import Projector
from mitsim.sensor.projector_images import ProjectorImages, allowed_images, checked_images
from mitsim.sensor.published_figures import PublishedAccuracy, PublishedLengths, PublishedNoise
from mitsim.sensor.rig_parameters import moved
from mitsim.sensor.sensor_file import MisalignmentTable, Purpose, RoomTable, needed_keys
from mitsim.sensor.unknowns import UnknownsTable


@dataclass(frozen=True)
class Sensor:
    """A sensor. Parts that its file may leave out have unknown values, and :meth:`missing_for` names their keys.

    - ``wavelength_nm``, ``working_range_mm``, the flux of the projector and numbers of the imager: NaN if unknown.
    - ``rig``: without a projector if that is not calibrated; ``projector.optics`` then has only a size, or 0 px.
    - ``pattern``: None if unknown.
    - ``linewidth_nm`` of its light; None if unknown, which disables speckle.
    - ``focus_mm`` of the cameras' lenses; None for pinholes.
    - ``ambient_image``: one additional image with the projector off.
    - ``matcher``, ``decoder`` or ``demodulation``: settings of the technology's decoder.
    - ``images`` of each camera in a folder of recordings, as file names or one pattern; None if the folder's names
      suffice.
    - ``unknowns`` of this type of sensor.
    - ``room`` light and ``misalignment`` of one unit in its place, fitted to captures by ``mitsim fit sensor``;
      ``fitted_to`` lists these captures.
    - ``missing``: keys that any purpose needs and the file leaves out.
    - ``notes``: warnings about the calibration.
    """

    name: str
    technology: str
    wavelength_nm: float
    linewidth_nm: float | None
    working_range_mm: tuple[float, float]
    rig: Rig
    projector: Projector
    imager: Imager
    focus_mm: float | None
    pattern: DotPattern | LightCode | ProjectorImages | AmplitudeModulation | None
    exposure: ExposurePolicy
    ambient_image: bool
    matcher: MatcherSettings | None
    decoder: DecoderSettings | None
    demodulation: TimeOfFlightSettings | None = None
    published_noise: tuple[PublishedNoise, ...] = field(default=(), repr=False)
    published_lengths: PublishedLengths | None = field(default=None, repr=False)
    published_accuracy: PublishedAccuracy | None = field(default=None, repr=False)
    images: dict[str, str | list[str]] | None = None
    unknowns: UnknownsTable = field(default=UnknownsTable(), repr=False)
    room: RoomTable | None = field(default=None, repr=False)
    misalignment: MisalignmentTable = field(default=MisalignmentTable(), repr=False)
    fitted_to: tuple[FittedCapture, ...] = field(default=(), repr=False)
    missing: frozenset[str] = field(default=frozenset(), repr=False)
    notes: tuple[str, ...] = field(default=(), repr=False)

    def missing_for(self, purpose: Purpose) -> tuple[str, ...]:
        """Return the keys of the sensor file that a purpose needs and the file lacks, as ``imager.pixel_um``.

        ``purpose``: ``simulation``, ``decoding``, ``noise`` (that of images, from the imager's description) or
        ``bits`` (of images).
        """
        table = {"technology": self.technology, "decoder": {"triangulate": self.decoder and self.decoder.triangulate}}
        return tuple(key for key in needed_keys(table, purpose) if key in self.missing)

    def require(self, purpose: Purpose, where: str | Path = "") -> None:
        """Check that the sensor has all that a purpose needs.

        Raises
        ------
        InputError
            If not; it names all missing keys, and ``where`` or the sensor.
        """
        missing = self.missing_for(purpose)
        if missing:
            raise InputError(
                where or f"sensor {self.name}",
                ", ".join(missing),
                "nothing",
                f"a value for each: {purpose} needs them",
                "the file describes a recorded rig: mitsim import and mitsim decode accept it",
            )

    @property
    def described_imager(self) -> Imager | None:
        """Return the imager; None if its description lacks a number that the noise of images needs."""
        return None if self.missing_for("noise") else self.imager

    @property
    def bits(self) -> int | None:
        """Return the bits of the images; None if the file states neither them nor all that simulation needs."""
        return None if self.missing_for("bits") else self.imager.bits

    @property
    def range_mm(self) -> tuple[float, float] | None:
        """Return the depths that the file states: the working range, else those of its decoder; None without both."""
        if "working_range_mm" not in self.missing:
            return self.working_range_mm
        stated = not any(key.endswith((".near_mm", ".far_mm")) for key in self.missing)
        return (self.settings.near_mm, self.settings.far_mm) if stated else None

    @property
    def settings(self) -> MatcherSettings | DecoderSettings | TimeOfFlightSettings:
        """Return the settings of this technology's decoder."""
        settings = self.matcher or self.decoder or self.demodulation
        assert settings is not None  # checked when the file is read
        return settings

    @property
    def merges_exposures(self) -> bool:
        """Return whether exposures can be merged into one image of a wider range; needs levels linear in light."""
        return self.technology != "time_of_flight" and not self.imager.companding

    @property
    def measuring_rig(self) -> Rig:
        """Return the rig with only the cameras that measure a point; a second one may serve another decoder."""
        matched = self.decoder is not None and self.decoder.triangulate == "cameras"
        pair = matched or self.technology == "active_stereo"
        cameras = dict(list(self.rig.cameras.items())[: 2 if pair else 1])
        return replace(self.rig, cameras=cameras)

    @property
    def measuring_eyes(self) -> dict[str, Camera]:
        """Return the cameras that measure, reference first, and as ``projector`` the projector if the decoder uses it.

        A calibration estimates these.
        """
        rig = self.measuring_rig
        seen = dict(rig.cameras)
        if len(seen) == 1 and self.technology in ("structured_light", "reference_stereo"):
            assert rig.projector is not None
            seen["projector"] = rig.projector
        return seen

    @property
    def true_rig(self) -> Rig:
        """Return the true rig; ``rig`` is the calibrated one, which the decoder uses."""
        return self.misaligned(self.rig)

    def misaligned(self, rig: Rig) -> Rig:
        """Return a rig with its second camera rotated relative to its calibration."""
        off = self.misalignment
        if len(rig.cameras) < 2 or (off.row_mrad == 0 and off.roll_mrad == 0):
            return rig
        second = list(rig.cameras)[1]
        names = (f"{second}.rotation_x_rad", f"{second}.rotation_z_rad")
        return moved(rig, names, (1e-3 * off.row_mrad, 1e-3 * off.roll_mrad))

    def room_irradiance(self, rays: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the room's irradiance (...) [W/mm^2] along view rays (..., 3) from the origin of the sensor frame."""
        if self.room is None:
            return np.zeros(rays.shape[:-1])
        x, y = np.moveaxis(rays[..., :2] / rays[..., 2:], -1, 0)
        share = 1 + np.stack([x, y, x * x, x * y, y * y], axis=-1) @ [*self.room.gradient, *self.room.curvature]
        return np.asarray(self.room.irradiance_w_mm2 * np.maximum(share, 0.0))

    @property
    def frames(self) -> int:
        """Return the number of images of one measurement with light of the projector."""
        optics, pattern = self.projector.optics, self.pattern
        if pattern is None:
            raise missing_error(f"sensor {self.name}", ["pattern"])
        if isinstance(pattern, AmplitudeModulation):
            return pattern.count
        if isinstance(pattern, DotPattern | ProjectorImages):
            return pattern.frames
        return len(roles(pattern, optics.width, optics.height))

    def patterns(self) -> NDArray[np.float32]:
        """Return all patterns of one measurement, (P, H, W), values 0..1 in projector pixels.

        A time-of-flight sensor has none: its light is modulated in time, not in space.
        """
        optics, pattern = self.projector.optics, self.pattern
        if pattern is None:
            raise missing_error(f"sensor {self.name}", ["pattern"])
        if isinstance(pattern, DotPattern):
            return dot_frames(pattern, optics.width, optics.height)
        if isinstance(pattern, ProjectorImages):
            return pattern.patterns()
        if isinstance(pattern, AmplitudeModulation):
            return np.empty((0, optics.height, optics.width), np.float32)
        return patterns(pattern, optics.width, optics.height)

    def with_patterns(self, images: ArrayLike) -> Sensor:
        """Return this sensor with images of one's own as its pattern: a new code, or another mask of dots.

        Parameters
        ----------
        images
            (P, H, W) in projector pixels, or (H, W) for one image: floats 0 to 1 relative to white, or uint8 or uint16
            of which the largest number is white. A capture has an image of each camera for each of them.

        Returns
        -------
        Sensor
            A sensor of two cameras that match dots decodes its captures as before; several images need
            ``matcher.method = "correlation"``. A structured-light sensor does not know the code: decode
            ``capture.images`` yourself, and triangulate the coordinate with :func:`mitsim.triangulate`.

        Raises
        ------
        InputError
            If the images do not have the projector's size, a value is not between 0 and 1, or the sensor's technology
            needs the pattern of its own.

        Examples
        --------
        >>> import mitsim as ms
        >>> import numpy as np
        >>> sensor = ms.load_sensor("small.toml")
        >>> height, width = sensor.rig.projector.height, sensor.rig.projector.width
        >>> dots = np.random.default_rng(1).random((height, width)) < 0.3
        >>> scene = ms.load_scene("matt_white.xml", sensor)
        >>> sensor, pose = sensor.with_patterns(dots), ms.look_at((0, -300, 400))
        >>> capture = ms.render(scene, sensor, pose, samples=2, depth=1, check=False)
        >>> capture.settings["pattern"]["count"]
        1
        """
        optics = self.projector.optics
        pattern = checked_images(images, optics.width, optics.height, f"patterns of {self.name}")
        return replace(self, pattern=allowed_images(pattern, self.technology, self.matcher, f"sensor {self.name}"))

    def electrons(self) -> float:
        """Return the photo-electrons per unit of radiance and second [e- / (s W mm^-2 sr^-1)]."""
        return electrons_per_radiance(self.imager, self.wavelength_nm, 1.0)

    def pupil_mm(self, camera: Camera) -> float:
        """Return the aperture diameter of a camera's lens [mm]: focal length over f-number."""
        return (
            float(np.sqrt(camera.matrix[0, 0] * camera.matrix[1, 1]))
            * self.imager.pixel_um
            * 1e-3
            / self.imager.f_number
        )
