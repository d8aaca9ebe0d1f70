"""Limits of the tolerance classes of ISO 286, such as H7 and g6, for sizes up to 500 mm.

Signal chain: tolerance class and nominal size -> standard tolerance of its grade and fundamental deviation of its
letter -> lower and upper deviation.

Values are those of ISO 286-1:2010, tables 1 to 5, in um, without the letters cd, ef and fg and the grades IT01 to IT4.
A hole's deviation is that of the shaft of its letter with the opposite sign, and the standard's special rules for J to
ZC.
"""

from __future__ import annotations

import re
from bisect import bisect_left

#: a tolerance class: its letters and its grade
_CLASS = re.compile(r"\s*([A-Za-z]{1,2})\s*(?:IT)?\s*(\d{1,2})\s*", re.ASCII)

#: ends of the ranges of the nominal size [mm]; a size on an end belongs to the range below
_MAIN = (3, 6, 10, 18, 30, 50, 80, 120, 180, 250, 315, 400, 500)

#: the same, with the ranges that some letters divide
_DIVIDED = (
    *(3, 6, 10, 14, 18, 24, 30, 40, 50, 65, 80, 100, 120),
    *(140, 160, 180, 200, 225, 250, 280, 315, 355, 400, 450, 500),
)

#: standard tolerances [um] by grade and main range (ISO 286-1:2010, table 1)
_GRADES = {
    4: "3 4 4 5 6 7 8 10 12 14 16 18 20",
    5: "4 5 6 8 9 11 13 15 18 20 23 25 27",
    6: "6 8 9 11 13 16 19 22 25 29 32 36 40",
    7: "10 12 15 18 21 25 30 35 40 46 52 57 63",
    8: "14 18 22 27 33 39 46 54 63 72 81 89 97",
    9: "25 30 36 43 52 62 74 87 100 115 130 140 155",
    10: "40 48 58 70 84 100 120 140 160 185 210 230 250",
    11: "60 75 90 110 130 160 190 220 250 290 320 360 400",
    12: "100 120 150 180 210 250 300 350 400 460 520 570 630",
    13: "140 180 220 270 330 390 460 540 630 720 810 890 970",
    14: "250 300 360 430 520 620 740 870 1000 1150 1300 1400 1550",
    15: "400 480 580 700 840 1000 1200 1400 1600 1850 2100 2300 2500",
    16: "600 750 900 1100 1300 1600 1900 2200 2500 2900 3200 3600 4000",
    17: "1000 1200 1500 1800 2100 2500 3000 3500 4000 4600 5200 5700 6300",
    18: "1400 1800 2200 2700 3300 3900 4600 5400 6300 7200 8100 8900 9700",
}

#: upper deviations of shafts below their nominal size [um], with the sign left out (ISO 286-1:2010, table 4)
_BELOW = {
    "a": "270 270 280 290 290 300 300 310 320 340 360 380 410 460 520 580 660 740 820 920 1050 1200 1350 1500 1650",
    "b": "140 140 150 150 150 160 160 170 180 190 200 220 240 260 280 310 340 380 420 480 540 600 680 760 840",
    "c": "60 70 80 95 95 110 110 120 130 140 150 170 180 200 210 230 240 260 280 300 330 360 400 440 480",
    "d": "20 30 40 50 65 80 100 120 145 170 190 210 230",
    "e": "14 20 25 32 40 50 60 72 85 100 110 125 135",
    "f": "6 10 13 16 20 25 30 36 43 50 56 62 68",
    "g": "2 4 5 6 7 9 10 12 14 15 17 18 20",
    "h": "0 0 0 0 0 0 0 0 0 0 0 0 0",
}

#: lower deviations of shafts above their nominal size [um], "-" where there is none; k of the grades IT4 to IT7
#: (ISO 286-1:2010, table 5)
_ABOVE = {
    "k": "0 1 1 1 2 2 2 3 3 4 4 4 5",
    "m": "2 4 6 7 8 9 11 13 15 17 20 21 23",
    "n": "4 8 10 12 15 17 20 23 27 31 34 37 40",
    "p": "6 12 15 18 22 26 32 37 43 50 56 62 68",
    "r": "10 15 19 23 23 28 28 34 34 41 43 51 54 63 65 68 77 80 84 94 98 108 114 126 132",
    "s": "14 19 23 28 28 35 35 43 43 53 59 71 79 92 100 108 122 130 140 158 170 190 208 232 252",
    "t": "- - - - - - 41 48 54 66 75 91 104 122 134 146 166 180 196 218 240 268 294 330 360",
    "u": "18 23 28 33 33 41 48 60 70 87 102 124 144 170 190 210 236 258 284 315 350 390 435 490 540",
    "v": "- - - - 39 47 55 68 81 102 120 146 172 202 228 252 284 310 340 385 425 475 530 595 660",
    "x": "20 28 34 40 45 54 64 80 97 122 146 178 210 248 280 310 350 385 425 475 525 590 660 740 820",
    "y": "- - - - - 63 75 94 114 144 174 214 254 300 340 380 425 470 520 580 650 730 820 920 1000",
    "z": "26 35 42 50 60 73 88 112 136 172 210 258 310 365 415 465 520 575 640 710 790 900 1000 1100 1250",
    "za": "32 42 52 64 77 98 118 148 180 226 274 335 400 470 535 600 670 740 820 920 1000 1150 1300 1450 1600",
    "zb": "40 50 67 90 108 136 160 200 242 300 360 445 525 620 700 780 880 960 1050 1200 1300 1500 1650 1850 2100",
    "zc": "60 80 97 130 150 188 218 274 325 405 480 585 690 800 900 1000 1150 1250 1350 1550 1700 1900 2100 2400 2600",
}

