"""Load a sensor from one TOML file: its parts, its exposure and its decoder.

``load_sensor("ensenso-n10")`` loads a preset of this package, ``load_sensor("my.toml")`` a file of the user's. The
file's tables are in :mod:`mitsim.sensor.sensor_file`. ``load_sensor("rig.toml", "decoding")`` also loads a file that
only describes a rig whose images exist; :meth:`Sensor.missing_for` names the keys that it lacks for other purposes.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from characterisation.files.documents import Document, Name, missing_error, missing_keys, read_toml_table, validate
from characterisation.files.errors import InputError, nearest
from mitsim.running.progress import say
from mitsim.sensor.camera import Camera, Rig
from mitsim.sensor.decoder_settings import DecoderSettings
from mitsim.sensor.exposure import ExposurePolicy, exposure_policy
from mitsim.sensor.imager import Imager, electrons_per_radiance
from mitsim.sensor.lens_keys import with_lenses
from mitsim.sensor.light_code import LightCode, patterns, roles
from mitsim.sensor.matcher import MatcherSettings
from mitsim.sensor.modulation import AmplitudeModulation, TimeOfFlightSettings
from mitsim.sensor.opencv_calibration import with_calibration
from mitsim.sensor.pattern import DotPattern, dot_frames
from mitsim.sensor.projector import Projector
from mitsim.sensor.projector_images import ImageFolder, ProjectorImages, allowed_images, checked_images, read_images
from mitsim.sensor.published_lengths import PublishedAccuracy, PublishedLengths
from mitsim.sensor.published_noise import PublishedNoise
from mitsim.sensor.rig_parameters import moved
from mitsim.sensor.sensor_file import (
    MisalignmentTable,
    Purpose,
    RoomTable,
    SensorFile,
    absent_keys,
    needed_keys,
    with_depths,
)
from mitsim.sensor.unknowns import UnknownsTable, unknowns_of


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
    - ``room`` light and ``misalignment`` of one unit in its place, fitted to captures by ``mitsim fit sensor``.
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
        >>> capture = ms.render(scene, sensor.with_patterns(dots), ms.look_at((0, -300, 400)), samples=2, depth=1)
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


def presets() -> list[str]:
    """Return the names of the sensors that come with the package."""
    folder = files("mitsim.sensor") / "presets"
    return sorted(p.name.removesuffix(".toml") for p in folder.iterdir() if p.name.endswith(".toml"))


def load_sensor(name: str | Path, purpose: Purpose = "simulation", size: tuple[int, int] | None = None) -> Sensor:
    """Load a preset by name, or a sensor TOML file by path.

    Parameters
    ----------
    name
        Of a preset, or path of a file.
    purpose
        What the sensor is for. Only for ``simulation`` warnings about the calibration are printed; for others they are
        in ``notes``.
    size
        (width, height) [px] of images, if known. It tells whether they show a part of the calibrated imager, and is
        the size of cameras without one: OpenCV's pair of ``intrinsics.yml`` and ``extrinsics.yml`` has none.

    Raises
    ------
    InputError
        For an unknown name, or a file that does not describe a sensor. The error names all keys that the purpose needs
        and the file lacks.
    """
    path, written = _written_table(name)
    table, notes = with_calibration(path, with_lenses(path, written), size)
    sensor = _sensor_of(path, table, purpose, tuple(notes))
    if purpose == "simulation":
        for note in notes:
            say(f"warning: {note}")
    sensor.require(purpose, path)
    return sensor


def named_sensor(name: str | Path) -> tuple[str, str]:
    """Return name and technology of a preset or sensor file. Nothing else is checked; its calibration is not read.

    Raises
    ------
    InputError
        For an unknown name, or a file that cannot be read or lacks one of the two.
    """
    path, table = _written_table(name)
    if not {"name", "technology"} <= set(table):
        # the unread calibration may contain these keys
        held = ("cameras", "projector") if "calibration" in table else ("\0",)
        raise missing_error(path, [key for key in _lacking(table, "decoding") if not key.startswith(held)])
    named = validate(path, {key: table[key] for key in ("name", "technology")}, _Named)
    return named.name, named.technology


def _written_table(name: str | Path) -> tuple[Path, dict[str, Any]]:
    """Return the path of a preset or sensor file, and its table as written."""
    path = Path(name)
    if path.suffix != ".toml":
        if str(name) not in presets():
            allowed = f"{', '.join(presets())}, or the path of a .toml file"
            raise InputError("--sensor", "", repr(str(name)), allowed, nearest(str(name), presets()))
        path = Path(str(files("mitsim.sensor") / "presets" / f"{name}.toml"))
    return path, read_toml_table(path)


def _lacking(table: dict[str, Any], purpose: Purpose) -> list[str]:
    """Return the keys that a sensor file's table lacks for a purpose, including those that every file has."""
    absent = absent_keys(table, needed_keys(table, purpose))
    return list(dict.fromkeys([*missing_keys(with_depths(table), SensorFile), *absent]))


