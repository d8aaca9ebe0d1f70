"""Characterise a sensor: show it coupons at many orientations, distances and finishes, and make its map.

Signal chain: plan (TOML) -> poses -> captures -> clouds -> patches with F and sigma -> ``samples.nc`` and ``map.nc``.

A campaign does not know where its captures come from: it asks a *source* for a capture of sample s at pose p. What is
finished is kept: the table of each sample at each distance is written whole or not at all, and a campaign that is
started again goes on with what is missing.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Annotated

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from pydantic import Field, field_validator

import mitsim
from characterisation.documents import Document, read_toml
from characterisation.orientations import cap_directions
from characterisation.patches import Coupon, measure_patches
from characterisation.performance_map import PerformanceMap, SampleTable, build_map
from characterisation.point_cloud import PointCloud
from characterisation.whole_files import written_whole
from mitsim.capture.capture import Capture
from mitsim.capture.cloud import Geometry, capture_cloud, sensor_geometry
from mitsim.capture.simulate import SimulatedSensor
from mitsim.errors import InputError
from mitsim.progress import track
from mitsim.scene.load import Scene, load_scene
from mitsim.sensor.frames import Transform
from mitsim.sensor.preset import Sensor


class SampleEntry(Document):
    """One coupon: a scene with one flat shape in the plane z = 0, and values for the scene's parameters."""

    scene: str
    parameters: dict[str, str | float] = Field(default_factory=dict)


class Band(Document):
    """Normals up to an incidence, as dense as an icosahedron subdivided so many times."""

    up_to_deg: Annotated[float, Field(gt=0, le=80)]
    subdivisions: int = Field(ge=0, le=6)


class CampaignFile(Document):
    """A campaign TOML file.

    ``orientations`` are bands of growing incidence: dense where F and sigma change fast, as near the mirror direction
    and at the rim, and sparse in between.
    """

    distances_mm: Annotated[list[Annotated[float, Field(ge=100, le=20000)]], Field(min_length=1)]
    orientations: Annotated[list[Band], Field(min_length=1)]
    samples: Annotated[list[SampleEntry], Field(min_length=1)]
    samples_per_pixel: int = Field(default=16, ge=1, le=4096)
    seed: int = Field(default=1, ge=0)

    @field_validator("orientations")
    @classmethod
    def _growing(cls, bands: list[Band]) -> list[Band]:
        edges = [band.up_to_deg for band in bands]
        if any(b <= a for a, b in pairwise(edges)):
            raise ValueError("bands in the order of growing up_to_deg")
        return bands

    @property
    def largest_deg(self) -> float:
        """Incidence at which the map ends [deg]."""
        return self.orientations[-1].up_to_deg

    def normals(self) -> NDArray[np.float64]:
        """Unit normals (n, 3) in the view frame (z toward the sensor), nearest to the axis first."""
        parts, inner = [], -1.0
        for band in self.orientations:
            directions = cap_directions(band.subdivisions, math.radians(band.up_to_deg))
            incidence = np.degrees(np.arccos(np.clip(directions[:, 2], -1, 1)))
            parts.append(directions[incidence > inner])
            inner = band.up_to_deg
        return np.concatenate(parts)


@dataclass(frozen=True)
class Sample:
    """A coupon ready to be shown: its scene, size [mm] and finish; ``origin`` is all that it was made from."""

    scene: Scene
    width: float
    height: float
    finish: str
    roughness: float
    origin: str

    def label(self) -> str:
        """``aluminium/ground Ra 0.37`` or ``matt_white``."""
        return self.finish if math.isnan(self.roughness) else f"{self.finish} Ra {self.roughness:g}"

    def at(self, sensor_from_coupon: Transform) -> Coupon:
        """The coupon where it stands in the sensor frame."""
        axes = sensor_from_coupon.rotation
        return Coupon(sensor_from_coupon.translation, axes[:, 2], axes[:, 0], self.width, self.height)


CaptureSource = Callable[[Sample, Transform, int], Capture]


