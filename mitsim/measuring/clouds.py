"""The clouds that are measured: files and captures, one or many, as the command line names them.

Signal chain: path -> cloud file of ``mitsim decode``; or capture folder, decoded; or a recording that ``mitsim import``
knows without being told more, decoded -> cloud, and its capture where there is one.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from characterisation.cloud_files import read_ply
from characterisation.errors import InputError
from characterisation.point_cloud import PointCloud
from mitsim.capture.capture import Capture
from mitsim.capture.folder import read_capture
from mitsim.reconstruction.cloud import Settings, capture_cloud, decoder_settings
from mitsim.reconstruction.noise import known_noise
from mitsim.recordings.recognise import Given, read_recording
from mitsim.sensor.matcher import MatcherSettings

#: endings of the files of a folder that are measured
_ENDINGS = (".ply", ".pcd")

#: what a cloud file of ``mitsim decode`` has in its head
_MARK, _HEAD = b"\ncomment mitsim ", 4096


@dataclass(frozen=True)
class GivenCloud:
    """A cloud by its ``path``; ``capture`` that it was decoded from, None of a cloud file.

    ``margin_px``: pixels beside the edge of a feature whose points may be of both sides, half a matching block.
    """

    path: Path
    cloud: PointCloud
    capture: Capture | None
    margin_px: int = 0


def cloud_paths(paths: Iterable[Path]) -> list[Path]:
    """Paths of clouds, with folders of clouds and captures replaced by what is in them, by name.

    Raises
    ------
    InputError
        If a folder holds none.
    """
    out: list[Path] = []
    for path in paths:
        if not path.is_dir() or (path / "capture.json").exists():
            out.append(path)
            continue
        inside = [
            one
            for one in sorted(path.iterdir())
            if (one / "capture.json").exists() or (one.is_file() and one.suffix.lower() in _ENDINGS)
        ]
        # a folder without either may be a recording as its device saved it
        out += inside or [path]
    return out


def read_cloud(path: Path, sensor: str | None = None) -> GivenCloud:
    """Read a cloud, or decode the capture that a path leads to, with the settings of ``sensor`` if given.

    Raises
    ------
    InputError
        If there is none, or it cannot be read or decoded.
    """
    if path.is_file() and _is_own(path):
        return GivenCloud(path, read_ply(path), None)
    if (path / "capture.json").exists():
        capture = read_capture(path)
    elif path.exists():
        capture = read_recording(path, Given()).capture
    else:
        raise InputError(
            path, "", "no such file or folder", "a cloud (.ply, .pcd), a capture folder, or folders of these"
        )
    settings, imager = decoder_settings(capture, sensor)
    cloud = capture_cloud(capture, settings, imager=known_noise(capture, imager))
    return GivenCloud(path, cloud, capture, margin_of(settings))


def margin_of(settings: Settings) -> int:
    """Pixels beside the edge of a feature whose points may be of both sides: half a matching block and one."""
    return settings.block_size // 2 + 1 if isinstance(settings, MatcherSettings) else 0


def _is_own(path: Path) -> bool:
    with path.open("rb") as file:
        head = file.read(_HEAD)
    return head.startswith(b"ply\n") and _MARK in head
