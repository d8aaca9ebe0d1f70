"""Shapes that a transform mirrors, or whose file has normals against its triangles: which side images show bright."""

import numpy as np
import pytest
import trimesh

from mitsim.scene.backend import mi
from mitsim.scene.first_hits import first_hits
from mitsim.scene.ray_casting.raycast import PixelRays, cast
from mitsim.scene.ray_casting.triangles import triangles
from mitsim.sensor.transforms import look_at
from tests.scene.test_inspect import WHITE, scene_of


def radiance(scene, origins, directions):
    """Light [1] of a white sky that each ray brings back, as Mitsuba's own path tracer finds it."""
    rays = mi.RayDifferential3f(mi.Ray3f(mi.Point3f(origins.T), mi.Vector3f(directions.T)))
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, len(origins))
    colours = mi.load_dict({"type": "path", "max_depth": 2}).sample(scene.mitsuba, sampler, rays)[0]
    return np.array(colours, float).reshape(-1, len(origins)).mean(axis=0)


@pytest.fixture
def balls(tmp_path):
    ball = trimesh.creation.icosphere(2, 10.0)
    away = trimesh.Trimesh(ball.vertices, ball.faces[:, ::-1], vertex_normals=ball.vertices / 10, process=False)
    for name, mesh in (("ball", ball), ("away", away)):
        (tmp_path / f"{name}.ply").write_bytes(mesh.export(file_type="ply", vertex_normal=True))


@pytest.mark.parametrize("flip", ["", '<boolean name="flip_normals" value="true"/>'])
@pytest.mark.parametrize(
    ("shape", "scale"),
    [
        ('type="rectangle">', 'x="-10" y="10"'),
        ('type="rectangle">', 'x="10" y="10" z="-1"'),
        ('type="rectangle">', 'value="10"'),
        ('type="cube">', 'x="-10" y="10" z="10"'),
        ('type="ply"><string name="filename" value="ball.ply"/>', 'y="-1"'),
        ('type="ply"><string name="filename" value="away.ply"/>', 'value="1"'),
        ('type="disk">', 'x="-10" y="10"'),
    ],
)
def test_rays_tell_the_side_that_images_show_bright(tmp_path, balls, shape, scale, flip):
    """Front and back by rays, points of a prediction and sides of triangles, against the light in Mitsuba's images."""
    kind, rest = shape.split(">", 1)
    body = f'<shape id="s" {kind}>{rest}{flip}{WHITE}<transform name="to_world"><scale {scale}/></transform></shape>'
    scene = scene_of(tmp_path, f'{body}<emitter type="constant"/>')
    for side in (1.0, -1.0):
        pose = look_at((1.3, 0.9, 60 * side), (1.3, 0.9, 0.0), (0, 1, 0))
        along = np.array([[0.0, 0.0, -side]])
        bright = radiance(scene, pose.translation[None], along)[0] > 0.1
        assert bool(first_hits(scene.mitsuba, pose.translation[None], along).front[0]) == bright
        seen = cast(scene, PixelRays(np.zeros(3), np.array([[[0.0, 0.0, 1.0]]])), pose, np.zeros((0, 3)))
        assert bool(np.isfinite(seen.distance[0, 0])) == bright
        corners = triangles(scene)
        facing = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2] * side
        near = corners.mean(axis=1)[:, 2] * side > -1e-6
        assert (facing[near].sum() > 0) == bright


def test_a_mirrored_mesh_keeps_its_place_and_its_normals(tmp_path):
    """Rays meet the cylinder whose exact normals are in the file, not its facets' normals."""
    sides = trimesh.creation.cylinder(10.0, 40.0, sections=12)
    corners = sides.triangles[np.abs(sides.face_normals[:, 2]) < 0.1].reshape(-1, 3)
    normals = corners * [0.1, 0.1, 0.0]
    mesh = trimesh.Trimesh(corners, np.arange(len(corners)).reshape(-1, 3), vertex_normals=normals, process=False)
    (tmp_path / "side.ply").write_bytes(mesh.export(file_type="ply", vertex_normal=True))
    scene = scene_of(
        tmp_path,
        f'<shape id="s" type="ply"><string name="filename" value="side.ply"/>{WHITE}'
        '<transform name="to_world"><scale x="-1"/><translate x="50"/></transform></shape>',
    )
    angle = np.linspace(0.01, 6.2, 40)
    outward = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(40)])
    start = [50, 0, 3] + 30 * outward
    met = scene.mitsuba.ray_intersect(mi.Ray3f(mi.Point3f(start.T), mi.Vector3f(-outward.T)))
    place, normal = np.array(met.p, float).T, np.array(met.sh_frame.n, float).T
    np.testing.assert_allclose(np.cross(place - [50, 0, 3], outward), 0, atol=1e-4)
    assert (np.einsum("ij,ij->i", normal, outward) > 0.999).all()
    assert (np.einsum("ij,ij->i", np.array(met.n, float).T, outward) > 0.9).all()
