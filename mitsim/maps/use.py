"""Make and load performance maps, and predict clouds from them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from characterisation.files.documents import read_toml
from characterisation.files.errors import InputError
from characterisation.maps.performance_map import PerformanceMap
from characterisation.maps.shipped import map_path
from characterisation.point_cloud import PointCloud
from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.decoding.cloud import sensor_geometry
from mitsim.maps.campaign.acquire import coupon_residuals, in_turn, simulated_source
from mitsim.maps.campaign.campaign_file import CampaignFile
from mitsim.maps.campaign.missing_finishes import NeededFinishes, map_with_finishes, seen_finishes
from mitsim.maps.campaign.orders import worker_source
from mitsim.maps.campaign.plan import Campaign, plan_campaign
from mitsim.maps.campaign.run import run_campaign
from mitsim.maps.prediction import CharacterisedScene, Predictor
from mitsim.running.executor import Executor
from mitsim.scene.load import Scene
from mitsim.sensor.poses import as_pose
from mitsim.sensor.sensor import Sensor
from mitsim.sensor.transforms import Transform


def characterise(
    campaign: str | Path,
    sensor: Sensor,
    folder: str | Path,
    *,
    file: CampaignFile | None = None,
    workers: Executor | None = None,
) -> PerformanceMap:
    """Make the performance map of a sensor from simulated captures of coupons, as ``mitsim map make`` does.

    Parameters
    ----------
    campaign
        Campaign TOML file; paths in it are relative to its folder.
    sensor
        The sensor that captures the coupons.
    folder
        Where captures, ``samples.nc`` and ``map.nc`` are kept. A campaign that was stopped continues there.
    file
        The content of the campaign, if a program states it; ``campaign`` is then the place for errors and paths.
    workers
        Processes or cluster that take the captures; by default this process takes them.

    Returns
    -------
    PerformanceMap
        F and sigma over distance, normal and finish.

    Raises
    ------
    InputError
        If the campaign is not valid, or names a device.

    See Also
    --------
    performance_map : Load a map that is made already.

    Examples
    --------
    >>> import mitsim as ms
    >>> small = ms.CampaignFile(
    ...     distances_mm=[500],
    ...     samples_per_pixel=1,
    ...     orientations=[{"up_to_deg": 10, "subdivisions": 0}],
    ...     samples=[{"scene": "coupon.xml"}],
    ... )
    >>> made = ms.characterise("campaign.toml", ms.load_sensor("small.toml"), "small_map", file=small)
    >>> made.data["distance"].values.tolist()
    [500.0]
    """
    content = read_toml(campaign, CampaignFile) if file is None else file
    if content.device is not None:
        raise InputError(campaign, "device", content.device, "no device", "use mitsim map make for live captures")
    return simulate_campaign(plan_campaign(campaign, content, sensor), folder, workers)


def simulate_campaign(plan: Campaign, folder: str | Path, workers: Executor | None = None) -> PerformanceMap:
    """Simulate the captures of a planned campaign, and make its map in ``folder``."""
    simulated = SimulatedSensor(plan.sensor)
    coupon_residuals(simulated, plan)
    if workers is None:
        source = in_turn(simulated_source(simulated, plan.file.samples_per_pixel), plan)
    else:
        source = worker_source(workers, plan)
    return run_campaign(plan, source, folder)


def performance_map(sensor_name_or_path: str | Path) -> PerformanceMap:
    """Load a performance map: F and sigma of a sensor over distance, normal and finish.

    Parameters
    ----------
    sensor_name_or_path
        The name of a preset whose map is shipped with mitsim, or a ``map.nc`` of ``mitsim map make``.

    Returns
    -------
    PerformanceMap
        ``samples`` that it contains; ``query(finish, Ra, distance, normals)`` looks up F and sigma; ``data`` is the
        ``xarray.Dataset``.

    Raises
    ------
    InputError
        If there is no such map, or the file is damaged.

    Examples
    --------
    >>> import mitsim as ms
    >>> known = ms.performance_map("ensenso-n10")
    >>> facing = known.query("matt_white", float("nan"), 600.0, [[0.0, 0.0, 1.0]])
    >>> bool(facing.fraction[0] > 0.9)
    True
    """
    return PerformanceMap.load(map_path(sensor_name_or_path))


def predict(
    scene: Scene,
    sensor: Sensor,
    performance_map: PerformanceMap,
    pose: Transform | ArrayLike,
    *,
    seed: int = 1,
    correlated: bool = False,
    ask: Callable[[str], bool] | None = None,
) -> PointCloud:
    """Predict the cloud of a view from a performance map, without rendering.

    Parameters
    ----------
    scene
        From :func:`load_scene`.
    sensor
        From :func:`load_sensor`.
    performance_map
        That of this sensor, from :func:`performance_map`.
    pose
        ``world_from_sensor``, from :func:`look_at`, or a (4, 4) matrix [mm].
    seed
        Equal seeds give equal clouds.
    correlated
        Draw the errors of neighbouring points with the correlation that the map measured; else independently.
    ask
        Called with a question if the map lacks a finish of the scene. If it returns True, that finish is characterised
        immediately, which takes minutes. By default, a missing finish is an error.

    Returns
    -------
    PointCloud
        Points (H, W, 3) [mm] in the sensor frame; labelled, with ``sigma`` (H, W) [mm]; ``source`` is ``predicted``.

    Raises
    ------
    InputError
        If the map belongs to another sensor, or lacks a finish; or the pose is not a rigid motion.

    See Also
    --------
    characterise : makes a map

    Notes
    -----
    A point is its true position plus a normal deviate times sigma along the view ray, kept with probability F
    (Kinnell and Justham, 2018).

    Examples
    --------
    >>> import mitsim as ms
    >>> sensor = ms.load_sensor("ensenso-n10")
    >>> scene = ms.load_scene("two_pillars.xml", sensor)
    >>> cloud = ms.predict(scene, sensor, ms.performance_map("ensenso-n10"), ms.look_at((0, -300, 400)))
    >>> cloud.source, cloud.points.shape
    ('predicted', (480, 752, 3))
    """
    map_sensor = str(performance_map.data.attrs.get("sensor"))
    if map_sensor != sensor.name:
        hint = "a map predicts only the sensor that it was measured with"
        raise InputError("predict", "performance_map", map_sensor, sensor.name, hint)
    world_from_sensor = as_pose(pose, "predict")
    eye = (world_from_sensor @ sensor.rig.reference.sensor_from_camera).translation
    predictor = Predictor.of_sensor(sensor, sensor_geometry(sensor))
    radius = float(np.linalg.norm(scene.bounds[1] - scene.bounds[0])) / 2
    distance = float(np.linalg.norm(np.subtract(eye, scene.centre)))
    needed = NeededFinishes(sensor, scene.where, seen_finishes(scene), (max(distance - radius, 1.0), distance + radius))
    characterised = CharacterisedScene(scene, map_with_finishes(performance_map, needed, ask))
    return predictor.predict(characterised, world_from_sensor, np.random.default_rng(seed), correlated)
