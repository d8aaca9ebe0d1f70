"""Load, render, write and read scenes, sensors, captures and clouds."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Literal, overload

from numpy.typing import ArrayLike

from characterisation import cloud_files
from characterisation.files.errors import InputError
from characterisation.point_cloud import PointCloud
from mitsim.capture import folder
from mitsim.capture.capture import Capture
from mitsim.capture.simulated.render_residual import advice, checked_rendering
from mitsim.capture.simulated.rendering import Rendering
from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.capture.simulated.truth import Truth, true_images
from mitsim.decoding import input_clouds as clouds
from mitsim.decoding.checks.checked_cloud import checked_cloud
from mitsim.decoding.cloud import decoder_settings
from mitsim.scene import load
from mitsim.scene.load import Scene
from mitsim.scene.surface.scatter import NOMINAL, Deviation
from mitsim.sensor import preset
from mitsim.sensor.noise_sources import Noise
from mitsim.sensor.poses import as_pose
from mitsim.sensor.sensor import Sensor
from mitsim.sensor.sensor_file import Purpose
from mitsim.sensor.transforms import Transform

#: the last sensor and its simulation: preparing the patterns takes longer than tracing an image
_prepared: list[tuple[Sensor, SimulatedSensor]] = []


def load_sensor(name_or_path: str | Path, purpose: Purpose = "simulation") -> Sensor:
    """Load a sensor: a preset by its name, or a sensor TOML file by its path.

    Parameters
    ----------
    name_or_path
        ``"ensenso-n10"`` or another preset of ``docs/reference/sensors.md``, or a path that ends in ``.toml``.
    purpose
        ``"simulation"``, or ``"decoding"`` for the file of a rig whose images exist, which may leave out its light and
        imager.

    Returns
    -------
    Sensor
        Cameras, projector, pattern, imager, exposure and decoder. ``missing_for("simulation")`` names the keys that
        simulation needs and the file lacks.

    Raises
    ------
    InputError
        For an unknown name, or a file that lacks keys for the purpose; the error names all of them.

    Examples
    --------
    >>> import mitsim as ms
    >>> sensor = ms.load_sensor("small.toml")
    >>> sensor.name, sensor.technology, sensor.working_range_mm
    ('small', 'active_stereo', (400.0, 800.0))
    """
    return preset.load_sensor(str(name_or_path), purpose)


def load_scene(
    path: str | Path,
    sensor: Sensor,
    definitions: Mapping[str, str | float] | None = None,
    *,
    deviation: Deviation = NOMINAL,
) -> Scene:
    """Load a scene XML for a sensor.

    Parameters
    ----------
    path
        Mitsuba 3 scene XML, lengths in mm.
    sensor
        Finishes are evaluated at its wavelength.
    definitions
        Values for the ``<default>``s of the XML, as Mitsuba's ``-D name=value`` sets them.
    deviation
        Deviation of finishes from their best estimates, within their uncertainty; see ``mitsim render --deviation``.

    Returns
    -------
    Scene
        ``names`` and ``finishes`` of its shapes, and ``bounds`` (2, 3) [mm] in the world frame.

    Raises
    ------
    InputError
        If the file is missing, cannot be parsed, names something unknown to Mitsuba, or has a size that is implausible
        in mm.

    See Also
    --------
    load_sensor : the sensor

    Examples
    --------
    >>> import mitsim as ms
    >>> scene = ms.load_scene("coupon.xml", ms.load_sensor("small.toml"), {"Ra": 0.2})
    >>> scene.names
    ('coupon',)
    >>> print(scene.finishes[0])
    aluminium/ground Ra 0.2 um
    """
    parameters = {name: str(value) for name, value in (definitions or {}).items()}
    return load.load_scene(path, sensor.wavelength_nm, parameters, deviation)


def prepared_sensor(sensor: Sensor) -> SimulatedSensor:
    """Return a sensor ready to take captures; the last one is kept for the next call."""
    if not (_prepared and _prepared[0][0] is sensor):
        _prepared[:] = [(sensor, SimulatedSensor(sensor))]
    return _prepared[0][1]


@overload
def render(
    scene: Scene,
    sensor: Sensor,
    pose: Transform | ArrayLike,
    *,
    seed: int = 1,
    samples: int = 16,
    depth: int = 3,
    smoothing_px: float = 0.0,
    noise: str = "all",
    truth: Literal[False] = False,
    check: bool = True,
) -> Capture: ...


@overload
def render(
    scene: Scene,
    sensor: Sensor,
    pose: Transform | ArrayLike,
    *,
    seed: int = 1,
    samples: int = 16,
    depth: int = 3,
    smoothing_px: float = 0.0,
    noise: str = "all",
    truth: Literal[True],
    check: bool = True,
) -> tuple[Capture, dict[str, Truth]]: ...


def render(  # noqa: PLR0913 - options of programs, all by name
    scene: Scene,
    sensor: Sensor,
    pose: Transform | ArrayLike,
    *,
    seed: int = 1,
    samples: int = 16,
    depth: int = 3,
    smoothing_px: float = 0.0,
    noise: str = "all",
    truth: bool = False,
    check: bool = True,
) -> Capture | tuple[Capture, dict[str, Truth]]:
    """Render one capture of a scene: all images that the sensor takes, with noise.

    Parameters
    ----------
    scene
        From :func:`load_scene`, for this sensor.
    sensor
        From :func:`load_sensor`.
    pose
        ``world_from_sensor``, from :func:`look_at`, or a (4, 4) matrix [mm].
    seed
        Equal seeds give equal bytes on one machine. Use a different seed for every capture.
    samples
        Light paths per pixel, 1 to 65536.
    depth
        Number of surfaces on a light path, 1 to 16; 1 is direct light.
    smoothing_px
        Standard deviation of a filter over the interreflections on each shape [px], 0 to 10; virtual measurements have
        1.5. It takes away their render noise, and blurs what polished metal mirrors.
    noise
        ``"all"``, ``"none"``, some sources by name (``"shot,read"``), or all but some (``"no-speckle"``).
    truth
        Return what every pixel truly sees, too.
    check
        Render one camera three times more to measure the error of the rendering, ``settings["render_residual"]``.

    Returns
    -------
    Capture
        ``images`` by camera, (frames, H, W) [DN]. :func:`decode` decodes it.
    dict of Truth
        With ``truth``: by camera, depth, normal, shape, projector coordinate, shadow and share of indirect light of the
        pixels of its images. A cloud of two cameras has other pixels, those of rectified images.

    Raises
    ------
    InputError
        If a number is out of its range, ``noise`` names an unknown source, or the pose is not a rigid motion.

    Warns
    -----
    UserWarning
        With ``check``: if the error of the rendering exceeds a fifth of the sensor's noise, so that it would be
        mistaken for one of the sensor, or if a camera or the projector does not see the part.

    Examples
    --------
    >>> import mitsim as ms
    >>> sensor = ms.load_sensor("small.toml")
    >>> scene = ms.load_scene("two_pillars.xml", sensor)
    >>> capture = ms.render(scene, sensor, ms.look_at((0, -300, 400)), samples=2, depth=1, check=False)
    >>> capture.images["left"].shape, capture.source
    ((1, 240, 320), 'simulated')
    >>> pose = ms.look_at((0, -300, 400))
    >>> capture, truth = ms.render(scene, sensor, pose, samples=2, depth=1, check=False, truth=True)
    >>> left = truth["left"]
    >>> left.depth.shape, left.feature_names[left.feature[120, 160]]
    ((240, 320), 'plane')
    """
    for name, value, low, high in (
        ("samples", samples, 1, 65536),
        ("depth", depth, 1, 16),
        ("smoothing_px", smoothing_px, 0, 10),
        ("seed", seed, 0, 2**63),
    ):
        if not low <= value <= high:
            raise InputError("render", name, value, f"{low} to {high}")
    world_from_sensor = as_pose(pose, "render")
    chosen = Noise.parse(noise, "render: noise")
    simulated = prepared_sensor(sensor)
    rendering = Rendering.smoothed(samples, depth, smoothing_px)
    capture = simulated.capture(scene, world_from_sensor, seed=seed, rendering=rendering, noise=chosen)
    if check:
        residual, unseen = checked_rendering(capture, simulated, scene, world_from_sensor, rendering, seed)
        doubts = [unseen] if unseen else []
        doubts += [f"{residual}; {what}"] if (what := advice(residual, rendering)) else []
        for text in doubts:
            warnings.warn(text, stacklevel=2)
    if not truth:
        return capture
    return capture, true_images(simulated, scene, world_from_sensor, samples=samples, depth=depth, seed=seed)


def decode(
    capture: Capture, sensor: Sensor | str | Path | None = None, *, range_mm: tuple[float, float] | None = None
) -> PointCloud:
    """Decode the images of a capture to a point cloud, and issue the warnings that ``mitsim decode`` prints.

    Parameters
    ----------
    capture
        From :func:`render` or :func:`read_capture`.
    sensor
        Sensor whose settings are used: loaded, the name of a preset, or the path of a sensor TOML file. By default
        those of the capture, or those of the preset that it names.
    range_mm
        Nearest and farthest depth to decode [mm], instead of the sensor's.

    Returns
    -------
    PointCloud
        Points (H, W, 3) float32 [mm] in the sensor frame, NaN where missing; ``status`` (H, W) is the reason.

    Raises
    ------
    InputError
        If the sensor is unknown or of another technology, the range is invalid, or the capture is inconsistent.

    Warns
    -----
    UserWarning
        If images, calibration or range are doubtful: one warning for each sentence.

    Examples
    --------
    >>> import mitsim as ms
    >>> cloud = ms.decode(ms.read_capture("capture"), "small.toml")
    >>> cloud.points.shape
    (240, 320, 3)
    >>> round(float(cloud.valid.mean()), 1) > 0
    True
    """
    settings, imager = decoder_settings(capture, sensor, range_mm)
    decoded = checked_cloud(capture, settings, imager, sensor=sensor)
    for text in decoded.warnings:
        warnings.warn(text, stacklevel=2)
    return decoded.cloud


def read_capture(path: str | Path) -> Capture:
    """Read a capture folder written by ``mitsim render``, ``capture`` or ``import``, or by :func:`write_capture`.

    Parameters
    ----------
    path
        The folder.

    Returns
    -------
    Capture
        Images, calibration, settings, and the pose if it is known.

    Raises
    ------
    InputError
        If it is not a capture folder, or a file in it is missing or was changed.

    Examples
    --------
    >>> import mitsim as ms
    >>> capture = ms.read_capture("capture")
    >>> capture.sensor, sorted(capture.images)
    ('small', ['left', 'right'])
    """
    return folder.read_capture(Path(path))


def write_capture(capture: Capture, path: str | Path, *, overwrite: bool = False) -> None:
    """Write a capture as a folder: images as PNG, calibration, settings and pose as JSON.

    Parameters
    ----------
    capture
        From :func:`render` or :func:`read_capture`.
    path
        The folder; it is written completely or not at all.
    overwrite
        Whether an existing capture may be replaced.

    Raises
    ------
    InputError
        If a folder of that name exists and may not be replaced.

    Examples
    --------
    >>> import mitsim as ms
    >>> ms.write_capture(ms.read_capture("capture"), "copy")
    """
    folder.write_capture(capture, Path(path), overwrite=overwrite)


def read_cloud(path: str | Path, sensor: str | None = None) -> PointCloud:
    """Read a cloud: a PLY file of mitsim, or a capture or recording, which is decoded first.

    Parameters
    ----------
    path
        A file of :func:`write_cloud` or ``mitsim decode``; a capture folder; or a recording that ``mitsim import``
        reads.
    sensor
        Decode with the settings of this preset or sensor TOML file.

    Returns
    -------
    PointCloud
        Points (H, W, 3) [mm] in the sensor frame, NaN where missing.

    Raises
    ------
    InputError
        If the file does not exist, or cannot be read or decoded.

    Examples
    --------
    >>> import mitsim as ms
    >>> cloud = ms.read_cloud("cloud.ply")
    >>> cloud.points.shape, cloud.source
    ((240, 320, 3), 'simulated')
    """
    return clouds.read_cloud(Path(path), sensor).cloud


def write_cloud(cloud: PointCloud, path: str | Path) -> None:
    """Write an organised cloud as binary PLY, as :func:`characterisation.write_cloud` does.

    Parameters
    ----------
    cloud
        Points (H, W, 3) [mm] in the sensor frame.
    path
        The file; it is written completely or not at all, and replaces an existing one.

    Raises
    ------
    OSError
        If it cannot be written.

    Examples
    --------
    >>> import mitsim as ms
    >>> ms.write_cloud(ms.read_cloud("cloud.ply"), "copy.ply")
    """
    cloud_files.write_cloud(cloud, path)
