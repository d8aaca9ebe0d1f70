"""Calibration of sensors, virtual or from the corners of a board, and its verification by a capture."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from characterisation.files.errors import InputError, nearest
from characterisation.words.progress import say
from mitsim.cli import options


def rig(
    context: typer.Context,
    sensor: Annotated[
        str,
        Argument(
            metavar="SENSOR|CORNERS",
            help="Virtual calibration: a preset, or a sensor TOML file. Real one: a folder of images of a board, or a "
            "file of its corners (.csv, .npz, OpenCV's .yml, .yaml, .xml, .json).",
        ),
    ],
    output: Annotated[Path, Option("--output", "-o", help="TOML file to write: the covariance of the calibration.")],
    board: Annotated[
        str | None,
        Option(
            help="Calibration board: COLUMNSxROWSxSQUARE_MM:GRADE, in squares; grade glass, composite or paper; "
            "default of a virtual calibration: half as wide as the field."
        ),
    ] = None,
    poses: Annotated[int, Option(help="Number of poses of the board, over range and field of view.")] = 20,
    drift: Annotated[
        list[str] | None,
        Option(
            "--drift",
            help="Drift since the calibration, for the printed accuracy only: NAME=VALUE, one sigma. Repeatable. "
            "Other terms are as in the sensor file.",
        ),
    ] = None,
    check: Annotated[
        int,
        Option(
            min=0,
            max=10000,
            help="Also simulate this many calibrations, and count those inside the stated 95 % intervals.",
        ),
    ] = 0,
    seed: options.Seed = 1,
) -> None:
    """Calibrate virtually, or from recorded corners, and write the covariance that statements of uncertainty draw.

    Recorded corners also give the calibration itself, in OpenCV's form beside the output. Two halves of the poses must
    agree: the covariance is widened until they do, or refused.

    Example: mitsim calibrate ensenso-n10 -o n10-calibration.toml --board 11x8x30:glass --poses 20

    Example: mitsim calibrate boards/ -o unit-calibration.toml --board 11x8x30:glass
    """
    from mitsim.capture.grey_image import SUFFIXES

    if Path(sensor).is_file() and Path(sensor).suffix.lower() in SUFFIXES:
        raise InputError(sensor, "", "one image", "a folder of images of the board, six or more")
    if ("/" in sensor or "\\" in sensor) and not Path(sensor).exists():
        raise InputError(sensor, "", "no such file or folder", "a sensor, a folder of images, or a file of corners")
    if _is_recorded(sensor):
        allowed = "no such option, or a sensor: it is of virtual calibrations"
        options.refuse_unused(context, "recorded corners", allowed, "poses", "drift", "check", "seed")
        _recorded(Path(sensor), output, board)
        return

    import numpy as np

    from mitsim.sensor.drift import Drift
    from mitsim.sensor.preset import load_sensor
    from mitsim.sensor.rig_covariance import write_rig_covariance
    from mitsim.study.calibration.board import parse_board
    from mitsim.study.calibration.simulated import coverage
    from mitsim.study.calibration.virtual_calibration import calibrate as calibrate_sensor
    from mitsim.study.calibration.virtual_calibration import calibration_table, coverage_table, sensor_drift

    drift_names = list(Drift().numbers())
    terms = {}
    for name, value in options.definitions(drift, "--drift", "NAME=VALUE").items():
        if name not in drift_names:
            raise InputError("--drift", "", repr(name), ", ".join(drift_names), nearest(name, drift_names))
        try:
            terms[name] = float(value)
        except ValueError:
            raise InputError("--drift", name, repr(value), "a number, 0 or more") from None
    options.check_file(output)
    chosen = load_sensor(sensor)
    since = replace(sensor_drift(chosen), **terms)
    say(f"calibrating {chosen.name}: noise of corners, adjustment, accuracy")
    calibration = calibrate_sensor(chosen, parse_board(board) if board else None, poses, seed, since)
    print(calibration_table(calibration), end="")
    if check:
        say(f"simulating {check} calibrations")
        count = len([name for name in calibration.covariance.names if not name.startswith("path.")])
        names, sigma = calibration.covariance.names[:count], calibration.covariance.one_sigma[:count]
        stated = dict(zip(names, sigma, strict=True))
        scores = coverage(calibration.setup, stated, np.random.default_rng(seed).spawn(check))
        print("\n" + coverage_table(names, scores), end="")
    write_rig_covariance(output, calibration.covariance, chosen.rig)
    say(f"calibration: {output}")


def verify(
    context: typer.Context,
    capture: Annotated[Path, Argument(help="Capture folder that shows a board or a plate of dots.")],
    board: Annotated[
        str | None, Option(help="Chequerboard: COLUMNSxROWSxSQUARE_MM:GRADE, grade glass, composite or paper.")
    ] = None,
    dots: Annotated[
        str | None,
        Option(metavar="PITCH[,COLUMN,ROW,WIDTH,HEIGHT]", help="Plate of dots of known pitch [mm], in a window [px]."),
    ] = None,
    printed: Annotated[
        float, Option(min=0, max=0.1, help="Relative standard uncertainty of the pitch of the dots.")
    ] = 2e-4,
    sensor: Annotated[
        str | None,
        Option(help="Preset or sensor file whose calibration is stated; default: the preset that the capture names."),
    ] = None,
) -> None:
    """Verify a calibration by one capture of a board or a plate of dots: use it, or calibrate again.

    Compares the error of lengths, and the difference of rows of two cameras, with what the stated covariance of the
    calibration, the drift since then and the temperature allow. Exit code 1 if one is larger.

    Example: mitsim calibrate verify captures/board --board 11x8x30:glass
    """
    from characterisation.region_of_interest import Roi
    from mitsim.capture.folder import read_capture
    from mitsim.decoding.checks.checked_cloud import checked_cloud
    from mitsim.decoding.cloud import decoder_settings
    from mitsim.decoding.plate import Plate
    from mitsim.sensor.fitted_to import shows_the_fit
    from mitsim.study.calibration import verification
    from mitsim.study.calibration.board import parse_board
    from mitsim.study.virtual.study_unknowns import calibration_covariance, with_temperature
    from mitsim.twin.finish.electrons import sensor_of

    if (board is None) == (dots is None):
        raise InputError("--board", "", "neither it nor --dots" if board is None else "--dots too", "one of both")
    if dots is None:
        options.refuse_unused(context, "no --dots", "--dots PITCH: it is the uncertainty of their pitch", "printed")
    numbers = [] if dots is None else _plate_numbers(dots)
    read = read_capture(capture)
    chosen = sensor_of(read, sensor, capture, "decoding")
    for note in chosen.notes:
        say(f"warning: {note}")
    covariance = calibration_covariance(chosen, chosen.unknowns.calibration, Path(sensor or ".").parent)
    covariance = with_temperature(covariance, chosen.rig, chosen.unknowns.temperature)
    cloud = None
    if dots is not None or len(read.images) < 2:
        settings, imager = decoder_settings(read, None, None)
        cloud = checked_cloud(read, settings, imager, where=str(capture), sensor=None).cloud
    if board is not None:
        points = verification.corners_of_board(read, parse_board(board), cloud)
    else:
        assert cloud is not None
        window = Roi(*(int(value) for value in numbers[1:])) if len(numbers) > 1 else None
        points = verification.dots_of_plate(read, Plate(window, numbers[0]), cloud, printed)
    say(f"comparing with the stated calibration of {chosen.name}")
    outcome = verification.verify(points, chosen, read.rig, covariance, chosen.published_lengths)
    print("\n".join([*outcome.rows(), outcome.sentence()]))
    if fitted := shows_the_fit([*chosen.fitted_to, *covariance.fitted_to], read.images, "the calibration"):
        say(f"warning: {fitted}")
    if not outcome.usable:
        raise typer.Exit(1)


def _plate_numbers(text: str) -> list[float]:
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    whole = all(value >= 0 and value % 1 == 0 for value in numbers[1:])
    if len(numbers) not in (1, 5) or not 0 < numbers[0] < 1e5 or not whole:
        raise InputError("--dots", "", repr(text), "PITCH, or PITCH,COLUMN,ROW,WIDTH,HEIGHT")
    return numbers


def _is_recorded(argument: str) -> bool:
    """Return whether an argument names recorded corners, rather than a sensor."""
    path = Path(argument)
    return path.is_dir() or path.suffix.lower() in (".csv", ".npz", ".yml", ".yaml", ".xml", ".json")


def _recorded(path: Path, output: Path, board: str | None) -> None:
    """Calibrate from recorded corners; print the result, and write it with its covariance."""
    from mitsim.study.calibration import written
    from mitsim.study.calibration.board import parse_board
    from mitsim.study.calibration.corner_files import read_corners
    from mitsim.study.calibration.halves import calibrate_checked

    if board is None:
        raise InputError("--board", "", "none", "the board of the recording: COLUMNSxROWSxSQUARE_MM:GRADE")
    if output.suffix.lower() in (".yml", ".yaml"):
        raise InputError("--output", "", str(output), "a .toml file; the calibration is written beside it as .yml")
    chequerboard = parse_board(board)
    options.check_file(output)
    options.check_file(output.with_suffix(".yml"))
    corners = read_corners(path, chequerboard)
    for line in corners.left_out:
        say(f"left out: {line}")
    say(f"calibrating {', '.join(corners.sizes)}: {len(corners.boards)} poses, and two halves of them")
    source = f"recorded corners: {path.name}, {chequerboard}"[:400]
    checked = calibrate_checked(corners, source, str(path))
    print(written.calibration_table(checked), end="")
    for hint in [*written.other_size_hints(checked.calibration.rig), *written.noisy_pose_hints(checked, corners)]:
        say(f"warning: {hint}")
    rig_file = written.write_calibration(checked, output)
    say(f"calibration: {output}, {rig_file}; in a sensor file:")
    say(written.sensor_lines(checked.calibration.rig, rig_file, output))
