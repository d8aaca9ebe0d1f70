"""Captures as a data set in the layout of the BOP benchmark, for people who train on depth.

Signal chain: capture folders -> cloud of each, with a status for every pixel -> image, depth, reasons, labels and true
depth on the pixels of one pinhole camera -> files of BOP (bop_toolkit, docs/bop_datasets_format.md), and beside them
what BOP has no folder for.

The camera is the cloud's grid: of a stereo sensor its rectified left image, else its camera without distortion. Depth
and status come to its pixels from the nearest pixel of the cloud, grey values by linear interpolation. Nothing is
filled in: depth is 0 where there is no point, and ``status`` says why. There is one object, the whole scene, in the
part frame.
"""

from __future__ import annotations

import json
import math
import shutil
import uuid
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.spatial import ConvexHull
from scipy.spatial.distance import pdist

import mitsim
from characterisation.errors import InputError
from characterisation.point_cloud import PointCloud, Status, ViewGrid
from mitsim.capture.capture import Capture
from mitsim.capture.cloud import capture_cloud, capture_geometry, decoder_settings
from mitsim.capture.folder import read_capture
from mitsim.capture.png import encode_png
from mitsim.export.run_scene import sensor_from_grid
from mitsim.progress import track
from mitsim.scene.load import Scene, load_scene
from mitsim.scene.raycast import PixelRays, cast
from mitsim.scene.triangles import triangles
from mitsim.sensor.frames import Transform

#: the object's number: BOP counts from 1
OBJECT = 1

#: wavelength that scenes are loaded at: only their geometry is looked at
_ANY_NM = 550.0


@dataclass(frozen=True)
class Frame:
    """One capture on the pixels of a pinhole camera, (H, W) each.

    ``grey`` uint8, None where the capture has no images; ``depth`` [mm] along the axis, NaN where there is no point;
    ``status``; ``shape`` index into the scene's names, -1 for nothing, and ``true_depth`` [mm], of the ray through the
    middle of the pixel; ``camera_from_part``.
    """

    grid: ViewGrid
    grey: NDArray[np.uint8] | None
    depth: NDArray[np.float64]
    status: NDArray[np.uint8]
    shape: NDArray[np.int16]
    true_depth: NDArray[np.float64]
    camera_from_part: Transform


@dataclass(frozen=True)
class Source:
    """A capture folder of ``mitsim render --many``: its finish and view, and the scene that it shows."""

    folder: Path
    finish: str
    view: int
    scene: Path
    parameters: Mapping[str, str]


def find_sources(folder: str | Path) -> list[Source]:
    """Captures of ``mitsim render --many`` in a folder, by finish and view.

    Raises
    ------
    InputError
        If there is none, or a scene is not there any more.
    """
    found = []
    for path in sorted(Path(folder).glob("*/view_*/settings.json")):
        try:
            many = json.loads(path.read_text(encoding="utf-8"))["many"]
            scene, view = Path(many["scene"]), int(many["view"])
            found.append(Source(path.parent, str(many["finish"]), view, scene, dict(many["parameters"])))
        except (OSError, ValueError, KeyError, TypeError) as error:
            allowed = "a capture that mitsim render --many took"
            raise InputError(path, "many", f"nothing that can be read ({error})", allowed) from None
        if not scene.is_file():
            raise InputError(path, "many.scene", f"{scene}, which is not there", "the scene that was rendered")
    if not found:
        raise InputError(folder, "", "no captures", "FINISH/view_NNNN folders, as mitsim render --many writes them")
    return found


def write_bop(sources: Sequence[Source], output: str | Path, split: str = "train") -> int:
    """Write a data set, whole or not at all, a BOP scene for each finish; returns the number of images.

    Raises
    ------
    InputError
        If there is something at ``output``, or a capture cannot be used.
    """
    output = Path(output).absolute()
    if output.exists():
        raise InputError("--output", "", f"{output}, which is there already", "a new folder")
    output.parent.mkdir(parents=True, exist_ok=True)
    partial = output.with_name(f".{output.name}.partial-{uuid.uuid4().hex[:12]}")
    finishes = list(dict.fromkeys(one.finish for one in sources))
    tables: dict[str, dict[str, dict[str, Any]]] = {one: {"camera": {}, "gt": {}, "gt_info": {}} for one in finishes}
    scenes: dict[str, Scene] = {}
    camera: dict[str, Any] = {}
    try:
        for source in track(sources, "export"):
            capture = read_capture(source.folder)
            scene = scenes.get(source.finish)
            if scene is None:
                scene = scenes[source.finish] = load_scene(source.scene, _ANY_NM, dict(source.parameters))
            frame, scale = bop_frame(capture, scene, source.folder)
            place = partial / split / f"{finishes.index(source.finish) + 1:06d}"
            _write_frame(frame, place, len(tables[source.finish]["camera"]), scale, tables[source.finish])
            camera = camera or _camera_file(frame.grid, scale)
        for number, finish in enumerate(finishes, 1):
            for name, table in tables[finish].items():
                _write_json(partial / split / f"{number:06d}" / f"scene_{name}.json", table)
        first = scenes[finishes[0]]
        _write_model(partial / "models", first)
        _write_json(partial / "camera.json", camera)
        _write_json(partial / "statuses.json", {str(one.value): one.name.lower() for one in Status})
        _write_json(partial / "features.json", {str(k): name for k, name in enumerate(first.names, 1)})
        _write_json(partial / "finishes.json", {f"{k:06d}": name for k, name in enumerate(finishes, 1)})
        (partial / "dataset_info.md").write_text(_about(sources, finishes, split), encoding="utf-8")
        partial.rename(output)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return len(sources)