def read_campaign(path: str | Path, wavelength_nm: float) -> tuple[CampaignFile, list[Sample]]:
    """Read a campaign file and the coupons that it names (paths relative to it)."""
    path = Path(path)
    plan = read_toml(path, CampaignFile)
    return plan, [_load_sample(path, i, entry, wavelength_nm) for i, entry in enumerate(plan.samples)]


def _load_sample(path: Path, index: int, entry: SampleEntry, wavelength_nm: float) -> Sample:
    parameters = {name: str(value) for name, value in entry.parameters.items()}
    scene = load_scene(path.parent / entry.scene, wavelength_nm, parameters)
    where = f"samples.{index}.scene"
    finish = scene.finishes[0]
    if len(scene.names) != 1 or finish is None:
        found = f"{len(scene.names)} shapes" if finish else "a BSDF of no known finish"
        raise InputError(
            path,
            where,
            found,
            "one flat shape with a BSDF of mitsim's own (machined_metal, matt_white, gloss_paint, powder_coat)",
        )
    (x0, y0, z0), (x1, y1, z1) = scene.bounds
    if max(abs(z0), abs(z1)) > 1e-3 * (x1 - x0) or abs(x0 + x1) + abs(y0 + y1) > 1e-3 * (x1 - x0):
        raise InputError(path, where, "a coupon elsewhere", "a flat shape in the plane z = 0, centred, normal +z")
    # the scatter stands for files that the scene names: a trace, a height map
    origin = Path(scene.where).read_text(encoding="utf-8") + json.dumps(parameters, sort_keys=True)
    origin += repr(finish.scatter)
    return Sample(scene, float(x1 - x0), float(y1 - y0), finish.name, finish.roughness, origin)


def coupon_pose(normal: NDArray[np.float64], distance: float, axis: NDArray[np.float64]) -> Transform:
    """``sensor_from_coupon`` with the coupon's centre on the view axis.

    ``normal`` (3,) in the view frame (z toward the sensor, x toward the second eye), ``distance`` |V| [mm],
    ``axis`` (3,) unit view direction in the sensor frame.
    """
    across = np.array([1.0, 0.0, 0.0]) - axis[0] * axis
    across /= np.linalg.norm(across)
    view = np.stack([across, np.cross(-axis, across), -axis], axis=1)
    z = view @ normal
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    return Transform(np.stack([x, np.cross(z, x), z], axis=1), axis * distance)


def simulated_source(sensor: SimulatedSensor, samples_per_pixel: int) -> CaptureSource:
    """Captures that are rendered, of the coupon's part of the images only."""

    def take(sample: Sample, sensor_from_coupon: Transform, seed: int) -> Capture:
        corners = sample.at(sensor_from_coupon).corners()
        return sensor.capture(
            sample.scene, sensor_from_coupon.inverse(), seed=seed, samples=samples_per_pixel, around=corners
        )

    return take


def coupon_cloud(capture: Capture, coupon: Coupon, geometry: Geometry, sensor: Sensor) -> PointCloud:
    """Decode the part of a capture that holds the coupon."""
    grid = geometry.grid
    corners = grid.project(coupon.corners())
    low = np.clip(np.floor(corners.min(axis=0)).astype(int) - 2, 0, [grid.width - 1, grid.height - 1])
    high = np.clip(np.ceil(corners.max(axis=0)).astype(int) + 3, low + 1, [grid.width, grid.height])
    window = (int(low[0]), int(low[1]), int(high[0]), int(high[1]))
    return capture_cloud(capture, sensor.settings, geometry, window)


@dataclass(frozen=True)
class Step:
    """One sample at one distance: what is written, and read back, as a whole."""

    sample: Sample
    distance: float
    number: int
    table: Path


