"""A sensor whose F and sigma are known functions of |V| and N, shown flat coupons: for tests of maps.

Patches lie as on a real coupon: their normals spread with the rays, their distances with the tilt, and both hang
together.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from characterisation.coupon.orientations import cap_directions
from characterisation.coupon.patch_table import patch_table
from characterisation.coupon.view_frame import in_view_frame
from characterisation.lambert_projection import lambert_projection

POSSIBLE = 113
NOMINAL = 600.0

#: of the lobe in which the sensor blinds itself: place, and standard deviation (3 deg) in the equal-area plane
LOBE, LOBE_WIDTH = np.array([0.1, 0.0]), 0.052


def known_fraction(normals, distance):
    """F: falls with tilt and distance, with a lobe of 0.7."""
    place = lambert_projection(normals)
    tilt = (place**2).sum(-1)
    lobe = np.exp(-((place - LOBE) ** 2).sum(-1) / (2 * LOBE_WIDTH**2))
    return np.clip(0.97 - 0.35 * tilt * (distance / NOMINAL) ** 2 - 0.7 * lobe, 0, 1)


def known_sigma(normals, distance):
    """Sigma [mm]: as |V|^2, twice as large at 60 deg, and more on one side."""
    place = lambert_projection(normals)
    return 1e-6 * distance**2 * np.exp(0.7 * (place**2).sum(-1) + 0.3 * place[..., 0])


@dataclass(frozen=True)
class Campaign:
    """Normals (n, 3) at which coupons are shown, nominal |V| [mm], and how far the patches reach [rad]."""

    normals: np.ndarray
    nominal: float = NOMINAL
    reach: float = np.radians(6.0)
    across: int = 7


def uneven_plan():
    """17 deg apart to 60 deg, 8.6 within 25 deg, 4.3 about the lobe."""
    fine = cap_directions(4, np.radians(40))
    fine = fine[np.linalg.norm(lambert_projection(fine) - LOBE, axis=1) < np.radians(13)]
    normals = np.concatenate([cap_directions(2, np.radians(60)), cap_directions(3, np.radians(25)), fine])
    return np.unique(np.round(normals, 9), axis=0)


def without_offsets(count):
    """Columns of independent patches whose offsets were not measured."""
    names = ("ray_offset", "offset_product_touching", "offset_product_apart")
    return {"independent_share": np.ones(count), **dict.fromkeys(names, np.full(count, np.nan))}


def shown(campaign, rng, fraction_effect=0.0, sigma_effect=0.0, fraction=known_fraction, sigma=known_sigma):
    """Table of patches; the effects are standard deviations common to a capture, of F and of ln sigma."""
    angle = np.linspace(-campaign.reach, campaign.reach, campaign.across)
    x, y = (grid.ravel() for grid in np.meshgrid(angle, angle))
    view = np.stack([np.tan(x), np.tan(y), np.ones(len(x))], axis=-1)
    view /= np.linalg.norm(view, axis=-1, keepdims=True)
    columns: dict[str, list[np.ndarray]] = {}
    for number, normal in enumerate(campaign.normals):
        # in the view frame of the coupon's centre z points back to the sensor, x along the baseline
        facing = normal * [1, -1, -1]
        distance = campaign.nominal * facing[2] / (view @ facing)
        seen = in_view_frame(np.broadcast_to(facing, view.shape), view, np.array([1.0, 0.0, 0.0]))
        share = np.clip(fraction(seen, distance) + fraction_effect * rng.standard_normal(), 0, 1)
        count = rng.binomial(POSSIBLE, share)
        spread = sigma(seen, distance) * np.exp(sigma_effect * rng.standard_normal())
        degrees = np.maximum(count - 3, 1)
        measured = np.where(count > 3, spread * np.sqrt(rng.chisquare(degrees) / degrees), np.nan)
        row = {
            "points": count,
            "points_possible": np.full(len(count), POSSIBLE),
            "ray_noise_inliers": measured,
            "false_fraction": np.zeros(len(count)),
            "distance": distance,
            "normal_x": seen[:, 0],
            "normal_y": seen[:, 1],
            "orientation": np.full(len(count), number),
            **without_offsets(len(count)),
        }
        for name, values in row.items():
            columns.setdefault(name, []).append(values)
    return patch_table(**{name: np.concatenate(parts) for name, parts in columns.items()})
