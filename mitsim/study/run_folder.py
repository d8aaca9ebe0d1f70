"""Read and check the folder of a run before anything is drawn."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
import xarray as xr

from characterisation.cloud_files import read_cloud
from characterisation.files.checked_files import read_json_object
from characterisation.files.datasets import Schema, Variable, read_dataset
from characterisation.files.documents import validate
from characterisation.files.errors import InputError
from characterisation.maps.performance_map import PerformanceMap
from characterisation.point_cloud import PointCloud
from characterisation.tasks.task_file import Task
from characterisation.tasks.task_reading import check_task
from mitsim.capture.capture import Capture
from mitsim.capture.folder import read_capture
from mitsim.study.run_document import RunDocument
from mitsim.study.run_files import AGAIN, TASK, check_own
from mitsim.study.statement_file import StatementDocument, read_statement

_MADE_BY = "a folder made by mitsim run"

#: dimensions of the variables of each measurement and view
_BY_VIEW = ("measurement", "view")
#: dimensions of the variables of each view and feature
_BY_FEATURE = ("view", "feature")
#: dimension of the variables of each view
_VIEW = ("view",)
_ALL = {"measurement": Variable(("measurement",), "text"), "view": Variable(_VIEW, "whole", 0, 1e9)}

_SCORES = Schema(
    "scores of a run",
    {
        "predicted_uncertainty": Variable(_BY_VIEW, low=0.0, high=1e12, gaps=True),
        "chance": Variable(_BY_VIEW, low=0.0, high=1.0, gaps=True),
        "uncertainty_possible": Variable(_BY_VIEW, "truth"),
        "possible": Variable(_BY_VIEW, "truth"),
        "uncertainty_rank": Variable(_BY_VIEW, "whole", 1, 1e9),
        "rank": Variable(_BY_VIEW, "whole", 1, 1e9),
        "limit": Variable(_BY_VIEW, "text"),
        "limiting_feature": Variable(_BY_VIEW, "text"),
        "V_m": Variable(_BY_VIEW, low=0.0, high=1e12),
        "tolerance": Variable(("measurement",), gaps=True),
        "n": Variable(_BY_FEATURE, low=0.0, high=1e12),
        "n_only_white": Variable(_BY_FEATURE, low=0.0, high=1e12),
        "mean_sigma": Variable(_BY_FEATURE, low=0.0, high=1e12, gaps=True),
        "R_f": Variable(_BY_FEATURE, low=0.0, high=1e12),
        "roll_deg": Variable(_VIEW, low=-720, high=720),
        "elevation_deg": Variable(_VIEW, low=-90.1, high=90.1),
        "azimuth_deg": Variable(_VIEW, low=-720, high=720),
        "standoff_mm": Variable(_VIEW, low=0, high=1e6),
        "direction": Variable(("view", "xyz"), low=-1.001, high=1.001),
        "world_from_sensor": Variable(("view", "i", "j"), low=-1e9, high=1e9),
        "measured_risk": Variable(_BY_VIEW, low=0.0, high=1e12, gaps=True, needed=False),
        "trials": Variable(_BY_VIEW, "whole", 0, 1e9, needed=False),
        "final_rank": Variable(_BY_VIEW, "whole", 1, 1e9, needed=False),
        "feature": Variable(("feature",), "text"),
        **_ALL,
    },
    {
        "view": (1, 1_000_000),
        "measurement": (1, 10_000),
        "feature": (1, 10_000),
        "i": (4, 4),
        "j": (4, 4),
        "xyz": (3, 3),
    },
    ("measurement", "view", "feature"),
    AGAIN,
)
_ERRORS = Variable(("measurement", "view", "repeat"), gaps=True)
_CHECKS = Schema(
    "checks of a run",
    {
        "value": _ERRORS,
        "error": _ERRORS,
        "tried": Variable(("measurement", "view", "repeat"), "whole", 0, 1, needed=False),
        **_ALL,
    },
    {"repeat": (0, 1_000_000)},
    ("measurement", "view"),
    AGAIN,
)
_PATCHES = Schema(
    "patches of a campaign",
    {
        "normal_x": Variable(("patch",), low=-1.001, high=1.001),
        "normal_y": Variable(("patch",), low=-1.001, high=1.001),
        "sample_number": Variable(("patch",), "whole", 0, 100_000),
        "finish": Variable(("sample",), "text"),
        "roughness": Variable(("sample",), low=0.0, high=1e6, gaps=True),
    },
    hint=AGAIN,
)


@dataclass(frozen=True)
class Run:
    """A run that has been read; ``patches`` is None if the run used an existing map."""

    folder: Path
    about: RunDocument
    performance_map: PerformanceMap
    patches: xr.Dataset | None
    scores: xr.Dataset
    checks: xr.Dataset
    statement: StatementDocument | None

    @property
    def measurements(self) -> list[str]:
        """Return the names of the measurements, in the order of the task."""
        return [str(name) for name in self.scores["measurement"].values]

    @property
    def checked(self) -> list[int]:
        """Return the numbers of the views with images and a decoded cloud, the best of all first."""
        return list(self.about.checked_views)

    @property
    def clouds(self) -> list[int]:
        """Return the numbers of the views with a predicted cloud, ascending."""
        return [int(view) for view in self.scores["view"].values if self.has_cloud("predicted", int(view))]

    def has(self, name: str) -> bool:
        """Return whether a file belongs to this run: ``run.json`` names it, or it exists and ``run.json`` is old and
        names none.
        """
        return name in self.about.files if self.about.files else (self.folder / name).exists()

    def has_cloud(self, kind: str, view: int) -> bool:
        """Return whether a view has a ``predicted`` or ``rendered`` cloud."""
        return self.has(_cloud_name(kind, view))

    def cloud(self, kind: str, view: int) -> PointCloud:
        """Return the ``predicted`` or ``rendered`` cloud of a view."""
        name = _cloud_name(kind, view)
        self.check(name)
        return read_cloud(self.folder / name)

    def part(self) -> trimesh.Trimesh | None:
        """Return the part's surface [mm], part frame; None if the run has no ``part.ply``."""
        if not self.has("part.ply"):
            return None
        self.check("part.ply")
        return _mesh(self.folder / "part.ply")

    def task(self) -> Task:
        """Return the task that the run had."""
        path = self.folder / TASK
        if not self.has(TASK):
            hint = "give the task: --task FILE"
            raise InputError(path, "", "no such file", "the copy of its task that a run keeps", hint)
        self.check(TASK)
        task = validate(path, read_json_object(path), Task)
        check_task(path, task)
        return task

    def check(self, name: str) -> None:
        """Check a file against its digest in ``run.json``; raise :class:`InputError` if they differ."""
        check_own(self.folder, self.about.files, [name])

    def predicted(self, view: int) -> PointCloud:
        """Return the cloud of a view that the map predicts."""
        return self.cloud("predicted", view)

    def decoded(self, view: int) -> PointCloud:
        """Return the cloud of a checked view, decoded from its rendered images."""
        cloud, grid = self.cloud("rendered", view), self.predicted(view).grid
        if (cloud.grid.height, cloud.grid.width) != (grid.height, grid.width):
            size, path = (
                f"{cloud.grid.height} x {cloud.grid.width} pixels",
                self.folder / _cloud_name("rendered", view),
            )
            raise InputError(path, "grid", size, f"{grid.height} x {grid.width}, as the predicted cloud")
        return cloud

    def capture(self, view: int) -> Capture:
        """Return the images of a checked view."""
        self.check(f"captures/view_{view:04d}/capture.json")
        return read_capture(self.folder / "captures" / f"view_{view:04d}")


