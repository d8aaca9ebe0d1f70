"""Make performance maps, and predict clouds from them."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from characterisation.files.errors import InputError
from mitsim.cli.devices import mount
from mitsim.cli.options import (
    Defines,
    Out,
    OutCloud,
    Position,
    Processes,
    Roll,
    Scene,
    Scheduler,
    Seed,
    SensorOption,
    Target,
    Variant,
    Yes,
    asking,
    check_file,
    check_folder,
    definitions,
    pose_of,
    print_reasons,
    requested_workers,
    start,
)


class Noise(StrEnum):
    """Correlation of the errors of neighbouring predicted points."""

    INDEPENDENT = "independent"
    CORRELATED = "correlated"


def characterise(
    campaign: Annotated[Path, typer.Argument(help="Campaign TOML file.")],
    output: Out,
    sensor: SensorOption = "ensenso-n10",
    captures: Annotated[
        Path | None, typer.Option(help="Use the captures of coupons in this folder; do not take new ones.")
    ] = None,
    scheduler: Scheduler = None,
    processes: Processes = 1,
    compact: Annotated[
        Path | None,
        typer.Option(help="Also write the map to this file, rounded and compressed: about 0.1 MB per sample."),
    ] = None,
    variant: Variant = None,
) -> None:
    """Capture coupons at many orientations, as a campaign file says, and make the performance map of a sensor.

    A coupon is a flat sample of one finish. The map gives the fraction F of pixels that get a point, and the noise
    sigma of the points, over distance, orientation and roughness.

    Captures are simulated, or taken with the [device] and [stage] of the campaign. Run the same command again to
    continue an interrupted campaign.

    Example: mitsim characterise scenes/coupon/campaign.toml -o runs/n10
    """
    start(variant)
    from characterisation.files.documents import read_toml
    from mitsim.capture.simulated.simulate import SimulatedSensor
    from mitsim.maps.campaign.acquire import (
        coupon_residuals,
        found_shots,
        found_source,
        in_turn,
        out_of_range,
        simulated_source,
    )
    from mitsim.maps.campaign.live import live_source, place_by_place, plan_live
    from mitsim.maps.campaign.plan import CampaignFile, plan_campaign
    from mitsim.maps.campaign.run import measure_captures, run_campaign
    from mitsim.report.figures import write_map_figures
    from mitsim.report.findings import spread_in_words
    from mitsim.running.progress import say
    from mitsim.sensor.preset import load_sensor

    if captures is not None and scheduler is not None:
        raise InputError("--scheduler", "", scheduler, "not with --captures", "existing captures need no cluster")
    file, chosen = read_toml(campaign, CampaignFile), load_sensor(sensor)
    live = None if file.device is None else plan_live(campaign, file, chosen)
    if live is not None and (scheduler is not None or processes != 1):
        option, given = ("--scheduler", scheduler) if scheduler is not None else ("--processes", str(processes))
        raise InputError(option, "", given, "not with a [device]", "a device takes one capture at a time")
    plan = plan_campaign(campaign, file, chosen) if live is None else live.campaign
    check_folder(output)
    if compact is not None:
        check_file(compact)
    found = None if captures is None else found_shots(captures, plan)
    for line in out_of_range(plan, found):
        say(line)
    if found is not None:
        source = in_turn(found_source(found), plan)
        performance_map = measure_captures(plan, list(found.values()), source, output)
    elif live is not None:
        with live_source(live, mount) as take:
            performance_map = run_campaign(plan, place_by_place(in_turn(take, plan)), output)
    else:
        workers = requested_workers(scheduler, processes)
        simulated = SimulatedSensor(plan.sensor)
        coupon_residuals(simulated, plan)
        if workers is None:
            source = in_turn(simulated_source(simulated, plan.file.samples_per_pixel), plan)
        else:
            from mitsim.maps.campaign.orders import worker_source

            source = worker_source(workers, plan)
        performance_map = run_campaign(plan, source, output)
    if compact is not None:
        performance_map.save(compact, compact=True)
    write_map_figures(performance_map, output)
    for line in spread_in_words(performance_map):
        say(line)
    say(f"map: {output / 'map.nc'}")


def compare(
    maps: Annotated[
        list[str],
        typer.Argument(help="map.nc files, or sensors whose map comes with mitsim; default: all such sensors."),
    ] = [],  # noqa: B006
    output: Out = Path("compare"),
    distance: Annotated[
        float | None,
        typer.Option(
            min=10,
            max=20000,
            help="Distance from the sensor at which to compare [mm]; default: the middle of each map.",
        ),
    ] = None,
) -> None:
    """Draw performance maps of several sensors side by side on one scale, and over distance.

    Example: mitsim compare ensenso-n10 david-sls-3 kinect-v2 --distance 600 -o runs/compare
    """
    from characterisation.maps.performance_map import PerformanceMap
    from characterisation.maps.shipped import map_path, shipped_maps
    from mitsim.report.map_comparison import check_distance, comparison_figure, strip_figure
    from mitsim.report.style import write_png
    from mitsim.running.progress import say

    loaded = [PerformanceMap.load(map_path(name)) for name in (maps or shipped_maps())]
    if distance is not None:
        check_distance(loaded, distance)
    check_folder(output)
    output.mkdir(parents=True, exist_ok=True)
    write_png(comparison_figure(loaded, "fraction", distance), output / "compare_fraction.png", dpi=62)
    write_png(comparison_figure(loaded, "noise", distance), output / "compare_noise.png", dpi=62)
    write_png(strip_figure(loaded), output / "compare_strip.png", dpi=80)
    say(f"figures: {output}")


def predict(
    scene: Scene,
    output: OutCloud,
    map_file: Annotated[
        Path, typer.Option("--map", metavar="MAP", help="A map.nc file, or a sensor whose map comes with mitsim.")
    ],
    position: Position,
    target: Target = (0.0, 0.0, 0.0),
    roll: Roll = 0.0,
    sensor: SensorOption = "ensenso-n10",
    noise: Annotated[
        Noise, typer.Option(help="Errors of neighbouring points: independent, or correlated as measured in the map.")
    ] = Noise.INDEPENDENT,
    seed: Seed = 1,
    define: Defines = None,
    yes: Yes = False,
    variant: Variant = None,
) -> None:
    """Predict the point cloud of a view from a performance map, without rendering.

    Example: mitsim predict scenes/two_pillars/two_pillars.xml --map runs/n10/map.nc --position 0 -400 300 -o cloud.ply
    """
    start(variant)
    from mitsim.decode.captures import load_scene, load_sensor, write_cloud
    from mitsim.maps import use as maps
    from mitsim.study import read_map

    chosen = load_sensor(sensor)
    performance_map = read_map(map_file, chosen)
    loaded = load_scene(scene, chosen, definitions(define))
    pose = pose_of(position, target, roll, chosen)
    correlated = noise is Noise.CORRELATED
    cloud = maps.predict(loaded, chosen, performance_map, pose, seed=seed, correlated=correlated, ask=asking(yes))
    check_file(output)
    write_cloud(cloud, output)
    print_reasons(cloud)
