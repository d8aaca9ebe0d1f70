"""Take the shots of a campaign and measure them.

Signal chain: shot -> capture, rendered or found in a folder -> cloud of the coupon's part of the image -> metrics of
its sub-point-clouds -> :class:`~mitsim.campaign.store.Finished`.

A *source* answers a list of shots in any order. The campaign never knows which it has. While one shot is decoded and
measured, the next is being rendered.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np
from threadpoolctl import threadpool_limits

from characterisation.coupon.patches import Coupon, measure_patches
from characterisation.point_cloud import PointCloud
from mitsim.campaign.plan import Campaign, Shot, view_axes
from mitsim.campaign.store import Finished
from mitsim.capture.calibration import calibration_table
from mitsim.capture.capture import Capture
from mitsim.capture.folder import read_capture, read_settings_and_pose
from mitsim.errors import InputError
from mitsim.reconstruction.cloud import Geometry, capture_cloud, capture_geometry, sensor_geometry
from mitsim.reconstruction.depth_range import depths_of, outside
from mitsim.sensor.preset import Sensor
from mitsim.sensor.roi import Roi
from mitsim.sensor.transforms import Transform
from mitsim.simulation.render_residual import RenderResidual, render_residual, told
from mitsim.simulation.rendering import Rendering
from mitsim.simulation.simulate import SimulatedSensor

Item = TypeVar("Item")
Taken = TypeVar("Taken")
Made = TypeVar("Made")
CaptureSource = Callable[[Shot], Capture]
Source = Callable[[Sequence[Shot]], Iterator[tuple[Shot, Finished]]]

#: captures out of range that are named one by one
NAMED = 5

#: a capture that was found belongs to the nearest planned distance, if it is no farther from it than this share
DISTANCE_SLACK = 0.05


def simulated_source(sensor: SimulatedSensor, samples_per_pixel: int) -> CaptureSource:
    """Captures that are rendered, of the coupon's part of the images only."""
    rendering = Rendering(samples_per_pixel)

    def take(shot: Shot) -> Capture:
        sample, pose = shot.series.sample, shot.sensor_from_coupon
        around = sample.at(pose).corners()
        return sensor.capture(sample.scene, pose.inverse(), seed=shot.seed, rendering=rendering, around=around)

    return take


def in_turn(take: CaptureSource, campaign: Campaign) -> Source:
    """A source that takes one shot after the other, and measures each while the next is taken."""
    geometry = sensor_geometry(campaign.sensor)

    def measure(capture: Capture, shot: Shot) -> Finished:
        return measured(capture, shot, geometry, campaign.sensor, campaign.file.keep_images)

    return lambda shots: one_ahead(shots, take, measure)


def one_ahead(
    items: Iterable[Item], take: Callable[[Item], Taken], finish: Callable[[Taken, Item], Made]
) -> Iterator[tuple[Item, Made]]:
    """Each item with ``finish(take(item), item)``, in order; one is finished while the next is taken.

    All is taken in the caller's thread, as Dr.Jit and devices want it. A thread finishes one item and ends; when the
    caller is stopped or stops asking, no other is started. If an item cannot be taken, the one before it still comes.

    Meanwhile BLAS has one thread: its products are long and narrow here, threads spin while they wait for one another,
    and the cores are wanted for taking.
    """
    with threadpool_limits(1, user_api="blas"):
        before: tuple[Item, Future[Made]] | None = None
        for item in items:
            try:
                taken = take(item)
            except Exception:
                if before is not None:
                    yield before[0], before[1].result()
                raise
            ready, before = before, (item, _begun(finish, taken, item))
            del taken
            if ready is not None:
                yield ready[0], ready[1].result()
        if before is not None:
            yield before[0], before[1].result()


def _begun(finish: Callable[[Taken, Item], Made], taken: Taken, item: Item) -> Future[Made]:
    thread = ThreadPoolExecutor(1)
    try:
        return thread.submit(finish, taken, item)
    finally:
        thread.shutdown(wait=False)


def measured(capture: Capture, shot: Shot, geometry: Geometry, sensor: Sensor, keep_images: bool) -> Finished:
    """Decode a capture of a coupon and measure its sub-point-clouds.

    The pose is the capture's own where it has one: a stage is read back, and does not stand exactly where it was sent.
    So is the calibration: a device has one of its own. ``geometry`` is that of the sensor's rig.
    """
    coupon = shot.series.sample.at(coupon_place(capture, shot))
    if own_sensor(capture, sensor) is not sensor:
        geometry = capture_geometry(capture, sensor.settings)
    patches = measure_patches(coupon_cloud(capture, coupon, geometry, sensor), coupon)
    if not keep_images:
        return Finished(patches, capture.source)
    shown = {
        "sample": shot.series.sample.label(),
        "distance_mm": float(shot.series.distance),
        "normal": [float(component) for component in shot.normal],
    }
    return Finished(patches, capture.source, replace(capture, settings={**capture.settings, "coupon": shown}))


def coupon_place(capture: Capture, shot: Shot) -> Transform:
    """``sensor_from_coupon`` of a capture, as it says itself; that of the plan if it does not."""
    world = capture.world_from_sensor
    return shot.sensor_from_coupon if world is None else world.inverse()


def own_sensor(capture: Capture, sensor: Sensor) -> Sensor:
    """The sensor with the calibration that a capture brings; itself, if they are the same."""
    rig = capture.rig
    if rig is sensor.rig or calibration_table(rig) == calibration_table(sensor.rig):
        return sensor
    return replace(sensor, rig=replace(rig, projector=rig.projector or sensor.rig.projector))


