"""General tolerances, which a drawing's note "ISO 2768-mK" gives to all dimensions without a tolerance of their own.

Linear dimensions, broken edges and angles are those of ISO 2768-1:1989, tables 1 to 3; flatness, perpendicularity and
symmetry those of ISO 2768-2:1989, tables 1 to 3. A size above the last range, or a kind of measurement that the
standard does not name, has no general tolerance.
"""

from __future__ import annotations

#: ends of the ranges of a size [mm], and by class plus and minus for each range [mm]; None where the standard has none
LINEAR: dict[str, list[float | None]] = {
    "to_mm": [3, 6, 30, 120, 400, 1000, 2000, 4000],
    "f": [0.05, 0.05, 0.1, 0.15, 0.2, 0.3, 0.5, None],
    "m": [0.1, 0.1, 0.2, 0.3, 0.5, 0.8, 1.2, 2],
    "c": [0.2, 0.3, 0.5, 0.8, 1.2, 2, 3, 4],
    "v": [None, 0.5, 1, 1.5, 2.5, 4, 6, 8],
}

#: the same for broken edges: external radii, and heights of chamfers; the last range has no end
BROKEN_EDGES: dict[str, list[float | None]] = {
    "to_mm": [3, 6, 1e9],
    "f": [0.2, 0.5, 1],
    "m": [0.2, 0.5, 1],
    "c": [0.4, 1, 2],
    "v": [0.4, 1, 2],
}

#: ends of the ranges of the shorter leg [mm], and by class plus and minus [minutes of arc]
ANGLES: dict[str, list[float | None]] = {
    "to_mm": [10, 50, 120, 400, 4000],
    "f": [60, 30, 20, 10, 5],
    "m": [60, 30, 20, 10, 5],
    "c": [90, 60, 30, 15, 10],
    "v": [180, 120, 60, 30, 20],
}

#: ends of the ranges of the longer side or the shorter leg [mm], and by class the width of the zone [mm]
ZONES: dict[str, dict[str, list[float | None]]] = {
    "flatness": {
        "to_mm": [10, 30, 100, 300, 1000, 3000],
        "H": [0.02, 0.05, 0.1, 0.2, 0.3, 0.4],
        "K": [0.05, 0.1, 0.2, 0.4, 0.6, 0.8],
        "L": [0.1, 0.2, 0.4, 0.8, 1.2, 1.6],
    },
    "perpendicularity": {
        "to_mm": [100, 300, 1000, 3000],
        "H": [0.2, 0.3, 0.4, 0.5],
        "K": [0.4, 0.6, 0.8, 1],
        "L": [0.6, 1, 1.5, 2],
    },
    "symmetry": {
        "to_mm": [100, 300, 1000, 3000],
        "H": [0.5, 0.5, 0.5, 0.5],
        "K": [0.6, 0.6, 0.8, 1],
        "L": [0.6, 1, 1.5, 2],
    },
}
