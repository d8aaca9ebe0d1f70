"""Load a sensor from one TOML file: its parts, its exposure and its decoder.

``load_sensor("ensenso-n10")`` loads a preset of this package, ``load_sensor("my.toml")`` a file of the user's. The
file's tables are in :mod:`mitsim.sensor.sensor_file`. ``load_sensor("rig.toml", "decoding")`` also loads a file that
only describes a rig whose images exist; :meth:`mitsim.sensor.sensor.Sensor.missing_for` names the keys that it lacks
for other purposes.
"""

from __future__ import annotations

from dataclasses import fields
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from characterisation.files.documents import Document, Name, missing_error, missing_keys, validate
from characterisation.files.errors import InputError, nearest
from characterisation.files.toml_tables import read_toml_table
from characterisation.words.progress import say
from mitsim.sensor.camera import Rig
from mitsim.sensor.exposure import exposure_policy
from mitsim.sensor.imager import Imager
from mitsim.sensor.lens_keys import with_lenses
from mitsim.sensor.light_code import LightCode
from mitsim.sensor.modulation import AmplitudeModulation
from mitsim.sensor.opencv_calibration import with_calibration
from mitsim.sensor.pattern import DotPattern
from mitsim.sensor.projector import Projector
from mitsim.sensor.projector_images import ImageFolder, ProjectorImages, allowed_images, read_images
from mitsim.sensor.rig_parameters import eyes
from mitsim.sensor.sensor import Sensor
from mitsim.sensor.sensor_file import Purpose, SensorFile, absent_keys, needed_keys, with_depths
from mitsim.sensor.unknowns import UnknownsTable, unknowns_of
from mitsim.sensor.working_volume import field_of_view

#: depths at which the images of a sensor are tried for a common view; chosen
_DEPTHS = 9


def presets() -> list[str]:
    """Return the names of the sensors that come with the package."""
    folder = files("mitsim.sensor") / "presets"
    return sorted(p.name.removesuffix(".toml") for p in folder.iterdir() if p.name.endswith(".toml"))


def load_sensor(
    name_or_path: str | Path, purpose: Purpose = "simulation", size: tuple[int, int] | None = None
) -> Sensor:
    """Load a sensor: a preset by its name, or a sensor TOML file by its path.

    Parameters
    ----------
    name_or_path
        ``"ensenso-n10"`` or another preset of ``docs/reference/sensors.md``, or a path that ends in ``.toml``.
    purpose
        What the sensor is for: ``"simulation"``, or ``"decoding"`` for the file of a rig whose images exist, which may
        leave out its light and imager. Only for ``"simulation"`` are warnings about the calibration printed; for others
        they are in ``notes``.
    size
        (width, height) [px] of images, if known. It tells whether they show a part of the calibrated imager, and is
        the size of cameras without one: OpenCV's pair of ``intrinsics.yml`` and ``extrinsics.yml`` has none.

    Returns
    -------
    Sensor
        Cameras, projector, pattern, imager, exposure and decoder. ``missing_for("simulation")`` names the keys that
        simulation needs and the file lacks.

    Raises
    ------
    InputError
        For an unknown name, or a file that does not describe a sensor. The error names all keys that the purpose needs
        and the file lacks.

    Examples
    --------
    >>> import mitsim as ms
    >>> sensor = ms.load_sensor("small.toml")
    >>> sensor.name, sensor.technology, sensor.working_range_mm
    ('small', 'active_stereo', (400.0, 800.0))
    """
    path, written = _written_table(name_or_path)
    table, notes = with_calibration(path, with_lenses(path, written), size)
    sensor = _sensor_of(path, table, purpose, tuple(notes))
    if purpose == "simulation":
        for note in notes:
            say(f"warning: {note}")
    sensor.require(purpose, path)
    if purpose == "simulation":
        _check_common_view(path, sensor)
    return sensor


def named_sensor(name: str | Path) -> tuple[str, str]:
    """Return name and technology of a preset or sensor file. Nothing else is checked; its calibration is not read.

    Raises InputError for an unknown name, or a file that cannot be read or lacks one of the two.
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
    if path.suffix.lower() != ".toml":
        if str(name) not in presets():
            allowed = f"{', '.join(presets())}, or the path of a .toml file"
            raise InputError("--sensor", "", repr(str(name)), allowed, nearest(str(name), presets()))
        path = Path(str(files("mitsim.sensor") / "presets" / f"{name}.toml"))
    return path, read_toml_table(path)


def _check_common_view(path: Path, sensor: Sensor) -> None:
    """Raise an error if no point within the working range is in the image of every camera and of the projector."""
    near, far = sensor.working_range_mm
    if not any(field_of_view(sensor, depth)[0] for depth in np.geomspace(near, far, _DEPTHS)):
        names = list(eyes(sensor.rig))
        raise InputError(
            path,
            "working_range_mm",
            f"[{near:g}, {far:g}], where no point is in the images of all of {', '.join(names)}",
            "depths at which they see the same part",
            f"check position_mm and rotation_deg of {' and '.join(names[1:])}, and the intrinsics of all",
        )


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
    imager = Imager(**{field.name: getattr(written, field.name) for field in fields(Imager)})
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
        fitted_to=tuple(table.fitted_to),
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
