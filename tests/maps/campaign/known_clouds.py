"""A sensor whose F and sigma are known functions of distance and normal: clouds without light, in milliseconds.

``python -m tests.maps.campaign.known_clouds CAMPAIGN.toml FOLDER [seconds between captures]`` runs a campaign of it, to
be killed.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from characterisation.coupon.patches import measure_patches
from characterisation.point_cloud import PointCloud, Status, ViewGrid
from mitsim.maps.campaign.acquire import Source
from mitsim.maps.campaign.plan import Campaign, Shot, read_campaign
from mitsim.maps.campaign.run import run_campaign
from mitsim.maps.campaign.store import Finished
from mitsim.sensor.preset import load_sensor

#: F and sigma [mm] of |V| [mm] and unit normals (n, 3) in the view frame
Known = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]

#: coarser than the N10, so that a coupon is quick
GRID = ViewGrid(fx=300.0, fy=300.0, cx=159.5, cy=119.5, width=320, height=240)
RAYS = GRID.rays()


def smooth(distance: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """F falls gently toward grazing incidence, sigma grows with distance squared."""
    cos = normals[..., 2]
    return 0.2 + 0.75 * cos**2, 0.3 * (distance / 500) ** 2 / cos


def stepped(distance: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """F falls from 1 to 0 about 40 deg of incidence; sigma is the same everywhere."""
    incidence = np.degrees(np.arccos(np.clip(normals[..., 2], -1, 1)))
    return 1 / (1 + np.exp((incidence - 40) / 1.5)), np.full(incidence.shape, 0.2)


def cloud_of(shot: Shot, known: Known) -> PointCloud:
    """What the sensor sees of a coupon."""
    coupon = shot.series.sample.at(shot.sensor_from_coupon)
    with np.errstate(divide="ignore"):
        distance = (coupon.centre @ coupon.normal) / (RAYS @ coupon.normal)
    across, along = coupon.across, np.cross(coupon.normal, coupon.across)
    on = np.abs(distance * (RAYS @ across) - coupon.centre @ across) < coupon.width / 2
    on &= np.abs(distance * (RAYS @ along) - coupon.centre @ along) < coupon.height / 2
    on &= distance > 0
    rng = np.random.default_rng(shot.seed)
    chance, noise = rng.random(distance.shape)[on], rng.standard_normal(distance.shape)[on]
    # the coupon's normal in the view frame of its middle: near enough to that of each pixel for these tests
    fraction, sigma = known(distance[on], np.broadcast_to(shot.normal, (len(noise), 3)))
    points, kept = np.full(RAYS.shape, np.nan), on.copy()
    kept[on] = recovered = chance < fraction
    points[kept] = ((distance[on] + noise * sigma)[:, None] * RAYS[on])[recovered]
    status = np.where(kept, Status.VALID, Status.LOW_MODULATION).astype(np.uint8)
    return PointCloud(points.astype(np.float32), status, GRID, "known", "simulated")


def known_source(known: Known, pause_s: float = 0.0) -> Source:
    """A campaign's source of such clouds."""

    def finish(shots: Sequence[Shot]) -> Iterator[tuple[Shot, Finished]]:
        for shot in shots:
            coupon = shot.series.sample.at(shot.sensor_from_coupon)
            time.sleep(pause_s)
            yield shot, Finished(measure_patches(cloud_of(shot, known), coupon), "simulated")

    return finish


def main() -> None:
    """Run a campaign in a folder."""
    campaign: Campaign = read_campaign(sys.argv[1], load_sensor("ensenso-n10"))
    pause = float(sys.argv[3]) if len(sys.argv) > 3 else 0.0
    run_campaign(campaign, known_source(smooth, pause), Path(sys.argv[2]))


if __name__ == "__main__":
    main()
