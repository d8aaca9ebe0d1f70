"""Campaign on hardware: a stage rotates the coupon in front of a live sensor.

Signal chain: campaign TOML with ``[device]`` and a connected ``[stage]`` -> one calibration of the stage for each
distance -> orientations that it can show at all of them -> for each shot: axes moved, angles read back, a capture taken
-> the capture with the pose at the angles *read back* -> measured and kept as in every campaign
(:mod:`mitsim.maps.campaign.acquire`).

A stage rotates a coupon at a fixed position. A person changes coupons and moves the stage, when the program asks for
it.

Nothing is opened before the first missing capture, and kept captures are never repeated. On an error and on Ctrl-C the
stage is stopped first, then the camera is restored to its former state.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from characterisation.files.errors import InputError
from mitsim.capture.capture import Capture
from mitsim.capture.devices.maker_captures import DepthaiTable, EnsensoTable, OpenDevice, device_capture, open_device
from mitsim.capture.devices.stage import LiveStage, open_stage
from mitsim.capture.devices.stage_connection import StageConnection
from mitsim.maps.campaign.acquire import DISTANCE_SLACK, CaptureSource, Source
from mitsim.maps.campaign.campaign_file import CampaignFile
from mitsim.maps.campaign.plan import Campaign, Shot, plan_campaign
from mitsim.maps.campaign.stage_pose import StageCalibration, StageTable, read_stage_calibration
from mitsim.sensor.sensor import Sensor

#: called before another sample or distance, with the sample's label and the distance
Mount = Callable[[str, float], None]


@dataclass(frozen=True)
class LiveCampaign:
    """A campaign ready to run on hardware; ``stages`` as calibrated, and their ``calibrations``, by distance [mm]."""

    campaign: Campaign
    device: EnsensoTable | DepthaiTable
    connection: StageConnection
    stages: dict[float, StageTable]
    calibrations: dict[float, StageCalibration]


def plan_live(
    path: str | Path, file: CampaignFile, sensor: Sensor, range_mm: tuple[float, float] = (0.0, math.inf)
) -> LiveCampaign:
    """Plan a campaign with a ``[device]``, read from the file ``path``.

    Raises InputError for anything that would stop the campaign later.

    Parameters
    ----------
    path, file, sensor
        The campaign file, and its content; preset or file of the same kind, for name, decoder and imager. The
        calibration is that of the device in each capture.
    range_mm
        Range of distances; stage positions outside it are ignored.
    """
    path, device, stage = Path(path), file.device, file.stage
    if device is None:
        raise InputError(path, "device", "nothing", "a [device] table", "see docs/how-to/first-capture.md")
    if stage is None or stage.connection is None or stage.calibration is None:
        allowed, hint = "a [stage] with connection and calibration", "the pose of the coupon must be known"
        raise InputError(path, "stage", "no live stage", allowed, hint)
    if device.settings.exposure_s is None:
        field, hint = "device.settings.exposure_s", "a map holds for one exposure"
        raise InputError(path, field, "nothing", "a fixed exposure [s]", hint)
    if sensor.technology != "active_stereo":
        hint = f"--sensor must be of the kind of the {device.kind} camera"
        raise InputError(f"sensor {sensor.name}", "technology", sensor.technology, "active_stereo", hint)
    if file.coupon_px is not None:
        raise InputError(path, "coupon_px", f"{file.coupon_px:g}", "nothing: a real coupon has the size of its scene")
    for number, sample in enumerate(file.samples):
        if sample.spread:
            raise InputError(path, f"samples.{number}.spread", "true", "false: a real coupon has one finish")
    eye = sensor.rig.reference.centre
    files = [stage.calibration] if isinstance(stage.calibration, str) else stage.calibration
    calibration_of = {}
    for name in files:
        calibration = read_stage_calibration(path.parent / name)
        distance = _planned(path, file.distances_mm, calibration.distance(eye))
        if distance in calibration_of:
            raise InputError(path, "stage.calibration", f"two at {distance:g} mm", "one for each distance")
        calibration_of[distance] = calibration
    if missing := set(file.distances_mm or ()) - set(calibration_of):
        allowed = ", ".join(f"{distance_mm:g}" for distance_mm in sorted(calibration_of))
        hint = "calibrate the stage at each distance, since it does not move the coupon"
        raise InputError(path, "distances_mm", f"{min(missing):g}", allowed, hint)
    calibrations = {d: calibration_of[d] for d in sorted(calibration_of) if range_mm[0] <= d <= range_mm[1]}
    if not calibrations:
        calibrated = ", ".join(f"{distance_mm:g} mm" for distance_mm in sorted(calibration_of))
        allowed = f"a place within {range_mm[0]:.4g} to {range_mm[1]:.4g} mm"
        raise InputError(path, "stage.calibration", calibrated, allowed, "calibrate the stage there")
    stages = {distance: calibration.stage(stage, eye) for distance, calibration in calibrations.items()}
    kept = file.model_copy(update={"keep_images": True})
    campaign = plan_campaign(path, kept, sensor, stage_tables=stages)
    return LiveCampaign(campaign, device, stage.connection, stages, calibrations)


def _planned(path: Path, distances: list[float] | None, distance_mm: float) -> float:
    """Return the planned distance at which a stage was calibrated; without a plan, the distance of the calibration."""
    if not distances:
        return float(f"{distance_mm:.4g}")
    nearest = min(distances, key=lambda distance: abs(math.log(distance_mm / distance)))
    if abs(distance_mm / nearest - 1) > DISTANCE_SLACK:
        planned = ", ".join(f"{distance:g}" for distance in distances)
        hint = "the stage was calibrated there"
        raise InputError(path, "distances_mm", planned, f"{distance_mm:.4g}, within 5 %", hint)
    return nearest


def place_by_place(source: Source) -> Source:
    """Return a source that sorts its shots by distance and sample, so that a person has fewer changes to make."""
    return lambda shots: source(sorted(shots, key=lambda shot: (shot.series.distance, shot.series.sample.label())))


@contextmanager
def live_source(live: LiveCampaign, mount: Mount) -> Iterator[CaptureSource]:
    """Return a source of captures from a stage and a camera, which are opened for the first shot and closed at the end.

    Raises DeviceError if one of them fails; kept captures stay.
    """
    with ExitStack() as opened:
        hardware: list[tuple[OpenDevice, LiveStage]] = []
        mounted: list[tuple[str, float]] = []

        def take(shot: Shot) -> Capture:
            wanted = (shot.series.sample.label(), shot.series.distance)
            if len(live.campaign.series) > 1 and mounted != [wanted]:
                mount(*wanted)
                mounted[:] = [wanted]
            if not hardware:
                camera = open_device(live.device)
                opened.enter_context(camera)
                stage = opened.enter_context(open_stage(live.connection))  # opened last, so stopped first
                stage.home()
                hardware.append((camera, stage))
            return _live_capture(live, shot, *hardware[0])

        yield take


def _live_capture(live: LiveCampaign, shot: Shot, camera: OpenDevice, stage: LiveStage) -> Capture:
    """Rotate the stage to a shot's normal, and take a capture with the pose at the angles that are read back."""
    distance = shot.series.distance
    calibration = live.calibrations[distance]
    asked = np.degrees(live.stages[distance].angles(shot.normal)[0])
    read = stage.move(asked)
    capture = device_capture(camera.take()).capture
    angles = np.radians(read)
    stage_record = {"axes": list(stage.axes), "asked_deg": asked.tolist(), "read_deg": read.tolist()}
    return replace(
        capture,
        sensor=live.campaign.sensor.name,
        world_from_sensor=calibration.sensor_from_coupon(angles).inverse(),
        settings={**capture.settings, "device_model": capture.sensor, "stage": stage_record},
    )
