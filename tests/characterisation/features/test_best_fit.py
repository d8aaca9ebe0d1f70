"""Best fit of views to one another: clouds of known shapes and noise, moved by known motions, against closed forms."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from characterisation.features.best_fit import best_fit, counted_as_one, motion_matrix
from characterisation.features.fits import fit_surface
from characterisation.features.robust_fit import FitError
from characterisation.features.surfaces import Cylinder, Plane
from characterisation.scores.joining import JoinedView, joined_covariance, pose_covariance, rigid_derivatives

ABOUT = np.array([0.0, 0.0, 20.0])
UP = np.array([0.0, 0.0, 1.0])
SHAPES = {
    "plate": Plane(np.zeros(3), UP),
    "left": Cylinder(np.array([-35.0, 0, 0]), UP, 20.0),
    "right": Cylinder(np.array([35.0, 0, 0]), UP, 20.0),
}
KNOWN = pose_covariance(2.0, 0.5)
SEEDS = 50

#: noise [mm] of points that err alone, and of bumps that cells of the surface have in common
SIGMA, BUMP, CELL = 0.05, 0.5, 6.0


def view(count: int, facing: float, seed: int, sigma: float = SIGMA, bump: float = 0.0) -> dict[str, np.ndarray]:
    """Points on the plate and on the half of each pillar that faces an azimuth [rad]."""
    rng = np.random.default_rng(seed)
    plate = np.column_stack([rng.uniform(-80, 80, count), rng.uniform(-50, 50, count)])
    out = {"plate": np.column_stack([plate, noise(plate, sigma, bump, rng)])}
    for name in ("left", "right"):
        angle, height = facing + rng.uniform(-np.pi / 2, np.pi / 2, count), rng.uniform(0, 60, count)
        radius = 20 + noise(np.column_stack([20 * angle, height]), sigma, bump, rng)
        out[name] = SHAPES[name].point + np.column_stack([radius * np.cos(angle), radius * np.sin(angle), height])
    return out


def noise(places: np.ndarray, sigma: float, bump: float, rng: np.random.Generator) -> np.ndarray:
    """Noise of each point, and of the square cell that it lies in."""
    cell = np.unique(np.floor(places / CELL), axis=0, return_inverse=True)[1].ravel()
    return rng.normal(0, sigma, len(places)) + bump * rng.normal(size=cell.max() + 1)[cell]


def covariances(some: dict[str, np.ndarray], sigma: float, bump: float) -> list[np.ndarray]:
    """Covariance of each shape's parameters by its points, exactly: N^-1 (sum over cells g g^T) N^-1."""
    out = []
    for name, points in some.items():
        shape = SHAPES[name]
        around = points - shape.point
        angle = np.unwrap(np.arctan2(around[:, 1], around[:, 0]) % (2 * np.pi))
        flat = points[:, :2] if name == "plate" else np.column_stack([20 * angle, points[:, 2]])
        g = shape.linearised(np.zeros(shape.parameter_count), points, None)[1]
        inverse = np.linalg.inv(g.T @ g)
        cell = np.unique(np.floor(flat / CELL), axis=0, return_inverse=True)[1].ravel()
        sums = np.stack([np.bincount(cell, column) for column in g.T], axis=1)
        out.append(inverse @ (sigma**2 * g.T @ g + bump**2 * sums.T @ sums) @ inverse)
    return out


def moved(points: np.ndarray, motion: np.ndarray) -> np.ndarray:
    return points @ motion[:3, :3].T + motion[:3, 3]


def step_of(motion: np.ndarray) -> np.ndarray:
    turn = Rotation.from_matrix(motion[:3, :3]).as_rotvec()
    return np.concatenate([turn, motion[:3, :3] @ ABOUT + motion[:3, 3] - ABOUT])


RIGID = [rigid_derivatives(shape, ABOUT) for shape in SHAPES.values()]

#: points of a shape, noise, and views from one side; bumps too, which several points share, and views from opposite
#: sides, which share the plate's points alone
CASES = [(200, SIGMA, 0.0, 0.0), (300, SIGMA, BUMP, np.pi)]


