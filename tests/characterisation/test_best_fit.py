"""Best fit of clouds of known shapes, moved by known motions."""

import numpy as np
import pytest

from characterisation.features.best_fit import best_fit, motion_matrix
from characterisation.features.robust_fit import FitError
from characterisation.scores.joining import pose_covariance

ABOUT = np.array([0.0, 0.0, 20.0])


def part(count: int, seed: int, sigma: float = 0.0) -> np.ndarray:
    """Points on a plate and two pillars, none of which another draw has."""
    rng = np.random.default_rng(seed)
    plate = np.column_stack([rng.uniform(-80, 80, count), rng.uniform(-50, 50, count), np.zeros(count)])
    angle, height = rng.uniform(0, 2 * np.pi, count), rng.uniform(0, 60, count)
    pillar = np.column_stack([20 * np.cos(angle), 20 * np.sin(angle), height])
    pillar[:, 0] += np.where(rng.random(count) < 0.5, -35, 35)
    return np.concatenate([plate, pillar]) + rng.normal(0, sigma, (2 * count, 3))


@pytest.mark.parametrize("seed", range(4))
def test_a_cloud_is_laid_back_to_within_its_noise(seed):
    step = np.concatenate(
        [np.random.default_rng(seed).normal(0, 0.008, 3), np.random.default_rng(seed).normal(0, 1, 3)]
    )
    motion = motion_matrix(step, ABOUT)
    reference, points = part(20_000, 10, 0.02), part(20_000, 20 + seed, 0.02)
    moved = points @ motion[:3, :3].T + motion[:3, 3]
    back = best_fit(moved, reference, ABOUT, pose_covariance(2.0, 0.5), 6.0) @ motion
    left = np.abs(points @ back[:3, :3].T + back[:3, 3] - points).max()
    # 4000 points of 0.02 mm determine six degrees of freedom to about a micrometre; the facets of the pillars' own
    # neighbourhoods, 16 of 40 000 points, add some
    assert left < 0.02


def test_what_the_points_leave_open_stays_as_it_is_known():
    rng = np.random.default_rng(1)
    plate, other = (np.column_stack([rng.uniform(-80, 80, (2, 8000)).T, rng.normal(0, 0.01, 8000)]) for _ in range(2))
    step = np.array([0.002, -0.003, 0.004, 0.5, -0.4, 0.8])
    motion = motion_matrix(step, np.zeros(3))
    found = best_fit(plate @ motion[:3, :3].T + motion[:3, 3], other, np.zeros(3), pose_covariance(2.0, 0.5), 6.0)
    total = found @ motion
    assert abs(total[2, 3]) < 0.01 and np.abs(total[2, :2]).max() < 1e-4  # laid on the plane
    # and not moved within it, but for what noise makes of the normals: 0.01 mm on a spacing of 1.8 mm
    assert total[:2, 3] == pytest.approx([0.5, -0.4], abs=0.2)


def test_clouds_that_have_nothing_in_common_are_refused():
    points = part(500, 1)
    with pytest.raises(FitError, match="points lie on both clouds"):
        best_fit(points + np.array([0, 0, 500.0]), points, ABOUT, pose_covariance(2.0, 0.5), 6.0)
