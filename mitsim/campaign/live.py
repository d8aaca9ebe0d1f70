"""A campaign on hardware: a stage turns the coupon in front of a live sensor.

Signal chain: campaign TOML with ``[device]`` and a connected ``[stage]`` -> calibrations of the stage, a distance each
-> the orientations that it can show at all of them -> for each shot: axes turned, angles read back, a capture taken ->
the capture with the pose at the angles *read back* -> measured and kept as every other
(:mod:`mitsim.campaign.acquire`).

A stage turns a coupon in its place. A person changes coupons and puts the stage elsewhere, and is asked to.

Nothing is opened before the first capture that is not kept yet, and what was kept is never taken again. On an error and
on Ctrl-C the stage is stopped first, then the camera is left as it was found.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mitsim.campaign.acquire import DISTANCE_SLACK, CaptureSource, Source
from mitsim.campaign.devices import DepthaiTable, EnsensoTable, LiveDevice, open_device
from mitsim.campaign.plan import Campaign, CampaignFile, Shot, plan_campaign
from mitsim.campaign.stage_pose import StageCalibration, StageTable, read_stage_calibration
from mitsim.capture.capture import Capture
from mitsim.errors import InputError
from mitsim.hardware.stage import LiveStage, open_stage
from mitsim.hardware.stage_connection import StageConnection
from mitsim.sensor.preset import Sensor

#: asked before another sample is shown, or elsewhere: its label, and the distance
Mount = Callable[[str, float], None]


@dataclass(frozen=True)
class LiveCampaign:
    """A campaign ready to be run on hardware; by distance [mm], ``stages`` as calibrated and their ``calibrations``."""

    campaign: Campaign
    device: EnsensoTable | DepthaiTable
    connection: StageConnection
    stages: dict[float, StageTable]
    calibrations: dict[float, StageCalibration]


def plan_live(
    path: str | Path, file: CampaignFile, sensor: Sensor, range_mm: tuple[float, float] = (0.0, math.inf)
) -> LiveCampaign:
    """Work out a campaign file with a ``[device]``, read from ``path``.

    ``sensor``: a preset or file of the same kind, for its name, its decoder and its imager. The calibration is the
    device's own in each capture. Of the stage's places those within a range of distances are taken.

    Raises
    ------
    InputError
        For anything that would stop the campaign later.
    """
    path, device, stage = Path(path), file.device, file.stage
    if device is None:
        raise InputError(path, "device", "nothing", "a [device] table", "see docs/how-to/first-capture.md")
    if stage is None or stage.connection is None or stage.calibration is None:
        raise InputError(
            path,
            "stage",
            "no live stage",
            "a [stage] with connection and calibration",
            "a capture is of no use without the coupon's pose",
        )
    if device.settings.exposure_s is None:
        raise InputError(
            path, "device.settings.exposure_s", "nothing", "a fixed exposure [s]", "a map is of one exposure"
        )
    if sensor.technology != "active_stereo":
        raise InputError(
            f"sensor {sensor.name}",
            "technology",
            sensor.technology,
            "active_stereo",
            f"--sensor must be of the kind of the {device.kind} camera",
        )
    if file.coupon_px is not None:
        raise InputError(path, "coupon_px", f"{file.coupon_px:g}", "nothing: a real coupon has the size of its scene")
    for number, sample in enumerate(file.samples):
        if sample.spread:
            raise InputError(path, f"samples.{number}.spread", "true", "false: a real coupon has one finish")
    eye = sensor.rig.reference.centre
    files = [stage.calibration] if isinstance(stage.calibration, str) else stage.calibration
    found = {}
    for name in files:
        calibration = read_stage_calibration(path.parent / name)
        distance = _planned(path, file.distances_mm, calibration.distance(eye))
        if distance in found:
            raise InputError(path, "stage.calibration", f"two at {distance:g} mm", "one for each distance")
        found[distance] = calibration
    if missing := set(file.distances_mm or ()) - set(found):
        raise InputError(
            path,
            "distances_mm",
            f"{min(missing):g}",
            ", ".join(f"{one:g}" for one in sorted(found)),
            "a stage turns the coupon in its place: calibrate it at each distance",
        )
    calibrations = {distance: found[distance] for distance in sorted(found) if range_mm[0] <= distance <= range_mm[1]}
    if not calibrations:
        known = ", ".join(f"{one:g} mm" for one in sorted(found))
        allowed = f"a place within {range_mm[0]:.4g} to {range_mm[1]:.4g} mm"
        raise InputError(path, "stage.calibration", known, allowed, "calibrate the stage there")
    stages = {distance: calibration.stage(stage, eye) for distance, calibration in calibrations.items()}
    kept = file.model_copy(update={"keep_images": True})
    campaign = plan_campaign(path, kept, sensor, places=stages)
    return LiveCampaign(campaign, device, stage.connection, stages, calibrations)


def _planned(path: Path, distances: list[float] | None, found: float) -> float:
    """The distance of the plan at which a stage was calibrated; where none is planned, that itself."""
    if not distances:
        return float(f"{found:.4g}")
    nearest = min(distances, key=lambda one: abs(math.log(found / one)))
    if abs(found / nearest - 1) > DISTANCE_SLACK:
        raise InputError(
            path,
            "distances_mm",
            ", ".join(f"{one:g}" for one in distances),
            f"{found:.4g}, within 5 %",
            "there the stage was calibrated",
        )
    return nearest


def place_by_place(source: Source) -> Source:
    """A source that takes its shots in the order of distances and samples: a person has less to change."""
    return lambda shots: source(sorted(shots, key=lambda shot: (shot.series.distance, shot.series.sample.label())))


@contextmanager
def live_source(live: LiveCampaign, mount: Mount) -> Iterator[CaptureSource]:
    """Captures of a stage and a camera, both opened for the first shot and closed at the end.

    Raises
    ------
    DeviceError
        If one of them does not do what it should; what was kept is kept.
    """
    with ExitStack() as opened:
        hardware: list[tuple[LiveDevice, LiveStage]] = []
        mounted: list[tuple[str, float]] = []

        def take(shot: Shot) -> Capture:
            wanted = (shot.series.sample.label(), shot.series.distance)
            if len(live.campaign.series) > 1 and mounted != [wanted]:
                mount(*wanted)
                mounted[:] = [wanted]
            if not hardware:
                camera = opened.enter_context(open_device(live.device))
                stage = opened.enter_context(open_stage(live.connection))  # the last to open is stopped first
                stage.home()
                hardware.append((camera, stage))
            return live_capture(live, shot, *hardware[0])

        yield take


def live_capture(live: LiveCampaign, shot: Shot, camera: LiveDevice, stage: LiveStage) -> Capture:
    """Turn the stage to a shot's normal, and take the capture with the pose at the angles that are read back."""
    distance = shot.series.distance
    calibration = live.calibrations[distance]
    asked = np.degrees(live.stages[distance].angles(shot.normal)[0])
    read = stage.move(asked)
    capture = camera.take().capture
    angles = np.radians(read)
    told = {"axes": list(stage.axes), "asked_deg": asked.tolist(), "read_deg": read.tolist()}
    return replace(
        capture,
        sensor=live.campaign.sensor.name,
        world_from_sensor=calibration.sensor_from_coupon(angles).inverse(),
        pose_covariance=calibration.world_covariance(angles),
        settings={**capture.settings, "device_model": capture.sensor, "stage": told},
    )