def _cloud_name(kind: str, view: int) -> str:
    return f"clouds/{kind}_{view:04d}.ply"


def read_run(folder: str | Path) -> Run:
    """Read the folder of a finished run; captures and clouds are read on request.

    Raises InputError if a file is missing, damaged or does not belong to the others; the message names the file.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(folder, "", "no such folder", _MADE_BY)
    table = read_json_object(folder / "run.json", _MADE_BY, "mitsim run writes it last: let the run finish")
    about = validate(folder / "run.json", table, RunDocument)
    digests = about.files
    check_own(folder, digests, ("map.nc", "samples.nc", "scores.nc", "checks.nc", "statement.json"))
    performance_map = PerformanceMap.load(folder / "map.nc")
    sampled = "samples.nc" in digests if digests else (folder / "samples.nc").exists()
    patches = read_dataset(folder / "samples.nc", _PATCHES) if sampled else None
    if patches is not None and (patches["sample_number"].values >= patches.sizes["sample"]).any():
        raise InputError(folder / "samples.nc", "sample_number", "a number without a sample", "numbers of the samples")
    scores = read_dataset(folder / "scores.nc", _SCORES)
    least = scores.attrs.get("minimum_points", 0)
    if not isinstance(least, (int, np.integer)) or not 0 <= least < 2**40:
        raise InputError(folder / "scores.nc", "minimum_points", repr(least)[:80], "a whole number of points")
    checks = read_dataset(folder / "checks.nc", _CHECKS)
    for name, data in (("scores.nc", scores), ("checks.nc", checks)):
        measurements = [str(measurement) for measurement in data["measurement"].values]
        if measurements != list(about.measurements):
            allowed = f"{', '.join(about.measurements)}, as in run.json"
            raise InputError(folder / name, "measurement", ", ".join(measurements), allowed)
    seen = {str(feature) for feature in scores["feature"].values}
    for name, entry in about.measurements.items():
        if absent := sorted(set(entry.shapes) - seen):
            allowed = "features of scores.nc"
            raise InputError(folder / "run.json", f"measurements.{name}.shapes", absent[0], allowed)
    named = [("checks.nc", "view", checks["view"].values.tolist())]
    named += [("run.json", f"view_sets[{i}].views", chosen.views) for i, chosen in enumerate(about.view_sets)]
    for name, key, views in named:
        if missing := sorted(set(views) - set(scores["view"].values.tolist())):
            raise InputError(folder / name, key, missing[0], "views of scores.nc")
    for name in ("possible", "uncertainty_possible"):
        scores[name] = scores[name].astype(bool)  # netCDF has no booleans
    stated = "statement.json" in digests or not digests
    statement = read_statement(folder / "statement.json") if stated else None
    if statement is not None and not set(statement.measurements) <= set(about.measurements):
        names, allowed = ", ".join(statement.measurements), f"{', '.join(about.measurements)}, as in run.json"
        raise InputError(folder / "statement.json", "measurements", names, allowed)
    return Run(folder, about, performance_map, patches, scores, checks, statement)


def _mesh(path: Path) -> trimesh.Trimesh | None:
    if not path.exists():
        return None
    try:
        mesh = trimesh.load(path, process=False)
    except (OSError, ValueError, KeyError, IndexError, TypeError, AttributeError) as error:  # as trimesh has it
        raise InputError(path, "", f"a file that cannot be read ({error})", "a mesh as PLY") from None
    if (
        not isinstance(mesh, trimesh.Trimesh)
        or not len(mesh.faces)
        or not np.isfinite(mesh.vertices).all()
        or not 0 <= mesh.faces.min() <= mesh.faces.max() < len(mesh.vertices)
    ):
        raise InputError(path, "", "no triangles, or bad vertices", "a mesh as PLY")
    return mesh
