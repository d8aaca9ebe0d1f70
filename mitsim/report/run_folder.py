"""The folder of a run, read and checked before anything is drawn."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import trimesh
import xarray as xr
from pydantic import ConfigDict, Field

from characterisation.cloud_files import read_ply
from characterisation.documents import Document, validate
from characterisation.errors import InputError
from characterisation.maps.performance_map import PerformanceMap
from characterisation.point_cloud import PointCloud
from mitsim.capture.capture import Capture
from mitsim.capture.folder import read_capture
from mitsim.report.run_files import check_own
from mitsim.report.statement_section import StatementDocument, read_statement

_MADE_BY = "a folder made by mitsim run"

_SCORES = (
    "predicted_uncertainty", "chance", "uncertainty_possible", "uncertainty_rank", "limit", "limiting_feature", "V_m",
    "rank", "possible", "tolerance", "n", "mean_sigma", "R_f", "n_only_white", "roll_deg", "elevation_deg",
    "azimuth_deg", "standoff_mm", "direction", "world_from_sensor", "measurement", "view", "feature",
)  # fmt: skip
_CHECKS = ("value", "error", "measurement", "view")
_PATCHES = ("normal_x", "normal_y", "sample_number", "finish", "roughness")


class MeasurementEntry(Document):
    """What ``run.json`` says of a measurement."""

    model_config = ConfigDict(extra="ignore", frozen=True, allow_inf_nan=False)
    nominal: float
    unit: str
    features: list[str]


class ResidualEntry(Document):
    """What ``run.json`` says of the renders, in units of the sensor's own noise [1]; ``outliers`` a share of pixels."""

    model_config = ConfigDict(extra="ignore", frozen=True, allow_inf_nan=False)
    noise: float
    quadrature: float
    outliers: float


class ViewSetEntry(Document):
    """Views that together keep limits, by measurement in its unit.

    ``exact`` where fewer are proven not to; ``feasible`` is false of a limit that all views together would miss.
    """

    model_config = ConfigDict(extra="ignore", frozen=True, allow_inf_nan=False)
    limits: dict[str, float]
    views: list[int]
    uncertainty: dict[str, float | None] = Field(default_factory=dict)
    feasible: dict[str, bool] = Field(default_factory=dict)
    exact: bool = False


class RunDocument(Document):
    """``run.json``, as far as a report needs it; what else stands there is left alone."""

    model_config = ConfigDict(extra="ignore", frozen=True, allow_inf_nan=False)
    schema_version: Literal[1]
    mitsim: str
    study: str
    scene: str
    sensor: str
    source: str
    map_source: str = ""
    exposure_rule: str
    seed: int
    checked_views: list[int]
    raced_views: int = 0
    race_trials: int = 0
    race_decided: bool = False
    leaders: dict[str, int] = Field(default_factory=dict)
    confidence: dict[str, float] = Field(default_factory=dict)
    light_path_depth: int
    score_light_path_depth: int = 1
    render_residual: ResidualEntry | None = None
    features: dict[str, str]
    measurements: dict[str, MeasurementEntry]
    view_sets: list[ViewSetEntry] = Field(default_factory=list)
    seconds: dict[str, float] = Field(default_factory=dict)
    python: str = ""
    machine: str = ""
    cores: int | None = None
    files: dict[str, str] = Field(default_factory=dict)


@dataclass(frozen=True)
class Run:
    """A run that has been read; ``patches`` is None where the map was made before."""

    folder: Path
    about: RunDocument
    performance_map: PerformanceMap
    patches: xr.Dataset | None
    scores: xr.Dataset
    checks: xr.Dataset
    statement: StatementDocument | None

    @property
    def measurements(self) -> list[str]:
        """Names, in the order of the task."""
        return [str(name) for name in self.scores["measurement"].values]

    @property
    def checked(self) -> list[int]:
        """Numbers of the views whose images and decoded cloud are there, the best of all first."""
        return list(self.about.checked_views)

    @property
    def clouds(self) -> list[int]:
        """Numbers of the views whose predicted cloud is there, ascending."""
        return [int(view) for view in self.scores["view"].values if self.has(f"clouds/predicted_{int(view):04d}.ply")]

    def has(self, name: str) -> bool:
        """Whether a file is of this run: named in ``run.json``, or merely there where that is of before."""
        return name in self.about.files if self.about.files else (self.folder / name).exists()

    def _cloud_path(self, kind: str, view: int) -> Path:
        return self.folder / "clouds" / f"{kind}_{view:04d}.ply"

    def part(self) -> trimesh.Trimesh | None:
        """The part's own surface [mm], part frame; None where the run has no ``part.ply``."""
        if not self.has("part.ply"):
            return None
        self.check("part.ply")
        return _mesh(self.folder / "part.ply")

    def check(self, name: str) -> None:
        """Refuse a file of the folder that is not as ``run.json`` names it, with an :class:`InputError`."""
        check_own(self.folder, self.about.files, [name])

    def predicted(self, view: int) -> PointCloud:
        """Cloud of a view as the map predicts it."""
        self.check(f"clouds/predicted_{view:04d}.ply")
        return read_ply(self._cloud_path("predicted", view))

    def decoded(self, view: int) -> PointCloud:
        """Cloud of a checked view, decoded from its rendered images."""
        path = self._cloud_path("rendered", view)
        self.check(f"clouds/rendered_{view:04d}.ply")
        cloud, grid = read_ply(path), self.predicted(view).grid
        if (cloud.grid.height, cloud.grid.width) != (grid.height, grid.width):
            found = f"{cloud.grid.height} x {cloud.grid.width} pixels"
            raise InputError(path, "grid", found, f"{grid.height} x {grid.width}, as the predicted cloud")
        return cloud

    def capture(self, view: int) -> Capture:
        """Images of a checked view."""
        self.check(f"captures/view_{view:04d}/capture.json")
        return read_capture(self.folder / "captures" / f"view_{view:04d}")


