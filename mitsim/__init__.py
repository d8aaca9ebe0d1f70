"""Simulate 3D vision sensors on Mitsuba 3, and characterise them from their point clouds.

``import mitsim as ms`` gives the functions and types in :data:`__all__`. Each is imported on first use, so that the
import itself takes milliseconds. ``docs/reference/interface.md`` lists the stable interface; all other modules may
change between versions.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from characterisation.words.version import __version__ as __version__

#: name -> module that defines it
_NAMES = {
    "BudgetLine": "characterisation.statements.budget",
    "CampaignFile": "mitsim.maps.campaign.campaign_file",
    "Capture": "mitsim.capture.capture",
    "InputError": "characterisation.files.errors",
    "MissingEnvironmentError": "characterisation.files.errors",
    "PerformanceMap": "characterisation.maps.performance_map",
    "PointCloud": "characterisation.point_cloud",
    "Result": "characterisation.tasks.result",
    "Scene": "mitsim.scene.load",
    "Sensor": "mitsim.sensor.sensor",
    "Statement": "characterisation.statements.statement",
    "Study": "mitsim.study",
    "StudyFile": "mitsim.study",
    "Task": "characterisation.tasks.task_file",
    "Transform": "mitsim.sensor.transforms",
    "Truth": "mitsim.capture.truth",
    "characterise": "mitsim.maps.use",
    "decode": "mitsim.decoding.decode",
    "label": "mitsim.study.task_measurement",
    "load_scene": "mitsim.capture.simulated.render",
    "load_sensor": "mitsim.sensor.preset",
    "look_at": "mitsim.sensor.poses",
    "measure": "mitsim.study.task_measurement",
    "open_study": "mitsim.study.reading",
    "performance_map": "mitsim.maps.use",
    "predict": "mitsim.maps.use",
    "read_capture": "mitsim.capture.folder",
    "read_cloud": "mitsim.decoding.decode",
    "read_task": "characterisation.tasks.task_reading",
    "read_truth": "mitsim.capture.truth",
    "render": "mitsim.capture.simulated.render",
    "run_study": "mitsim.study.run",
    "score": "mitsim.study.session",
    "statement": "mitsim.study.session",
    "triangulate": "mitsim.decoding.own_code",
    "true_points": "mitsim.scene.ray_casting.true_points",
    "write_capture": "mitsim.capture.folder",
    "write_cloud": "characterisation.cloud_files",
}

if TYPE_CHECKING:
    from characterisation.cloud_files import write_cloud as write_cloud
    from characterisation.files.errors import InputError as InputError
    from characterisation.files.errors import MissingEnvironmentError as MissingEnvironmentError
    from characterisation.maps.performance_map import PerformanceMap as PerformanceMap
    from characterisation.point_cloud import PointCloud as PointCloud
    from characterisation.statements.budget import BudgetLine as BudgetLine
    from characterisation.statements.statement import Statement as Statement
    from characterisation.tasks.result import Result as Result
    from characterisation.tasks.task_file import Task as Task
    from characterisation.tasks.task_reading import read_task as read_task
    from mitsim.capture.capture import Capture as Capture
    from mitsim.capture.folder import read_capture as read_capture
    from mitsim.capture.folder import write_capture as write_capture
    from mitsim.capture.simulated.render import load_scene as load_scene
    from mitsim.capture.simulated.render import render as render
    from mitsim.capture.truth import Truth as Truth
    from mitsim.capture.truth import read_truth as read_truth
    from mitsim.decoding.decode import decode as decode
    from mitsim.decoding.decode import read_cloud as read_cloud
    from mitsim.decoding.own_code import triangulate as triangulate
    from mitsim.maps.campaign.campaign_file import CampaignFile as CampaignFile
    from mitsim.maps.use import characterise as characterise
    from mitsim.maps.use import performance_map as performance_map
    from mitsim.maps.use import predict as predict
    from mitsim.scene.load import Scene as Scene
    from mitsim.scene.ray_casting.true_points import true_points as true_points
    from mitsim.sensor.poses import look_at as look_at
    from mitsim.sensor.preset import load_sensor as load_sensor
    from mitsim.sensor.sensor import Sensor as Sensor
    from mitsim.sensor.transforms import Transform as Transform
    from mitsim.study import Study as Study
    from mitsim.study import StudyFile as StudyFile
    from mitsim.study.reading import open_study as open_study
    from mitsim.study.run import run_study as run_study
    from mitsim.study.session import score as score
    from mitsim.study.session import statement as statement
    from mitsim.study.task_measurement import label as label
    from mitsim.study.task_measurement import measure as measure

__all__ = list(_NAMES)


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used (PEP 562)."""
    if name not in _NAMES:
        raise AttributeError(f"module 'mitsim' has no attribute {name!r}")
    found = globals()[name] = getattr(import_module(_NAMES[name]), name)
    return found


def __dir__() -> list[str]:
    """Return the public names and those of the module."""
    return sorted({*globals(), *__all__})
