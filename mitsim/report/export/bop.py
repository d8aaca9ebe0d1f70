"""Write captures as a data set in the layout of the BOP benchmark, for training on depth images.

Signal chain: capture folders -> each on the pixels of one pinhole camera (:mod:`mitsim.report.export.bop_frame`) ->
files of BOP (bop_toolkit, docs/bop_datasets_format.md), and additional folders for data without a place in BOP.

An object is a group of the scene's shapes; the other shapes are its surroundings. Without groups it is the whole scene.
All objects are in the part frame, so all have the same pose: that of the part frame in the camera's.
"""

from __future__ import annotations

import fnmatch
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import ConvexHull
from scipy.spatial.distance import pdist

from characterisation.files.atomic_io import atomic_folder
from characterisation.files.checked_files import read_json_object
from characterisation.files.errors import InputError
from characterisation.point_cloud import Status, ViewGrid
from characterisation.region_of_interest import Roi
from characterisation.words.progress import track
from characterisation.words.version import __version__
from mitsim.capture.folder import read_capture
from mitsim.report.export.bop_frame import Frame, bop_frame
from mitsim.scene.load import Scene, load_scene
from mitsim.scene.ray_casting.triangles import triangles
from mitsim.sensor.png import encode_png

#: wavelength for loading scenes; only their geometry is used
_ANY_NM = 550.0

#: largest thickness of a flat object, relative to its length: rounding of coordinates in single precision
_FLAT = 1e-6


@dataclass(frozen=True)
class Source:
    """A capture folder of ``mitsim render --many``: its finish and view, and its scene."""

    folder: Path
    finish: str
    view: int
    scene: Path
    parameters: Mapping[str, str]


def find_sources(folder: str | Path) -> list[Source]:
    """Return the captures of ``mitsim render --many`` in a folder, by finish and view.

    Raises InputError if there is none, or a scene no longer exists.
    """
    sources = []
    for path in sorted(Path(folder).glob("*/view_*/settings.json")):
        settings = read_json_object(path)
        try:
            many = settings["many"]
            scene, view = Path(many["scene"]), int(many["view"])
            sources.append(Source(path.parent, str(many["finish"]), view, scene, dict(many["parameters"])))
        except (ValueError, KeyError, TypeError, OverflowError) as error:
            allowed = "a capture taken by mitsim render --many"
            raise InputError(path, "many", f"unreadable data ({error})", allowed) from None
        if not scene.is_file():
            raise InputError(path, "many.scene", f"{scene}, which does not exist", "the scene that was rendered")
    if not sources:
        raise InputError(folder, "", "no captures", "FINISH/view_NNNN folders, as mitsim render --many writes them")
    return sources


def objects_of(names: Sequence[str], patterns: Sequence[str]) -> list[tuple[str, ...]]:
    """Return the shapes of each object by patterns, all in one without; InputError if none or two match a shape."""
    if not patterns:
        return [tuple(names)]
    objects = [tuple(fnmatch.filter(names, pattern)) for pattern in patterns]
    for pattern, shapes in zip(patterns, objects, strict=True):
        if not shapes:
            raise InputError("--object", "", repr(pattern), f"a pattern of shapes: {', '.join(names)}")
    every = [name for shapes in objects for name in shapes]
    for name in every:
        if every.count(name) > 1:
            both = [pattern for pattern, shapes in zip(patterns, objects, strict=True) if name in shapes]
            overlap = f"{' and '.join(both)}, which both have {name}"
            raise InputError("--object", "", overlap, "objects without common shapes")
    return objects


