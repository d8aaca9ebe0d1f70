"""The same fits by an independent library of coordinate metrology, engeom (https://github.com/mattj23/engeom)."""

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from characterisation.features.figures import Circle
from characterisation.features.fits import fit_cone, fit_cylinder, fit_plane, fit_sphere
from characterisation.features.pose_fit import fit_pose
from characterisation.features.robust_fit import robust_fit
from characterisation.features.surfaces import Cone, Cylinder, Plane

geom3 = pytest.importorskip("engeom.geom3", reason="pip install engeom to compare with its fits")
align3 = pytest.importorskip("engeom.align3", reason="pip install engeom to compare with its fits")

SIGMA = 0.02


def array(xyz):
    return np.array([xyz.x, xyz.y, xyz.z])


def noisy(points, ways, rng):
    """Points off their surface by at most two standard deviations, so that no fit leaves any out."""
    return points + SIGMA * np.clip(rng.normal(size=(len(points), 1)), -2, 2) * ways


def ring(count, rng, arc=2.0):
    angle = rng.uniform(-arc, arc, count)
    return np.column_stack([np.cos(angle), np.sin(angle), np.zeros(count)])


def test_planes_agree():
    rng = np.random.default_rng(1)
    points = noisy(np.column_stack([rng.uniform(-30, 30, (500, 2)), np.zeros(500)]), np.eye(3)[2], rng)
    points = points @ Rotation.from_euler("xyz", [0.3, 0.2, 0.1]).as_matrix().T + np.array([3, 4, 500])
    ours, theirs = fit_plane(points), geom3.Plane3.from_fit(points)
    assert ours.count == 500
    assert np.linalg.norm(np.cross(ours.normal, array(theirs.normal))) < 1e-9
    assert abs(theirs.signed_distance_to_point(geom3.Point3(*ours.point))) < 1e-9


def test_spheres_agree():
    rng = np.random.default_rng(2)
    ways = rng.normal(size=(500, 3))
    ways[:, 2] = -np.abs(ways[:, 2])
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    points = noisy(25 * ways + np.array([5, 6, 600]), ways, rng)
    ours, theirs = fit_sphere(points), geom3.Sphere3.from_fit(points)
    assert ours.count == 500
    # both stop where the sum of squares is flat to some 1e-12 of it
    assert np.abs(ours.centre - array(theirs.center)).max() < 1e-6
    assert ours.radius == pytest.approx(theirs.r, abs=1e-6)


def test_circles_agree():
    """Theirs is a circle in space; points that lie in a plane make it ours."""
    rng = np.random.default_rng(3)
    around = ring(300, rng)
    points = noisy(12 * around, around, rng) + np.array([5, 6, 600])
    z = np.array([0.0, 0, 1])

    def linearised(circle, parameters, chosen, along_rays):
        return circle.linearised(parameters, points[chosen])

    ours, kept = robust_fit(Circle(np.array([5.5, 6, 600]), z, 11.0, z), linearised, 300)
    theirs = geom3.Circle3.from_fit(points)
    assert kept.all()
    assert np.abs(ours.centre - array(theirs.center)).max() < 1e-6
    assert ours.radius == pytest.approx(theirs.r, abs=1e-6)


def test_cylinders_and_cones_agree_within_their_uncertainty():
    """Theirs are robust by a consensus that weighs points by their distance, so not the same estimate."""
    rng = np.random.default_rng(4)
    around, along, z = ring(2000, rng), rng.uniform(-20, 20, 2000), np.array([0.0, 0, 1])
    turn = Rotation.from_euler("xyz", [0.4, 0.3, 0.1]).as_matrix()
    points = noisy(15 * around + np.outer(along, z), around, rng) @ turn.T
    ours = fit_cylinder(points, Cylinder(np.zeros(3), turn @ z, 14.0))
    theirs = geom3.Cylinder3.from_consensus(points, around @ turn.T, 3 * SIGMA, seed=1)
    deviation = np.sqrt(np.diag(ours.covariance))
    assert abs(ours.radius - theirs.r) < deviation[4]
    assert np.linalg.norm(np.cross(ours.axis, array(theirs.direction))) < np.hypot(*deviation[2:4])

    slant = 0.4
    outward = np.cos(slant) * around - np.sin(slant) * z
    points = noisy((20 + along * np.tan(slant))[:, None] * around + np.outer(along, z), outward, rng) @ turn.T
    ours = fit_cone(points, Cone(np.zeros(3), turn @ z, 19.0, 0.35))
    theirs = geom3.Cone3.from_consensus(points, outward @ turn.T, 3 * SIGMA, seed=1)
    deviation = np.sqrt(np.diag(ours.covariance))
    assert abs(ours.half_angle - theirs.half_angle) < deviation[5]
    assert np.linalg.norm(np.cross(ours.axis, array(theirs.direction))) < np.hypot(*deviation[2:4])