def coupon_cloud(capture: Capture, coupon: Coupon, geometry: Geometry, sensor: Sensor) -> PointCloud:
    """Decode the part of a capture that holds the coupon."""
    grid = geometry.grid
    corners = grid.project(coupon.corners())
    low = np.clip(np.floor(corners.min(axis=0)).astype(int) - 2, 0, [grid.width - 1, grid.height - 1])
    high = np.clip(np.ceil(corners.max(axis=0)).astype(int) + 3, low + 1, [grid.width, grid.height])
    return capture_cloud(capture, sensor.settings, geometry, Roi.between(*low, *high), sensor.imager)


def coupon_residuals(sensor: SimulatedSensor, campaign: Campaign) -> list[RenderResidual]:
    """How far the render of each sample is from the light, in the reference camera; told if too far.

    At the normal in the middle of the plan: the first is often the mirror direction, where a metal blinds the camera.
    """
    camera = next(iter(sensor.sensor.rig.cameras))
    normals = campaign.file.normals()
    samples, seed = campaign.file.samples_per_pixel, campaign.file.seed
    out = []
    for series in campaign.series:
        if series.variant is None and series.distance == campaign.distances[0]:
            pose = campaign.shot(series, normals[len(normals) // 2]).sensor_from_coupon
            sample, corners = series.sample, series.sample.at(pose).corners()
            residual = render_residual(
                sensor, sample.scene, pose.inverse(), camera, Rendering(samples), seed=seed, around=corners
            )
            out.append(told(sample.label(), residual))
    return out


def found_shots(folder: str | Path, campaign: Campaign) -> dict[Path, Shot]:
    """Captures of coupons in a folder and below it, as shots of a campaign.

    Each must say which sample it shows (``settings.coupon.sample``) and know its pose, the world being the coupon's
    frame; of the planned distances it takes the nearest.

    Raises
    ------
    InputError
        If there is none, or one that is of no sample or distance of the campaign.
    """
    folder = Path(folder)
    places = sorted(path.parent for path in folder.rglob("capture.json"))
    if not places:
        raise InputError(folder, "", "no capture in it", "a folder with captures of coupons")
    return {place: _found_shot(place, campaign) for place in places}


def out_of_range(campaign: Campaign, found: dict[Path, Shot] | None = None) -> list[str]:
    """Word a warning for each capture whose coupon's middle stands outside the depths that the decoder searches.

    Of captures that were ``found``, by their own poses; else of the planned ones, once for each sample and distance. At
    most :data:`NAMED` lines, and one that says how many more.
    """
    sensor = campaign.sensor
    facing = np.array([0.0, 0.0, 1.0])
    planned = {
        f"{one.sample.label()} at {one.distance:g} mm": campaign.shot(one, facing)
        for one in campaign.series
        if one.variant is None
    }
    shown = planned if found is None else {str(place): shot for place, shot in found.items()}
    known = "by the plan" if found is None else "by its pose"
    lines = []
    for name, shot in shown.items():
        coupon = shot.series.sample.at(shot.sensor_from_coupon)
        places = np.concatenate([coupon.centre[None], coupon.corners()])
        middle, *depths = depths_of(places, sensor.rig, sensor.settings)
        if not sensor.settings.near_mm <= middle <= sensor.settings.far_mm:
            reach = (float(min(depths)), float(max(depths)))
            lines.append(outside(f"{name}: the coupon", reach, sensor.settings, sensor.name, known))
    if len(lines) > NAMED:
        lines[NAMED:] = [f"warning: and {len(lines) - NAMED} of {len(shown)} more stand outside the range"]
    return lines


def found_source(shots: dict[Path, Shot]) -> CaptureSource:
    """Captures that :func:`found_shots` found, read when they are asked for."""
    places = {(shot.series.name, shot.name): place for place, shot in shots.items()}
    return lambda shot: read_capture(places[shot.series.name, shot.name])


def _found_shot(place: Path, campaign: Campaign) -> Shot:
    sensor, settings, world_from_sensor = read_settings_and_pose(place)
    if sensor != campaign.sensor.name:
        raise InputError(place / "capture.json", "sensor", sensor, campaign.sensor.name, "or another --sensor")
    shown = settings.get("coupon")
    label = shown.get("sample") if isinstance(shown, dict) else None
    labels = [sample.label() for sample in campaign.samples]
    if label not in labels:
        raise InputError(
            place / "settings.json",
            "coupon.sample",
            repr(label),
            ", ".join(labels),
            "the label of a sample of the campaign",
        )
    if world_from_sensor is None:
        raise InputError(place / "pose.json", "world_from_sensor", "null", "the pose, in the coupon's frame")
    pose = world_from_sensor.inverse()
    distance = float(np.linalg.norm(pose.translation - campaign.sensor.rig.reference.sensor_from_camera.translation))
    nominal = min(campaign.distances, key=lambda planned: abs(np.log(distance / planned)))
    if abs(distance / nominal - 1) > DISTANCE_SLACK:
        known = ", ".join(f"{planned:g}" for planned in campaign.distances)
        raise InputError(
            place / "pose.json",
            "distance",
            f"{distance:.1f} mm",
            f"within 5 % of {known} mm",
            "name it in distances_mm",
        )
    series = next(
        s for s in campaign.series if s.variant is None and s.distance == nominal and s.sample.label() == label
    )
    axis = campaign.sensor.rig.reference.sensor_from_camera.rotation[:, 2]
    return Shot(series, view_axes(axis).T @ pose.rotation[:, 2], pose)
