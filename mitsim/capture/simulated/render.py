"""Load a scene for a sensor, and render a capture of it, as programs do."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Literal, overload

from numpy.typing import ArrayLike

from characterisation.files.errors import InputError
from mitsim.capture.capture import Capture
from mitsim.capture.simulated.render_residual import advice, checked_rendering
from mitsim.capture.simulated.rendering import Rendering
from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.capture.simulated.truth import true_images
from mitsim.capture.truth import Truth
from mitsim.scene import load
from mitsim.scene.load import Scene
from mitsim.scene.surface.scatter import NOMINAL, Deviation
from mitsim.sensor.noise_sources import Noise
from mitsim.sensor.poses import as_pose
from mitsim.sensor.sensor import Sensor
from mitsim.sensor.sensor_text import once_for_sensor
from mitsim.sensor.transforms import Transform

#: a sensor ready to take captures; the last one is kept: preparing the patterns takes longer than tracing an image
simulated_sensor = once_for_sensor(SimulatedSensor)


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
    mitsim.sensor.preset.load_sensor : the sensor

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
        Without quantisation images have 16 bits.
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
    simulated = simulated_sensor(sensor)
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
