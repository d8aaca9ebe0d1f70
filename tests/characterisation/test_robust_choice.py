"""Which points are expected to belong to a surface, against points that are drawn and chosen."""

import numpy as np
import pytest

from characterisation.features.fits import Cylinder, Plane, belonging, fit_cylinder
from characterisation.features.robust_choice import belonging_share, kept, near


@pytest.mark.parametrize("share", [0.1, 0.6, 0.9])
@pytest.mark.parametrize("sigma", [0.02, 0.5])
def test_as_many_belong_as_of_drawn_points(share: float, sigma: float) -> None:
    """A share of the points lies far off. The gate is 6 sigma, or 1 mm, until three quarters lie off."""
    rng = np.random.default_rng(3)
    number = 40_000
    displaced = np.where(np.arange(number) < share * number, np.linspace(2.0, 40.0, number), 0.0)
    noise = np.full(number, sigma)
    points = np.column_stack([rng.uniform(-50, 50, (number, 2)), displaced + noise * rng.normal(size=number)])
    plane = Plane(np.zeros(3), np.array([0.0, 0.0, 1.0]))
    chosen = belonging(points, plane)
    expected = belonging_share(displaced, noise, np.ones(number))
    for group in (displaced == 0, (displaced > 0) & (displaced < 20), displaced >= 20):
        if group.any():
            assert expected[group].mean() == pytest.approx(chosen[group].mean(), abs=0.02)
    assert expected[displaced == 0].min() > 0.999


def test_weights_count_as_points() -> None:
    displaced, sigma = np.array([0.0, 0.0, 5.0]), np.full(3, 0.1)
    few = belonging_share(displaced, sigma, np.array([1.0, 1.0, 1.0]))
    many = belonging_share(displaced, sigma, np.array([1.0, 1.0, 100.0]))
    assert few == pytest.approx([1, 1, 0], abs=1e-3)
    assert many == pytest.approx([1, 1, 1], abs=1e-3)


def test_where_nothing_lies_off_all_belong() -> None:
    assert (belonging_share(np.full(5, 0.05), np.full(5, 0.1), np.ones(5)) == 1).all()


def test_as_many_are_no_false_match_as_of_drawn_points() -> None:
    """A plane seen at a slant, its points displaced along their rays by 0 to 2 % of their distance."""
    rng, number = np.random.default_rng(5), 40_000
    plane = Plane(np.array([0.0, 0.0, 500.0]), np.array([0.0, 0.6, -0.8]))
    rays = np.column_stack([rng.uniform(-0.2, 0.2, (number, 2)), np.ones(number)])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    distance = (plane.point @ plane.normal) / (rays @ plane.normal)
    displaced, sigma = rng.choice([0.0, 0.5, 0.9, 1.1, 2.0], number) * 0.01 * distance, 0.0015 * distance
    drawn = rays * (distance + displaced + sigma * rng.normal(size=number))[:, None]
    chosen = belonging(drawn, plane, np.zeros(3))  # 6 sigma of the nearest quarter are wider than the border here
    expected, mean, spread = near(displaced, sigma, distance)
    off = np.linalg.norm(drawn, axis=1) - distance
    for share in (0.0, 0.5, 0.9, 1.1, 2.0):
        group = np.isclose(displaced, share * 0.01 * distance)
        assert expected[group].mean() == pytest.approx(chosen[group].mean(), abs=0.02)
        if share < 2:
            left = (off - mean)[group & chosen]
            error = 4 * left.std() / np.sqrt(len(left))
            assert left.mean() == pytest.approx(0, abs=error)
            assert np.sqrt((spread[group & chosen] ** 2).mean()) == pytest.approx(left.std(), abs=error)
    assert 0.7 < expected[np.isclose(displaced, 0.009 * distance)].mean() < 0.8  # one border at 2/3 sigma


@pytest.mark.parametrize("limb", [0.02, 0.06, 0.15])
def test_a_limb_pulls_a_fit_by_what_is_kept_of_it(limb: float) -> None:
    """A pillar, one limb of which lies off by up to ``limb`` [mm], and scatters as much: as radii of 60 fits."""
    rng = np.random.default_rng(7)
    pillar = Cylinder(np.array([0.0, 0.0, 500.0]), np.array([0.0, 1.0, 0.0]), 20.0)
    angle, height = (
        one.ravel() for one in np.meshgrid(np.radians(np.linspace(-70, 70, 120)), np.linspace(-25, 25, 40))
    )
    points = pillar.point + np.column_stack([20 * np.sin(angle), height, -20 * np.cos(angle)])
    distance = np.linalg.norm(points, axis=1)
    rays = points / distance[:, None]
    steep = np.clip((np.degrees(angle) - 45) / 25, 0, 1) ** 2
    displaced, sigma = -limb * steep, 0.012 + limb * steep
    g = pillar.linearised(np.zeros(5), points, rays)[1]
    expected = kept(g, displaced, sigma, np.ones(len(points)))
    weight = expected.response
    foretold = -np.linalg.solve((g * weight[:, None]).T @ g, g.T @ (weight * expected.displaced))[4]
    spread = np.linalg.inv((g * weight[:, None]).T @ g)
    noise = np.sqrt((spread @ ((g * (weight * expected.sigma**2)[:, None]).T @ g) @ spread)[4, 4])
    drawn = ((distance + displaced + sigma * rng.normal(size=len(sigma)))[:, None] * rays for _ in range(60))
    radii = np.array([fit_cylinder(one, pillar, np.zeros(3)).radius for one in drawn])
    pulled = radii.mean() - 20
    assert pulled == pytest.approx(foretold, abs=0.04 * abs(foretold) + 3 * noise / np.sqrt(60))
    assert radii.std() == pytest.approx(noise, rel=3 / np.sqrt(2 * 60))
    assert expected.share.min() < 0.9


def test_what_is_as_noisy_as_all_is_kept_as_it_is() -> None:
    sigma = np.full(50, 0.1)
    found = kept(np.ones((50, 1)), np.linspace(-0.03, 0.03, 50), sigma, np.ones(50))
    assert (found.share == 1).all() and (found.sigma == sigma).all()
