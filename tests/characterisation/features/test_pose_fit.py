"""Pose of a part from several of its surfaces."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from characterisation.features.pose_fit import Pose, fit_pose, pose_jacobian
from characterisation.features.robust_fit import FitError
from characterisation.features.surfaces import Cone, Cylinder, Plane, Sphere

EYE = np.zeros(3)
X, Y, Z = np.eye(3)
NOMINAL = {
    "top": Plane(np.array([0.0, 0, 10]), Z),
    "side": Plane(np.array([30.0, 0, 0]), X),
    "front": Plane(np.array([0.0, 20, 0]), Y),
    "pin": Cylinder(np.array([0.0, 0, 10]), Z, 8.0),
    "bar": Cylinder(np.array([0.0, 5, 10]), X, 6.0),
    "ball": Sphere(np.array([10.0, 5, 30]), 9.0),
    "cone": Cone(np.array([0.0, 0, 0]), Z, 10.0, 0.3),
}


def posed(euler_deg=(150, 20, 30), place=(10.0, -20, 500)):
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("xyz", euler_deg, degrees=True).as_matrix()
    matrix[:3, 3] = place
    return matrix


TRUE = posed()
ROUGH = posed((152, 19, 31.5), (11.0, -18, 499))


def sample(name, count, rng):
    """Points on a feature of the part, sensor frame; on round ones all round."""
    a, b, zero = *rng.uniform(-20, 20, (2, count)), np.zeros(count)
    surface = NOMINAL[name]
    if isinstance(surface, Plane):
        columns = {"top": (a, b, zero + 10), "side": (zero + 30, a, b), "front": (a, zero + 20, b)}[name]
        points = np.column_stack(columns)
    elif isinstance(surface, Sphere):
        ways = rng.normal(size=(count, 3))
        points = surface.centre + surface.radius * ways / np.linalg.norm(ways, axis=1, keepdims=True)
    else:
        radius = surface.radius + b * np.tan(getattr(surface, "half_angle", 0.0))
        angle = a * np.pi / 20
        across = (X, Y) if name != "bar" else (Y, Z)
        points = (
            surface.point
            + np.outer(radius * np.cos(angle), across[0])
            + np.outer(radius * np.sin(angle), across[1])
            + np.outer(b, surface.axis)
        )
    return points @ TRUE[:3, :3].T + TRUE[:3, 3]


def unit_rays(points):
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def motion_between(fit, true):
    """Parameters (6,) of the small motion that takes a fitted pose to the true one."""
    motion = true @ np.linalg.inv(fit.sensor_from_part)
    vector = Rotation.from_matrix(motion[:3, :3]).as_rotvec()
    return np.array([*vector, *(motion[:3, :3] @ fit.about + motion[:3, 3] - fit.about)])


@pytest.mark.parametrize("viewpoint", [None, EYE])
@pytest.mark.parametrize(
    "names", [("top", "side", "front"), ("pin", "ball"), ("cone", "ball", "top"), ("pin", "bar"), ("bar", "cone")]
)
def test_exact_points_give_the_exact_pose(names, viewpoint):
    rng = np.random.default_rng(1)
    fit = fit_pose({name: sample(name, 300, rng) for name in names}, NOMINAL, ROUGH, viewpoint)
    assert np.abs(fit.sensor_from_part - TRUE).max() < 1e-9
    assert fit.covariance.shape == (6, 6) and fit.residual_std < 1e-9
    assert fit.count > 300 * len(names) / 2  # the points behind were seen at grazing incidence, or not at all


@pytest.mark.parametrize(
    "names, said",
    [
        (["top"], r"shift along \(1, 0, 0\) and shift along \(0, 1, 0\) and turn about \(0, 0, 1\) through"),
        (["top", "side"], r"free to shift along \(0, 1, 0\)$"),
        (["pin"], r"shift along \(0, 0, 1\) and turn about \(0, 0, 1\) through \(0, 0, 0\)$"),
        (["pin", "top"], r"free to turn about \(0, 0, 1\) through \(0, 0, 0\)$"),
        (
            ["ball"],
            r"turn about \(1, 0, 0\) through \(10, 5, 30\) and turn about \(0, 1, 0\) through \(10, 5, 30\) "
            r"and turn about \(0, 0, 1\) through \(10, 5, 30\)$",
        ),
        (["ball", "top"], r"free to turn about \(0, 0, 1\) through \(10, 5, 0\)$"),
        (["cone"], r"free to turn about \(0, 0, 1\) through \(0, 0, 0\)$"),
        ([], "0 points, a pose needs at least 7"),
    ],
)
def test_a_motion_that_is_left_free_is_named_in_the_part_frame(names, said):
    rng = np.random.default_rng(2)
    for viewpoint in (None, EYE):
        with pytest.raises(FitError, match=said):
            fit_pose({name: sample(name, 200, rng) for name in names}, NOMINAL, TRUE, viewpoint)


@pytest.mark.parametrize("name", list(NOMINAL))
@pytest.mark.parametrize("along_rays", [False, True])
def test_derivatives_by_a_motion_are_those_of_the_residuals(name, along_rays):
    rng = np.random.default_rng(3)
    points = sample(name, 200, rng) + rng.normal(0, 0.1, (200, 3))
    rays = unit_rays(points) if along_rays else None
    pose = Pose(TRUE, np.array([5.0, -10, 480]))
    surface = NOMINAL[name]
    placed = surface.placed(TRUE)
    jacobian = pose_jacobian(placed, points, rays, pose.about)
    clear = np.abs(placed.meet(points, rays).cosine) > 0.2
    for column in range(6):
        step = np.zeros(6)
        step[column] = 2e-6
        ahead, behind = (
            surface.placed(pose.moved(sign * step).sensor_from_part).meet(points, rays).residual for sign in (1, -1)
        )
        # central differences: h^2 times the third derivative, below 1e6 for a turn where N.V is small, and 1e-13 / h
        assert np.abs((ahead - behind) / 4e-6 - jacobian[:, column])[clear].max() < 1e-5


def test_the_covariance_is_the_one_of_repeated_measurements_and_the_pose_is_unbiased():
    """Noise and its negative: half their sum is the bias, and each is a measurement."""
    names, runs, chi, biases, uncertainties = ("top", "pin", "front"), 24, [], [], []
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        feet = {name: sample(name, 150, rng) for name in names}
        noise = {name: rng.normal(0, 0.1, (150, 1)) * unit_rays(points) for name, points in feet.items()}
        fits = [
            fit_pose({name: feet[name] + sign * noise[name] for name in names}, NOMINAL, TRUE, EYE) for sign in (1, -1)
        ]
        errors = [motion_between(fit, TRUE) for fit in fits]
        chi.append(errors[0] @ np.linalg.solve(fits[0].covariance, errors[0]))
        biases.append(np.mean(errors, axis=0))
        uncertainties.append(np.sqrt(np.diag(fits[0].covariance)))
    assert abs(np.mean(chi) - 6) < 4 * np.sqrt(12 / runs)  # chi^2 with 6 degrees of freedom has variance 12
    assert (np.abs(np.mean(biases, axis=0)) < 0.1 * np.mean(uncertainties, axis=0)).all()


def test_the_covariance_of_three_faces_has_a_closed_form():
    """Square faces of side 2a centred on the axes at distance d, orthogonal noise sigma, n points on each.

    A shift along an axis is known from one face, sigma^2 / n; a turn about the middle of the points by the two faces
    beside the axis.
    """
    n, sigma, a, d = 441, 0.01, 20.0, 30.0
    u, v = (one.ravel() for one in np.meshgrid(np.linspace(-a, a, 21), np.linspace(-a, a, 21)))
    away = np.full(n, d)
    faces = {"x": Plane(d * X, X), "y": Plane(d * Y, Y), "z": Plane(d * Z, Z)}
    points = {"x": [away, u, v], "y": [v, away, u], "z": [u, v, away]}
    rng = np.random.default_rng(4)
    noise = rng.normal(size=n)
    stacked = {}
    for name, columns in points.items():
        local = np.column_stack(columns)
        # noise without any share in a motion of the face, of the stated standard deviation
        shapes = np.column_stack([np.ones(n), u, v])
        clean = noise - shapes @ np.linalg.lstsq(shapes, noise, rcond=None)[0]
        clean *= sigma / np.sqrt(clean @ clean / (n - 2))  # 3 n - 6 degrees of freedom in all
        stacked[name] = local + clean[:, None] * faces[name].normal
    fit = fit_pose(stacked, faces, np.eye(4))
    assert fit.count == 3 * n
    assert fit.about == pytest.approx([d / 3] * 3, abs=1e-3)
    middle, square = np.array([d, d, d]) / 3, np.mean(u**2)
    information = np.zeros((6, 6))
    for axis in range(3):
        normal = np.eye(3)[axis]
        arm = np.cross(d * normal - middle, normal)
        spread = np.diag([square if k != axis else 0.0 for k in range(3)])
        information[:3, :3] += n * (np.outer(arm, arm) + spread)
        information[:3, 3:] += n * np.outer(arm, normal)
        information[3:, 3:] += n * np.outer(normal, normal)
    information[3:, :3] = information[:3, 3:].T
    assert fit.covariance == pytest.approx(sigma**2 * np.linalg.inv(information), rel=0.01, abs=1e-12)


def test_stray_points_do_not_pull_the_pose():
    rng = np.random.default_rng(5)
    points = {name: sample(name, 400, rng) for name in ("top", "side", "front")}
    noisy = {name: rows + rng.normal(0, 0.05, (400, 1)) * unit_rays(rows) for name, rows in points.items()}
    spoilt = {name: rows.copy() for name, rows in noisy.items()}
    for rows in spoilt.values():
        rows[:40] += [0, 0, 15.0]
    spoilt["top"][50:60] = np.nan
    clean, robust = fit_pose(noisy, NOMINAL, ROUGH, EYE), fit_pose(spoilt, NOMINAL, ROUGH, EYE)
    assert robust.count == pytest.approx(1200 - 130, abs=10)
    assert (np.abs(motion_between(robust, clean.sensor_from_part)) < 2 * np.sqrt(np.diag(clean.covariance))).all()
