"""Load a sensor from one TOML file: its parts, its exposure and its decoder.

``load_sensor("ensenso-n10")`` loads a preset of this package, ``load_sensor("my.toml")`` a file of the user's. The
file's tables are in :mod:`mitsim.sensor.sensor_file`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import ConfigDict

from characterisation.files.documents import Document, read_toml, validate
from characterisation.files.errors import InputError, nearest
from mitsim.running.progress import say
from mitsim.sensor.camera import Camera, Rig
from mitsim.sensor.decoder_settings import DecoderSettings
from mitsim.sensor.exposure import automatic, bracket
from mitsim.sensor.imager import Imager, electrons_per_radiance
from mitsim.sensor.lens_keys import with_lenses
from mitsim.sensor.light_code import LightCode, patterns
from mitsim.sensor.matcher import MatcherSettings
from mitsim.sensor.modulation import AmplitudeModulation, TimeOfFlightSettings
from mitsim.sensor.opencv_calibration import with_calibration
from mitsim.sensor.pattern import DotPattern, dot_frames
from mitsim.sensor.projector import Projector
from mitsim.sensor.projector_images import ImageFolder, ProjectorImages, checked_images, read_images
from mitsim.sensor.published_noise import PublishedNoise
from mitsim.sensor.recorded_keys import for_recordings, lacking_keys
from mitsim.sensor.rig_parameters import moved
from mitsim.sensor.sensor_file import (
    AutomaticExposure,
    Bracket,
    FixedExposure,
    MisalignmentTable,
    RoomTable,
    SensorFile,
)
from mitsim.sensor.unknowns import UnknownsTable, unknowns_of
from mitsim.sensor.written_imager import imager_of


@dataclass(frozen=True)
class ExposurePolicy:
    """Exposure rule of a sensor.

    - ``rule`` in words.
    - ``base_s``: the exposure; None if it follows the scene by ``control``.
    - ``bracket``: the exposures around it.
    - ``limits_s``: the limits of the device.
    """

    rule: str
    base_s: float | None
    control: AutomaticExposure | None
    bracket: Bracket | None
    limits_s: tuple[float, float]

    def exposures(self, brightest: NDArray[np.floating] | None, full_well: float) -> tuple[float, ...]:
        """Return the exposures of one capture [s], shortest first.

        ``brightest``: electrons per second of the brightest image of all cameras; only automatic control needs it.
        """
        base = self.base_s
        if base is None:
            assert self.control is not None and brightest is not None
            control = self.control
            base = automatic(brightest, full_well, control.level, control.percentile, self.limits_s)
        if self.bracket is None:
            return (base,)
        return bracket(base, self.bracket.count, self.bracket.factor, self.limits_s)


@dataclass(frozen=True)
class Sensor:
    """A sensor ready for use.

    - ``linewidth_nm`` of its light; None if unknown, which disables speckle.
    - ``focus_mm`` of the cameras' lenses; None for pinholes.
    - ``ambient_image``: one additional image with the projector off.
    - ``matcher``, ``decoder`` or ``demodulation``: settings of the technology's decoder.
    - ``images`` of each camera in a folder of recordings, as file names or one pattern; None if the folder's names
      suffice.
    - ``unknowns`` of this type of sensor.
    - ``room`` light and ``misalignment`` of one unit in its place, fitted to captures by ``mitsim fit sensor``.
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
    pattern: DotPattern | LightCode | ProjectorImages | AmplitudeModulation
    exposure: ExposurePolicy
    ambient_image: bool
    matcher: MatcherSettings | None
    decoder: DecoderSettings | None
    demodulation: TimeOfFlightSettings | None = None
    published_noise: tuple[PublishedNoise, ...] = field(default=(), repr=False)
    images: dict[str, str | list[str]] | None = None
    unknowns: UnknownsTable = field(default=UnknownsTable(), repr=False)
    room: RoomTable | None = field(default=None, repr=False)
    misalignment: MisalignmentTable = field(default=MisalignmentTable(), repr=False)

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

    def patterns(self) -> NDArray[np.float32]:
        """Return all patterns of one measurement, (P, H, W), values 0..1 in projector pixels.

        A time-of-flight sensor has none: its light is modulated in time, not in space.
        """
        optics, pattern = self.projector.optics, self.pattern
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
        return replace(self, pattern=_allowed(pattern, self.technology, self.matcher, f"sensor {self.name}"))

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


def load_sensor(name: str | Path) -> Sensor:
    """Load a preset by name, or a sensor TOML file by path.

    Raises
    ------
    InputError
        For an unknown name, or a file that does not describe a sensor. If the file describes a recorded rig
        (:mod:`mitsim.sensor.recorded_rig`), the error names all keys that simulation needs.
    """
    path, table, notes = sensor_table(name)
    for note in notes:
        say(f"warning: {note}")
    lacking = lacking_keys(table)
    if lacking and _is_recorded_rig(path, table):
        raise InputError(
            path,
            ", ".join(lacking),
            "nothing",
            "a value for each: simulation needs them",
            "the file describes a recorded rig: mitsim import and mitsim decode accept it",
        )
    return sensor_of(path, table)


def sensor_table(name: str | Path, size: tuple[int, int] | None = None) -> tuple[Path, dict[str, Any], list[str]]:
    """Return the path of a preset or sensor file, its unchecked table with the calibration filled in, and warnings.

    ``size`` (width, height) [px] of the images, if known, tells whether they show a part of the calibrated imager.

    Raises
    ------
    InputError
        For an unknown name, or a file or calibration that cannot be read.
    """
    path, written = written_table(name)
    return path, *with_calibration(path, with_lenses(path, written), size)


