"""A campaign small enough to be run many times."""

from __future__ import annotations

from functools import partial

import pytest

from characterisation.maps.building import build_map
from mitsim.maps.campaign import missing_finishes, one_finish, run
from mitsim.maps.campaign.campaign_file import CampaignFile
from mitsim.maps.campaign.plan import plan_campaign
from tests.maps.campaign.known_clouds import known_source, smooth
from tests.smaller_sensors import binned


@pytest.fixture(scope="session")
def half_n10(n10):
    """The N10 with pixels of twice the size: a quarter of the work, where the values do not matter."""
    return binned(n10, 2)


@pytest.fixture
def planned(scenes, n10):
    """Make a campaign of matt white and one metal; keywords change the file."""

    def make(sensor=n10, **changes):
        table = {
            "distances_mm": [400, 600],
            "orientations": [{"up_to_deg": 60, "subdivisions": 1}],
            "samples": [{"scene": "matt_white.xml"}, {"scene": "coupon.xml", "parameters": {"Ra": 0.37}}],
            "samples_per_pixel": 1,
            **changes,
        }
        return plan_campaign(scenes / "coupon/campaign.toml", CampaignFile.model_validate(table), sensor)

    return make


@pytest.fixture
def coarse_maps(monkeypatch):
    """Campaigns that end in a map with nodes 5 deg apart: with all nodes it takes longer than known clouds."""
    monkeypatch.setattr(run, "build_map", partial(build_map, nodes=25))


@pytest.fixture
def quick(monkeypatch, tmp_path, coarse_maps):
    """Clouds of a known F and sigma in place of light, few orientations, and a cache of its own; counts campaigns."""
    made = []
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(one_finish, "BANDS", ((80.0, 0),))
    monkeypatch.setattr(one_finish, "REFINED", None)
    monkeypatch.setattr(missing_finishes, "SimulatedSensor", lambda sensor: None)
    monkeypatch.setattr(one_finish, "simulated_source", lambda *_: None)

    def take(_, campaign):
        made.append(campaign)
        return known_source(smooth)

    monkeypatch.setattr(one_finish, "in_turn", take)
    return made
