"""A tiny run folder, as mitsim run would leave it: 12 views, 3 of them checked, in which all names are hostile."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
import trimesh
import xarray as xr

from characterisation.cloud_files import write_cloud
from characterisation.coupon.patch_table import patch_table
from characterisation.files.atomic_io import write_netcdf
from characterisation.maps.map_file import SCHEMA_VERSION
from characterisation.maps.performance_map import PerformanceMap
from characterisation.point_cloud import PointCloud, Status, ViewGrid
from characterisation.scores.view_score import score_views, view_statistics
from characterisation.tasks.task_file import Feature, Measurement, Task
from mitsim.capture.capture import Capture
from mitsim.capture.folder import write_capture
from mitsim.report import style
from mitsim.report.page import write_report
from mitsim.sensor.camera import Camera, Rig
from mitsim.sensor.transforms import look_at
from tests.plain_pages import without_pictures

HOSTILE = "<script>alert('study')</script>&\"x\".toml"
MEASUREMENTS = ("angle <b>$1</b>", "radius & co")
FEATURES = ("plane<i>", "pillar")
CHECKED = [4, 0, 9]
WIDTH, HEIGHT = 32, 24


def make_map() -> PerformanceMap:
    """Matt white and steel at two distances, 9 x 9 nodes, NaN beyond 60 deg."""
    axis = np.linspace(-1, 1, 9)
    radius = np.hypot(*np.meshgrid(axis, axis))
    rng = np.random.default_rng(1)
    fraction = np.clip(1.2 - radius * np.array([0.2, 1.2])[:, None, None, None], 0, 1) * np.ones((2, 2, 9, 9))
    sigma = rng.uniform(0.1, 0.4, fraction.shape)
    fields = {"recovered_fraction": fraction, "ray_noise_std": sigma}
    fields |= {f"{name}_error": 0.1 * values for name, values in fields.items()}
    fields["noise_area"] = np.full(fraction.shape, 20.0)
    return PerformanceMap(
        xr.Dataset(
            {n: (("sample", "distance", "b", "a"), np.where(radius > 1, np.nan, v)) for n, v in fields.items()},
            {
                "a": axis,
                "b": axis,
                "distance": [500.0, 600.0],
                "finish": ("sample", ["matt_white", "steel/ground"]),
                "roughness": ("sample", [np.nan, 0.4]),
            },
            {"source": "simulated", "name": "test map", "schema_version": SCHEMA_VERSION},
        )
    )


def make_patches() -> xr.Dataset:
    rng = np.random.default_rng(2)
    tilt, angle = np.radians(rng.uniform(0, 60, 90)), rng.uniform(0, 2 * np.pi, 90)
    return patch_table(
        normal_x=np.sin(tilt) * np.cos(angle),
        normal_y=np.sin(tilt) * np.sin(angle),
        sample_number=np.repeat([0, 1], 45),
    ).assign_coords(finish=("sample", ["matt_white", "steel/ground"]), roughness=("sample", [np.nan, 0.4]))


def cloud(source: str, seed: int) -> PointCloud:
    rng = np.random.default_rng(seed)
    grid = ViewGrid(40.0, 40.0, 15.5, 11.5, WIDTH, HEIGHT)
    status = np.full((HEIGHT, WIDTH), Status.NO_SURFACE, np.uint8)
    status[5:20, 8:28] = rng.choice([Status.VALID, Status.LOW_MODULATION, Status.DROPPED], (15, 20), p=[0.7, 0.2, 0.1])
    points = (grid.rays() * rng.uniform(500, 520, (HEIGHT, WIDTH, 1))).astype(np.float32)
    points[status != Status.VALID] = np.nan
    return PointCloud(points, status, grid, "test-sensor", source)


def expect(scores: xr.Dataset, u: np.ndarray, chance: np.ndarray) -> None:
    """Give scores an uncertainty and a chance (measurement, view), and the ranks that follow."""
    by = ("measurement", "view")
    possible = np.isfinite(u) & (chance >= 0.5)
    worth = np.where(possible, u, np.inf)
    scores["predicted_uncertainty"], scores["chance"], scores["uncertainty_possible"] = (
        (by, u),
        (by, chance),
        (by, possible),
    )
    scores["uncertainty_rank"] = (by, worth.argsort(axis=1, kind="stable").argsort(axis=1) + 1)
    scores["limit"] = (by, np.where(possible, "noise", "few points"))
    scores["limiting_feature"] = (by, np.full(u.shape, FEATURES[1]))


def write_run(folder: Path, checked: list[int] = CHECKED) -> Path:
    (folder / "clouds").mkdir(parents=True)
    make_map().save(folder / "map.nc")
    write_netcdf(make_patches(), folder / "samples.nc")

    rng = np.random.default_rng(5)
    numbers, azimuth = np.arange(12), np.radians(np.arange(12) * 60.0)
    elevation = np.where(numbers < 6, 60.0, 20.0)
    task = Task.model_construct(
        features={name: Feature.model_construct(kind="plane") for name in FEATURES},
        measurements={
            MEASUREMENTS[0]: Measurement.model_construct(features=FEATURES, nominal=0.0, unit="deg"),
            MEASUREMENTS[1]: Measurement.model_construct(features=FEATURES[1:], nominal=20.0, unit="mm"),
        },
    )
    n = rng.uniform(60, 900, (12, 2))
    sigma = rng.uniform(0.1, 0.4, (12, 2))
    scores = score_views(view_statistics(FEATURES, n, sigma, n * 1.2, sigma, n * 1.5), task, 100)
    c, s = np.cos(np.radians(elevation)), np.sin(np.radians(elevation))
    direction = np.stack([c * np.cos(azimuth), c * np.sin(azimuth), s], axis=-1)
    poses = np.stack([look_at(500 * d, [0, 0, 0], [0, 0, 1]).matrix() for d in direction])
    scores["world_from_sensor"] = (("view", "i", "j"), poses)
    scores["roll_deg"] = (("view",), np.where(numbers % 2 == 0, 0.0, 90.0))
    scores["elevation_deg"] = (("view",), elevation)
    scores["azimuth_deg"] = (("view",), np.degrees(azimuth))
    scores["standoff_mm"] = (("view",), np.full(12, 500.0))
    scores["direction"] = (("view", "xyz"), direction)
    scores["mean_sigma"], scores["n_only_white"] = (("view", "feature"), sigma), (("view", "feature"), n * 1.5)
    scores["tolerance"] = (("measurement",), [np.nan, np.nan])
    scores["measured_risk"] = (("measurement", "view"), np.where(np.isin(numbers, checked), 0.2 + 0.01 * n.T, np.nan))
    scores["trials"] = (("measurement", "view"), np.where(np.isin(numbers, checked), 8, 0) * np.ones((2, 1), int))
    u = rng.uniform(0.02, 0.1, (2, 12))
    u[1, 9] = np.nan
    expect(scores, u, np.where(np.isfinite(u), 0.99, 0.0))
    write_netcdf(scores, folder / "scores.nc")

    errors = rng.normal(0, 0.3, (2, len(checked), 2))
    if checked:
        errors[0, -1] = np.nan
        errors[1, 0, 1] = np.nan
    dims = ("measurement", "view", "repeat")
    fields = dict.fromkeys(("value", "error", "standard_uncertainty"), (dims, errors))
    names = {"measurement": list(MEASUREMENTS), "view": np.array(checked, int)}
    write_netcdf(xr.Dataset(fields, names), folder / "checks.nc")

    K = np.array([[40.0, 0, 15.5], [0, 40.0, 11.5], [0, 0, 1]])
    camera = Camera(K, np.zeros(0), WIDTH, HEIGHT)
    for view in checked:
        write_cloud(cloud("predicted", view), folder / "clouds" / f"predicted_{view:04d}.ply")
        write_cloud(cloud("simulated", 100 + view), folder / "clouds" / f"rendered_{view:04d}.ply")
        images = {name: rng.integers(0, 60, (1, HEIGHT, WIDTH)).astype(np.uint8) for name in ("left", "right")}
        rig = Rig({"left": camera, "right": camera})
        capture = Capture("test-sensor", "active_stereo", "simulated", rig, images)
        write_capture(capture, folder / "captures" / f"view_{view:04d}")
    about = {
        "schema_version": 1,
        "mitsim": "0.0",
        "study": HOSTILE,
        "scene": "scenes/<u>part.xml",
        "sensor": "test-sensor",
        "source": "simulated",
        "map_source": "simulated",
        "exposure_rule": "fixed at 1 ms",
        "seed": 7,
        "views": 12,
        "checked_views": checked,
        "light_path_depth": 1,
        "raced_views": len(checked),
        "race_trials": 8 * len(checked),
        "leaders": dict.fromkeys(["all measurements", *MEASUREMENTS], checked[1]) if checked else {},
        "confidence": dict.fromkeys(["all measurements", *MEASUREMENTS], 0.87) if checked else {},
        "losses": {"all measurements": 0.034} if checked else {},
        "lacks": ["no <b>budget"] if checked else [],
        "runners_up": [
            {"view": checked[0], "ratio": 1.04, "near": 0.31, "trials": 5, "stated_ratio": 1.13},
            {"view": checked[2], "ratio": 1.27, "near": 0.02, "trials": 3, "stated_ratio": None},
        ]
        if checked
        else [],
        "render_residual": {"noise": 0.0, "quadrature": 0.0614, "outliers": 0.013},
        "features": dict.fromkeys(FEATURES, "steel/ground Ra 0.4 um"),
        "measurements": {
            name: {"nominal": m.nominal, "unit": m.unit, "features": list(m.features), "shapes": list(m.features)}
            for name, m in task.measurements.items()
        },
        "seconds": {"predict and score": 1.25},
        "python": "3.11",
        "machine": "x",
        "cores": 2,
        "a key of later": 1,
    }
    (folder / "run.json").write_text(json.dumps(about), encoding="utf-8")
    write_scene_geometry(folder)
    if checked:
        (folder / "statement.json").write_text(json.dumps(statement_of(checked[1])), encoding="utf-8")
    return folder


#: of a measurement without a value
DECISION = {
    "rule": "ISO 14253-1 <b>",
    "accepted": None,
    "demand": None,
    "demand_interval": [None, None],
    "needed": None,
    "fits_corrected": False,
    "false_accept": None,
    "false_accept_interval": [None, None],
    "false_reject": None,
    "false_reject_nominal": None,
    "consumer_risk": None,
    "producer_risk": None,
}


def write_scene_geometry(folder: Path) -> None:
    """A plate and a block on it, and two eyes that look along z, as mitsim run leaves them."""
    plate = trimesh.creation.box((240, 240, 1)).triangles
    block = trimesh.creation.box((60, 60, 80), trimesh.transformations.translation_matrix([0, 40, 40])).triangles
    corners = np.array([[-0.3, -0.2, 1], [0.3, -0.2, 1], [0.3, 0.2, 1], [-0.3, 0.2, 1]])
    rays = corners / np.linalg.norm(corners, axis=1, keepdims=True)
    np.savez_compressed(
        folder / "stand.npz",
        corners=np.concatenate([plate, block]).astype(np.float32),
        names=np.array(FEATURES),
        shape=np.repeat([0, 1], 12),
        centres=np.array([[0.0, 0, 0], [100.0, 0, 0]]),
        rays=np.stack([rays, rays]),
        reach=np.array([400.0, 700.0]),
    )


def statement_of(view):
    """A statement of both measurements, whose names are hostile: the second has no value and a tolerance."""
    line = {
        "group": "calibration",
        "variance": 0.04,
        "low": 0.02,
        "high": 0.09,
        "share": 0.64,
        "share_interval": [0.32, 0.9],
        "settled": False,
        "source": "",
        "fresh": False,
    }
    known = {
        "unit": "mm",
        "trials": 200,
        "without_value": 0.13,
        "bias": -0.031,
        "bias_uncertainty": 0.018,
        "standard_uncertainty": 0.25,
        "interval": [-0.52, 0.47],
        "interval_corrected": [-0.49, 0.5],
        "numerical_tolerance": 0.05,
        "settled": False,
        "repeatability": 0.1,
        "after_repeats": {"1": 0.25, "4": 0.231},
        "budget": [
            line,
            line
            | {
                "group": "noise",
                "variance": 0.01,
                "share": 0.36,
                "share_interval": [0.25, 0.48],
                "settled": True,
                "fresh": True,
            },
        ],
        "tolerance": None,
        "share_of_tolerance": None,
        "verdict": "no tolerance",
    }
    nothing = known | dict.fromkeys(("bias", "bias_uncertainty", "standard_uncertainty", "repeatability"), None)
    nothing |= {
        "interval": [None, None],
        "interval_corrected": [None, None],
        "budget": [],
        "without_value": 1.0,
        "losses": [{"reason": f"{HOSTILE}: 3 to 12 points, at least 100 are required", "count": 200}],
        "tolerance": 0.1,
        "verdict": "undecidable",
        "after_repeats": {},
        "decision": DECISION,
    }
    return {
        "schema_version": 1,
        "measured_by": "render",
        "view": view,
        "calibration": HOSTILE,
        "measurements": dict(zip(MEASUREMENTS, (known, nothing), strict=True)),
        "influences": [
            {"name": "noise", "included": True, "how": "drawn"},
            {"name": "dirt", "included": False, "how": HOSTILE},
        ],
    }


@contextmanager
def plain_pictures() -> Iterator[None]:
    """Pages whose pictures have all their parts, but not in their final places, which take half the time of a page.

    For tests of the page around the pictures.
    """
    with mock.patch.object(style, "_lay_out", lambda figure: figure.set_layout_engine("none")):
        yield


@pytest.fixture(scope="session")
def run_folder(tmp_path_factory) -> Path:
    """Made once; tests that change something copy it."""
    return write_run(tmp_path_factory.mktemp("report") / "run")


@pytest.fixture(scope="session")
def report(run_folder) -> Path:
    return write_report(run_folder)


@pytest.fixture(scope="session")
def expecting(tmp_path_factory) -> Path:
    """The run of :mod:`.view_sphere_run`; made once, tests that change something copy it."""
    from tests.report.view_sphere_run import write_expecting_run  # it builds on this module

    return write_expecting_run(tmp_path_factory.mktemp("sphere") / "run")


@pytest.fixture(scope="session")
def page(expecting) -> Path:
    """The page of that run, with the sphere of views but without pictures: a browser opens it in half the time."""
    with without_pictures():
        return write_report(expecting)