def written_table(name: str | Path) -> tuple[Path, dict[str, Any]]:
    """Return the path of a preset or sensor file, and its table as written.

    Raises
    ------
    InputError
        For an unknown name, or a file that cannot be read.
    """
    path = Path(name)
    if path.suffix != ".toml":
        if str(name) not in presets():
            allowed = f"{', '.join(presets())}, or the path of a .toml file"
            raise InputError("--sensor", "", repr(str(name)), allowed, nearest(str(name), presets()))
        path = Path(str(files("mitsim.sensor") / "presets" / f"{name}.toml"))
    return path, read_toml(path, _Written).model_extra or {}


def sensor_of(path: Path, written: dict[str, Any]) -> Sensor:
    """Make a sensor from a complete table.

    Raises
    ------
    InputError
        If a value is missing or not allowed.
    """
    table = validate(path, written, SensorFile)
    near, far = table.working_range_mm
    if near >= far:
        raise InputError(path, "working_range_mm", f"[{near:g}, {far:g}]", "near before far")
    return _assemble(path, table)


def _is_recorded_rig(path: Path, table: dict[str, Any]) -> bool:
    """Return whether a table lacks only keys that simulation needs."""
    try:
        sensor_of(path, for_recordings(table))
    except InputError:
        return False
    return True


class _Written(Document):
    """A sensor file as written, before its calibration is read."""

    model_config = ConfigDict(extra="allow")


def _assemble(path: Path, table: SensorFile) -> Sensor:
    cameras = {name: optics.camera() for name, optics in table.cameras.items()}
    keys, given = table.projector, table.imager
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
    imager = imager_of(given)
    return Sensor(
        name=table.name,
        technology=table.technology,
        wavelength_nm=table.wavelength_nm,
        linewidth_nm=keys.linewidth_nm,
        working_range_mm=table.working_range_mm,
        rig=Rig(cameras, projector.optics),
        projector=projector,
        imager=imager,
        focus_mm=given.focus_mm,
        pattern=_pattern(path, table, projector),
        exposure=_exposure(path, table, projector, imager),
        ambient_image=table.ambient_image,
        matcher=table.matcher,
        decoder=table.decoder,
        demodulation=table.demodulation,
        published_noise=tuple(table.published_noise),
        images=table.images,
        unknowns=_unknowns(path, table),
        room=table.room,
        misalignment=table.misalignment,
    )


def _allowed(pattern: ProjectorImages, technology: str, matcher: MatcherSettings | None, where: str) -> ProjectorImages:
    """Return own images that a technology can project; else raise an error."""
    if technology not in ("active_stereo", "structured_light"):
        raise InputError(where, "pattern", f"images, for {technology}", "images for active_stereo or structured_light")
    if pattern.count > 1 and matcher is not None and matcher.method != "correlation":
        hint = 'set method = "correlation" in [matcher], which matches all images at once'
        raise InputError(where, "pattern", f"{pattern.count} images, for matcher.method {matcher.method}", "one", hint)
    return pattern


def _pattern(
    path: Path, table: SensorFile, projector: Projector
) -> DotPattern | LightCode | ProjectorImages | AmplitudeModulation:
    """Return the pattern of a sensor file; the folder of own images is relative to the file."""
    pattern = table.pattern
    if not isinstance(pattern, ImageFolder):
        return pattern
    optics = projector.optics
    images = read_images(path.parent / pattern.folder, optics.width, optics.height)
    return _allowed(images, table.technology, table.matcher, str(path))


def _unknowns(path: Path, table: SensorFile) -> UnknownsTable:
    """Return the unknowns of a sensor file; the path of a covariance is relative to the file."""
    covariance = table.unknowns.calibration.covariance
    if covariance is None:
        return table.unknowns
    return unknowns_of(
        table.unknowns,
        UnknownsTable.model_validate({"calibration": {"covariance": str((path.parent / covariance).absolute())}}),
    )


def _exposure(path: Path, table: SensorFile, projector: Projector, imager: Imager) -> ExposurePolicy:
    rule = table.exposure
    shortest, longest = rule.limits_s
    if shortest > longest:
        raise InputError(path, "exposure.limits_s", f"[{shortest:g}, {longest:g}]", "shortest before longest")
    several = "" if rule.bracket is None else f"; {rule.bracket.count} exposures a factor {rule.bracket.factor:g} apart"
    if isinstance(rule, AutomaticExposure):
        words = f"automatic: {rule.percentile:g} % of the pixels under {100 * rule.level:g} % of full scale"
        return ExposurePolicy(words + several, None, rule, rule.bracket, rule.limits_s)
    if isinstance(rule, FixedExposure):
        return ExposurePolicy(
            f"fixed at {rule.exposure_s:g} s{several}", rule.exposure_s, None, rule.bracket, rule.limits_s
        )
    radiance = rule.reflectance / np.pi * projector.plane_irradiance / rule.distance_mm**2
    wanted = rule.level * imager.full_well
    exposure = float(wanted / (radiance * electrons_per_radiance(imager, table.wavelength_nm, 1.0)))
    if not shortest <= exposure <= longest:
        hint = f"the rule asks for {exposure:.3g} s: change projector.flux_w, exposure.level or exposure.distance_mm"
        raise InputError(path, "exposure.limits_s", f"[{shortest:g}, {longest:g}] s", "limits that hold", hint)
    words = (
        f"fixed at {exposure:.3g} s: matt white (reflectance {rule.reflectance:g}) at {rule.distance_mm:g} mm "
        f"shows the bright pattern at {100 * rule.level:g} % of full scale"
    )
    return ExposurePolicy(words + several, exposure, None, rule.bracket, rule.limits_s)
