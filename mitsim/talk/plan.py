"""Plan the pieces of work of a talk: plain values that any process can work on, and the digest of each.

A piece is a function of this package's ``..._pieces`` modules with its arguments. Files that it reads are named by
paths relative to the talk's folder, so a digest does not depend on where the talk lies.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, is_dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import xarray as xr
from pydantic import BaseModel

from characterisation.files.checked_files import read_bounded
from characterisation.files.documents import read_toml
from characterisation.maps.shipped import map_path
from mitsim.maps.campaign.campaign_file import CampaignFile
from mitsim.scene import backend
from mitsim.scene.xml_check import named_digests
from mitsim.sensor.sensor_text import sensor_checksum
from mitsim.talk import coupon_pieces, noise_pieces, opening_pieces, pictured, view_pieces
from mitsim.talk.coupon_pieces import CouponPlace
from mitsim.talk.results import VERSION
from mitsim.talk.talk_file import ArtefactEntry, Talk, sensor_in, sensor_key

#: functions of pieces: each takes the talk's folder and its arguments
FUNCTIONS: dict[str, Callable[..., xr.Dataset]] = {
    "opening": opening_pieces.projected_frames,
    "finish": pictured.picture_of_finish,
    "light": pictured.features_in_light,
    "characterised": coupon_pieces.characterised,
    "tilts": coupon_pieces.tilts,
    "sub_clouds": coupon_pieces.sub_clouds,
    "clouds": coupon_pieces.clouds_of_coupon,
    "validation": coupon_pieces.validation_of,
    "noise": noise_pieces.noise_of,
    "scores": view_pieces.scores_of,
}

#: number of poses of the sample whose clouds are compared, over that of the others: it returns points in few of them
_SHOWN_POSES = 3

#: elevation, and azimuth from the part's x axis, of the view in which finishes are pictured [deg]
_PICTURED = (50.0, -70.0)

#: views in which direct light alone is compared with all light
_COMPARED_VIEWS = 6

#: tilt of the coupon whose clouds are compared [deg]; chosen
_CLOUDS_TILT_DEG = 6.0

#: tilt of the coupon whose sub-clouds are drawn [deg]; chosen
_SUB_CLOUDS_TILT_DEG = 50.0


@dataclass(frozen=True)
class Piece:
    """One piece of work: a key of :data:`FUNCTIONS` with its arguments, and the files and sensors that these name."""

    name: str
    function: str
    arguments: tuple[Any, ...]
    sensors: tuple[str, ...] = ()
    scenes: tuple[tuple[str, tuple[tuple[str, str], ...]], ...] = ()
    map_name: str = ""
    files: tuple[str, ...] = ()

    def digest(self, folder: Path) -> str:
        """Return the digest of everything that determines the result."""
        content = {
            "version": VERSION,
            "function": self.function,
            "arguments": [_as_plain(argument) for argument in self.arguments],
            "sensors": [sensor_checksum(sensor_in(folder, name)) for name in self.sensors],
            "scenes": [_scene_digest(folder / path, parameters) for path, parameters in self.scenes],
            "files": [_file_digest(folder / name) for name in self.files],
            "map": _file_digest(map_path(self.map_name, folder)) if self.map_name else "",
        }
        return hashlib.sha256(json.dumps(content, sort_keys=True, default=str).encode()).hexdigest()[:16]


def make_piece(folder: str, piece: Piece) -> xr.Dataset:
    """Make one piece of work; workers call this function."""
    backend.activate(None)
    return FUNCTIONS[piece.function](folder, *piece.arguments)


def pieces_of(talk: Talk) -> list[Piece]:
    """Return all pieces of a talk but its virtual measurements, those of the first slides first."""
    file, coupons = talk.file, talk.file.coupons
    number = pictured_view(talk)
    sensor, map_name = (file.sensor,), talk.map_name
    pieces = [
        Piece(f"opening_{sensor_key(name)}", "opening", (*_scene(entry), name), (name,), (_scene(entry),))
        for name in file.opening_sensors
        for entry in (file.finishes or file.samples)[:1]
    ]
    for finish in file.finishes:
        asked, scenes = (talk.study_file(finish), number), (_scene(finish),)
        pieces.append(Piece(f"finish_{finish.key}", "finish", asked, sensor, scenes, files=(file.task,)))
    coupon_place = CouponPlace(coupons.campaign, file.sensor, coupons.distance_mm, coupons.roughness_um)
    campaign = read_toml(talk.folder / coupons.campaign, CampaignFile)
    of_coupons = tuple((str(Path(coupons.campaign).parent / sample.scene), ()) for sample in campaign.samples)
    captured = (sensor, of_coupons, "", (coupons.campaign,))
    refined = (coupons.subdivisions, coupons.refined, file.seed)
    pieces.append(Piece("characterised", "characterised", (coupon_place, *refined), *captured))
    pieces.append(Piece("tilts", "tilts", (coupon_place, tuple(coupons.tilts_deg)), *captured))
    pieces.append(Piece("sub_clouds", "sub_clouds", (coupon_place, _SUB_CLOUDS_TILT_DEG), *captured))
    pieces += [Piece(f"noise_{sensor_key(name)}", "noise", (name, file.seed), (name,)) for name in file.noise_sensors]
    shown = CouponPlace(coupons.campaign, file.sensor, coupons.shown_distance_mm, coupons.shown_roughness_um)
    predicted = (sensor, of_coupons, map_name, (coupons.campaign,))
    pieces.append(Piece("clouds", "clouds", (shown, map_name, _CLOUDS_TILT_DEG, file.seed), *predicted))
    for sample in campaign.samples:
        rough = coupon_pieces.roughness_of(sample)
        for distance in coupons.validated_distances_mm:
            there = CouponPlace(coupons.campaign, file.sensor, distance, rough)
            poses = coupons.poses * (_SHOWN_POSES if rough == coupons.shown_roughness_um else 1)
            arguments = (there, map_name, poses, file.seed)
            pieces.append(Piece(validation_name(rough, distance), "validation", arguments, *predicted))
    for entry in file.samples:
        of_study = (sensor, (_scene(entry),), map_name, (file.task,))
        pieces.append(Piece(f"scores_{entry.key}", "scores", (talk.study_file(entry),), *of_study))
    numbers = compared_views(talk)
    for entry in file.samples:
        of_study = (sensor, (_scene(entry),), map_name, (file.task,))
        for name, depth in (("direct", 1), ("all", file.light_path_depth)):
            pieces.append(
                Piece(f"light_{name}_{entry.key}", "light", (talk.study_file(entry, depth), numbers), *of_study)
            )
    return pieces


def validation_name(roughness: float | None, distance: float) -> str:
    """Return the name of the piece that validates a sample at a distance [mm]."""
    return f"validation_{'white' if roughness is None else f'Ra{roughness:g}'}_{distance:g}mm"


def pictured_view(talk: Talk) -> int:
    """Return the number of the candidate view nearest to the one in which finishes are pictured."""
    elevation, azimuth = map(math.radians, _PICTURED)
    wanted = (math.cos(elevation) * math.cos(azimuth), math.cos(elevation) * math.sin(azimuth), math.sin(elevation))
    return max(talk.views, key=lambda view: float(view.direction @ wanted)).number


def compared_views(talk: Talk) -> tuple[int, ...]:
    """Return the numbers of views, evenly chosen from all candidates, for the comparison of light."""
    numbers = [view.number for view in talk.views]
    return tuple(numbers[:: max(1, -(-len(numbers) // _COMPARED_VIEWS))])


def _as_plain(argument: Any) -> Any:
    if isinstance(argument, BaseModel):
        return argument.model_dump(mode="json")
    return asdict(argument) if is_dataclass(argument) and not isinstance(argument, type) else argument


def _scene(entry: ArtefactEntry) -> tuple[str, tuple[tuple[str, str], ...]]:
    return entry.scene, tuple((name, str(value)) for name, value in sorted(entry.parameters.items()))


@lru_cache(maxsize=64)
def _scene_digest(path: Path, parameters: tuple[tuple[str, str], ...]) -> str:
    return _file_digest(path) + json.dumps(named_digests(path, dict(parameters)), sort_keys=True)


@lru_cache(maxsize=64)
def _file_digest(path: Path) -> str:
    return hashlib.sha256(read_bounded(path, "a file of the talk")).hexdigest()
