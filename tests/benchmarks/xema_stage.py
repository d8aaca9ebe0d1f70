"""Predict a recording of a metal stage by the preset ``xema`` from its bright image alone, then compare.

python tests/benchmarks/xema_stage.py predict FOLDER -o PREDICTIONS.toml
python tests/benchmarks/xema_stage.py compare CAPTURE PREDICTIONS.toml

``predict`` reads ``phase36.png``, which carries no code. It finds the outline of the projector's image in it, from
that the plane of the plate, and predicts F, the reasons of loss and the noise for each cell of the image and for the
top of the stage. ``compare`` decodes the imported capture. Noise is the median over patches of 40 px of the standard
deviation about a plane, along the view ray.

The noise of a phase is sqrt(2/N) sigma_I / B, with sigma_I by the preset's imager. Texture moves the centre of what a
pixel sees by s^2 d(ln w)/dx, exact for a Gaussian of standard deviation s [px] and brightness w; s contains the pixel.
"""

from __future__ import annotations

import argparse
import sys
import tomllib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from characterisation.point_cloud import PointCloud, Status
from mitsim.capture.folder import read_capture
from mitsim.decoding.cloud import capture_cloud
from mitsim.sensor.preset import load_sensor
from mitsim.sensor.sensor import Sensor

Floats = NDArray[np.float64]
CELL, PATCH = 240, 40
#: a part with this share of points has no reason of loss
COMPLETE = 0.995
#: noise is predicted for parts with more than this share of points
LIT = 0.5
#: rows and columns of the top of the stage that have neither holes nor screws, in the bright image
TOP = ((slice(390, 440), slice(680, 860)), (slice(670, 725), slice(680, 860)))
#: period [px], number of steps, contrast of the finest fringes with all blur: of the preset
PERIOD, STEPS = 10.0, 6
#: range of a flat plate's form [mm], median and 95 %, of the calibration with drift: mitsim calibrate xema -o FILE
FORM = {"median": 0.034, "limit_95": 0.069}
REASONS = ("LOW_MODULATION", "SATURATED", "PHASE_INCONSISTENT", "AMBIGUOUS", "OUT_OF_RANGE", "HIDDEN")


def outline(white: Floats) -> Floats:
    """Return the corners (4, 2) [px] of the lit field: lines through half of the level 20 px inside each border."""
    lit = cv2.GaussianBlur(white, (0, 0), 2)
    lines = []
    for axis, first, near in ((1, True, 66), (0, True, 65), (1, False, 1774), (0, False, 1045)):
        image = lit if axis == 1 else lit.T
        places = []
        for row in range(250, image.shape[0] - 300, 10):
            low, high = max(near - 60, 0), min(near + 60, image.shape[1])
            line = image[row, low:high] if first else image[row, low:high][::-1]
            above = np.flatnonzero(line > 0.5 * np.median(line[-30:]))
            if len(above):
                places.append((row, low + above[0] if first else high - 1 - above[0]))
        at = np.array(places, float)
        kept = np.ones(len(at), bool)
        for _ in range(5):
            slope, offset = np.polyfit(at[kept, 0], at[kept, 1], 1)
            off = np.abs(at[:, 1] - slope * at[:, 0] - offset)
            kept = off <= max(2.5 * 1.4826 * np.median(off[kept]), 0.5)
        lines.append((1.0, -slope, offset) if axis == 1 else (-slope, 1.0, offset))
    return np.array(
        [
            np.linalg.solve([lines[i][:2], lines[j][:2]], [lines[i][2], lines[j][2]])
            for i, j in ((0, 1), (2, 1), (2, 3), (0, 3))
        ]
    )


def plane_of(sensor: Sensor, corners: Floats) -> tuple[Floats, Floats, float]:
    """Return a point, the normal [sensor frame], and the largest gap [mm] of the rays of the field's four corners."""
    camera, projector = sensor.rig.reference, sensor.rig.projector
    w, h = projector.width - 0.5, projector.height - 0.5
    code = np.array([[-0.5, -0.5], [w, -0.5], [w, h], [-0.5, h]])
    best: tuple[Floats, float] | None = None
    for order in ([0, 1, 2, 3], [1, 0, 3, 2], [3, 2, 1, 0], [2, 3, 0, 1]):
        a = camera.rays(corners)
        a = camera.sensor_from_camera.rotation @ a.T
        b = projector.sensor_from_camera.rotation @ projector.rays(code[order]).T
        places, gaps = [], []
        for one, other in zip(a.T, b.T, strict=True):
            t = np.linalg.lstsq(np.stack([one, -other], axis=1), projector.centre - camera.centre, rcond=None)[0]
            first, second = camera.centre + t[0] * one, projector.centre + t[1] * other
            places.append((first + second) / 2)
            gaps.append(np.linalg.norm(first - second))
        if best is None or max(gaps) < best[1]:
            best = np.array(places), float(max(gaps))
    assert best is not None
    middle = best[0].mean(axis=0)
    normal = np.linalg.svd(best[0] - middle)[2][2]
    return middle, normal, best[1]