def _sensor_of(path: Path, written: dict[str, Any], purpose: Purpose, notes: tuple[str, ...]) -> Sensor:
    """Make a sensor from the table of its file, which has at least what decoding needs."""
    try:
        table = validate(path, with_depths(written), SensorFile)
    except InputError as error:
        raise (missing_error(path, _lacking(written, purpose)) if error.found == "nothing" else error) from None
    if absent_keys(written, needed_keys(written, "decoding")):
        raise missing_error(path, _lacking(written, purpose))
    near, far = table.working_range_mm
    if near >= far:
        raise InputError(path, "working_range_mm", f"[{near:g}, {far:g}]", "near before far")
    absent = absent_keys(written, needed_keys(written, "simulation"))
    if absent:  # the bits of a complete imager have a default
        absent += absent_keys(written, needed_keys(written, "bits"))
    return _assemble(path, table, frozenset(absent), notes)


class _Named(Document):
    name: Name
    technology: str


def _assemble(path: Path, table: SensorFile, missing: frozenset[str], notes: tuple[str, ...]) -> Sensor:
    cameras = {name: optics.camera() for name, optics in table.cameras.items()}
    keys, written = table.projector, table.imager
    projector = Projector(
        keys.camera(),
        keys.flux_w,
        black_level=keys.black_level,
        gamma=keys.gamma,
        aperture_mm=keys.aperture_mm,
        focus_mm=keys.focus_mm,
        corner_illumination=keys.corner_illumination,
        pixel_gap=keys.pixel_gap,
    )
    imager = Imager(**{each.name: getattr(written, each.name) for each in fields(Imager)})
    calibrated = not missing & {"projector.focal_px", "projector.principal_px"}
    return Sensor(
        name=table.name,
        technology=table.technology,
        wavelength_nm=table.wavelength_nm,
        linewidth_nm=keys.linewidth_nm,
        working_range_mm=table.working_range_mm,
        rig=Rig(cameras, projector.optics if calibrated else None),
        projector=projector,
        imager=imager,
        focus_mm=written.focus_mm,
        pattern=_pattern(path, table, projector),
        exposure=exposure_policy(path, table.exposure, projector, imager, table.wavelength_nm),
        ambient_image=table.ambient_image,
        matcher=table.matcher,
        decoder=table.decoder,
        demodulation=table.demodulation,
        published_noise=tuple(table.published_noise),
        published_lengths=table.published_lengths,
        published_accuracy=table.published_accuracy,
        images=table.images,
        unknowns=_unknowns(path, table),
        room=table.room,
        misalignment=table.misalignment,
        missing=missing,
        notes=notes,
    )


def _pattern(
    path: Path, table: SensorFile, projector: Projector
) -> DotPattern | LightCode | ProjectorImages | AmplitudeModulation | None:
    """Return the pattern of a sensor file; the folder of own images is relative to the file."""
    pattern, optics = table.pattern, projector.optics
    if not isinstance(pattern, ImageFolder):
        return pattern
    if not optics.width:  # a rig of two cameras, which match images of any projector
        return None
    images = read_images(path.parent / pattern.folder, optics.width, optics.height)
    return allowed_images(images, table.technology, table.matcher, str(path))


def _unknowns(path: Path, table: SensorFile) -> UnknownsTable:
    """Return the unknowns of a sensor file; the path of a covariance is relative to the file."""
    covariance = table.unknowns.calibration.covariance
    if covariance is None:
        return table.unknowns
    return unknowns_of(
        table.unknowns,
        UnknownsTable.model_validate({"calibration": {"covariance": str((path.parent / covariance).absolute())}}),
    )
