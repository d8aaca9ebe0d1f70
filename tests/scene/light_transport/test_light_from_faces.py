"""Interreflected light by the face that it met before: as much as the renderer finds, from faces that reflect it."""

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from characterisation.region_of_interest import Roi
from mitsim.report.bounce_figure import bounce_figure
from mitsim.scene.light_transport.light_from_faces import LightFromFaces, light_from_faces
from mitsim.scene.light_transport.light_paths import LightPaths
from mitsim.scene.light_transport.projected_codes import ProjectedPatterns
from mitsim.scene.light_transport.transport import trace
from mitsim.scene.load import load_scene
from mitsim.scene.ray_casting.camera_rays import CameraRays
from mitsim.sensor.working_volume import pose_at

#: a floor of 160 x 160 mm before a wall, and a panel beside it; ``wall`` and ``panel`` are reflectances
CORNER = """<scene version="3.0.0">
    <shape type="rectangle" id="floor"><transform name="to_world"><scale value="80"/></transform>
        <bsdf type="matt_white"><float name="reflectance" value="0.8"/></bsdf></shape>
    <shape type="rectangle" id="wall"><transform name="to_world"><scale value="80"/><rotate x="1" angle="90"/>
        <translate y="80" z="80"/></transform>
        <bsdf type="matt_white"><float name="reflectance" value="{wall}"/></bsdf></shape>
    <shape type="rectangle" id="panel"><transform name="to_world"><scale value="80"/><rotate y="1" angle="90"/>
        <translate x="-80" z="80"/></transform>
        <bsdf type="matt_white"><float name="reflectance" value="{panel}"/></bsdf></shape>
</scene>"""


def corner(tmp_path, sensor, wall=0.8, panel=0.8):
    (tmp_path / "corner.xml").write_text(CORNER.format(wall=wall, panel=panel))
    scene = load_scene(tmp_path / "corner.xml", sensor.wavelength_nm)
    return scene, pose_at(sensor, np.array([60.0, -420.0, 420.0]), np.array([0.0, 20.0, 30.0]))


def test_the_light_of_two_surfaces_is_that_of_the_renderer(tmp_path, n10):
    scene, pose = corner(tmp_path, n10)
    camera = n10.rig.reference.binned(16)
    found = light_from_faces(scene, camera, n10.projector, pose, samples=400)
    optics = n10.projector.optics
    white = ProjectedPatterns(np.ones((1, optics.height, optics.width), np.float32), n10.projector)
    direct = trace(scene, CameraRays(camera), white, pose, LightPaths(64, 1))[0]
    paths = LightPaths(400, 2, 2, jitter=True, photons=0, indirect_only=True)
    other = trace(scene, CameraRays(camera), white, pose, paths)[0]
    assert found.by_face.sum() == pytest.approx(other.sum(), rel=0.02) and found.by_face.sum() > 0.1 * direct.sum()
    assert found.direct.sum() == pytest.approx(direct.sum(), rel=0.01)
    region = Roi(10, 5, 20, 12)
    part = light_from_faces(scene, camera, n10.projector, pose, samples=400, roi=region)
    assert part.share.shape == (12, 20)
    inside = found.by_face[:, 5:17, 10:30].sum()
    assert part.by_face.sum() == pytest.approx(inside, rel=0.05)


def test_a_source_is_in_proportion_to_its_reflectance_and_a_plane_does_not_light_itself(tmp_path, n10):
    camera = n10.rig.reference.binned(16)
    scene, pose = corner(tmp_path, n10)
    bright = light_from_faces(scene, camera, n10.projector, pose, samples=64)
    scene, _ = corner(tmp_path, n10, panel=0.02)
    found = light_from_faces(scene, camera, n10.projector, pose, samples=64)
    floor, wall, panel = (scene.names.index(name) for name in ("floor", "wall", "panel"))
    others = found.shape != panel  # what the panel itself returns is in proportion to its reflectance, too
    before, now = (one.by_face[panel][others].sum() for one in (bright, found))
    assert now == pytest.approx(before * 0.02 / 0.8, rel=0.05) and before > 0
    assert found.by_face[wall][others].sum() == pytest.approx(bright.by_face[wall][others].sum(), rel=0.02)
    inner = np.zeros(found.shape.shape, bool)
    same = found.shape == floor
    inner[1:-1, 1:-1] = (
        same[1:-1, 1:-1] & same[:-2, 1:-1] & same[2:, 1:-1] & same[1:-1, :-2] & same[1:-1, 2:]
    )  # pixels at an edge show two faces
    assert inner.sum() > 20 and not found.by_face[floor][inner].any()
    assert found.shares_of(floor)[wall] > 0.02


def test_the_picture_names_the_sources_of_each_face():
    shape = np.repeat([[0, 0, 1, -1]], 3, axis=0)
    by_face = np.zeros((2, 3, 4))
    by_face[1, :, :2], by_face[0, :, 2] = 3.0, 1.0
    found = LightFromFaces(shape, np.where(shape >= 0, 1.0, 0.0), by_face)
    assert np.isnan(found.share[0, 3]) and found.share[0, :3] == pytest.approx([0.75, 0.75, 0.5])
    figure = bounce_figure(found, ["plate", "pin"], "title")
    words = " ".join(text.get_text() for text in figure.texts)
    assert "plate: 75\N{NO-BREAK SPACE}% of its light met another face before: pin 75\N{NO-BREAK SPACE}%" in words
    assert "pin: 50\N{NO-BREAK SPACE}% of its light met another face before: plate" in words
    FigureCanvasAgg(figure).draw()
    dark = LightFromFaces(shape, np.zeros((3, 4)), np.zeros((2, 3, 4)))
    assert "no face is lit" in bounce_figure(dark, ["plate", "pin"], "title").texts[-1].get_text()
