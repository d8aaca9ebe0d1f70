"""Read errors of real captures of the artefact, which take the place of virtual measurements.

The talk measured its views on a real stage. Layout, as of a campaign with ``keep_images``: any folders below the given
one that hold a ``capture.json``. The capture has a pose in the part's frame. Its settings name the sample
(``settings.coupon.sample``), or a folder above it has the sample's name.

Signal chain: capture -> nearest candidate view -> cloud -> labels by the geometry of the part -> measurements -> error.
Several captures of one view are its trials.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from characterisation.files.errors import InputError
from characterisation.words.progress import track
from mitsim.capture.folder import read_capture, read_settings_and_pose
from mitsim.decoding.cloud import capture_cloud, decoder_settings
from mitsim.decoding.input_clouds import margin_of
from mitsim.sensor.transforms import Transform
from mitsim.study.task_measurement import measure_task
from mitsim.talk.talk_file import ArtefactEntry, Talk
from mitsim.views import View

#: largest angle between the axis of a capture and its view, and difference of their rolls [deg]
NEAR_DEG = 5.0

#: largest difference between the distances of a capture and of its view from the part, relative to it
NEAR_SHARE = 0.05


def measured_errors(talk: Talk, folder: Path) -> dict[str, xr.Dataset]:
    """Return the errors of the captures in a folder, by the key of their sample, as those of virtual measurements.

    Raises InputError if there is no capture, or one without a pose, of another sensor, of no sample of the talk, or of
    no view.
    """
    capture_folders = sorted(path.parent for path in folder.rglob("capture.json"))
    if not capture_folders:
        raise InputError(folder, "", "no captures", "a folder with captures of the artefact")
    errors: dict[str, dict[int, list[dict[str, float]]]] = {}
    for capture_folder in track(capture_folders, "measure captures"):
        sample, view = _shown(talk, capture_folder, folder)
        errors.setdefault(sample.key, {}).setdefault(view.number, []).append(_errors(talk, sample, capture_folder))
    return {key: _as_trials(talk, views) for key, views in errors.items()}


def _shown(talk: Talk, capture_folder: Path, folder: Path) -> tuple[ArtefactEntry, View]:
    """Return the sample and the candidate view that a capture shows."""
    sensor, settings, pose = read_settings_and_pose(capture_folder)
    if sensor != talk.sensor.name:
        raise InputError(capture_folder / "capture.json", "sensor", sensor, talk.sensor.name, "the sensor of the talk")
    if pose is None:
        allowed = "the pose, in the frame of the part"
        raise InputError(capture_folder / "pose.json", "world_from_sensor", "null", allowed)
    coupon = settings.get("coupon")
    named = coupon.get("sample") if isinstance(coupon, dict) else None
    above = {part.name for part in (capture_folder, *capture_folder.parents) if part.is_relative_to(folder)}
    for sample in talk.file.samples:
        if named == sample.name or (named is None and above & {sample.name, sample.key}):
            return sample, _nearest(talk, pose, capture_folder)
    names, hint = ", ".join(sample.name for sample in talk.file.samples), "or a folder of this name above it"
    raise InputError(capture_folder / "settings.json", "coupon.sample", repr(named), names, hint)


def _nearest(talk: Talk, pose: Transform, capture_folder: Path) -> View:
    """Return the candidate view whose pose is nearest to that of a capture, in rotation and position."""

    def turned(view: View) -> float:
        between = view.world_from_sensor.rotation.T @ pose.rotation
        return math.degrees(math.acos(min(max((float(np.trace(between)) - 1) / 2, -1.0), 1.0)))

    def moved(view: View) -> NDArray[np.float64]:
        """Across, across and along the view's axis [mm]."""
        apart = pose.translation - view.world_from_sensor.translation
        return np.asarray(view.world_from_sensor.rotation.T @ apart)

    def over_limits(view: View) -> float:
        *across, along = (moved(view) / view.standoff).tolist()
        direction = math.degrees(math.hypot(*across))
        return float(max(turned(view) / NEAR_DEG, direction / NEAR_DEG, abs(along) / NEAR_SHARE))

    view = min(talk.views, key=over_limits)
    if over_limits(view) > 1:
        apart = float(np.linalg.norm(moved(view)))
        offset = f"{turned(view):.1f} deg and {apart:.0f} mm from the nearest view, number {view.number}"
        allowed = f"a pose within {NEAR_DEG:g} deg of a candidate view, at its standoff within {100 * NEAR_SHARE:g} %"
        hint = "poses.json of mitsim study score"
        raise InputError(capture_folder / "pose.json", "world_from_sensor", offset, allowed, hint)
    return view


def _errors(talk: Talk, sample: ArtefactEntry, capture_folder: Path) -> dict[str, float]:
    study, capture = talk.study(sample), read_capture(capture_folder)
    settings, imager = decoder_settings(capture, talk.sensor)
    cloud = capture_cloud(capture, settings, imager=imager)
    assert capture.world_from_sensor is not None  # as _shown has checked
    results = measure_task(cloud, study.task, study.scene, capture.world_from_sensor, margin_px=margin_of(settings))
    return {name: float(result.error) for name, result in zip(study.task.measurements, results, strict=True)}


def _as_trials(talk: Talk, views: dict[int, list[dict[str, float]]]) -> xr.Dataset:
    """Return errors (measurement, view, trial) over all candidate views; ``tried`` is 0 for one without a capture."""
    names = list(next(iter(views.values()))[0])
    numbers = [view.number for view in talk.views]
    most = max(len(captures) for captures in views.values())
    errors = np.full((len(names), len(numbers), most), np.nan)
    for number, captures in views.items():
        for trial, values in enumerate(captures):
            errors[:, numbers.index(number), trial] = [values[name] for name in names]
    tried = [len(views.get(number, ())) for number in numbers]
    return xr.Dataset(
        {"error": (("measurement", "view", "trial"), errors), "tried": ("view", tried)},
        {"measurement": names, "view": numbers},
        {"source": "captures"},
    )