def predicted(sensor: Sensor, white: Floats) -> dict[str, object]:
    """Return all predictions, by the names of the file."""
    camera, projector, imager = sensor.rig.reference, sensor.rig.projector, sensor.imager
    point, normal, gap = plane_of(sensor, outline(white))
    rays = camera.pixel_directions() @ camera.sensor_from_camera.rotation.T
    rays = rays.reshape(*white.shape, 3)
    along = (normal @ point) / (rays @ normal)
    points = rays * along[..., None]
    u = projector.project(points)
    du = projector.project(points + rays)[..., 0] - u[..., 0]  # per mm along the view ray
    lit = (u > -0.5).all(-1) & (u[..., 0] < projector.width - 0.5) & (u[..., 1] < projector.height - 0.5)
    contrast = _finest_contrast(sensor)
    low, top_level = white < 2 * sensor.settings.minimum_modulation_dn / contrast, white >= 255
    mean = white / 2
    per_electron = 255 / imager.full_well
    variance = mean * per_electron + (imager.read_noise * per_electron) ** 2 + 1 / 12
    blurred = cv2.GaussianBlur(white, (0, 0), 1.0)
    gradient = np.gradient(np.log(np.maximum(blurred, 1)), axis=1)
    spread = imager.blur_px**2 + 1 / 12
    across = np.abs(np.gradient(u[..., 0], axis=1))
    photon = PERIOD / (2 * np.pi) * np.sqrt(2 / STEPS * variance) / (mean * contrast + 1e-9) / np.abs(du)
    texture = spread * across * np.abs(gradient) / np.abs(du)
    maps = {
        "F": lit & ~low & ~top_level,
        "LOW_MODULATION": ~lit | low,
        "SATURATED": lit & top_level,
        "photon": photon,
        "texture": texture,
    }
    corners = [(row, column) for row in range(0, white.shape[0], CELL) for column in range(0, white.shape[1], CELL)]
    names = [f"{row} {column}" for row, column in corners]
    table = [part_of(name, cell(name), maps) for name in names]
    top = [part_of(f"top {k}", each, maps) for k, each in enumerate(TOP)]
    shares = {key: maps[key].mean() for key in ("F", "LOW_MODULATION", "SATURATED")}
    tilt = np.degrees(np.arccos(abs(normal[2])))
    return {
        "plane_mm": round(float(point[2]), 1),
        "tilt_deg": round(float(tilt), 2),
        "gap_mm": round(gap, 2),
        "form_mm": FORM,
        "all": {k: round(float(v), 4) for k, v in shares.items()},
        "cells": table,
        "top": top,
    }


def _finest_contrast(sensor: Sensor) -> float:
    """Return amplitude over mean of the finest fringes in the image: black level, pattern and the camera's blur."""
    black = sensor.projector.black_level
    px = sensor.rig.reference.matrix[0, 0] / sensor.rig.projector.matrix[0, 0]
    spread = (sensor.imager.blur_px**2 + 1 / 12) / px**2
    return float((1 - black) / (1 + black) * 2 * sensor.pattern.contrast * np.exp(-2 * np.pi**2 * spread / PERIOD**2))


def part_of(name: str, where: tuple[slice, slice], maps: dict[str, NDArray[Any]]) -> dict[str, object]:
    """Return the predictions of one part of the image."""
    kept = maps["F"][where]
    reason = {key: maps[key][where].mean() for key in ("LOW_MODULATION", "SATURATED")}
    out: dict[str, object] = {"where": name, "F": round(float(kept.mean()), 4)}
    out["reason"] = max(reason, key=lambda key: reason[key]) if kept.mean() < COMPLETE else "none"
    if kept.mean() > LIT:
        photons = float(np.median(maps["photon"][where][kept]))
        moved = float(np.sqrt(np.mean(maps["texture"][where][kept] ** 2)))
        sigma = float(np.hypot(photons, moved))
        out |= {"photon_mm": round(photons, 4), "texture_mm": round(moved, 4), "sigma_mm": round(sigma, 4)}
    return out


def measured_noise(cloud: PointCloud, where: tuple[slice, slice]) -> float:
    """Return the median over patches of the standard deviation about a plane, along the view ray [mm]."""
    points, valid = cloud.points[where].astype(float), cloud.valid[where]
    found = []
    for row in range(0, points.shape[0] - PATCH + 1, PATCH):
        for column in range(0, points.shape[1] - PATCH + 1, PATCH):
            part = np.s_[row : row + PATCH, column : column + PATCH]
            p = points[part][valid[part]]
            if len(p) < 0.9 * PATCH**2:
                continue
            centre = p.mean(axis=0)
            normal = np.linalg.svd(p - centre, full_matrices=False)[2][2]
            off = (p - centre) @ normal / np.abs(p @ normal / np.linalg.norm(p, axis=1))
            found.append(1.4826 * np.median(np.abs(off - np.median(off))))
    return float(np.median(found)) if found else float("nan")


