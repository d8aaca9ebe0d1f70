"""Make performance maps, and predict clouds from them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer
from typer import Argument, Option

from characterisation.files.atomic_io import write_json
from characterisation.words.progress import say, track
from mitsim.cli import options
from mitsim.cli.devices import mount

#: why a campaign with a device has no workers, and what is allowed
_ONE_AT_A_TIME = ("a campaign with a [device]", "no such option: a device takes one capture at a time")


def make(
    context: typer.Context,
    campaign: Annotated[Path, Argument(help="Campaign TOML file.")],
    output: options.Out,
    sensor: options.SensorOption = "ensenso-n10",
    captures: Annotated[
        Path | None, Option(help="Use the captures of coupons in this folder; do not take new ones.")
    ] = None,
    scheduler: options.Scheduler = None,
    processes: options.Processes = 1,
    compact: Annotated[
        Path | None, Option(help="Also write the map to this file, rounded and compressed: about 0.1 MB per sample.")
    ] = None,
    variant: options.Variant = None,
) -> None:
    """Capture coupons at many orientations, as a campaign file says, and make the performance map of a sensor.

    A coupon is a flat sample of one finish. The map gives the fraction F of pixels that get a point, and the noise
    sigma of the points, over distance, orientation and roughness.

    Captures are simulated, or taken with the [device] and [stage] of the campaign. Run the same command again to
    continue an interrupted campaign.

    Example: mitsim map make scenes/coupon/campaign.toml -o runs/n10
    """
    options.start(variant)
    from characterisation.files.documents import read_toml
    from mitsim.maps.campaign.acquire import check_directions, found_shots, found_source, in_turn, out_of_range
    from mitsim.maps.campaign.campaign_file import CampaignFile
    from mitsim.maps.campaign.live import live_source, place_by_place, plan_live
    from mitsim.maps.campaign.plan import plan_campaign
    from mitsim.maps.campaign.run import measure_captures, run_campaign
    from mitsim.maps.use import simulate_campaign
    from mitsim.report.figures import write_map_figures
    from mitsim.report.findings import spread_in_words
    from mitsim.sensor.preset import load_sensor

    if captures is not None:
        allowed = "no such option: existing captures need no workers"
        options.refuse_unused(context, "--captures", allowed, "scheduler", "processes")
    file, chosen = read_toml(campaign, CampaignFile), load_sensor(sensor)
    live = None if file.device is None else plan_live(campaign, file, chosen)
    if live is not None:
        options.refuse_unused(context, *_ONE_AT_A_TIME, "scheduler", "processes")
    plan = plan_campaign(campaign, file, chosen) if live is None else live.campaign
    options.check_folder(output)
    if compact is not None:
        options.check_file(compact)
    found = None if captures is None else found_shots(captures, plan)
    if found is not None:
        check_directions(plan, found)
    for line in out_of_range(plan, found):
        say(line)
    if found is not None:
        source = in_turn(found_source(found), plan)
        performance_map = measure_captures(plan, list(found.values()), source, output)
    elif live is not None:
        with live_source(live, mount) as take:
            performance_map = run_campaign(plan, place_by_place(in_turn(take, plan)), output)
    else:
        performance_map = simulate_campaign(plan, output, options.requested_workers(scheduler, processes))
    if compact is not None:
        performance_map.save(compact, compact=True)
    write_map_figures(performance_map, output)
    for line in [*spread_in_words(performance_map), *plan.file.edge_in_words()]:
        say(line)
    say(f"map: {output / 'map.nc'}")


def compare(
    maps: Annotated[
        list[str], Argument(help="map.nc files, or sensors whose map comes with mitsim; default: all such sensors.")
    ] = [],  # noqa: B006
    output: options.Out = Path("compare"),
    distance: Annotated[
        float | None,
        Option(
            min=10,
            max=20000,
            help="Distance from the sensor at which to compare [mm]; default: the middle of each map.",
        ),
    ] = None,
) -> None:
    """Draw performance maps of several sensors side by side on one scale, and over distance.

    Example: mitsim map compare ensenso-n10 david-sls-3 kinect-v2 --distance 600 -o runs/compare
    """
    from characterisation.maps.performance_map import PerformanceMap
    from characterisation.maps.shipped import map_path, shipped_maps
    from mitsim.report.map_comparison import check_distance, comparison_figure, strip_figure
    from mitsim.report.style import write_png

    loaded = [PerformanceMap.load(map_path(name)) for name in (maps or shipped_maps())]
    if distance is not None:
        check_distance(loaded, distance)
    options.check_folder(output)
    write_png(comparison_figure(loaded, "fraction", distance), output / "compare_fraction.png", dpi=62)
    write_png(comparison_figure(loaded, "noise", distance), output / "compare_noise.png", dpi=62)
    write_png(strip_figure(loaded), output / "compare_strip.png", dpi=80)
    say(f"figures: {output}")


def predict(
    scene: options.Scene,
    output: options.OutCloud,
    map_file: Annotated[
        Path, Option("--map", metavar="MAP", help="A map.nc file, or a sensor whose map comes with mitsim.")
    ],
    position: options.Position,
    target: options.Target = (0.0, 0.0, 0.0),
    roll: options.Roll = 0.0,
    sensor: options.SensorOption = "ensenso-n10",
    noise: Annotated[
        Literal["independent", "correlated"],
        Option(help="Errors of neighbouring points: independent, or correlated as measured in the map."),
    ] = "independent",
    seed: options.Seed = 1,
    define: options.Defines = None,
    yes: options.Yes = False,
    variant: options.Variant = None,
) -> None:
    """Predict the point cloud of a view from a performance map, without rendering.

    Example: mitsim map predict scenes/two_pillars/two_pillars.xml --map ensenso-n10 --position 0 -400 300 -o cloud.ply
    """
    options.start(variant)
    from characterisation.cloud_files import write_cloud
    from mitsim.capture.simulated.render import load_scene
    from mitsim.decoding.cloud import sensor_geometry
    from mitsim.maps import use as maps
    from mitsim.maps.prediction import Predictor
    from mitsim.maps.prediction.faces_in_sight import faces_in_sight, in_words
    from mitsim.sensor.preset import load_sensor
    from mitsim.study import read_map

    chosen = load_sensor(sensor)
    performance_map = read_map(map_file, chosen)
    loaded = load_scene(scene, chosen, options.definitions(define))
    pose = options.pose_of(position, target, roll, chosen)
    correlated, ask = noise == "correlated", options.asking(yes)
    cloud = maps.predict(loaded, chosen, performance_map, pose, seed=seed, correlated=correlated, ask=ask)
    options.check_cloud_file(output)
    write_cloud(cloud, output)
    options.print_reasons(cloud)
    predictor = Predictor.of_sensor(chosen, sensor_geometry(chosen))
    if lit := in_words(faces_in_sight(predictor, loaded, pose)):
        say(f"{lit}; their F can be far lower: mitsim study score predicts it")


def validate(
    context: typer.Context,
    map_file: options.MapFile,
    campaign: Annotated[Path, Argument(help="Campaign TOML file with the coupons to capture.")],
    output: options.Out,
    sensor: options.SensorOption = "ensenso-n10",
    poses: Annotated[int, Option(min=1, max=10000, help="Poses of each sample at each distance.")] = 24,
    repeats: Annotated[
        int,
        Option(min=1, max=1000, help="Captures of each pose; up to four times as many where few points are recovered."),
    ] = 1,
    seed: options.Seed = 1,
    scheduler: options.Scheduler = None,
    processes: options.Processes = 1,
    variant: options.Variant = None,
) -> None:
    """Compare a map with captures at new poses; exit code 1 if the map predicts them wrongly.

    The poses have random surface normals, at the distances of the map and half-way between them. Prints one row per
    sample and distance. A [device] and a [stage] in the campaign take the captures, at the distance of the stage;
    without them, the captures are simulated.

    Example: mitsim map validate runs/n10/map.nc scenes/coupon/campaign.toml -o runs/n10_held_out
    """
    options.start(variant)

    from characterisation.files.documents import read_toml
    from characterisation.maps.performance_map import PerformanceMap
    from characterisation.maps.shipped import map_path
    from characterisation.maps.validation import residual_table, within_limits
    from mitsim.maps.campaign import hold_out
    from mitsim.maps.campaign.campaign_file import CampaignFile
    from mitsim.maps.campaign.live import live_source
    from mitsim.maps.campaign.orders import PreparedSensor
    from mitsim.maps.campaign.run import write_netcdf
    from mitsim.report.style import write_png
    from mitsim.report.validation_figures import agreement_figure, validation_table
    from mitsim.running.executor import results_of
    from mitsim.sensor.preset import load_sensor

    path = map_path(map_file)
    performance_map = PerformanceMap.load(path)
    file, chosen = read_toml(campaign, CampaignFile), load_sensor(sensor)
    if file.device is not None:
        options.refuse_unused(context, *_ONE_AT_A_TIME, "scheduler", "processes")
    live = None if file.device is None else hold_out.held_out_live(campaign, file, chosen, performance_map)
    plan = hold_out.held_out_campaign(campaign, chosen, performance_map) if live is None else live.campaign
    shots = hold_out.held_out_shots(plan, poses, seed)
    options.check_folder(output)
    if live is None:
        orders = hold_out.held_out_orders(plan, shots, path, repeats)
        workers = options.requested_workers(scheduler, processes)
        pairs = results_of(orders, hold_out.hold_out_order, workers, "hold out")
    else:
        prepared = PreparedSensor(plan.sensor)
        with live_source(live, mount) as take:
            compared = (hold_out.compared(shot, prepared, performance_map, take, repeats) for shot in shots)
            pairs = list(track(compared, "hold out", len(shots)))
    table = residual_table(pairs)
    write_netcdf(table, output / "validation.nc")
    for sample in plan.samples:
        mine = [p for p in pairs if (p.finish, str(p.roughness)) == (sample.finish, str(sample.roughness))]
        name = sample.label().replace("/", "-").replace(" ", "_")
        write_png(agreement_figure(mine), output / f"held_out_{name}.png")
    print(validation_table(table), end="")
    say(f"figures: {output}")
    if not within_limits(table).all():
        raise typer.Exit(1)


def sheet(
    sensors: Annotated[list[str], Argument(help="Presets or sensor TOML files; default: all presets.")] = [],  # noqa: B006
    output: options.Out = Path("datasheet"),
    seed: options.Seed = 1,
    scheduler: options.Scheduler = None,
    processes: options.Processes = 1,
    variant: options.Variant = None,
) -> None:
    """Make data sheets: noise floor, noise over distance, and recovery on metal, from simulated plates and balls.

    Example: mitsim map sheet ensenso-n10 kinect-v2 -o runs/sheets
    """
    options.start(variant)
    from mitsim.maps.data_sheet import gallery, measure_sensor
    from mitsim.report.sheet_figures import gallery_figure, noise_figure, residual_figure, sheet_leaves_out, sheet_table
    from mitsim.report.style import write_png
    from mitsim.sensor.preset import load_sensor, presets

    chosen = [load_sensor(name) for name in (sensors or presets())]
    options.check_folder(output)
    workers = options.requested_workers(scheduler, processes)
    sheets = []
    for sensor in chosen:
        sheets.append(measure_sensor(sensor, seed, workers))
        pictures = gallery_figure(sensor.name, gallery(sensor, seed))
        write_png(pictures, output / f"gallery_{sensor.name}.png", dpi=120, colours=128)
        write_json(output / f"{sensor.name}.json", sheets[-1].numbers())
    write_png(noise_figure(sheets), output / "noise.png", dpi=90)
    write_png(residual_figure(sheets), output / "residuals.png", dpi=90)
    print(sheet_table(sheets), end="")
    print("\nNot included in these values:\n\n" + sheet_leaves_out(sheets), end="")
    say(f"figures: {output}")
