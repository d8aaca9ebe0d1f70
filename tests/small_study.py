"""A study of the two pillars that runs in seconds: a dozen views, one of them raced, two trials of it stated."""

from __future__ import annotations

import re
from pathlib import Path

from tests.shell import ROOT

#: measurements of :func:`few_measurements`: one of all three features, and the radii
MEASUREMENTS = ("point1_point2_distance", "pillar1_radius", "pillar2_radius")

SCENES = ROOT / "scenes" / "two_pillars"


def small_study(parameters: str, sensor: str | Path = "ensenso-n10", task: str | Path = SCENES / "task.toml") -> str:
    """The text of the study with these ``parameters`` of its scene, an inline table of TOML."""
    return f"""
scene = "{SCENES / "two_pillars.xml"}"
parameters = {parameters}
task = "{task}"
sensor = "{sensor}"
[views]
subdivisions = 0
lowest_elevation_deg = 20
[score]
light_path_depth = 1
[measure]
light_path_depth = 1
[race]
shortlist = 1
trials = 4
[statement]
trials = 2
[check]
views = 0
"""


def few_measurements() -> str:
    """The text of the task of the two pillars with :data:`MEASUREMENTS` alone: a page of them has half the pictures."""
    head, *tables = re.split(r"(?m)^(?=\[measurements\.)", (SCENES / "task.toml").read_text(encoding="utf-8"))
    kept = tuple(f"[measurements.{name}]" for name in MEASUREMENTS)
    return head + "".join(table for table in tables if table.startswith(kept))