def form(cloud: PointCloud, wall: float = 8.0) -> tuple[float, float]:
    """Return the range of a cubic surface through the plate about its best plane, and of the rest's patch means [mm].

    Points more than ``wall`` mm from the plane of most points belong to the stage, and are left out.
    """
    p = cloud.points[::8, ::8].reshape(-1, 3).astype(float)
    p = p[np.isfinite(p).all(axis=1)]
    kept = np.ones(len(p), bool)
    for limit in (50.0, 20.0, wall, 3.0, 1.5):
        centre = np.median(p[kept], axis=0)
        turn = np.linalg.svd(p[kept] - centre, full_matrices=False)[2]
        local = (p - centre) @ turn.T
        kept = np.abs(local[:, 2] - np.median(local[kept, 2])) < limit
    x, y, z = (local[kept] / [100, 100, 1]).T
    terms = np.stack([x**i * y**j for i in range(4) for j in range(4 - i)], axis=1)
    flat = np.stack([np.ones_like(x), x, y], axis=1)
    fit = terms @ np.linalg.lstsq(terms, z, rcond=None)[0]
    low = fit - flat @ np.linalg.lstsq(flat, fit, rcond=None)[0]
    return float(np.ptp(np.percentile(low, [0.5, 99.5]))), float(np.std(z - fit))


def written(found: dict[str, object]) -> str:
    """Return predictions as TOML."""

    def value(one: object) -> str:
        return f'"{one}"' if isinstance(one, str) else repr(one)

    def inline(row: dict[str, object]) -> str:
        return "{ " + ", ".join(f"{key} = {value(one)}" for key, one in row.items()) + " }"

    lines = ["# Written before decoding, by python tests/benchmarks/xema_stage.py predict"]
    for key, one in found.items():
        if isinstance(one, list):
            lines += [f"{key} = [", *(f"  {inline(row)}," for row in one), "]"]
        elif isinstance(one, dict):
            lines.append(f"{key} = {inline(one)}")
        else:
            lines.append(f"{key} = {value(one)}")
    return "\n".join(lines) + "\n"


def compare(capture_folder: str, predictions: dict[str, Any]) -> None:
    """Print measured figures beside the predicted ones."""
    sensor = load_sensor("xema")
    cloud = capture_cloud(read_capture(capture_folder), sensor.settings, None)
    status, valid, said = cloud.status, cloud.valid, predictions["all"]
    unlit = np.isin(status, (Status.NO_SURFACE, Status.LOW_MODULATION)).mean()
    low, rest = form(cloud)
    rows = [
        ("F", f"{said['F']:.4f}", f"{valid.mean():.4f}"),
        ("too little light: low modulation, no surface", f"{said['LOW_MODULATION']:.4f}", f"{unlit:.4f}"),
        ("saturated", f"{said['SATURATED']:.4f}", f"{(status == Status.SATURATED).mean():.4f}"),
        ("phases inconsistent", "0", f"{(status == Status.PHASE_INCONSISTENT).mean():.4f}"),
        ("form of the plate, range of a cubic surface [mm]", f"{predictions['form_mm']['median']}", f"{low:.2f}"),
        ("standard deviation of the plate about it [mm]", "", f"{rest:.3f}"),
    ]
    print("| all pixels | predicted | measured |\n|---|---|---|")
    for row in rows:
        print(f"| {' | '.join(row)} |")
    heads = ["part", *(f"{name} {how}" for name in ("F", "reason", "sigma") for how in ("predicted", "measured"))]
    print(f"\n| {' | '.join(heads)} |\n{'|---' * len(heads)}|")
    for part in [*predictions["cells"], *predictions["top"]]:
        where = TOP[int(part["where"][-1])] if part["where"].startswith("top") else cell(part["where"])
        lost = {reason: (status[where] == Status[reason]).mean() for reason in REASONS}
        why = max(lost, key=lambda key: lost[key]) if valid[where].mean() < COMPLETE else "none"
        sigma, found = part.get("sigma_mm", np.nan), measured_noise(cloud, where)
        cells = (part["where"], f"{part['F']:.3f}", f"{valid[where].mean():.3f}", part["reason"], why)
        print(f"| {' | '.join(cells)} | {sigma:.3f} | {found:.3f} |")


def cell(name: str) -> tuple[slice, slice]:
    """Return the rows and columns of a cell by its first row and column."""
    row, column = (int(part) for part in name.split())
    return slice(row, row + CELL), slice(column, column + CELL)


def main(arguments: list[str]) -> None:
    """Predict or compare."""
    parser = argparse.ArgumentParser()
    parser.add_argument("what", choices=["predict", "compare"])
    parser.add_argument("folder")
    parser.add_argument("predictions", nargs="?")
    parser.add_argument("-o", "--output")
    given = parser.parse_args(arguments)
    if given.what == "predict":
        white = cv2.imread(str(Path(given.folder) / "phase36.png"), cv2.IMREAD_UNCHANGED).astype(float)
        Path(given.output).write_text(written(predicted(load_sensor("xema"), white)))
    else:
        compare(given.folder, tomllib.loads(Path(given.predictions).read_text()))


if __name__ == "__main__":
    main(sys.argv[1:])
