"""Simulate a preset before the planes and spheres of a recorded cloud, to state the same figures of both.

Signal chain: target in the recorded cloud -> its plane or sphere -> the same target, matt white, before the simulated
sensor -> capture, decoded -> window of the simulated grid that shows the recorded window.

Only points of the recorded device are needed: neither its images nor its calibration enter the simulation. Both grids
see the target from the origin of the sensor frame. So a figure for each pixel (F, sigma) is one of the pixels of the
grid of each, which may differ in size.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from characterisation.features.robust_fit import FitError
from characterisation.features.surfaces import Plane, Sphere
from characterisation.features.vectors import tangents
from characterisation.files.arrays import Floats
from characterisation.files.errors import InputError
from characterisation.point_cloud import PointCloud, ViewGrid
from characterisation.region_of_interest import Roi
from characterisation.tasks.windows import fit_shape, window_points
from mitsim.capture.simulated.rendering import Rendering
from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.decoding.cloud import capture_cloud, decoder_settings
from mitsim.decoding.depth_range import depths_of
from mitsim.scene.load import Scene
from mitsim.scene.test_targets import ball, plate
from mitsim.sensor.sensor import Sensor
from mitsim.sensor.transforms import Transform

#: rays per pixel
SAMPLES = 16

#: side of the sheet over its distance: it fills a field of view of 127 deg
_SHEET = 4.0

#: cosine of the tilt below which a sheet is centred at its recorded points, not on the optical axis
_ASKEW = 0.2

#: pixels of the simulated window that are given up at each edge of a plane's window
_EDGE_PX = 2

#: side of the recorded window that is projected, in steps
_STEPS = 24


@dataclass(frozen=True)
class Target:
    """A target in the sensor frame [mm]: its ``surface``, and the ``window`` [px] of the recorded grid; None is all."""

    surface: Plane | Sphere
    window: Roi | None


def seen_target(shape: str, window: Roi | None, cloud: PointCloud, name: str, distance: float | None = None) -> Target:
    """Return a target as a recorded cloud shows it.

    Raises FitError if the points are too few or do not lie on the shape. Raises InputError if the window does not lie
    in the grid.

    Parameters
    ----------
    shape, name
        ``plane`` or ``sphere``, and name of the target in messages.
    cloud, window
        Recorded cloud, and the target's window of its grid [px]; None is all.
    distance
        True distance of a plane that is perpendicular to the axis of the grid [mm], in place of the recorded plane.
    """
    points, grid = window_points(window, cloud, name), cloud.grid
    if distance is not None:
        axis = grid.rotation[:, 2]
        return Target(Plane(grid.origin + distance * axis, -axis), window)
    fit = fit_shape(points, "plane" if shape == "plane" else "sphere", grid.origin)
    assert isinstance(fit, Plane | Sphere)
    surface = Plane(fit.point, fit.normal) if isinstance(fit, Plane) else Sphere(fit.centre, fit.radius)
    return Target(surface, window)


def simulated_target(
    target: Target, recorded: PointCloud, sensor: Sensor, name: str, seed: int = 1
) -> tuple[PointCloud, Roi]:
    """Return the cloud of a simulated sensor before a target, and the window of its grid that shows the recorded one.

    Raises FitError if more than half of the target lies beyond the depths that the sensor's decoder searches: all
    points are false. Raises InputError if the sensor does not see the target.

    Parameters
    ----------
    target, recorded, name
        The target, the cloud in whose grid its window lies, and its name in messages.
    sensor, seed
        Sensor to simulate, and seed of the noise.
    """
    shown = _shown_points(target, recorded.grid)
    near, far = sensor.settings.near_mm, sensor.settings.far_mm
    depths = depths_of(shown, sensor.rig, sensor.settings)
    depths = depths[depths > 0]
    if len(depths) and not near <= np.median(depths) <= far:
        extent = f"{depths.min():.0f} to {depths.max():.0f} mm"
        raise FitError(f"at {extent}, beyond {near:g} to {far:g} mm, the depths that {sensor.name} searches")
    scene, pose = _scene(target.surface, sensor)
    capture = SimulatedSensor(sensor).capture(scene, pose, rendering=Rendering(samples=SAMPLES), seed=seed)
    settings, imager = decoder_settings(capture, sensor)
    cloud = capture_cloud(capture, settings, imager=imager)
    window = _same_window(target, shown, cloud.grid)
    if window is None:
        found = f"{name} outside the field of view of {sensor.name}"
        raise InputError("--simulated", "", found, "a window that both sensors see")
    return cloud, window


def _scene(surface: Plane | Sphere, sensor: Sensor) -> tuple[Scene, Transform]:
    """Return the scene of a target, and the pose of the sensor in it."""
    if isinstance(surface, Sphere):
        scene = ball(float(surface.radius), "matt white", sensor.wavelength_nm)
        return scene, Transform(np.eye(3), -np.asarray(surface.centre, float))
    turn = np.vstack([tangents(surface.normal), surface.normal])  # from the sensor frame to that of the sheet
    axis, reach = np.array([0.0, 0.0, 1.0]), float(surface.point @ surface.normal)
    cosine = float(axis @ surface.normal)
    middle = axis * reach / cosine if abs(cosine) > _ASKEW else surface.point
    size = _SHEET * float(np.linalg.norm(middle))
    return plate(size, "matt white", sensor.wavelength_nm), Transform(turn, -turn @ middle)


def _shown_points(target: Target, recorded: ViewGrid) -> Floats:
    """Return points (n, 3) [mm] around what the recorded window shows of the target, in the sensor frame."""
    if isinstance(target.surface, Sphere):
        around = 1.05 * float(target.surface.radius) * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
        return np.asarray(target.surface.centre + around)
    window = target.window or Roi.whole(recorded.width, recorded.height)
    columns, rows = np.meshgrid(
        np.linspace(window.left, window.right - 1, _STEPS).round().astype(int),
        np.linspace(window.top, window.bottom - 1, _STEPS).round().astype(int),
    )
    rays = recorded.rays_at(columns.ravel(), rows.ravel())
    reach_of = ((target.surface.point - recorded.origin) @ target.surface.normal) / (rays @ target.surface.normal)
    return np.asarray(recorded.origin + rays * reach_of[:, None])


def _same_window(target: Target, shown: Floats, simulated: ViewGrid) -> Roi | None:
    """Return the window of the simulated grid around points (n, 3) of the target; None outside."""
    edge = 0 if isinstance(target.surface, Sphere) else _EDGE_PX
    pixels = simulated.project(shown)
    pixels = pixels[np.isfinite(pixels).all(axis=1)]
    if not len(pixels):
        return None
    size = np.array([simulated.width, simulated.height])
    low = np.clip(np.ceil(pixels.min(axis=0)) + edge, 0, size).astype(int)
    high = np.clip(np.floor(pixels.max(axis=0)) + 1 - edge, 0, size).astype(int)
    return None if (high - low < 3).any() else Roi.between(*low, *high)