def read_run(folder: str | Path) -> Run:
    """Read the folder of a finished run; captures and clouds are read when they are asked for.

    Raises
    ------
    InputError
        If a file is missing, damaged or does not belong to the others; the file is named.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(folder, "", "no such folder", _MADE_BY)
    about = _read_about(folder / "run.json")
    own = about.files
    check_own(folder, own, ("map.nc", "samples.nc", "scores.nc", "checks.nc", "statement.json"))
    performance_map = PerformanceMap.load(folder / "map.nc")
    sampled = "samples.nc" in own if own else (folder / "samples.nc").exists()
    patches = _dataset(folder / "samples.nc", _PATCHES) if sampled else None
    scores = _dataset(folder / "scores.nc", _SCORES)
    checks = _dataset(folder / "checks.nc", _CHECKS)
    for name, data in (("scores.nc", scores), ("checks.nc", checks)):
        found = [str(measurement) for measurement in data["measurement"].values]
        if found != list(about.measurements):
            allowed = f"{', '.join(about.measurements)}, as in run.json"
            raise InputError(folder / name, "measurement", ", ".join(found), allowed)
    unknown = sorted(set(checks["view"].values.tolist()) - set(scores["view"].values.tolist()))
    if unknown:
        raise InputError(folder / "checks.nc", "view", unknown[0], "views of scores.nc")
    for i, entry in enumerate(about.view_sets):
        if absent := sorted(set(entry.views) - set(scores["view"].values.tolist())):
            raise InputError(folder / "run.json", f"view_sets[{i}].views", absent[0], "views of scores.nc")
    for name in ("possible", "uncertainty_possible"):
        scores[name] = scores[name].astype(bool)  # netCDF has no booleans
    stated = "statement.json" in own or not own
    statement = read_statement(folder / "statement.json") if stated else None
    return Run(folder, about, performance_map, patches, scores, checks, statement)


def _read_about(path: Path) -> RunDocument:
    try:
        table = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(path, "", "no such file", _MADE_BY, "mitsim run writes it last: let the run finish") from None
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(path, "", f"a file that cannot be read ({error})", "JSON in UTF-8") from None
    if not isinstance(table, dict):
        raise InputError(path, "", type(table).__name__, "a JSON object")
    return validate(path, table, RunDocument)


def _dataset(path: Path, variables: tuple[str, ...]) -> xr.Dataset:
    if not path.is_file():
        raise InputError(path, "", "no such file", _MADE_BY)
    try:
        data = xr.load_dataset(path)
    except (OSError, ValueError, RuntimeError) as error:
        raise InputError(path, "", f"a file that cannot be read ({error})", "netCDF") from None
    _check_variables(path, data, variables)
    return data


def _check_variables(path: Path, data: xr.Dataset, variables: tuple[str, ...]) -> None:
    missing = [name for name in variables if name not in data]
    if missing:
        hint = "run the study again: mitsim run STUDY.toml -o DIR"
        raise InputError(path, missing[0], "nothing", "a variable of this name", hint)


def _mesh(path: Path) -> trimesh.Trimesh | None:
    if not path.exists():
        return None
    try:
        mesh = trimesh.load(path, process=False)
    except (OSError, ValueError, KeyError, IndexError, TypeError, AttributeError) as error:  # as trimesh has it
        raise InputError(path, "", f"a file that cannot be read ({error})", "a mesh as PLY") from None
    if (
        not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces) or not np.isfinite(mesh.vertices).all()
        or not 0 <= mesh.faces.min() <= mesh.faces.max() < len(mesh.vertices)
    ):  # fmt: skip
        raise InputError(path, "", "no triangles, or corners that are no numbers", "a mesh as PLY")
    return mesh