def bop_frame(capture: Capture, scene: Scene, where: str | Path) -> tuple[Frame, float]:
    """Decode a capture and put all that BOP wants on the pixels of a pinhole; and the scale of its depth images [mm].

    Raises
    ------
    InputError
        If the capture has no pose, or cannot be decoded.
    """
    if capture.world_from_sensor is None:
        raise InputError(where, "pose.json", "no pose", "a capture whose pose in the part frame is known")
    settings, imager = decoder_settings(capture)
    cloud = capture_cloud(capture, settings, capture_geometry(capture, settings), imager=imager)
    grid = replace(cloud.grid, normalised=None)
    depth, status = on_pinhole(cloud, grid)
    seen = cast(scene, PixelRays.of_grid(grid), capture.world_from_sensor, np.zeros((0, 3)))
    along = grid.rays() @ grid.rotation[:, 2]
    pose = (capture.world_from_sensor @ sensor_from_grid(grid)).inverse()
    frame = Frame(grid, _grey(capture, grid), depth, status, seen.shape, seen.distance * along, pose)
    return frame, depth_scale(float(settings.far_mm))


def on_pinhole(cloud: PointCloud, grid: ViewGrid) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Depth [mm] and status (H, W) of a cloud on a pinhole's pixels, each of the nearest pixel of the cloud's grid."""
    depth = (cloud.points.astype(np.float64) - cloud.grid.origin) @ cloud.grid.rotation[:, 2]
    if cloud.grid.normalised is None:
        return depth, cloud.status
    place = np.rint(cloud.grid.project(grid.origin + 1000.0 * grid.rays()))
    last = np.array([grid.width, grid.height]) - 1
    inside = np.asarray(np.isfinite(place).all(-1) & (place >= 0).all(-1) & (place <= last).all(-1))
    column, row = np.moveaxis(np.where(inside[..., None], place, 0).astype(np.intp), -1, 0)
    return np.where(inside, depth[row, column], np.nan), np.where(
        inside, cloud.status[row, column], np.uint8(Status.NO_SURFACE)
    )


def depth_scale(far: float) -> float:
    """Step of a depth image [mm]: the least of 1, 2, 5 times a power of ten with which 16 bits reach ``far`` [mm]."""
    least = far / 65535
    power = 10.0 ** math.floor(math.log10(least))
    return next(round(k * power, 12) for k in (1, 2, 5, 10) if k * power >= least * (1 - 1e-12))


def _grey(capture: Capture, grid: ViewGrid) -> NDArray[np.uint8] | None:
    """Mean of the reference camera's lit images on the pinhole's pixels, full scale 255."""
    name, camera = next(iter(capture.rig.cameras.items()))
    if name not in capture.images or not len(capture.images[name]):
        return None
    lit = capture.images[name]
    if capture.settings.get("ambient_image") and len(lit) > 1:
        lit = lit[:-1]
    place = camera.project((camera.centre + 1000.0 * grid.rays()).reshape(-1, 3)).reshape(grid.height, grid.width, 2)
    mean = lit.mean(axis=0, dtype=np.float64) * 255 / (2**capture.bits - 1)
    sampled = map_coordinates(mean, [place[..., 1], place[..., 0]], order=1, mode="constant", cval=0.0)
    return np.asarray(np.rint(np.nan_to_num(sampled)).clip(0, 255), np.uint8)


def _write_frame(frame: Frame, place: Path, number: int, scale: float, tables: dict[str, dict[str, Any]]) -> None:
    name = f"{number:06d}"
    mask = np.where(frame.shape >= 0, 255, 0).astype(np.uint8)
    counts = np.rint(np.nan_to_num(frame.depth) / scale).clip(0, 65535).astype(np.uint16)
    true = np.rint(np.nan_to_num(frame.true_depth) / scale).clip(0, 65535).astype(np.uint16)
    images: dict[str, NDArray[Any] | None] = {
        f"gray/{name}": frame.grey, f"depth/{name}": counts, f"mask/{name}_000000": mask,
        f"mask_visib/{name}_000000": mask, f"status/{name}": frame.status, f"depth_true/{name}": true,
        f"feature/{name}": (frame.shape + 1).astype(np.uint16),
    }  # fmt: skip
    for path, image in images.items():
        if image is not None:
            (place / path).parent.mkdir(parents=True, exist_ok=True)
            (place / f"{path}.png").write_bytes(encode_png(np.ascontiguousarray(image)))
    pose, key = frame.camera_from_part, str(number)
    turn, shift = pose.rotation.ravel().tolist(), pose.translation.tolist()
    tables["camera"][key] = {
        "cam_K": _matrix(frame.grid), "depth_scale": scale, "cam_R_w2c": turn, "cam_t_w2c": shift,
    }  # fmt: skip
    tables["gt"][key] = [{"cam_R_m2c": turn, "cam_t_m2c": shift, "obj_id": OBJECT}]
    shown = mask > 0
    pixels, box = int(shown.sum()), _box(shown)
    tables["gt_info"][key] = [{
        "bbox_obj": box, "bbox_visib": box, "px_count_all": pixels, "px_count_visib": pixels,
        "px_count_valid": int((shown & (counts > 0)).sum()), "visib_fract": 1.0 if pixels else 0.0,
    }]  # fmt: skip


def _box(mask: NDArray[np.bool_]) -> list[int]:
    """x, y, width, height of a mask; -1 four times where it is empty."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    if not len(rows):
        return [-1, -1, -1, -1]
    return [int(columns[0]), int(rows[0]), int(columns[-1] - columns[0] + 1), int(rows[-1] - rows[0] + 1)]


