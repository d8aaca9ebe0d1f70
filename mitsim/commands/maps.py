"""Make performance maps, hold them against captures, and predict clouds from them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mitsim.commands.options import (
    Defines,
    Out,
    Position,
    Roll,
    Seed,
    SensorOption,
    Target,
    Variant,
    check_file,
    check_folder,
    definitions,
    pose_of,
    start,
)
from mitsim.errors import InputError


def characterise(
    campaign: Path, output: Out, sensor: SensorOption = "ensenso-n10",
    captures: Annotated[Path | None, typer.Option(
        help="Measure the captures of coupons in this folder, and take none.")] = None,
    scheduler: Annotated[str | None, typer.Option(
        help="Address of a Dask scheduler whose workers take the captures: tcp://HOST:8786.")] = None,
    compact: Annotated[Path | None, typer.Option(
        help="Write the map here as well, rounded and deflated: a tenth of a megabyte for each sample.")] = None,
    variant: Variant = None,
) -> None:  # fmt: skip
    """Run a campaign of coupons, or go on with one, and make the sensor's performance map.

    Example: mitsim characterise scenes/coupon/campaign.toml -o runs/n10
    """
    start(variant)
    from mitsim.campaign.plan import read_campaign
    from mitsim.campaign.run import measure_captures, run_campaign
    from mitsim.campaign.take import coupon_residuals, found_shots, found_source, in_turn, simulated_source
    from mitsim.capture.simulate import SimulatedSensor
    from mitsim.progress import say
    from mitsim.report.figures import write_map_figures
    from mitsim.report.findings import spread_in_words
    from mitsim.sensor.preset import load_sensor

    if captures is not None and scheduler is not None:
        raise InputError("--scheduler", "", scheduler, "not with --captures", "what was taken is measured here")
    plan = read_campaign(campaign, load_sensor(sensor))
    check_folder(output)
    if compact is not None:
        check_file(compact)
    if captures is not None:
        found = found_shots(captures, plan)
        source = in_turn(found_source(found), plan)
        performance_map = measure_captures(plan, list(found.values()), source, output)
    else:
        simulated = SimulatedSensor(plan.sensor)
        coupon_residuals(simulated, plan)
        if scheduler is None:
            source = in_turn(simulated_source(simulated, plan.file.samples_per_pixel), plan)
        else:
            from mitsim.campaign.cluster import on_cluster

            source = on_cluster(scheduler, plan)
        performance_map = run_campaign(plan, source, output)
    if compact is not None:
        performance_map.save(compact, compact=True)
    write_map_figures(performance_map, output)
    for line in spread_in_words(performance_map):
        say(line)
    say(f"map: {output / 'map.nc'}")


def validate(
    map_file: Annotated[Path, typer.Argument(metavar="MAP", help="A map.nc, or a sensor whose map comes with mitsim.")],
    campaign: Annotated[Path, typer.Argument(help="The campaign TOML whose coupons are shown.")],
    output: Out, sensor: SensorOption = "ensenso-n10",
    poses: Annotated[int, typer.Option(min=1, max=10000, help="Of each sample at each distance.")] = 24,
    repeats: Annotated[int, typer.Option(min=1, max=1000, help="Captures of each pose, with fresh noise.")] = 1,
    seed: Seed = 1, variant: Variant = None,
) -> None:  # fmt: skip
    """Hold a map against captures at poses that it was not made of; exit code 1 if it misses them.

    Random normals, at the map's distances and half-way between them. On stdout, a row for each sample and distance.

    Example: mitsim validate runs/n10/map.nc scenes/coupon/campaign.toml -o runs/n10_held_out
    """
    start(variant)
    from characterisation.performance_map import PerformanceMap
    from characterisation.shipped_maps import map_path
    from characterisation.validation import holds, residual_table
    from mitsim.campaign.hold_out import compare, held_out_campaign, held_out_shots
    from mitsim.campaign.run import write_netcdf
    from mitsim.campaign.take import simulated_source
    from mitsim.capture.simulate import SimulatedSensor
    from mitsim.progress import say, track
    from mitsim.report.style import write_png
    from mitsim.report.validation_figures import agreement_figure, validation_table
    from mitsim.sensor.preset import load_sensor

    performance_map = PerformanceMap.load(map_path(map_file))
    plan = held_out_campaign(campaign, load_sensor(sensor), performance_map)
    shots = held_out_shots(plan, poses, seed)
    check_folder(output)
    take = simulated_source(SimulatedSensor(plan.sensor), plan.file.samples_per_pixel)
    pairs = list(track(compare(plan, performance_map, shots, take, repeats), "hold out", len(shots)))
    table = residual_table(pairs)
    write_netcdf(table, output / "validation.nc")
    for sample in plan.samples:
        mine = [p for p in pairs if (p.finish, str(p.roughness)) == (sample.finish, str(sample.roughness))]
        name = sample.label().replace("/", "-").replace(" ", "_")
        write_png(agreement_figure(mine), output / f"held_out_{name}.png")
    print(validation_table(table), end="")
    say(f"figures: {output}")
    if not holds(table).all():
        raise typer.Exit(1)


def predict(
    scene: Path, output: Out,
    map_file: Annotated[Path, typer.Option("--map", help="A map.nc, or a sensor whose map comes with mitsim.")],
    position: Position, target: Target = (0.0, 0.0, 0.0), roll: Roll = 0.0, sensor: SensorOption = "ensenso-n10",
    seed: Seed = 1, define: Defines = None, variant: Variant = None,
) -> None:  # fmt: skip
    """Predict the cloud of a view from a performance map, without rendering.

    Example: mitsim predict scenes/two_pillars/two_pillars.xml --map runs/n10/map.nc --position 0 -400 300 -o cloud.ply
    """
    start(variant)
    import numpy as np

    from characterisation.cloud_files import write_ply
    from mitsim.capture.cloud import sensor_geometry
    from mitsim.predict import Predictor, performance
    from mitsim.scene.load import load_scene
    from mitsim.sensor.preset import load_sensor
    from mitsim.study import read_map

    chosen = load_sensor(sensor)
    performance_map = read_map(map_file, chosen)
    loaded = load_scene(scene, chosen.wavelength_nm, definitions(define))
    pose = pose_of(position, target, roll, chosen.rig.reference.sensor_from_camera)
    geometry = sensor_geometry(chosen)
    predictor = Predictor.of_sensor(chosen, geometry)
    surfaces = predictor.surfaces(loaded, pose)
    ideal = predictor.ideal(surfaces)
    fraction, sigma = performance(ideal, loaded, performance_map)
    labels = predictor.labels(surfaces)
    cloud = predictor.draw(loaded, ideal, labels, fraction, sigma, np.random.default_rng(seed))
    check_file(output)
    write_ply(cloud, output)
    for reason, count in cloud.reasons().items():
        print(f"{reason}\t{count}")
