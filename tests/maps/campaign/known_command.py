"""``mitsim map make`` of a sensor that is known: the command as it is, with clouds in place of light.

``python -m tests.maps.campaign.known_command characterise CAMPAIGN.toml -o FOLDER``
"""

from __future__ import annotations

from typing import Any

from mitsim.capture.simulated import simulate
from mitsim.cli import program as cli
from mitsim.maps.campaign import acquire
from mitsim.maps.campaign.acquire import Source
from tests.maps.campaign.known_clouds import known_source, smooth


def known_in_turn(*_: Any) -> Source:
    """Stand in for ``in_turn``."""
    return known_source(smooth)


if __name__ == "__main__":
    acquire.in_turn = known_in_turn  # type: ignore[assignment]
    acquire.coupon_residuals = lambda *_: []
    simulate.SimulatedSensor = lambda *_: None  # type: ignore[assignment,misc]
    cli.main()