def _matrix(grid: ViewGrid) -> list[float]:
    return [grid.fx, 0.0, grid.cx, 0.0, grid.fy, grid.cy, 0.0, 0.0, 1.0]


def _camera_file(grid: ViewGrid, scale: float) -> dict[str, Any]:
    return {
        "cx": grid.cx, "cy": grid.cy, "depth_scale": scale, "fx": grid.fx, "fy": grid.fy, "height": grid.height,
        "width": grid.width,
    }  # fmt: skip


def _write_model(folder: Path, scene: Scene) -> None:
    """The scene's triangles as the object [mm], part frame, with normals of its faces."""
    folder.mkdir(parents=True)
    corners = triangles(scene)
    mesh = trimesh.Trimesh(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3), process=False)
    name = f"obj_{OBJECT:06d}.ply"
    (folder / name).write_bytes(trimesh.exchange.ply.export_ply(mesh, encoding="ascii", vertex_normal=True))
    low, size = mesh.bounds[0], np.ptp(mesh.bounds, axis=0)
    info = {"diameter": _diameter(mesh.vertices)}
    info |= {f"min_{axis}": float(low[k]) for k, axis in enumerate("xyz")}
    info |= {f"size_{axis}": float(size[k]) for k, axis in enumerate("xyz")}
    _write_json(folder / "models_info.json", {str(OBJECT): info})


def _diameter(vertices: NDArray[np.float64]) -> float:
    """Largest distance between any two vertices; they lie on the convex hull, or all in a plane."""
    flat = np.ptp(vertices, axis=0).min() < 1e-9
    corners = np.unique(vertices, axis=0) if flat else vertices[ConvexHull(vertices).vertices]
    return float(pdist(corners).max())


def _write_json(path: Path, table: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(table, indent=1) + "\n", encoding="utf-8")


def _about(sources: Sequence[Source], finishes: Sequence[str], split: str) -> str:
    listed = "\n".join(f"- `{split}/{k:06d}`: {name}" for k, name in enumerate(finishes, 1))
    return f"""# {sources[0].scene.stem}, simulated by mitsim {mitsim.__version__}

{len(sources)} images, one object (the whole scene, part frame, mm). A folder for each finish:

{listed}

Beside what BOP knows, each folder has:

- `status`: why a pixel has, or has not, a depth: `statuses.json`
- `feature`: which shape of the scene a pixel shows: `features.json`; 0 for none
- `depth_true`: depth of the geometry, on the scale of `depth`

Depth is what the sensor's decoder measured; nothing is filled in. Masks hold what lies inside the image.
"""
