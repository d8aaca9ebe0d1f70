"""Write part, views, frusta, clouds and statuses as a recording (``.rrd``) for the Rerun viewer, with rerun-sdk.

Everything is in mm and in the part frame; entities::

    part                                mesh
    views/view_0012                     pose of the sensor; best_of, the measurements for which it is the best view
    views/view_0012/grid                the image grid: a frustum, with its pose in the sensor frame
    views/view_0012/grid/KIND_status    why each pixel has a point or none; named by the annotation context
    views/view_0012/KIND                points, coloured by sigma; sigma, and covariance, six numbers for each point

KIND is ``predicted`` or ``rendered``. The frustum is that of a pinhole, even if a lens distorts the grid's rays.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.colors import to_rgb
from numpy.typing import NDArray

from characterisation.files.atomic_io import atomic_write
from characterisation.point_cloud import Status
from mitsim.report.cloud_figures import REASONS
from mitsim.report.export.cloud_points import cloud_points
from mitsim.report.export.gltf import FRUSTUM_MM
from mitsim.report.export.needed import needed
from mitsim.report.export.run_scene import RunScene, ShownView

#: of points with an unknown sigma
_UNKNOWN = (150, 150, 150)


def write_rrd(scene: RunScene, path: str | Path, recording: str) -> None:
    """Write a recording; ``recording`` is its id, which distinguishes it in the viewer."""
    rerun = needed("rerun", "rerun-sdk", f"{path}: Rerun")
    stream = rerun.RecordingStream("mitsim", recording_id=recording, send_properties=False)
    memory = stream.memory_recording()  # on a full disk Rerun's own file is cut short without an error, or never ends
    stream.log("/", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    colours = {status: (255 * np.array(to_rgb(REASONS[status][1]))).round().astype(np.uint8) for status in Status}
    classes = [(status.value, status.name.lower(), colour.tolist()) for status, colour in colours.items()]
    stream.log("views", rerun.AnnotationContext(classes), static=True)
    if scene.part is not None:
        corners = {"vertex_positions": scene.part.vertices, "vertex_normals": scene.part.vertex_normals}
        mesh = rerun.Mesh3D(triangle_indices=scene.part.faces, albedo_factor=(180, 180, 185), **corners)
        stream.log("part", mesh, static=True)
    for view in scene.views:
        _log_view(rerun, stream, scene, view)
    with atomic_write(path) as file:
        file.write_bytes(memory.drain_as_bytes())


def _log_view(rerun: Any, stream: Any, scene: RunScene, view: ShownView) -> None:
    entity, pose = f"views/{view.name}", view.part_from_sensor
    at = rerun.Transform3D(translation=pose.translation, mat3x3=pose.rotation)
    stream.log(entity, at, rerun.AnyValues(best_of=list(view.best_of) or [""]), static=True)
    grid = scene.grid
    if grid is not None:
        pinhole = rerun.Pinhole(
            focal_length=(grid.fx, grid.fy),
            principal_point=(grid.cx + 0.5, grid.cy + 0.5),  # the first pixel's centre is (0.5, 0.5) for Rerun
            width=grid.width,
            height=grid.height,
            camera_xyz=rerun.ViewCoordinates.RDF,
            image_plane_distance=FRUSTUM_MM,
        )
        at = rerun.Transform3D(translation=grid.origin, mat3x3=grid.rotation)
        stream.log(f"{entity}/grid", at, pinhole, static=True)
    for kind, cloud in view.clouds.items():
        stream.log(f"{entity}/grid/{kind}_status", rerun.SegmentationImage(cloud.status), static=True)
        points = cloud_points(cloud)
        shown = rerun.Points3D(points.points, colors=_colours(points.sigma), radii=-1.5)
        noise = {"sigma": points.sigma, "covariance": points.covariance.ravel()}
        numbers = rerun.AnyValues(**{name: values.astype(np.float32) for name, values in noise.items()})
        stream.log(f"{entity}/{kind}", shown, numbers, static=True)


def _colours(sigma: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Return colours (n, 3) by ln sigma from its 2nd to its 98th percentile; grey where it is unknown."""
    out = np.tile(np.array(_UNKNOWN, np.uint8), (len(sigma), 1))
    positive = np.isfinite(sigma) & (sigma > 0)
    if positive.any():
        level = np.log(sigma[positive])
        low, high = np.percentile(level, [2, 98])
        share = np.clip((level - low) / max(high - low, 1e-9), 0, 1)
        out[positive] = (255 * matplotlib.colormaps["viridis"](share)[:, :3]).astype(np.uint8)
    return out