def write_bop(sources: Sequence[Source], output: str | Path, split: str = "train", patterns: Sequence[str] = ()) -> int:
    """Write a data set atomically, with one BOP scene for each finish, and return the number of images.

    Raises InputError if ``output`` exists, a pattern matches nothing, or a capture cannot be used or shows other
    objects.

    Parameters
    ----------
    sources, output, split, patterns
        Captures, as :func:`find_sources` returns them; the split is train, val or test; patterns as :func:`objects_of`.
    """
    output = Path(output).absolute()
    if output.exists():
        raise InputError("--output", "", f"{output}, which exists", "a new folder")
    finishes = list(dict.fromkeys(source.finish for source in sources))
    tables = {finish: {name: dict[str, Any]() for name in ("camera", "gt", "gt_info")} for finish in finishes}
    scenes: dict[tuple[Any, ...], tuple[Scene, list[Scene]]] = {}  # by file and parameters
    camera: dict[str, Any] = {}
    with atomic_folder(output) as partial:
        for source in sources:
            if _key(source) not in scenes:
                scene = load_scene(source.scene, _ANY_NM, dict(source.parameters))
                scenes[_key(source)] = scene, [scene.only(*names) for names in objects_of(scene.names, patterns)]
                _check_same_objects(scenes[_key(source)], next(iter(scenes.values())), source)
        first, objects = next(iter(scenes.values()))
        _write_models(partial / "models", objects)
        for source in track(sources, "export"):
            frame, scale = bop_frame(read_capture(source.folder), *scenes[_key(source)], source.folder)
            folder = partial / split / f"{finishes.index(source.finish) + 1:06d}"
            _write_frame(frame, folder, len(tables[source.finish]["camera"]), scale, tables[source.finish])
            camera = camera or _camera_file(frame.grid, scale)
        for number, finish in enumerate(finishes, 1):
            for name, table in tables[finish].items():
                _write_json(partial / split / f"{number:06d}" / f"scene_{name}.json", table)
        _write_json(partial / "camera.json", camera)
        _write_json(partial / "statuses.json", {str(status.value): status.name.lower() for status in Status})
        _write_json(partial / "features.json", {str(k): name for k, name in enumerate(first.names, 1)})
        _write_json(partial / "finishes.json", {f"{k:06d}": name for k, name in enumerate(finishes, 1)})
        described = _about(sources, finishes, split, [part.names for part in objects])
        (partial / "dataset_info.md").write_text(described, encoding="utf-8")
    return len(sources)


def _key(source: Source) -> tuple[Any, ...]:
    return source.scene, *sorted(source.parameters.items())


def _check_same_objects(found: tuple[Scene, list[Scene]], first: tuple[Scene, list[Scene]], source: Source) -> None:
    """Check that a scene has the shapes and objects of the first: a data set has one table and one model of each."""
    pairs = zip(found[1], first[1], strict=True)
    if found[0].names == first[0].names and all(np.array_equal(triangles(a), triangles(b)) for a, b in pairs):
        return
    told = f"{source.scene} with {dict(source.parameters)}, whose shapes or objects differ from the first capture's"
    hint = "simulate other parts into other folders, and export each"
    raise InputError(source.folder, "many.scene", told, "captures of the same objects", hint)


def _levels(depth: NDArray[np.float64], scale: float) -> NDArray[np.uint16]:
    """Return a depth image [mm] in steps of ``scale``, 0 where it is missing or beyond 16 bits."""
    levels = np.rint(np.nan_to_num(depth) / scale)
    return np.where((levels > 0) & (levels <= 65535), levels, 0).astype(np.uint16)


def _write_frame(frame: Frame, folder: Path, number: int, scale: float, tables: dict[str, dict[str, Any]]) -> None:
    name = f"{number:06d}"
    counts, true = (_levels(depth, scale) for depth in (frame.depth, frame.true_depth))
    images: dict[str, NDArray[Any]] = {} if frame.grey is None else {f"gray/{name}": frame.grey}
    images |= {f"depth/{name}": counts, f"status/{name}": frame.status, f"depth_true/{name}": true}
    images[f"feature/{name}"] = (frame.shape + 1).astype(np.uint16)
    for k, (silhouette, visible) in enumerate(frame.masks):
        images[f"mask/{name}_{k:06d}"] = np.where(silhouette, 255, 0).astype(np.uint8)
        images[f"mask_visib/{name}_{k:06d}"] = np.where(visible, 255, 0).astype(np.uint8)
    for path, image in images.items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / f"{path}.png").write_bytes(encode_png(np.ascontiguousarray(image)))
    pose, key, grid = frame.camera_from_part, str(number), frame.grid
    turn, shift = pose.rotation.ravel().tolist(), pose.translation.tolist()
    matrix = [grid.fx, 0.0, grid.cx, 0.0, grid.fy, grid.cy, 0.0, 0.0, 1.0]
    tables["camera"][key] = {"cam_K": matrix, "depth_scale": scale, "cam_R_w2c": turn, "cam_t_w2c": shift}
    numbers = range(1, len(frame.masks) + 1)  # BOP counts objects from 1
    tables["gt"][key] = [{"cam_R_m2c": turn, "cam_t_m2c": shift, "obj_id": number} for number in numbers]
    tables["gt_info"][key] = [_info(silhouette, visible, counts > 0) for silhouette, visible in frame.masks]