def test_a_cone_is_the_least_squares_one_of_another_parameterisation():
    """Apex, axis by two angles and half-angle, residuals without derivatives: scipy alone, and the same cone."""
    rng = np.random.default_rng(5)
    around, along, z, slant = ring(600, rng), rng.uniform(-20, 20, 600), np.array([0.0, 0, 1]), 0.4
    outward = np.cos(slant) * around - np.sin(slant) * z
    points = noisy((20 + along * np.tan(slant))[:, None] * around + np.outer(along, z), outward, rng)

    def residual(unknowns):
        axis = np.array(
            [np.sin(unknowns[3]), np.cos(unknowns[3]) * np.sin(unknowns[4]), np.cos(unknowns[3]) * np.cos(unknowns[4])]
        )
        local = points - unknowns[:3]
        height = local @ axis
        reach = np.linalg.norm(local - np.outer(height, axis), axis=1)
        return reach * np.cos(unknowns[5]) - height * np.sin(unknowns[5])

    start = np.array([0.0, 0, -20 / np.tan(slant), 0.0, 0.0, slant])
    other = least_squares(residual, start, xtol=1e-14, ftol=1e-14, gtol=1e-14, x_scale="jac")
    ours = fit_cone(points, Cone(np.zeros(3), z, 19.0, 0.35))
    assert ours.count == 600
    assert np.abs(ours.apex - other.x[:3]).max() < 1e-4
    assert ours.half_angle == pytest.approx(other.x[5], abs=1e-6)
    covariance = np.linalg.inv(other.jac.T @ other.jac) * 2 * other.cost / (600 - 6)
    assert np.sqrt(ours.covariance[5, 5]) == pytest.approx(np.sqrt(covariance[5, 5]), rel=1e-3)


def test_poses_agree():
    """Theirs aligns points to a mesh, here of a box; without a viewpoint ours minimises the same distances."""
    rng = np.random.default_rng(6)
    faces = {
        "x": Plane(np.array([30.0, 0, 0]), np.eye(3)[0]),
        "y": Plane(np.array([0.0, 20, 0]), np.eye(3)[1]),
        "z": Plane(np.array([0.0, 0, 10]), np.eye(3)[2]),
    }
    half, local = np.array([30.0, 20, 10]), {}
    for axis, (name, plane) in enumerate(faces.items()):
        points = rng.uniform(-0.8, 0.8, (200, 3)) * half
        points[:, axis] = half[axis]
        local[name] = noisy(points, plane.normal, rng)
    true = np.eye(4)
    true[:3, :3] = Rotation.from_euler("xyz", [2, -1, 1.5], degrees=True).as_matrix()
    true[:3, 3] = [0.5, -0.3, 0.4]
    points = {name: rows @ true[:3, :3].T + true[:3, 3] for name, rows in local.items()}
    ours = fit_pose(points, faces, np.eye(4))
    assert ours.count == 600

    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * half
    triangles = [
        [0, 1, 3],
        [0, 3, 2],
        [4, 6, 7],
        [4, 7, 5],
        [0, 4, 5],
        [0, 5, 1],
        [2, 3, 7],
        [2, 7, 6],
        [0, 2, 6],
        [0, 6, 4],
        [1, 5, 7],
        [1, 7, 3],
    ]
    mesh = geom3.Mesh3(corners, np.array(triangles, np.uint32))
    every = np.concatenate(list(points.values()))
    outcome = align3.points_to_mesh(every, mesh, align3.AlignParams3(), refinement_steps=0)
    theirs = np.linalg.inv(outcome.alignment.full_transform.as_numpy())  # part from sensor
    deviation = np.sqrt(np.diag(ours.covariance))
    difference = theirs @ np.linalg.inv(ours.sensor_from_part)
    assert np.abs(Rotation.from_matrix(difference[:3, :3]).as_rotvec()).max() < 1e-4 * deviation[:3].min()
    assert np.abs(difference[:3, :3] @ ours.about + difference[:3, 3] - ours.about).max() < 1e-4 * deviation[3:].min()
