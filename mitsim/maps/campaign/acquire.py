"""Take the shots of a campaign and measure them.

Signal chain: shot -> capture, rendered or found in a folder -> cloud of the coupon's part of the image -> metrics of
its patches -> :class:`~mitsim.maps.campaign.store.Finished`.

A *source* returns the results of a list of shots in any order; the campaign does not depend on the kind of source.
While one shot is decoded and measured, the next is rendered.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np
from threadpoolctl import threadpool_limits

from characterisation.coupon.patches import Coupon, measure_patches, outline
from characterisation.files.checked_files import read_bounded
from characterisation.files.errors import InputError
from characterisation.point_cloud import PointCloud
from characterisation.region_of_interest import Roi
from characterisation.words.progress import say
from mitsim.capture.calibration import calibration_table
from mitsim.capture.capture import Capture
from mitsim.capture.folder import read_capture, read_settings_and_pose
from mitsim.capture.simulated.render_residual import RenderResidual, render_residual, warn_above_limit
from mitsim.capture.simulated.rendering import Rendering
from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.decoding.cloud import Geometry, capture_cloud, capture_geometry, imager_of_bits, sensor_geometry
from mitsim.decoding.depth_range import depths_of, range_warning
from mitsim.maps.campaign.plan import Campaign, Shot, view_axes
from mitsim.maps.campaign.pose_doubt import DIRECTION, fits, fits_inverted, may_be_inverted, pose_doubt
from mitsim.maps.campaign.store import Finished
from mitsim.sensor.sensor import Sensor
from mitsim.sensor.transforms import Transform

Item = TypeVar("Item")
Taken = TypeVar("Taken")
Made = TypeVar("Made")
CaptureSource = Callable[[Shot], Capture]
Source = Callable[[Sequence[Shot]], Iterator[tuple[Shot, Finished]]]

#: number of captures out of range that are named one by one
NAMED = 5

#: number of captures whose poses are checked for their direction before all are measured
_CHECKED = 5

#: largest relative difference between the distance of a found capture and its planned distance
DISTANCE_SLACK = 0.05


def simulated_source(sensor: SimulatedSensor, samples_per_pixel: int) -> CaptureSource:
    """Return a source of rendered captures, limited to the coupon's part of the images."""
    rendering = Rendering(samples_per_pixel)

    def take(shot: Shot) -> Capture:
        sample, pose = shot.series.sample, shot.sensor_from_coupon
        around = sample.at(pose).corners()
        return sensor.capture(sample.scene, pose.inverse(), seed=shot.seed, rendering=rendering, around=around)

    return take


def in_turn(take: CaptureSource, campaign: Campaign) -> Source:
    """Return a source that takes one shot after the other, and measures each while the next is taken."""
    geometry = sensor_geometry(campaign.sensor)

    def measure(capture: Capture, shot: Shot) -> Finished:
        return measured(capture, shot, geometry, campaign.sensor, campaign.file.keep_images)

    return lambda shots: one_ahead(shots, take, measure)


