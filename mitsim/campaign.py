"""Characterise a sensor: show it coupons at many orientations, distances and finishes, and make its map.

Signal chain: plan (TOML) -> poses -> captures -> clouds -> patches with F and sigma -> ``samples.nc`` and ``map.nc``.

A campaign does not know where its captures come from: it asks a *source* for a capture of sample s at pose p. What is
finished is kept: the table of each sample at each distance is written whole or not at all, and a campaign that is
started again goes on with what is missing.

A sample of which the *spread* is asked for is shown four times more, at the same poses and with the same seeds: with
the width of its lobe one standard deviation down and up, and with its wide-angle share at its low and high end.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
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
from characterisation.performance_map import PerformanceMap, SampleTable, Variant, build_map
from characterisation.point_cloud import PointCloud
from characterisation.whole_files import written_whole
from mitsim.capture.capture import Capture
from mitsim.capture.cloud import Geometry, capture_cloud, sensor_geometry
from mitsim.capture.render_residual import RenderResidual, render_residual, told
from mitsim.capture.simulate import SimulatedSensor
from mitsim.errors import InputError
from mitsim.progress import track
from mitsim.scene.load import Scene, load_scene
from mitsim.sensor.frames import Transform
from mitsim.sensor.preset import Sensor
from mitsim.surface.scatter import NOMINAL, Deviation

#: what is shown besides a sample for its spread
VARIANTS: dict[Variant, Deviation] = {
    ("alpha", "low"): Deviation(alpha=-1.0),
    ("alpha", "high"): Deviation(alpha=1.0),
    ("wide_angle", "low"): Deviation(wide_angle=-1.0),
    ("wide_angle", "high"): Deviation(wide_angle=1.0),
}


class SampleEntry(Document):
    """One coupon: a scene with one flat shape in the plane z = 0, and values for the scene's parameters.

    ``spread``: whether what is not known of its finish is carried into the map.
    """

    scene: str
    parameters: dict[str, str | float] = Field(default_factory=dict)
    spread: bool = False


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
        if any(b <= a for a, b in itertools.pairwise(edges)):
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
    """A coupon ready to be shown: its scene, size [mm] and finish; ``origin`` is all that it was made from.

    ``variants`` are the same coupon with its finish moved by what is not known of it; none unless asked for.
    """

    scene: Scene
    width: float
    height: float
    finish: str
    roughness: float
    origin: str
    variants: dict[Variant, Sample] = field(default_factory=dict)

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
    sample = _load_coupon(path, index, entry, wavelength_nm, NOMINAL)
    if not entry.spread:
        return sample
    variants = {name: _load_coupon(path, index, entry, wavelength_nm, moved) for name, moved in VARIANTS.items()}
    return replace(sample, variants=variants)


def _load_coupon(path: Path, index: int, entry: SampleEntry, wavelength_nm: float, deviation: Deviation) -> Sample:
    parameters = {name: str(value) for name, value in entry.parameters.items()}
    scene = load_scene(path.parent / entry.scene, wavelength_nm, parameters, deviation)
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
    # the scatter stands for files that the scene names, a trace or a height map, and for the deviation
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


def coupon_residuals(sensor: SimulatedSensor, plan: CampaignFile, samples: list[Sample]) -> list[RenderResidual]:
    """How far the render of each sample is from the light, in the reference camera; told if too far.

    At the normal in the middle of the plan: the first is often the mirror direction, where a metal blinds the camera.
    """
    camera, optics = next(iter(sensor.sensor.rig.cameras.items()))
    axis = optics.sensor_from_camera.rotation[:, 2]
    normals = plan.normals()
    pose = coupon_pose(normals[len(normals) // 2], plan.distances_mm[0], axis).inverse()
    return [
        told(sample.label(), render_residual(
            sensor, sample.scene, pose, camera, samples=plan.samples_per_pixel, depth=1, seed=plan.seed
        ))
        for sample in samples
    ]  # fmt: skip


def coupon_cloud(capture: Capture, coupon: Coupon, geometry: Geometry, sensor: Sensor) -> PointCloud:
    """Decode the part of a capture that holds the coupon."""
    grid = geometry.grid
    corners = grid.project(coupon.corners())
    low = np.clip(np.floor(corners.min(axis=0)).astype(int) - 2, 0, [grid.width - 1, grid.height - 1])
    high = np.clip(np.ceil(corners.max(axis=0)).astype(int) + 3, low + 1, [grid.width, grid.height])
    window = (int(low[0]), int(low[1]), int(high[0]), int(high[1]))
    return capture_cloud(capture, sensor.settings, geometry, window, sensor.imager)


@dataclass(frozen=True)
class Step:
    """One sample, or a variant of it, at one distance: what is written, and read back, as a whole.

    ``number`` decides the seeds, and is that of the sample for all its variants.
    """

    sample: Sample
    distance: float
    number: int
    table: Path
    variant: Variant | None = None


def check_exposure(sensor: Sensor) -> None:
    """Refuse a sensor whose exposure follows the scene.

    Raises
    ------
    InputError
        Naming the sensor and its rule.
    """
    if sensor.exposure.base_s is None:
        raise InputError(
            f"sensor {sensor.name}", "exposure.rule", sensor.exposure.rule, "fixed, matt_white",
            "a map is of one exposure: with an automatic one F depends on whatever else is in view, not on distance, "
            "normal and finish",
        )  # fmt: skip


def run_campaign(
    plan: CampaignFile, samples: list[Sample], sensor: Sensor, take: CaptureSource, folder: Path
) -> PerformanceMap:
    """Take every capture of a plan that is not there yet, and make ``samples.nc`` and ``map.nc`` in ``folder``.

    Raises
    ------
    InputError
        If the sensor's exposure follows the scene.
    """
    check_exposure(sensor)
    (folder / "tables").mkdir(parents=True, exist_ok=True)
    normals = plan.normals()
    steps = _steps(plan, samples, sensor, folder / "tables")
    # a variant that differs in nothing has the table of its sample
    missing = list({step.table: step for step in steps if not step.table.exists()}.values())
    captures = _captures(missing, plan, sensor, take, normals)
    for _ in track(captures, "characterise", len(missing) * len(normals)):
        pass
    tables = [
        SampleTable(step.sample.finish, step.sample.roughness, step.distance, xr.load_dataset(step.table), step.variant)
        for step in steps
    ]
    attributes = {
        "name": f"{sensor.name} map", "sensor": sensor.name, "source": tables[0].patches.attrs["source"],
        "exposure_rule": sensor.exposure.rule, "wavelength_nm": sensor.wavelength_nm, "seed": plan.seed,
        "orientations": len(normals), "software": f"mitsim {mitsim.__version__}",
    }  # fmt: skip
    performance = build_map(tables, attributes, math.radians(plan.largest_deg))
    write_netcdf(_all_patches([table for table in tables if table.variant is None]), folder / "samples.nc")
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
    for number, (sample, distance) in enumerate(itertools.product(samples, plan.distances_mm)):
        shown: list[tuple[Variant | None, Sample]] = [(None, sample), *sample.variants.items()]
        for variant, one in shown:
            origin = "|".join([*common, one.origin, one.label(), f"{distance:g}"])
            name = f"{one.label()} {distance:g}mm".replace("/", "-").replace(" ", "_")
            if variant is not None and one.origin != sample.origin:
                name += "_" + "_".join(variant)
            digest = hashlib.sha256(origin.encode()).hexdigest()[:12]
            steps.append(Step(one, distance, number, folder / f"{name}_{digest}.nc", variant))
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
