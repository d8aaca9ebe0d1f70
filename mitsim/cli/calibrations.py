"""Virtual calibration of sensors."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from characterisation.files.errors import InputError, nearest
from mitsim.cli.options import Seed, check_file, definitions


def calibrate(
    sensor: Annotated[str, typer.Argument(help="Name of a preset, or path of a sensor TOML file.")],
    output: Annotated[
        Path, typer.Option("--output", "-o", help="TOML file to write: the covariance of the calibration.")
    ],
    board: Annotated[
        str | None,
        typer.Option(
            help="Calibration board: COLUMNSxROWSxSQUARE_MM:GRADE, grade glass, composite or paper; default: half as "
            "wide as the field."
        ),
    ] = None,
    poses: Annotated[int, typer.Option(help="Number of poses of the board, over range and field of view.")] = 20,
    drift: Annotated[
        list[str] | None,
        typer.Option(
            "--drift",
            help="Drift since the calibration, for the printed accuracy only: NAME=VALUE, one sigma. Repeatable. "
            "Other terms are as in the sensor file.",
        ),
    ] = None,
    check: Annotated[
        int,
        typer.Option(
            min=0,
            max=10000,
            help="Also simulate this many calibrations, and count those inside the stated 95 % intervals.",
        ),
    ] = 0,
    seed: Seed = 1,
) -> None:
    """Compute the uncertainty of a sensor's calibration from a virtual board, its poses and the noise of its corners.

    Example: mitsim calibrate ensenso-n10 -o n10-calibration.toml --board 11x8x30:glass --poses 20
    """
    from dataclasses import replace

    import numpy as np

    from mitsim.running.progress import say
    from mitsim.sensor.drift import Drift
    from mitsim.sensor.preset import load_sensor
    from mitsim.sensor.rig_covariance import write_rig_covariance
    from mitsim.study.calibration.board import parse_board
    from mitsim.study.calibration.simulated import coverage
    from mitsim.study.calibration.virtual_calibration import calibrate as calibrate_sensor
    from mitsim.study.calibration.virtual_calibration import calibration_table, coverage_table, sensor_drift

    known = list(Drift().numbers())
    terms = {}
    for name, value in definitions(drift, "--drift", "NAME=VALUE").items():
        if name not in known:
            raise InputError("--drift", "", repr(name), ", ".join(known), nearest(name, known))
        try:
            terms[name] = float(value)
        except ValueError:
            raise InputError("--drift", name, repr(value), "a number, 0 or more") from None
    check_file(output)
    chosen = load_sensor(sensor)
    since = replace(sensor_drift(chosen), **terms)
    say(f"calibrating {chosen.name}: noise of corners, adjustment, accuracy")
    found = calibrate_sensor(chosen, parse_board(board) if board else None, poses, seed, since)
    print(calibration_table(found), end="")
    if check:
        say(f"simulating {check} calibrations")
        count = len([name for name in found.covariance.names if not name.startswith("path.")])
        names, sigma = found.covariance.names[:count], found.covariance.one_sigma[:count]
        stated = dict(zip(names, sigma, strict=True))
        rng = np.random.default_rng(seed)
        scores = coverage(chosen.measuring_rig, found.eyes, found.board, found.views, stated, check, rng)
        print("\n" + coverage_table(names, scores), end="")
    write_rig_covariance(output, found.covariance, chosen.rig)
    say(f"calibration: {output}")
