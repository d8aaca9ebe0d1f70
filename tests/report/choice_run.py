"""A folder as mitsim study choose leaves it: a sensor that fits, one that does not, one screened, one excluded."""

import json
from pathlib import Path

import numpy as np

from tests.report.conftest import FEATURES, statement_of, write_scene_geometry

HOSTILE_NAME = "radius <i>& co"
NAMES = ("distance_of_the_pillars", HOSTILE_NAME, "angle_of_pillar_to_plane")


def cell(by: str, verdict: str, u: float | None, view: int | None = 3) -> dict:
    return {
        "by": by,
        "view": view,
        "uncertainty": u,
        "bias": 0.01,
        "share_of_tolerance": None if u is None else 10 * u,
        "demand": None if u is None else 40 * u,
        "demand_interval": None,
        "verdict": verdict,
        "fits_corrected": False,
        "accepted": [19.85, 20.15] if verdict == "fits" else None,
        "needed": 0.025,
        "false_accept": 0.02,
        "false_reject": 0.98,
        "trials": 80,
        "without_value": 0.0,
    }


def sensor(name: str, status: str, cells: list[dict], ratio: float | None, words: str = "") -> dict:
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[:3, 3] = [100.0, -300.0, 450.0]
    # looks from the side, down at the part
    back = pose[:3, 3] / np.linalg.norm(pose[:3, 3])
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    pose[:3, :3] = np.stack([right, np.cross(-back, right), -back], axis=1)
    place = {"view": 3, "azimuth_deg": -71.0, "elevation_deg": 55.0, "roll_deg": 0.0, "standoff_mm": 550.0}
    return {
        "name": name,
        "given": name,
        "status": status,
        "why": "out by far" if status == "screened" else "",
        "ratio": ratio,
        "fits": sum(one["verdict"] == "fits" for one in cells),
        "words": words,
        "poses": [place | {"world_from_sensor": pose.tolist()}] if cells else [],
        "capture": {"images": 29, "exposures_s": [0.01, 0.04], "seconds": 1.45},
        "measurements": dict(zip(NAMES, cells, strict=True)) if cells else {},
        "map_digest": "0123456789abcdef",
    }


def choice() -> dict:
    good = [cell("statement", "fits", 0.012)] * 3
    poor = [cell("statement", "fits", 0.02), cell("statement", "does not fit", 0.05), cell("none", "undecidable", None)]
    far = [cell("screening", "undecidable", 0.4)] * 3
    asked = {"unit": "mm", "nominal": 20.0, "tolerance": 0.2, "rule": "ISO 14253-1", "features": list(FEATURES)}
    out = sensor("sensor-d", "excluded", [], None) | {"why": "no map of <its> finish", "capture": None}
    return {
        "schema_version": 1,
        "mitsim": "0.0",
        "study": "study <x>.toml",
        "scene": "scenes/part.xml",
        "seed": 1,
        "words": "sensor-a: fits 3 of 3 tolerances",
        "finished": True,
        "seconds": 12.5,
        "measurements": dict.fromkeys(NAMES, asked),
        "sensors": [
            sensor("sensor-a-of-a-long-name", "stated", good, 0.48, "fits 3 of 3 tolerances"),
            sensor("sensor-b", "stated", poor, None, "fits 1 of 3 tolerances"),
            sensor("sensor-c", "screened", far, 16.0, "by screening alone"),
            out,
        ],
    }


def write_choice(folder: Path) -> Path:
    folder.mkdir(parents=True)
    (folder / "choice.json").write_text(json.dumps(choice()), encoding="utf-8")
    (folder / "sensor-a-of-a-long-name").mkdir()
    (folder / "sensor-a-of-a-long-name" / "statement.json").write_text(json.dumps(statement_of(3)), encoding="utf-8")
    write_scene_geometry(folder)
    return folder