def run_campaign(
    plan: CampaignFile, samples: list[Sample], sensor: Sensor, take: CaptureSource, folder: Path
) -> PerformanceMap:
    """Take every capture of a plan that is not there yet, and make ``samples.nc`` and ``map.nc`` in ``folder``."""
    (folder / "tables").mkdir(parents=True, exist_ok=True)
    normals = plan.normals()
    steps = _steps(plan, samples, sensor, folder / "tables")
    missing = [step for step in steps if not step.table.exists()]
    captures = _captures(missing, plan, sensor, take, normals)
    for _ in track(captures, "characterise", len(missing) * len(normals)):
        pass
    tables = [
        SampleTable(step.sample.finish, step.sample.roughness, step.distance, xr.load_dataset(step.table))
        for step in steps
    ]
    attributes = {
        "name": f"{sensor.name} map", "sensor": sensor.name, "source": tables[0].patches.attrs["source"],
        "exposure_rule": sensor.exposure.rule, "wavelength_nm": sensor.wavelength_nm, "seed": plan.seed,
        "orientations": len(normals), "software": f"mitsim {mitsim.__version__}",
    }  # fmt: skip
    performance = build_map(tables, attributes, math.radians(plan.largest_deg))
    write_netcdf(_all_patches(tables), folder / "samples.nc")
    performance.save(folder / "map.nc")
    return performance


def _all_patches(tables: list[SampleTable]) -> xr.Dataset:
    """Join the tables; each patch keeps the number of its sample, whose finish and Ra are coordinates."""
    samples = list(dict.fromkeys((table.finish, str(table.roughness)) for table in tables))
    numbered = []
    for table in tables:
        number = samples.index((table.finish, str(table.roughness)))
        column = np.full(table.patches.sizes["patch"], number, np.int16)
        numbered.append(table.patches.assign(sample_number=("patch", column)))
    joined = xr.concat(numbered, dim="patch", combine_attrs="drop_conflicts")
    return joined.assign_coords(
        finish=("sample", [finish for finish, _ in samples]),
        roughness=("sample", [float(ra) for _, ra in samples], {"units": "um", "long_name": "roughness average Ra"}),
    )


def _steps(plan: CampaignFile, samples: list[Sample], sensor: Sensor, folder: Path) -> list[Step]:
    """Every part of the campaign; a table's name carries a digest of all that it follows from."""
    rest = plan.model_dump(exclude={"samples", "distances_mm"})
    common = [mitsim.__version__, json.dumps(rest, sort_keys=True), repr(sensor)]
    steps: list[Step] = []
    for sample in samples:
        for distance in plan.distances_mm:
            origin = "|".join([*common, sample.origin, sample.label(), f"{distance:g}"])
            name = f"{sample.label()} {distance:g}mm".replace("/", "-").replace(" ", "_")
            digest = hashlib.sha256(origin.encode()).hexdigest()[:12]
            steps.append(Step(sample, distance, len(steps), folder / f"{name}_{digest}.nc"))
    return steps


def _captures(
    steps: list[Step], plan: CampaignFile, sensor: Sensor, take: CaptureSource, normals: NDArray[np.float64]
) -> Iterator[None]:
    """Do the work, yielding after every capture; a step's table is written when its last capture is measured."""
    geometry = sensor_geometry(sensor)
    axis = sensor.rig.reference.sensor_from_camera.rotation[:, 2]
    for step in steps:
        tables, source = [], ""
        for number, normal in enumerate(normals):
            pose = coupon_pose(normal, step.distance, axis)
            seed = int(np.random.SeedSequence([plan.seed, step.number, number]).generate_state(1)[0])
            capture = take(step.sample, pose, seed)
            coupon = step.sample.at(pose)
            table = measure_patches(coupon_cloud(capture, coupon, geometry, sensor), coupon)
            tables.append(table.assign(orientation=("patch", np.full(table.sizes["patch"], number))))
            source = capture.source
            yield
        whole = xr.concat(tables, dim="patch").assign_attrs(source=source)
        write_netcdf(whole, step.table)


def write_netcdf(data: xr.Dataset, path: Path) -> None:
    """Write a dataset whole or not at all."""
    numbers = [name for name, variable in data.data_vars.items() if variable.dtype.kind in "fi"]
    with written_whole(path) as file:
        data.to_netcdf(file, encoding={name: {"zlib": True, "complevel": 2} for name in numbers})
