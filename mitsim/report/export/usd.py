"""Write part and views as OpenUSD (``.usda``, ``.usdc`` or ``.usdz``), with usd-core.

The stage is in mm (``metersPerUnit`` 0.001) with z up: it is the part frame. Each view is an Xform with the pose of the
sensor frame. Below it is a Camera with the sensor's image grid, which in USD looks along its own -z with y up. Its
aperture offsets represent the principal point.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from characterisation.files.atomic_io import atomic_write_named
from characterisation.point_cloud import ViewGrid
from mitsim.report.export.gltf import OPENCV_FROM_OPENGL
from mitsim.report.export.needed import needed
from mitsim.report.export.run_scene import RunScene, sensor_from_grid
from mitsim.sensor.transforms import Transform

#: arbitrary focal length, since only its ratio to the aperture matters [tenths of a mm, as in USD]
FOCAL = 240.0


def write_usd(scene: RunScene, path: str | Path) -> None:
    """Write part and views as a USD stage."""
    path = Path(path)
    usd, geometry = needed("pxr.Usd", "usd-core", f"{path}: USD"), needed("pxr.UsdGeom", "usd-core", f"{path}: USD")
    values = needed("pxr.Gf", "usd-core", f"{path}: USD")
    with atomic_write_named(path) as file:
        package = path.suffix.lower() == ".usdz"
        layer = file.with_suffix(".usdc") if package else file
        stage = usd.Stage.CreateNew(str(layer))
        geometry.SetStageUpAxis(stage, geometry.Tokens.z)
        geometry.SetStageMetersPerUnit(stage, geometry.LinearUnits.millimeters)
        root = geometry.Xform.Define(stage, "/part_frame")
        stage.SetDefaultPrim(root.GetPrim())
        if scene.part is not None:
            mesh = geometry.Mesh.Define(stage, "/part_frame/part")
            mesh.CreatePointsAttr(np.asarray(scene.part.vertices, np.float32))
            mesh.CreateFaceVertexCountsAttr(np.full(len(scene.part.faces), 3, np.int32))
            mesh.CreateFaceVertexIndicesAttr(np.asarray(scene.part.faces, np.int32).ravel())
            mesh.CreateSubdivisionSchemeAttr(geometry.Tokens.none)
            mesh.CreateDoubleSidedAttr(True)
            mesh.CreateExtentAttr(np.asarray(scene.part.bounds, np.float32))
        for view in scene.views:
            xform = geometry.Xform.Define(stage, f"/part_frame/{view.name}")
            xform.AddTransformOp().Set(_matrix(values, view.part_from_sensor))
            prim = xform.GetPrim()
            prim.SetCustomDataByKey("mitsim:view", view.number)
            prim.SetCustomDataByKey("mitsim:sensor", scene.sensor)
            prim.SetCustomDataByKey("mitsim:best_of", ", ".join(view.best_of))
            if scene.grid is not None:
                _camera(stage, geometry, values, f"/part_frame/{view.name}/camera", scene.grid)
        stage.GetRootLayer().Save()
        del stage
        if package:
            needed("pxr.UsdUtils", "usd-core", f"{path}: USD").CreateNewUsdzPackage(str(layer), str(file))


def _camera(stage: Any, geometry: Any, values: Any, path: str, grid: ViewGrid) -> None:
    camera = geometry.Camera.Define(stage, path)
    camera.AddTransformOp().Set(_matrix(values, sensor_from_grid(grid) @ OPENCV_FROM_OPENGL))
    camera.CreateFocalLengthAttr(FOCAL)
    camera.CreateHorizontalApertureAttr(FOCAL * grid.width / grid.fx)
    camera.CreateVerticalApertureAttr(FOCAL * grid.height / grid.fy)
    # offset of the image centre from the axis; y is up in USD and down in the grid
    camera.CreateHorizontalApertureOffsetAttr(FOCAL * ((grid.width - 1) / 2 - grid.cx) / grid.fx)
    camera.CreateVerticalApertureOffsetAttr(FOCAL * (grid.cy - (grid.height - 1) / 2) / grid.fy)
    camera.CreateClippingRangeAttr(values.Vec2f(10.0, 1e5))


def _matrix(values: Any, pose: Transform) -> Any:
    """Convert a pose to USD, which multiplies rows: the transpose."""
    return values.Matrix4d(*pose.matrix().T.ravel().tolist())