#: deviations of j below and of J above the nominal size [um], by the letter and the grade (tables 5 and 3)
_NEAR = {
    ("j", 5): "2 2 2 3 4 5 7 9 11 13 16 18 20",
    ("j", 6): "2 2 2 3 4 5 7 9 11 13 16 18 20",
    ("j", 7): "4 4 5 6 8 10 12 15 18 21 26 28 32",
    ("j", 8): "6 - - - - - - - - - - - -",
    ("J", 6): "2 5 5 6 8 10 13 16 18 22 25 29 33",
    ("J", 7): "4 6 8 10 12 14 18 22 26 30 36 39 43",
    ("J", 8): "6 10 12 15 20 24 28 34 41 47 55 60 66",
}


def fit_deviations(name: str, nominal_mm: float) -> tuple[float, float] | None:
    """Return the lower and the upper deviation [mm] of a size with a tolerance class, such as ``"H7"`` or ``"g6"``.

    Capitals are holes. None if the standard, or this part of it, has no such class for the size.
    """
    match = _CLASS.fullmatch(name)
    if match is None or not 0 < nominal_mm <= _MAIN[-1]:
        return None
    letter, grade = match.group(1), int(match.group(2))
    width = _value(_GRADES.get(grade, ""), nominal_mm) if grade >= 5 else None
    if width is None:
        return None
    if letter.lower() == "js":
        return -width / 2000, width / 2000
    if letter.islower():
        ends = _shaft(letter, grade, width, nominal_mm)
    else:
        ends = _hole(letter, grade, width, nominal_mm) if letter.isupper() else None
    return None if ends is None else (ends[0] / 1000, ends[1] / 1000)


def _value(row: str, nominal_mm: float) -> float | None:
    """Return the value of a size in a row of a table [um]; None if it has none."""
    values = row.split()
    ranges = _MAIN if len(values) == len(_MAIN) else _DIVIDED
    at = bisect_left(ranges, nominal_mm)
    return float(values[at]) if values and values[at] != "-" else None


def _shaft(letter: str, grade: int, width: float, nominal_mm: float) -> tuple[float, float] | None:
    """Return the deviations of a shaft [um]."""
    if letter in ("a", "b") and nominal_mm <= 1:
        return None
    if letter in _BELOW or letter == "j":
        low = _value(_NEAR.get((letter, grade), "") if letter == "j" else _BELOW[letter], nominal_mm)
        if low is None:
            return None
        return (-low, width - low) if letter == "j" else (-low - width, -low)
    low = 0.0 if letter == "k" and grade > 7 else _value(_ABOVE.get(letter, ""), nominal_mm)
    return None if low is None else (low, low + width)


def _hole(letter: str, grade: int, width: float, nominal_mm: float) -> tuple[float, float] | None:
    """Return the deviations of a hole [um]."""
    shaft = letter.lower()
    if shaft in _BELOW:
        ends = _shaft(shaft, grade, width, nominal_mm)
        return None if ends is None else (-ends[1], -ends[0])
    if letter == "J":
        high = _value(_NEAR.get((letter, grade), ""), nominal_mm)
        return None if high is None else (high - width, high)
    above = _value(_ABOVE.get(shaft, ""), nominal_mm)
    if above is None or (letter == "K" and grade > 8 and nominal_mm > _MAIN[0]):
        return None
    if letter == "N" and grade > 8 and nominal_mm > _MAIN[0]:
        return -width, 0.0
    if (letter, grade) == ("M", 6) and 250 < nominal_mm <= 315:
        return -9 - width, -9.0
    fine = grade <= (8 if letter in "KMN" else 7) and nominal_mm > _MAIN[0]
    finer = _value(_GRADES[grade - 1], nominal_mm) if fine else None
    high = -above + (width - finer if finer is not None else 0.0)
    return high - width, high
