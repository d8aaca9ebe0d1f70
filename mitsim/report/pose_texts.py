"""Describe a view: its pose, angles in deg and lengths in mm in the part frame, and its predicted figures."""

from __future__ import annotations

from typing import Any

import xarray as xr

from characterisation.words.numbers import NONE, SPACE, count, percent, quantity, rounded, two_digits
from mitsim.report.findings import ranked_views
from mitsim.study.choice_document import PoseEntry
from mitsim.study.run_folder import Run

#: rows of a table of the best views; scores.csv holds all views
TOP = 10


def pose_of_view(run: Run, view: int) -> PoseEntry:
    """Return the pose of a candidate view of a run."""
    here = run.scores.sel(view=view)
    names = ("azimuth_deg", "elevation_deg", "roll_deg", "standoff_mm")
    numbers: dict[str, Any] = {name: float(here[name]) for name in names}
    return PoseEntry.model_construct(view=view, world_from_sensor=here["world_from_sensor"].values.tolist(), **numbers)


def angle_texts(pose: PoseEntry) -> dict[str, str]:
    """Return azimuth, elevation and roll as texts."""
    angles = {"azimuth": pose.azimuth_deg, "elevation": pose.elevation_deg, "roll": pose.roll_deg}
    return {name: f"{rounded(angle)}°" for name, angle in angles.items()}


def angles_in_words(pose: PoseEntry) -> str:
    """Return azimuth, elevation and roll in one text."""
    return ", ".join(f"{name} {angle}" for name, angle in angle_texts(pose).items())


def origin_text(pose: PoseEntry, decimals: int = 0) -> str:
    """Return the position of the sensor's origin [mm], rounded to a number of decimal places."""
    return ", ".join(rounded(row[3], decimals) for row in pose.world_from_sensor[:3])


def pose_texts(pose: PoseEntry) -> dict[str, str]:
    """Return view, angles, standoff and position as texts for a row of a table."""
    standoff = f"{rounded(pose.standoff_mm)}{SPACE}mm"
    return {"view": str(pose.view), **angle_texts(pose), "standoff": standoff, "position": origin_text(pose)}


def pose_words(pose: PoseEntry) -> str:
    """Describe a pose in plain words: distance, azimuth, elevation and roll, each with its reference."""
    angles = angle_texts(pose)
    return (
        f"distance {rounded(pose.standoff_mm)}{SPACE}mm, "
        f"azimuth {angles['azimuth']} (about the part’s z axis, from x), "
        f"elevation {angles['elevation']} (above the plane z = 0), "
        f"roll {angles['roll']} (about the line of sight, clockwise as the sensor sees)"
    )


def expected_texts(run: Run, name: str, view: int) -> dict[str, str]:
    """Return the predicted figures of a view and a measurement that it can make, as texts."""
    here = run.scores.sel(measurement=name, view=view)
    u, tolerance = float(here["predicted_uncertainty"]), float(here["tolerance"])
    return {
        "chance": percent(float(here["chance"])),
        "uncertainty": quantity(u, run.about.measurements[name].unit),
        "margin": two_digits(tolerance / u) if u > 0 else NONE,
        "limit": limit_words(here),
        "score": rounded(float(here["V_m"]), 2),
        "score_rank": count(int(here["rank"])),
    }


def best_rows(run: Run, name: str) -> list[dict[str, Any]]:
    """Return the texts of the :data:`TOP` best views of a measurement, with their rank."""
    views = run.scores["view"].values[ranked_views(run.scores, name)[:TOP]].tolist()
    return [
        pose_texts(pose_of_view(run, view)) | expected_texts(run, name, view) | {"rank": rank}
        for rank, view in enumerate(views, 1)
    ]


def limit_words(here: xr.Dataset) -> str:
    """Return the limit of a view and a measurement, ``noise on plane``, from their scores."""
    limit, feature = str(here["limit"].values), str(here["limiting_feature"].values)
    return f"{limit} on {feature}" if limit and feature else limit