def one_ahead(
    items: Iterable[Item], take: Callable[[Item], Taken], finish: Callable[[Taken, Item], Made]
) -> Iterator[tuple[Item, Made]]:
    """Yield each item with ``finish(take(item), item)``, in order; one item is finished while the next is taken.

    All items are taken in the caller's thread, as Dr.Jit and devices require. A thread finishes one item and ends. If
    the caller is stopped or asks for no more items, no further thread starts. If taking an item fails, the item before
    it is still yielded.

    Meanwhile BLAS uses one thread. Its products are long and narrow here, its threads would wait actively for one
    another, and the cores are needed for taking.
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
            thread = ThreadPoolExecutor(1)
            ready, before = before, (item, thread.submit(finish, taken, item))
            thread.shutdown(wait=False)
            del taken
            if ready is not None:
                yield ready[0], ready[1].result()
        if before is not None:
            yield before[0], before[1].result()


def measured(capture: Capture, shot: Shot, geometry: Geometry, sensor: Sensor, keep_images: bool) -> Finished:
    """Decode a capture of a coupon and measure its patches.

    Pose and calibration are those of the capture, if it has them: a stage stops near its requested position and is read
    back, and a device has its own calibration.

    Parameters
    ----------
    capture, shot, geometry, sensor, keep_images
        Capture of the coupon, and its shot; geometry of the rig, and sensor of the campaign; whether the result
        contains the capture.
    """
    sample, pose = shot.series.sample, coupon_place(capture, shot)
    coupon = sample.at(pose)
    if own_sensor(capture, sensor) is not sensor:
        geometry = capture_geometry(capture, sensor.settings)
    decode = partial(coupon_cloud, capture, geometry=geometry, sensor=sensor)
    cloud = decode(coupon)
    if capture.source != "simulated" and (doubt := pose_doubt(cloud, decode, sample, pose)):
        say(f"warning: {shot.series.name}, {shot.name}: {doubt}")
    patches = measure_patches(cloud, coupon)
    if not keep_images:
        return Finished(patches, capture.source)
    shown = {
        "sample": shot.series.sample.label(),
        "distance_mm": float(shot.series.distance),
        "normal": [float(component) for component in shot.normal],
    }
    return Finished(patches, capture.source, replace(capture, settings={**capture.settings, "coupon": shown}))


def check_directions(campaign: Campaign, shots: dict[Path, Shot]) -> None:
    """Check a few captures of :func:`found_shots`, of all tilts, for poses that are inverted as a whole.

    Raises InputError if the points of two or more lie in the plane of the coupon at the inverse pose, and those of none
    at its pose.
    """
    told = []
    tilted = [folder for folder, shot in shots.items() if may_be_inverted(shot.series.sample, shot.sensor_from_coupon)]
    tilted.sort(key=lambda folder: shots[folder].normal[2])
    for folder in tilted[:: max(len(tilted) // _CHECKED, 1)]:
        capture, shot = read_capture(folder), shots[folder]
        decode = partial(
            coupon_cloud, capture, geometry=capture_geometry(capture, campaign.sensor.settings), sensor=campaign.sensor
        )
        if capture.source == "simulated" or fits(decode, shot.series.sample.at(shot.sensor_from_coupon)):
            return
        told += [folder] if fits_inverted(decode, shot.series.sample, shot.sensor_from_coupon) else []
    if len(told) > 1:
        inside = f"poses that fit the points only if they are inverted, also in {', '.join(map(str, told[1:]))}"
        raise InputError(told[0] / "pose.json", "world_from_sensor", inside, "from sensor to coupon", DIRECTION)


def coupon_place(capture: Capture, shot: Shot) -> Transform:
    """Return ``sensor_from_coupon`` of a capture, or that of the plan if the capture has no pose."""
    world = capture.world_from_sensor
    return shot.sensor_from_coupon if world is None else world.inverse()


def own_sensor(capture: Capture, sensor: Sensor) -> Sensor:
    """Return the sensor with the calibration of a capture, or the sensor itself if both are the same."""
    rig = capture.rig
    if rig is sensor.rig or calibration_table(rig) == calibration_table(sensor.rig):
        return sensor
    return replace(sensor, rig=replace(rig, projector=rig.projector or sensor.rig.projector))


def coupon_cloud(capture: Capture, coupon: Coupon, geometry: Geometry, sensor: Sensor) -> PointCloud:
    """Decode the part of a capture that shows the coupon.

    Parameters
    ----------
    capture, coupon, geometry, sensor
        Capture and its geometry; the coupon at its pose, sensor frame; gives the decoder, and the imager of a capture
        that states none.
    """
    grid = geometry.grid
    seen = outline(grid, coupon)
    corners = np.nan_to_num(seen) if len(seen) else np.zeros((1, 2))
    low = np.clip(np.floor(corners.min(axis=0)).astype(int) - 2, 0, [grid.width - 1, grid.height - 1])
    high = np.clip(np.ceil(corners.max(axis=0)).astype(int) + 3, low + 1, [grid.width, grid.height])
    imager = imager_of_bits(capture, capture.decoding.imager or sensor.imager)
    return capture_cloud(capture, sensor.settings, geometry, Roi.between(*low, *high), imager)


def coupon_residuals(sensor: SimulatedSensor, campaign: Campaign) -> list[RenderResidual]:
    """Return the render residual of each sample in the reference camera, and warn if it is too large.

    The coupon is rendered at the middle normal of the plan. The first one is often the mirror direction, in which a
    metal saturates the camera.
    """
    camera = next(iter(sensor.sensor.rig.cameras))
    normals = campaign.file.normals()
    rendering, seed = Rendering(campaign.file.samples_per_pixel), campaign.file.seed
    out = []
    for series in campaign.series:
        if series.variant is None and series.distance == campaign.distances[0]:
            pose = campaign.shot(series, normals[len(normals) // 2]).sensor_from_coupon
            sample, around = series.sample, series.sample.at(pose).corners()
            residual = render_residual(
                sensor, sample.scene, pose.inverse(), camera, rendering, seed=seed, around=around
            )
            out.append(warn_above_limit(sample.label(), residual))
    return out


def found_shots(folder: str | Path, campaign: Campaign) -> dict[Path, Shot]:
    """Return the captures of coupons in a folder and its subfolders as shots of a campaign.

    Each capture must name its sample (``settings.coupon.sample``) and have a pose, with the coupon's frame as the
    world, z toward the sensor. It belongs to the nearest planned distance. Raises InputError if there is no capture,
    one whose sample or distance is not in the campaign, or two of one pose.
    """
    folder = Path(folder)
    folders = sorted(path.parent for path in folder.rglob("capture.json"))
    if not folders:
        raise InputError(folder, "", "no captures", "a folder with captures of coupons")
    folder_of: dict[tuple[str, str], Path] = {}
    shots = {capture_folder: _found_shot(capture_folder, campaign) for capture_folder in folders}
    for capture_folder, shot in shots.items():
        other = folder_of.setdefault((shot.series.name, shot.name), capture_folder)
        if other != capture_folder:
            found, hint = f"the orientation of {other}", "write the pose anew, or keep one capture of each orientation"
            raise InputError(capture_folder / "pose.json", "", found, "another for each capture", hint)
    return shots


def out_of_range(campaign: Campaign, shots: dict[Path, Shot] | None = None) -> list[str]:
    """Return a warning for each capture whose coupon centre is outside the depth range of the decoder.

    Captures in ``shots`` count by their own poses, else planned ones count once for each sample and distance. At most
    :data:`NAMED` captures have a line each; one more line has the number of the others.
    """
    sensor = campaign.sensor
    facing = np.array([0.0, 0.0, 1.0])
    planned = {
        f"{series.sample.label()} at {series.distance:g} mm": campaign.shot(series, facing)
        for series in campaign.series
        if series.variant is None
    }
    shown = planned if shots is None else {str(folder): shot for folder, shot in shots.items()}
    reason = "by the plan" if shots is None else "by its pose"
    lines = []
    for name, shot in shown.items():
        coupon = shot.series.sample.at(shot.sensor_from_coupon)
        points = np.concatenate([coupon.centre[None], coupon.corners()])
        middle, *depths = depths_of(points, sensor.rig, sensor.settings)
        if not sensor.settings.near_mm <= middle <= sensor.settings.far_mm:
            reach = (float(min(depths)), float(max(depths)))
            warned = range_warning(f"{name}: the coupon", reach, sensor.settings, sensor.name, reason)
            lines.append(f"warning: {warned}")
    if len(lines) > NAMED:
        lines[NAMED:] = [f"warning: and {len(lines) - NAMED} of {len(shown)} more are outside the range"]
    return lines


def found_source(shots: dict[Path, Shot]) -> CaptureSource:
    """Return a source of the captures from :func:`found_shots`, which are read when needed."""
    folders = {(shot.series.name, shot.name): folder for folder, shot in shots.items()}
    return lambda shot: read_capture(folders[shot.series.name, shot.name])


def _found_shot(folder: Path, campaign: Campaign) -> Shot:
    sensor, settings, world_from_sensor = read_settings_and_pose(folder)
    if sensor != campaign.sensor.name:
        raise InputError(folder / "capture.json", "sensor", sensor, campaign.sensor.name, "or choose another --sensor")
    shown = settings.get("coupon")
    label = shown.get("sample") if isinstance(shown, dict) else None
    labels = [sample.label() for sample in campaign.samples]
    if label not in labels:
        hint = "the label of a sample of the campaign"
        raise InputError(folder / "settings.json", "coupon.sample", repr(label), ", ".join(labels), hint)
    if world_from_sensor is None:
        hint = "mitsim import --coupon COLUMN ROW WIDTH HEIGHT takes it from the plane of a coupon's points"
        raise InputError(folder / "pose.json", "world_from_sensor", "null", "the pose, in the coupon's frame", hint)
    if world_from_sensor.translation[2] <= 0:
        found, allowed = "a sensor behind the coupon", "a position with z over 0 in the coupon's frame"
        raise InputError(folder / "pose.json", "world_from_sensor", found, allowed, "the coupon's z faces the sensor")
    pose = world_from_sensor.inverse()
    distance = float(np.linalg.norm(pose.translation - campaign.sensor.rig.reference.sensor_from_camera.translation))
    nominal = min(campaign.distances, key=lambda planned: abs(np.log(distance / planned)))
    if abs(distance / nominal - 1) > DISTANCE_SLACK:
        allowed = f"within 5 % of {', '.join(f'{planned:g}' for planned in campaign.distances)} mm"
        hint = "add this distance to distances_mm"
        raise InputError(folder / "pose.json", "distance", f"{distance:.1f} mm", allowed, hint)
    here = (series for series in campaign.series if series.variant is None and series.distance == nominal)
    series = next(series for series in here if series.sample.label() == label)
    axis = campaign.sensor.rig.reference.sensor_from_camera.rotation[:, 2]
    index = read_bounded(folder / "capture.json", "a complete capture folder")  # it has the digest of every other file
    return Shot(series, view_axes(axis).T @ pose.rotation[:, 2], pose, hashlib.sha256(index).hexdigest())
