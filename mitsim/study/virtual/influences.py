"""List the influences on a measurement and whether a statement includes them, as ISO/TS 15530-4 requires.

The list describes the situation of the user, not the features of the simulator. It names influences that mitsim does
not simulate as missing.
"""

from __future__ import annotations

from dataclasses import dataclass

from mitsim.sensor.unknowns import FLIGHT_DRIFT, TRIANGULATION_DRIFT, UnknownsTable


@dataclass(frozen=True)
class Influence:
    """One influence, ``included`` and ``how``; else fixed at nominal if ``simulated``, or left out."""

    name: str
    included: bool
    how: str
    simulated: bool = True


#: keys of a finish that are drawn, in words
_OF_FINISH = {
    "alpha": "width of the lobe",
    "tail": "its tail",
    "wide_angle": "light at wide angles",
    "reflectance": "reflectance",
    "lay": "lay, and its direction where it is not given",
}

#: how an influence is fixed in a map
_AS_COUPONS = "as during the characterisation"

#: how an influence is fixed whose unknown is 0
_NOMINAL = "nominal: [unknowns] gives it no size"

#: how an influence is included that every trial draws
_ANEW = "drawn anew in every virtual measurement"

#: how a statement from a map includes effects outside the map
_OTHER_PARTS = "not in the map; drawn with the size found on other parts, see effects outside the map"


def influences(
    table: UnknownsTable,
    source: str,
    depth: int,
    sprayed: bool = False,
    flight: bool = False,
    dots: bool = False,
) -> list[Influence]:
    """Return the influences of a statement.

    Parameters
    ----------
    table
        Sizes of the unknowns.
    source
        ``render`` or ``map``.
    depth
        Number of surfaces on a light path.
    sprayed
        Whether a face of the part has a coat.
    flight
        Whether the sensor measures time of flight.
    dots
        Whether it projects a mask of random dots.
    """
    rendered = source == "render"
    form, pose, temperature, light = table.form.features, table.pose, table.temperature, table.light
    finish = [words for key, words in _OF_FINISH.items() if getattr(table.finish, key) > 0]
    finish += ["measured values"] * bool(table.finish.measured)
    mask = "another" if table.unit.mask == "another" else "that of the sensor file"
    drift = [(TRIANGULATION_DRIFT | FLIGHT_DRIFT)[key] for key in table.calibration.drifting(flight)]
    low, high = table.coat.thickness_um
    coat = f"drawn: mean thickness {low:g} to {high:g} um, {100 * table.coat.spread:.0f} % from place to place"
    return [
        Influence(
            "calibration of the sensor",
            table.calibration.scale > 0,
            "drawn from the covariance of the calibration" if table.calibration.scale > 0 else "exact: its scale is 0",
        ),
        Influence(
            "drift since the calibration",
            bool(drift),
            f"drawn: {', '.join(drift)}" if drift else "none: the sensor is calibrated just before",
        ),
        _drawn("temperature of the sensor", temperature.sensor_kelvin, "drawn; expands the baseline evenly"),
        _drawn("temperature of the part", temperature.part_kelvin, "drawn; expands the part evenly"),
        Influence(
            "temperature gradients and warming up", False, "let the sensor warm up, and measure its drift", False
        ),
        Influence(
            "finish of the part",
            not rendered or table.finish.varies,
            (f"drawn: {', '.join(finish)}" if finish else _NOMINAL)
            if rendered
            else "drawn from errors and spread of the map; the finish is that of the map",
        ),
        Influence(
            "form of the part",
            any(size > 0 for size in form.values()),
            "drawn for the features with a value"
            if any(size > 0 for size in form.values())
            else "give [unknowns.form] for the features whose form is not negligible",
        ),
        Influence(
            "light of the room",
            rendered and light.illuminance > 0,
            ("drawn; equal from all sides" if light.illuminance > 0 else "none, or [room] of the sensor file")
            if rendered
            else "as during the characterisation of the sensor",
        ),
        _drawn("power of the projector", light.power_relative, "drawn", rendered),
        _drawn(
            "resolution of the exposure setting",
            light.exposure_relative,
            f"drawn within {100 * light.exposure_relative:g} %",
            rendered,
        ),
        _drawn("position of the part", max(pose.placement_mm, pose.placement_deg), _ANEW),
        _drawn("error of the assumed pose of the part", max(pose.told_mm, pose.told_deg), _ANEW),
        Influence("noise of the imager and speckle", True, _ANEW),
        Influence(
            f"fixed pattern of the imager{' and mask of dots' * dots} of another unit",
            rendered,
            f"drawn{f'; mask: {mask}' * dots}" if rendered else "that of the unit that the map was made with",
        ),
        Influence(
            "interreflections",
            not rendered or depth > 1,
            (f"rendered, up to {depth} surfaces on a path" if depth > 1 else "none: one surface on a path")
            if rendered
            else _OTHER_PARTS,
        ),
        Influence("edges and curved faces", True, "rendered and decoded" if rendered else _OTHER_PARTS),
        Influence(
            "decoding software of the maker",
            rendered and not table.decoder.known,
            "drawn from decoders within published ranges; compare with captures of your unit"
            if rendered and not table.decoder.known
            else "mitsim decodes with the settings of the sensor file; compare with captures of your unit",
            rendered,
        ),
        Influence("vibration and motion during a capture", False, "hold the sensor and the part still", False),
        *([Influence("thickness of the spray on the part", True, coat)] if sprayed else []),
        Influence(
            "dirt, oil, marks and other coats on the part", False, "clean the part as for the characterisation", False
        ),
        Influence("deformation by clamping", False, "clamp as in use", False),
        Influence("datums and choice of features", False, "the task is assumed to agree with the drawing", False),
    ]


def _drawn(name: str, size: float, how: str, rendered: bool = True) -> Influence:
    """Return an influence that is drawn if it has a size, or else nominal; in a map it is that of the coupons."""
    return Influence(name, rendered and size > 0, (how if size > 0 else _NOMINAL) if rendered else _AS_COUPONS)