def _info(silhouette: NDArray[np.bool_], visible: NDArray[np.bool_], valid: NDArray[np.bool_]) -> dict[str, Any]:
    whole, shown = int(silhouette.sum()), int(visible.sum())
    return {
        "bbox_obj": _box(silhouette),
        "bbox_visib": _box(visible),
        "px_count_all": whole,
        "px_count_valid": int((silhouette & valid).sum()),
        "px_count_visib": shown,
        "visib_fract": shown / whole if whole else 0.0,
    }


def _box(mask: NDArray[np.bool_]) -> list[int]:
    """Return x, y, width, height of a mask; four times -1 if it is empty."""
    box = Roi.around(mask)
    return [-1, -1, -1, -1] if box is None else [box.left, box.top, box.width, box.height]


def _camera_file(grid: ViewGrid, scale: float) -> dict[str, Any]:
    axes = {"cx": grid.cx, "cy": grid.cy, "depth_scale": scale, "fx": grid.fx, "fy": grid.fy}
    return axes | {"height": grid.height, "width": grid.width}


def _write_models(folder: Path, objects: Sequence[Scene]) -> None:
    """Write the triangles of each object [mm], part frame, with normals of its faces; and its box and diameter."""
    folder.mkdir(parents=True)
    table: dict[str, Any] = {}
    for number, scene in enumerate(objects, 1):
        corners = triangles(scene)
        if not len(corners):
            found = f"{', '.join(scene.names)}, which light passes"
            raise InputError("--object", "", found, "at least one solid shape")
        mesh = trimesh.Trimesh(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3), process=False)
        written = trimesh.exchange.ply.export_ply(mesh, encoding="ascii", vertex_normal=True)
        (folder / f"obj_{number:06d}.ply").write_bytes(written)
        low, size = mesh.bounds[0], np.ptp(mesh.bounds, axis=0)
        table[str(number)] = {"diameter": _diameter(mesh.vertices)}
        table[str(number)] |= {f"min_{axis}": float(low[k]) for k, axis in enumerate("xyz")}
        table[str(number)] |= {f"size_{axis}": float(size[k]) for k, axis in enumerate("xyz")}
    _write_json(folder / "models_info.json", table)


def _diameter(vertices: NDArray[np.float64]) -> float:
    """Return the largest distance between any two vertices: corners of the convex hull, or of a flat outline."""
    centred = vertices - vertices.mean(axis=0)
    along = centred @ np.linalg.svd(centred, full_matrices=False)[2].T
    sides = np.ptp(along, axis=0)
    spanned = along[:, sides > _FLAT * sides.max()]
    return float(pdist(vertices[ConvexHull(spanned).vertices]).max()) if spanned.shape[1] > 1 else float(sides.max())


def _write_json(path: Path, table: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(table, indent=1) + "\n", encoding="utf-8")


def _about(sources: Sequence[Source], finishes: Sequence[str], split: str, objects: Sequence[Sequence[str]]) -> str:
    listed = "\n".join(f"- `{split}/{k:06d}`: {name}" for k, name in enumerate(finishes, 1))
    groups = "\n".join(f"- `obj_{k:06d}`: {', '.join(names)}" for k, names in enumerate(objects, 1))
    return f"""# {sources[0].scene.stem}, simulated by mitsim {__version__}

{len(sources)} images. One folder for each finish:

{listed}

Objects by their shapes, in the part frame (mm):

{groups}

In addition to BOP's files, each folder has:

- `status`: why a pixel has a depth or none: `statuses.json`
- `feature`: the shape of the scene that a pixel shows: `features.json`; 0 for none
- `depth_true`: depth of the geometry, on the scale of `depth`

Depth is what the sensor's decoder measured; nothing is filled in. Silhouettes are clipped to the image.
"""
