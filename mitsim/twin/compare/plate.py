"""Specimen of a rebuilt capture: a matt sheet with the recorded bend, or a plate with the recorded print.

Signal chain, sheet: pose and bend -> mesh -> matt white. Signal chain, print: recorded image [e-] -> removal of its
noise (:mod:`mitsim.twin.compare.denoise`) -> ratio to the image of a white plate -> reflectance of the plate, or of
every pixel.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import trimesh
from scipy.ndimage import laplace, map_coordinates

from characterisation.files.arrays import Floats
from mitsim.capture.simulated.exposing import LightOnImagers
from mitsim.scene import backend
from mitsim.scene.load import Scene, scene_from_dict
from mitsim.sensor.camera import Camera
from mitsim.sensor.sensor import Sensor
from mitsim.twin.compare.denoise import denoised
from mitsim.twin.compare.plain_image import PlainImage
from mitsim.twin.finish.find_specimen import image_mask
from mitsim.twin.finish.specimen import Bend, Specimen

#: reflectance of the twin's plate without texture; the fit determines only its product with the power
REFLECTANCE = 0.85

#: number of squares of a bent sheet's mesh along each side
_MESH = 96

#: texels per pixel footprint along an axis; chosen
_TEXELS_PER_PX = 2.0

#: largest number of texels along a side, which bounds the memory; chosen
_LARGEST_TEXTURE = 4096
#: variance [px^2] of the aperture of a rendered texture: a pixel, which the recorded image already contains, and the
#: interpolation between texels
_APERTURE_PX2 = 1 / 12 + 1 / (6 * _TEXELS_PER_PX**2)


def plate(specimen: Specimen, sensor: Sensor, texture: Floats | None) -> Scene:
    """Return a rectangle at the specimen, matt white, or with reflectances (rows, columns) from low x and y on."""
    backend.activate()
    mi, half = backend.mi, specimen.extent / 2
    to_world = mi.ScalarTransform4f().translate([*(specimen.low + half), 0.0]).scale([*half, 1.0])
    bsdf: dict[str, Any] = {"type": "matt_white", "reflectance": REFLECTANCE}
    if texture is not None:
        image = mi.TensorXf(np.ascontiguousarray(REFLECTANCE * texture[..., None], np.float32))
        bitmap = {"type": "bitmap", "data": image, "raw": True, "wrap_mode": "clamp"}
        bsdf = {"type": "diffuse", "reflectance": bitmap}
    where = "the plane of a recording"
    if specimen.bend is None or texture is not None:
        shapes = {"specimen": {"type": "rectangle", "to_world": to_world, "bsdf": bsdf}}
        return scene_from_dict(shapes, sensor.wavelength_nm, where)
    with TemporaryDirectory() as folder:
        file = Path(folder) / "sheet.ply"
        _sheet(specimen, specimen.bend).export(file)
        shapes = {"specimen": {"type": "ply", "filename": str(file), "bsdf": bsdf}}
        return scene_from_dict(shapes, sensor.wavelength_nm, where)


def _sheet(specimen: Specimen, bend: Bend) -> trimesh.Trimesh:
    """Return the extent of the specimen as a bent mesh, with normals toward the sensor."""
    x, y = (specimen.low[axis] + np.linspace(0, specimen.extent[axis], _MESH + 1) for axis in (0, 1))
    xy = np.stack(np.meshgrid(x, y), axis=-1)
    vertices = np.concatenate([xy, bend.heights(xy)[..., None]], axis=-1).reshape(-1, 3)
    number = np.arange(len(vertices)).reshape(_MESH + 1, _MESH + 1)
    a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]
    faces = np.concatenate([np.stack(corners, axis=-1).reshape(-1, 3) for corners in ((a, b, c), (b, d, c))])
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    mesh.vertex_normals  # noqa: B018 - computed here, so that they are written, and the mesh is shaded as smooth
    return mesh


def texture_of(specimen: Specimen, camera: Camera, electrons: Floats, light: LightOnImagers, name: str) -> Floats:
    """Return the reflectance (rows, columns) of the plate, up to a factor.

    It is the ratio of the plain image (H, W) [e-] that a camera recorded to the light of a white plate. Outside the
    image of the camera, the value of the nearest pixel is repeated.
    """
    roi = light.rois[name]
    white = light.radiance[name][0].astype(float)
    lit = white > 0.05 * np.percentile(white, 99)
    ratio = denoised(electrons[roi.slices], lit) / np.where(lit, white, np.nan)
    ratio = np.where(np.isfinite(ratio), ratio, np.nanmedian(ratio))
    texel = specimen.distance / float(np.sqrt(camera.matrix[0, 0] * camera.matrix[1, 1])) / _TEXELS_PER_PX
    counts = np.minimum(np.ceil(specimen.extent / texel).astype(int), _LARGEST_TEXTURE)
    x, y = (
        low + (np.arange(count) + 0.5) / count * extent
        for low, count, extent in zip(specimen.low, counts, specimen.extent, strict=True)
    )
    pixels = np.nan_to_num(camera.project(specimen.in_sensor(x, y))) - [roi.left, roi.top]
    sharp = ratio - _APERTURE_PX2 / 2 * laplace(ratio, mode="nearest")
    return np.asarray(map_coordinates(sharp, [pixels[..., 1], pixels[..., 0]], order=3, mode="nearest")).clip(0.0)


def printed(
    light: LightOnImagers, specimen: Specimen, camera: Camera, electrons: Floats, name: str, plain: PlainImage
) -> LightOnImagers:
    """Return the light of a white specimen on its only camera with the print of the recorded plain image (H, W) [e-].

    Parameters
    ----------
    light, specimen, camera, electrons, name, plain
        The plain image is ``electrons``, the largest level of the images ``plain``; ``name`` is that of the camera.
    """
    inside, radiance = light.rois[name].slices, light.radiance[name]
    there = image_mask(specimen, camera)[inside]
    white = radiance[list(plain.images)].max(axis=0).astype(float)
    ratio = np.where(there & (white > 0), denoised(electrons[inside], there) / np.where(white > 0, white, 1.0), 0.0)
    ratio /= max(float(np.percentile(ratio[there], 95)), 1e-12)
    return replace(light, radiance={name: radiance * np.maximum(ratio, 0.0).astype(np.float32)})
