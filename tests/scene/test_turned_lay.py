"""The turned BSDF against the stock lobe in a frame that is turned by hand."""

import numpy as np
import pytest

from mitsim.scene import backend
from mitsim.scene.bsdf_descriptions import conductor_bsdf
from mitsim.scene.turned_lay import from_z_axis, turned_description


def directions(rng, count):
    vectors = rng.normal(size=(3, count))
    vectors[2] = np.abs(vectors[2]) + 0.1
    return vectors / np.linalg.norm(vectors, axis=0)


def turned(vectors, degrees):
    """Coordinates of vectors in a frame that is turned about z."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) @ vectors


def surface_of(vectors):
    from mitsim.scene.backend import dr, mi

    surface = dr.zeros(mi.SurfaceInteraction3f, vectors.shape[1])
    surface.wi = mi.Vector3f(vectors.astype(np.float32))
    return surface


@pytest.fixture(scope="module")
def lobe():
    backend.activate()
    return conductor_bsdf("ggx", (0.05, 0.3), (2.6, 8.2))


@pytest.mark.parametrize("degrees", [0.0, 35.0, 90.0, 160.0])
def test_a_turned_lobe_is_the_lobe_in_a_turned_frame(lobe, degrees):
    from mitsim.scene.backend import mi

    rng = np.random.default_rng(3)
    view, light = directions(rng, 4000), directions(rng, 4000)
    one = mi.load_dict(turned_description(lobe, degrees))
    stock, context = mi.load_dict(lobe), mi.BSDFContext()
    found = one.eval_pdf(context, surface_of(view), mi.Vector3f(light.astype(np.float32)), True)
    in_frame = mi.Vector3f(turned(light, degrees).astype(np.float32))
    wanted = stock.eval_pdf(context, surface_of(turned(view, degrees)), in_frame, True)
    for a, b in zip(found, wanted, strict=True):
        np.testing.assert_allclose(np.array(a).ravel(), np.array(b).ravel(), rtol=2e-3, atol=1e-5)
    value = one.eval(context, surface_of(view), mi.Vector3f(light.astype(np.float32)), True)
    np.testing.assert_allclose(np.array(value), np.array(found[0]), rtol=1e-5)


def test_samples_have_the_density_that_is_stated(lobe):
    from mitsim.scene.backend import mi

    rng = np.random.default_rng(4)
    count = 20000
    view = np.repeat(directions(rng, 1), count, axis=1)
    one, context = mi.load_dict(turned_description(lobe, 50.0)), mi.BSDFContext()
    random = rng.random((3, count)).astype(np.float32)
    sampled, weight = one.sample(context, surface_of(view), mi.Float(random[0]), mi.Point2f(random[1:]), True)
    value, density = one.eval_pdf(context, surface_of(view), sampled.wo, True)
    density, weight = np.array(density), np.array(weight)[0]
    used = density > 1e-3
    assert used.mean() > 0.9
    np.testing.assert_allclose(np.array(sampled.pdf)[used], density[used], rtol=1e-2)
    np.testing.assert_allclose(weight[used], np.array(value)[0][used] / density[used], rtol=1e-2)


def test_the_streak_of_a_turned_lay_lies_across_the_marks(lobe):
    """Light along the normal: the lobe of marks at 30 deg is widest at 120 deg."""
    from mitsim.scene.backend import mi

    azimuths, polar = np.radians(np.arange(0.0, 180.0, 2.0)), np.radians(25.0)
    light = np.array([np.sin(polar) * np.cos(azimuths), np.sin(polar) * np.sin(azimuths), 0 * azimuths + np.cos(polar)])
    view = np.repeat([[0.0], [0.0], [1.0]], len(azimuths), axis=1)
    one = mi.load_dict(turned_description(lobe, 30.0))
    value = np.array(one.eval(mi.BSDFContext(), surface_of(view), mi.Vector3f(light.astype(np.float32)), True))[0]
    assert np.degrees(azimuths[np.argmax(value)]) == pytest.approx(120.0, abs=2.1)


def test_a_flat_face_without_uvs_has_one_direction():
    """Two triangles of one tilted face, whose tangents differ: all over it, light returns as from marks in one plane.

    The marks at 90 deg to the projected z axis are horizontal, so the streak lies in the plane of normal and z.
    """
    from mitsim.scene.backend import dr, mi

    slope = np.array([0.4, 0.15])
    corners = np.array([[-10, -10], [10, -10], [10, 10], [-10, 10]], float)
    mesh_props = mi.Properties()
    mesh_props["bsdf"] = mi.load_dict(turned_description(conductor_bsdf("ggx", (0.02, 0.3), (2.6, 8.2)), 90.0))
    mesh = mi.Mesh("face", 4, 2, props=mesh_props)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = np.column_stack([corners, corners @ slope]).astype(np.float32).ravel()
    parameters["faces"] = np.array([0, 1, 2, 0, 2, 3], np.uint32)
    parameters.update()
    rng = np.random.default_rng(5)
    origins = np.vstack([rng.uniform(-8, 8, (2, 200)), np.full((1, 200), 50.0)]).astype(np.float32)
    scene = mi.load_dict({"type": "scene", "face": mesh})
    surface = scene.ray_intersect(mi.Ray3f(mi.Point3f(origins), mi.Vector3f(0, 0, -1)))
    assert dr.all(surface.is_valid()) and len(np.unique(np.array(surface.prim_index))) == 2
    assert len(np.unique(np.array(surface.sh_frame.s).round(3), axis=1).T) == 2  # two frames of Mitsuba
    normal = np.array([-slope[0], -slope[1], 1.0]) / np.sqrt(1 + slope @ slope)
    uphill = np.array([0, 0, 1.0]) - normal * normal[2]
    uphill /= np.linalg.norm(uphill)
    level = np.cross(normal, uphill)
    surface.wi = surface.to_local(mi.Vector3f(normal))
    found = []
    for tangent in (uphill, level):
        toward = np.cos(0.4) * normal + np.sin(0.4) * tangent
        found.append(np.array(surface.bsdf().eval(mi.BSDFContext(), surface, surface.to_local(mi.Vector3f(toward))))[0])
    for values in found:
        np.testing.assert_allclose(values, values[0], rtol=1e-3)
    assert found[0][0] > 20 * found[1][0]


def test_directions_from_the_z_axis_need_no_place(lobe):
    """On a cylinder along x, whose u is around it: local directions on it, and turned ones without any frame."""
    from mitsim.scene.backend import dr, mi

    shape = {"type": "cylinder", "p0": [-9, 0, 0], "p1": [9, 0, 0], "radius": 5, "bsdf": turned_description(lobe, 30.0)}
    rng = np.random.default_rng(6)
    origins = np.vstack([rng.uniform(-8, 8, 300), rng.uniform(-4.5, 4.5, 300), np.full(300, 50.0)]).astype(np.float32)
    scene = mi.load_dict({"type": "scene", "shape": shape})
    surface = scene.ray_intersect(mi.Ray3f(mi.Point3f(origins), mi.Vector3f(0, 0, -1)))
    light = mi.Vector3f(directions(rng, 300).astype(np.float32))
    one, context = surface.bsdf(), mi.BSDFContext()
    there = np.array(one.eval(context, surface, light))[0]
    bare = dr.zeros(mi.SurfaceInteraction3f, 300)
    bare.wi = from_z_axis(surface.sh_frame, surface.wi)
    anywhere = mi.load_dict(turned_description(lobe, 30.0)).eval(context, bare, from_z_axis(surface.sh_frame, light))
    assert (there > 0).mean() > 0.5
    np.testing.assert_allclose(np.array(anywhere)[0], there, rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("degrees", [0.0, 40.0])
def test_marks_on_a_horizontal_face_are_counted_from_x(degrees):
    from mitsim.scene.backend import mi

    lobe = conductor_bsdf("ggx", (0.02, 0.3), (2.6, 8.2))
    turn = mi.ScalarTransform4f().rotate([0, 0, 1], 25).scale(10)
    face = {"type": "rectangle", "to_world": turn, "bsdf": turned_description(lobe, degrees)}
    scene = mi.load_dict({"type": "scene", "face": face})
    azimuths = np.radians(np.arange(0.0, 180.0, 2.0))
    ray = mi.Ray3f(mi.Point3f(np.repeat([[1.0], [2.0], [50.0]], 90, axis=1)), mi.Vector3f(0, 0, -1))
    surface = scene.ray_intersect(ray)
    light = np.array([0.4 * np.cos(azimuths), 0.4 * np.sin(azimuths), 0 * azimuths + np.sqrt(1 - 0.16)])
    value = surface.bsdf().eval(mi.BSDFContext(), surface, surface.to_local(mi.Vector3f(light.astype(np.float32))))
    assert np.degrees(azimuths[np.argmax(np.array(value)[0])]) == pytest.approx((degrees + 90) % 180, abs=2.1)