@pytest.mark.parametrize(("count", "sigma", "bump", "turn"), CASES)
def test_poses_and_merged_shapes_have_the_covariance_that_is_predicted(count, sigma, bump, turn):
    """The relative pose has that of generalised least squares, with K before; shapes what merging makes of it."""
    of_pose, of_shapes = [], []
    for seed in range(SEEDS):
        rng = np.random.default_rng(1000 + seed)
        clean = [view(count, facing, 2 * seed + k, sigma, bump) for k, facing in enumerate((0.0, turn))]
        off = [motion_matrix(np.sqrt(np.diag(KNOWN)) * rng.standard_normal(6), ABOUT) for _ in clean]
        seen = [{name: moved(points, e) for name, points in one.items()} for one, e in zip(clean, off, strict=True)]
        back = best_fit(seen, SHAPES, ABOUT, KNOWN, seed)
        total = [fit @ e for fit, e in zip(back, off, strict=True)]
        each = [covariances(one, sigma, bump) for one in clean]
        between = sum(j.T @ np.linalg.inv(a + b) @ j for j, a, b in zip(RIGID, *each, strict=True))
        expected = np.linalg.inv(between + np.linalg.inv(2 * KNOWN))
        step = step_of(np.linalg.inv(total[0]) @ total[1])
        of_pose.append(step @ np.linalg.solve(expected, step))
        joined = {
            name: np.concatenate([moved(one[name], fit) for one, fit in zip(seen, back, strict=True)])
            for name in ("left", "right")
        }
        fits = {name: fit_surface(points, SHAPES[name]) for name, points in joined.items()}
        c = joined_covariance([JoinedView(tuple(one)) for one in each], RIGID, KNOWN, True)
        radii = np.array([fits["left"].radius - 20, fits["right"].radius - 20])
        of_shapes.append(radii @ np.linalg.solve(c[np.ix_([7, 12], [7, 12])], radii))
    # sums of squares of standard normals, within 99.9 % of their chi-squared distribution
    for squares, freedom in ((of_pose, 6 * SEEDS), (of_shapes, 2 * SEEDS)):
        low, high = chi2.ppf([0.0005, 0.9995], freedom)
        assert low <= np.sum(squares) <= high


def test_what_the_shapes_leave_open_stays_as_it_is_known():
    plates = [{"plate": view(2000, 0.0, seed, 0.5 * SIGMA, BUMP)["plate"]} for seed in (1, 2)]
    step = np.array([0.002, -0.003, 0.004, 0.5, -0.4, 0.8])
    off = motion_matrix(step, ABOUT)
    back = best_fit([plates[0], {"plate": moved(plates[1]["plate"], off)}], SHAPES, ABOUT, KNOWN)
    left = step_of(np.linalg.inv(back[0]) @ back[1])
    assert np.abs(left[[2, 3, 4]]).max() < 0.02 * np.abs(step[[2, 3, 4]]).max()  # neither turned in the plane nor slid
    assert left[[0, 1]] == pytest.approx(-step[[0, 1]], abs=0.002)
    assert left[5] == pytest.approx(-step[5], abs=0.2)


def test_false_points_do_not_pull_a_view():
    seen = [view(2000, 0.0, seed) for seed in (1, 2)]
    exact = best_fit(seen, SHAPES, ABOUT, KNOWN)
    rng = np.random.default_rng(3)
    for name in SHAPES:
        seen[1][name] = np.concatenate([seen[1][name], seen[1][name][:150] + rng.uniform(3, 8, (150, 3))])
    again = best_fit(seen, SHAPES, ABOUT, KNOWN)
    assert np.abs(step_of(np.linalg.inv(exact[1]) @ again[1])[3:]).max() < 0.02


def test_views_that_share_no_shape_are_refused_and_a_chain_of_them_is_not():
    one = view(500, 0.0, 1)
    left, right = ({name: one[name]} for name in ("left", "right"))
    with pytest.raises(FitError, match="share no shape"):
        best_fit([left, right], SHAPES, ABOUT, KNOWN)
    assert len(best_fit([left, right, one], SHAPES, ABOUT, KNOWN)) == 3


def test_points_that_count_as_one_are_those_of_a_bump():
    rng = np.random.default_rng(0)

    def counted(sigma: float, bump: float, thinning: float = 1.0) -> float:
        """Mean over 20 draws of 2000 points in 400 cells."""
        found = []
        for _ in range(20):
            flat = rng.uniform(0, 120, (2000, 2))
            places = np.column_stack([flat, np.zeros(len(flat))])
            found.append(counted_as_one(places, noise(flat, sigma, bump, rng), thinning, rng))
        return float(np.mean(found))

    # a point and 2000 / 400 others share all of a bump; half of it where the variance is half that of single points
    assert counted(0.0, 1.0) == pytest.approx(6, rel=0.25)
    assert counted(1.0, 1.0) == pytest.approx(3.5, rel=0.25)
    assert 1 <= counted(1.0, 0.0) < 1.5
    # of twice as many, every other one is here
    assert counted(0.0, 1.0, 2.0) == pytest.approx(11, rel=0.25)
