"""Go on from a fitted sensor file to its map and to the report of a study, and announce the time of each step.

Signal chain: sensor file -> campaign of coupons, timed by one capture -> map -> the study with this sensor and map ->
report.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from characterisation.files.documents import read_toml
from characterisation.files.errors import InputError
from characterisation.words.numbers import time_in_words
from characterisation.words.progress import say

if TYPE_CHECKING:
    from characterisation.maps.performance_map import PerformanceMap


@dataclass(frozen=True)
class Journey:
    """Steps after a fit: the ``study``, the ``campaign`` of its map, and the ``folder`` of map and report.

    ``minutes`` limits the run of the study; ``ask`` answers whether a missing finish may be characterised.
    """

    study: Path
    campaign: Path
    folder: Path
    minutes: float | None
    ask: Callable[[str], bool] | None


def read_journey(
    study: Path, campaign: Path | None, output: Path, minutes: float | None, ask: Callable[[str], bool] | None
) -> Journey:
    """Return the steps after a fit; everything that can be checked before the fit is checked.

    The default campaign is the one that the study names. Map and report go to a folder beside the sensor file
    ``output``, of its name. Raises InputError if a file cannot be read, or no campaign is given.
    """
    from mitsim.maps.campaign.campaign_file import CampaignFile
    from mitsim.study import StudyFile

    named = read_toml(study, StudyFile).characterisation.campaign
    if campaign is None and named is None:
        hint = "for the two pillars: --campaign scenes/two_pillars/quick.toml"
        raise InputError("--campaign", "", "none", f"a campaign for the map, as {study} names none", hint)
    chosen = campaign if campaign is not None else study.parent / str(named)
    file = read_toml(chosen, CampaignFile)
    if file.device is not None:
        raise InputError(chosen, "device", f"a live {file.device.kind}", "a campaign of simulated captures")
    return Journey(study, chosen, output.with_suffix(""), minutes, ask)


def map_and_run(journey: Journey, sensor: Path) -> None:
    """Make the map of a fitted sensor, run the study with both, and print where the report is."""
    from mitsim.report.figures import write_map_figures
    from mitsim.report.page import write_report
    from mitsim.study import StudyFile, open_study, report_doubts
    from mitsim.study.run import run_study

    begun = time.monotonic()
    made = journey.folder / "map"
    write_map_figures(_map(journey.campaign, sensor, made), made)
    say(f"map: {made / 'map.nc'}, after {time_in_words(time.monotonic() - begun)}")
    limit = "no limit: see --minutes" if journey.minutes is None else f"at most {journey.minutes:g} min"
    say(f"step 3 of 3: run {journey.study}, {limit}")
    run = journey.folder / "run"
    file = read_toml(journey.study, StudyFile).model_copy(update={"sensor": str(sensor.resolve())})
    chosen = open_study(journey.study, file, performance_map=made / "map.nc", ask=journey.ask)
    report_doubts(chosen)
    run_study(chosen, run, journey.minutes, None)
    write_report(run)
    say(f"report: {run / 'report.html'}, {time_in_words(time.monotonic() - begun)} after the fit")


def _map(campaign: Path, sensor: Path, folder: Path) -> PerformanceMap:
    """Make the map of a campaign in a folder; first say how long its captures take, by the time of one."""
    from mitsim.capture.simulated.simulate import SimulatedSensor
    from mitsim.maps.campaign.acquire import simulated_source
    from mitsim.maps.campaign.plan import read_campaign
    from mitsim.maps.use import simulate_campaign
    from mitsim.sensor.preset import load_sensor

    plan = read_campaign(campaign, load_sensor(sensor))
    normals = plan.file.normals()
    count = len(plan.series) * int(plan.reachable(normals).sum())
    take = simulated_source(SimulatedSensor(plan.sensor), plan.file.samples_per_pixel)
    seconds = 0.0
    for _ in range(2):  # the first capture also compiles
        start = time.monotonic()
        take(plan.shot(plan.series[0], normals[0]))
        seconds = time.monotonic() - start
    more = ", and more where F or sigma changes fast" if plan.file.refine is not None else ""
    say(
        f"step 2 of 3: the map, {count} captures of about {seconds:.2g} s: {time_in_words(count * seconds)}{more}. "
        "An interrupted map is continued"
    )
    return simulate_campaign(plan, folder)
