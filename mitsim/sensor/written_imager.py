"""Convert an imager to and from the table ``[imager]`` of a sensor file; a capture's settings use these terms."""

from __future__ import annotations

from typing import Any

from mitsim.sensor.imager import Imager
from mitsim.sensor.sensor_file import ImagerTable


def imager_of(table: ImagerTable) -> Imager:
    """Return the imager that a table describes."""
    return Imager(
        pixel_um=table.pixel_um,
        quantum_efficiency=table.quantum_efficiency,
        full_well=table.full_well_e,
        read_noise=table.read_noise_e,
        dsnu=table.dsnu_e,
        prnu=table.prnu,
        bits=table.bits,
        black_level=table.black_level_dn,
        f_number=table.f_number,
        blur_px=table.blur_px,
        gamma=table.gamma,
        row_noise=table.row_noise_e,
        column_pattern=table.column_pattern_e,
        dark_current=table.dark_current_e_s,
        corner_illumination=table.corner_illumination,
        companding=tuple(table.companding_dn),
        smoothing_px=table.smoothing_px,
        corner_blur_px=table.corner_blur_px,
    )


def written_imager(imager: Imager) -> dict[str, Any]:
    """Return the table of JSON values from which :func:`imager_of` makes the imager; it excludes the focus."""
    return {
        "pixel_um": imager.pixel_um,
        "quantum_efficiency": imager.quantum_efficiency,
        "full_well_e": imager.full_well,
        "read_noise_e": imager.read_noise,
        "dsnu_e": imager.dsnu,
        "prnu": imager.prnu,
        "bits": imager.bits,
        "black_level_dn": imager.black_level,
        "f_number": imager.f_number,
        "blur_px": imager.blur_px,
        "gamma": imager.gamma,
        "row_noise_e": imager.row_noise,
        "column_pattern_e": imager.column_pattern,
        "dark_current_e_s": imager.dark_current,
        "corner_illumination": imager.corner_illumination,
        "companding_dn": [list(knee) for knee in imager.companding],
        "smoothing_px": imager.smoothing_px,
        "corner_blur_px": imager.corner_blur_px,
    }
