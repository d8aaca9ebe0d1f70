"""Simulate one capture of a scene, or all captures of a plan."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer import Option

from characterisation.files.errors import InputError
from characterisation.words.progress import say
from mitsim.cli import options
from mitsim.cli.decode import decoding_step

if TYPE_CHECKING:
    from mitsim.running.executor import Executor
    from mitsim.study.many_captures import CaptureSettings


def render(
    context: typer.Context,
    scene: options.Scene,
    output: options.Out,
    position: Annotated[
        tuple[float, float, float] | None,
        Option(help="Position of the sensor in the frame of the scene [mm]; or use --many."),
    ] = None,
    target: options.Target = (0.0, 0.0, 0.0),
    roll: options.Roll = 0.0,
    sensor: options.SensorOption = "ensenso-n10",
    seed: options.Seed = 1,
    samples: Annotated[int, Option(min=1, max=65536, help="Light paths per pixel.")] = 16,
    depth: Annotated[
        int, Option(min=1, max=16, help="Largest number of surfaces on a light path; 1: direct light only.")
    ] = 3,
    smoothing: Annotated[
        float,
        Option(
            min=0,
            max=10,
            help="Standard deviation of a filter over the interreflections on each shape [px]; virtual measurements "
            "have 1.5. It takes away their render noise, and blurs what polished metal mirrors. 0: none.",
        ),
    ] = 0.0,
    noise: Annotated[
        str,
        Option(
            help="Noise sources: all, none, a list (shot,read), or all but some (no-speckle). Without quantisation "
            "images have 16 bits."
        ),
    ] = "all",
    deviation: Annotated[
        str,
        Option(help="Shift the uncertain parameters of the finishes by standard deviations: alpha=1,wide_angle=-1."),
    ] = "",
    truth: Annotated[bool, Option("--truth", help="Also write the true geometry at each pixel, as OpenEXR.")] = False,
    many: Annotated[
        Path | None,
        Option(
            help="TOML plan of views and finishes: simulate each one into a folder in OUTPUT; continues an "
            "interrupted plan."
        ),
    ] = None,
    scheduler: Annotated[
        str | None,
        Option(help="With --many: address of a Dask scheduler whose workers simulate the captures, tcp://HOST:8786."),
    ] = None,
    processes: options.Processes = 1,
    define: options.Defines = None,
    variant: options.Variant = None,
) -> None:
    """Simulate one capture of a scene, or many of them.

    Example: mitsim render scenes/two_pillars/two_pillars.xml --position 0 -400 300 -o captures/first
    """
    if (position is None) == (many is None):
        found = "both --position and --many" if many else "neither --position nor --many"
        raise InputError("--position", "", found, "one of them: a position, or a plan")
    if many is None:
        allowed = "--many: a single capture runs in this process"
        options.refuse_unused(context, "no --many", allowed, "scheduler", "processes")
    else:
        options.refuse_unused(context, "--many", "no such option: the plan has the views", "target", "roll")
    options.start(variant)
    from mitsim.sensor.noise_sources import Noise
    from mitsim.study.many_captures import CaptureJob, CaptureSettings, digest_of, origin_of

    defined = options.definitions(define)
    settings = CaptureSettings(defined, deviation, seed, samples, depth, Noise.parse(noise), truth, smoothing)
    if many is not None:
        _render_many(many, scene, sensor, settings, output, options.requested_workers(scheduler, processes))
        return
    assert position is not None

    from mitsim.capture.folder import check_free, read_capture, write_capture
    from mitsim.capture.simulated.render import load_scene, simulated_sensor
    from mitsim.capture.simulated.render import render as render_capture
    from mitsim.capture.simulated.render_residual import advice, checked_rendering
    from mitsim.capture.simulated.rendering import Rendering
    from mitsim.capture.simulated.truth import true_images
    from mitsim.scene.surface.scatter import Deviation
    from mitsim.sensor.preset import load_sensor

    chosen, moved = load_sensor(sensor), Deviation.parse(deviation)
    loaded = load_scene(scene, chosen, defined, deviation=moved)
    pose = options.pose_of(position, target, roll, chosen)
    origin = origin_of(scene, chosen, defined)
    digest = CaptureJob(chosen, str(scene), "", 0, pose, settings, origin).digest()
    options.check_new_folder(output)  # what a killed process left beside it goes too
    if digest_of(output, "render") == digest:
        read_capture(output)
        say(f"capture: {output}, finished before")
        return
    check_free(output)
    rendering = Rendering.smoothed(samples, depth, smoothing)
    capture = render_capture(
        loaded, chosen, pose, seed=seed, samples=samples, depth=depth, smoothing_px=smoothing, noise=noise, check=False
    )
    simulated = simulated_sensor(chosen)
    residual, unseen = checked_rendering(capture, simulated, loaded, pose, rendering, seed)
    capture.settings["deviation"] = asdict(moved)
    capture.settings["render"] = {"digest": digest}
    known = true_images(simulated, loaded, pose, samples=samples, depth=depth, seed=seed) if truth else None
    write_capture(capture, output, truth=known)
    if deviation:
        finishes = [finish for finish in loaded.finishes if finish and finish.scatter]
        for source in dict.fromkeys(f"{finish}: {finish.scatter.provenance}" for finish in finishes if finish.scatter):
            say(source)
    if unseen:
        say(f"warning: {unseen}")
    say("; ".join(filter(None, [str(residual), advice(residual, rendering)])))
    say(f"capture: {output}; next: {decoding_step(capture, output, sensor)}")


def _render_many(
    plan: Path, scene: Path, sensor: str, common: CaptureSettings, output: Path, workers: Executor | None
) -> None:
    """Simulate the missing captures of a plan, and report their number."""
    from mitsim.capture.simulated.simulate import SimulatedSensor
    from mitsim.sensor.preset import load_sensor
    from mitsim.study.many_captures import in_turn, missing_jobs, read_jobs, render_many, take_job

    chosen = load_sensor(sensor)
    jobs = read_jobs(plan, scene, chosen, common)
    options.check_folder(output)
    missing = missing_jobs(jobs, output)
    if len(missing) < len(jobs):
        say(f"{len(jobs) - len(missing)} of {len(jobs)} captures exist already")
    if not missing:
        say(f"captures: {output}: {len(jobs)}, all of them finished before")
        return
    if workers is None:
        taken = in_turn(missing, SimulatedSensor(chosen))
    else:
        taken = workers.distribute(missing, lambda job: job, take_job)
    render_many(taken, output, len(missing))
    say(f"captures: {output}: {len(jobs)}, {len(missing)} of them new")
