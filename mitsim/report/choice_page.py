"""Write ``choice.html``, a self-contained page, from ``choice.json``: which sensor measures a task best.

Signal chain: ``choice.json``, ``stand.npz`` -> first screen (:mod:`mitsim.report.first_screen`), a table of sensors and
measurements, a table for each sensor -> the template ``choice.html.j2``. The page has no script. The template escapes
all names given by a user.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from characterisation.files.errors import InputError
from characterisation.words.numbers import NONE, listed, quantity, rounded, two_digits, with_degree_signs
from mitsim.report.first_rows import breakable, exact, share_words, tolerance_words
from mitsim.report.first_screen import of_choice, sensor_rows
from mitsim.report.placement_figure import VERDICTS
from mitsim.report.pose_texts import pose_texts
from mitsim.report.templates import write_page
from mitsim.study.choice_document import CHOICE, CellEntry, ChoiceDocument, SensorEntry, best_statement, read_choice
from mitsim.study.scene_geometry import read_scene_geometry


def write_choice_page(folder: Path) -> Path:
    """Write ``choice.html`` atomically into a folder that holds ``choice.json``, and return its path.

    Raises InputError if a file is missing or damaged; the message names the file.
    """
    choice = read_choice(folder)
    if choice is None:
        raise InputError(folder / CHOICE, "", "no such file", "a folder made by mitsim study choose")
    return write_page(folder / "choice.html", "choice.html.j2", page_content(choice, folder))


def page_content(choice: ChoiceDocument, folder: Path) -> dict[str, Any]:
    """Return everything that the template shows."""
    tolerances, asked = choice.toleranced > 0, [_asked(choice, name) for name in choice.measurements]
    taking_part = [sensor for sensor in choice.sensors if sensor.status != "excluded"]
    return {
        "choice": choice,
        "part": Path(choice.scene).stem,
        "first": of_choice(choice, read_scene_geometry(folder), best_statement(choice, folder)),
        "tolerances": tolerances,
        "best": taking_part[0].name if taking_part else "no sensor",
        "names": [(breakable(one["name"]), one["tolerance"].removeprefix(NONE)) for one in asked],
        "asked": asked,
        "rows": [_row(choice, entry) for entry in taking_part],
        "screened": any(entry.status == "screened" or entry.roughness_in_words for entry in taking_part),
        "sensors": [_details(choice, entry, tolerances) for entry in taking_part],
        "excluded": [
            {"name": sensor.name, "why": sensor.why} for sensor in choice.sensors if sensor.status == "excluded"
        ],
        "seconds": rounded(choice.seconds),
    }


def _asked(choice: ChoiceDocument, name: str) -> dict[str, str]:
    measurement = choice.measurements[name]
    return {
        "name": name,
        "nominal": exact(measurement.nominal, measurement.unit),
        "features": listed(measurement.features),
        "rule": measurement.rule,
        "tolerance": tolerance_words(measurement.tolerance, measurement.nominal, measurement.unit),
    }


def _row(choice: ChoiceDocument, entry: SensorEntry) -> dict[str, Any]:
    toleranced = choice.toleranced
    return {
        "name": entry.name,
        "stated": entry.status == "stated",
        "why": entry.why,
        "rough": entry.roughness_in_words,
        "fits": entry.fits_in_cell(toleranced),
        "possible": entry.possible_in_words,
        "ratio": NONE if entry.ratio is None else two_digits(entry.ratio),
        "capture": NONE if entry.capture is None else f"{rounded(1e3 * entry.capture.seconds)}\N{NO-BREAK SPACE}ms",
        "exposures": "" if entry.capture is None else _exposures(entry),
        "cells": [_cell(entry.measurements[name], choice.measurements[name].unit) for name in choice.measurements],
    }


def _exposures(entry: SensorEntry) -> str:
    assert entry.capture is not None
    times = listed([f"{two_digits(1e3 * seconds)}" for seconds in entry.capture.exposures_s])
    return f"{entry.capture.images} × {times}\N{NO-BREAK SPACE}ms"


def _cell(cell: CellEntry, unit: str) -> dict[str, str]:
    verdict = {"verdict": cell.verdict, "colour": VERDICTS[cell.verdict]}
    if cell.uncertainty is None:
        why = f"no value in {cell.trials} trials" if cell.trials else "no view, by screening"
        return verdict | {"u": "none", "view": why, "by": "none"}
    share = "" if cell.share_of_tolerance is None else f"{share_words(cell.share_of_tolerance)}; "
    return verdict | {"u": quantity(cell.uncertainty, unit), "view": f"{share}view {cell.view}", "by": cell.by}


def _details(choice: ChoiceDocument, entry: SensorEntry, tolerances: bool) -> dict[str, Any]:
    return {
        "name": entry.name,
        "stated": entry.status == "stated",
        "why": entry.why,
        "impossible": [{"name": name, "why": with_degree_signs(why)} for name, why in entry.impossible.items()],
        "words": with_degree_signs(entry.words),
        "rows": sensor_rows(choice, entry),
        "tolerances": tolerances,
        "poses": [
            pose_texts(pose)
            | {"for": listed([name for name, cell in entry.measurements.items() if cell.view == pose.view]) or "none"}
            for pose in entry.poses
        ],
        "trials": max((cell.trials for cell in entry.measurements.values()), default=0),
    }
