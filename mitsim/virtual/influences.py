"""Influences on a measurement, and which of them a statement contains: what ISO/TS 15530-4 asks to be declared.

The list is that of a user's own situation, not of the simulator's features: what nobody has drawn is named as missing.
"""

from __future__ import annotations

from dataclasses import dataclass

from mitsim.sensor.unknowns import UnknownsTable


@dataclass(frozen=True)
class Influence:
    """One influence: its ``name``, whether it is ``included``, and ``how``, or what it would take."""

    name: str
    included: bool
    how: str


#: how a statement from a map contains what the map does not know
_OTHER_PARTS = "not in the map; drawn as it was found on other parts, see what the map does not know"


def influences(table: UnknownsTable, source: str, depth: int) -> list[Influence]:
    """Declare the influences of a statement; ``source`` ``render`` or ``map``, ``depth`` surfaces on a light path."""
    rendered = source == "render"
    form, pose, temperature, light = table.form.features, table.pose, table.temperature, table.light
    told = [
        Influence("calibration of the sensor", True, "drawn from the covariance that a calibration leaves"),
        Influence(
            "drift since the calibration",
            any(table.calibration.drift().numbers().values()),
            "drawn: row error, vergence, roll, focal length",
        ),
        Influence("temperature of the sensor", temperature.sensor_kelvin > 0, "drawn; expands the baseline evenly"),
        Influence("temperature of the part", temperature.part_kelvin > 0, "drawn; expands the part evenly"),
        Influence("temperature gradients and warming up", False, "let the sensor warm up, and measure how it moves"),
        Influence(
            "finish of the part",
            rendered and table.finish.alpha > 0,
            "drawn: width of the lobe and wide-angle share"
            if rendered
            else "the map's own errors and spread are drawn; the finish is the map's",
        ),
        Influence(
            "form of the part",
            any(size > 0 for size in form.values()),
            "drawn for the features that have a figure"
            if form
            else "give [unknowns.form] for the features whose form is not negligible",
        ),
        Influence(
            "light of the room",
            rendered and light.illuminance > 0,
            "drawn, even from all sides" if rendered else "as it was when the sensor was characterised",
        ),
        Influence("power of the projector", rendered and light.power_relative > 0, "drawn"),
        Influence("place of the part", pose.placement_mm > 0 or pose.placement_deg > 0, "drawn anew in every trial"),
        Influence(
            "pose as the measurement is told it", pose.told_mm > 0 or pose.told_deg > 0, "drawn anew in every trial"
        ),
        Influence("noise of the imager, speckle", True, "drawn anew in every trial"),
        Influence("fixed pattern of another unit", rendered, "drawn" if rendered else "that of the unit of the map"),
        Influence(
            "light by way of other surfaces",
            not rendered or depth > 1,
            f"rendered, up to {depth} surfaces on a path" if rendered else _OTHER_PARTS,
        ),
        Influence("edges and curved faces", True, "rendered and decoded" if rendered else _OTHER_PARTS),
        Influence("the maker's own software", False, "OpenCV decodes in its place; compare with captures of your unit"),
        Influence("vibration, motion during a capture", False, "hold the sensor and the part still"),
        Influence("dirt, oil, coatings, marks on the part", False, "clean the part as for the characterisation"),
        Influence("deformation by clamping", False, "clamp as in use"),
        Influence("datums and how features are chosen", False, "the task is taken as what the drawing means"),
    ]
    return told
