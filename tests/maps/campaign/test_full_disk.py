"""What a full disk does to a campaign and to single commands: a real disk, that is small; and a limit on files.

The disk is a tmpfs in a mount namespace of its own, which needs no rights where user namespaces are allowed, and is
gone with the process that holds it. It is reached from outside through ``/proc/PID/root``.
"""

from __future__ import annotations

import errno
import os
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import trimesh
import xarray as xr
from matplotlib.figure import Figure

from characterisation.files.atomic_io import FULL, write_json, write_netcdf
from characterisation.files.errors import InputError
from mitsim.capture.folder import write_capture
from mitsim.capture.simulated.rendering import Rendering
from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.cli.options import check_file
from mitsim.maps.campaign.plan import read_campaign
from mitsim.maps.campaign.run import run_campaign
from mitsim.maps.campaign.store import read_shot
from mitsim.report.style import write_png
from mitsim.scene.load import load_scene
from mitsim.sensor.transforms import look_at
from tests.maps.campaign.known_clouds import known_source, smooth
from tests.quick_process import QuickProcess

KNOWN = [Path(__file__).with_name("known_command.py"), "map", "make"]
MITSIM = ["-m", "mitsim"]

_HOLD = (
    'mount -t tmpfs -o size=16k tmpfs "$0" && echo there && '
    'while read -r size; do mount -o "remount,size=$size" "$0" && echo done; done'
)


@dataclass(frozen=True)
class SmallDisk:
    """A disk at ``place``, of the size that it was last given."""

    place: Path
    holder: subprocess.Popen[str]

    def resize(self, kib: int) -> None:
        assert self.holder.stdin is not None
        assert self.holder.stdout is not None
        self.holder.stdin.write(f"{kib}k\n")
        self.holder.stdin.flush()
        assert self.holder.stdout.readline() == "done\n"


@pytest.fixture
def small_disk(tmp_path) -> Iterator[SmallDisk]:
    point = tmp_path / "small"
    point.mkdir()
    refused = "no unshare on this system"
    for names in ("-rm", "-m"):  # as anybody, where user namespaces are allowed; as root, where they are not
        command = ["unshare", names, "sh", "-c", _HOLD, str(point)]
        pipe = subprocess.PIPE
        try:
            holder = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, text=True)
        except FileNotFoundError:
            break
        with holder:
            assert holder.stdout is not None
            assert holder.stderr is not None
            if holder.stdout.readline() == "there\n":
                yield SmallDisk(Path(f"/proc/{holder.pid}/root{point}"), holder)
                return
            refused = holder.stderr.read().strip()
    pytest.skip(f"no mounts here: {refused}")


@pytest.fixture
def campaign(tmp_path, scenes) -> Path:
    """Some ten captures of matt white."""
    file = tmp_path / "campaign.toml"
    file.write_text(
        "distances_mm = [500]\norientations = [{ up_to_deg = 40, subdivisions = 1 }]\n"
        f"samples = [{{ scene = '{(scenes / 'coupon/matt_white.xml').as_posix()}' }}]\n"
    )
    return file


def run(command, code, limits=None):
    """Run a command; whatever happens, a traceback is a fault of ours."""
    ended, said = QuickProcess(*command, limits=limits).wait()
    assert ended == code, (ended, said)
    assert "Traceback" not in said, said
    assert "Exception ignored" not in said, said
    return said


def limit_files(size):
    """For ``limits``: no file over ``size`` bytes, as ``ulimit -f``."""
    resource = pytest.importorskip("resource", reason="no limits on this system")
    return partial(resource.setrlimit, resource.RLIMIT_FSIZE, (size, size))


def whole_captures(plan, folder) -> dict[Path, int]:
    """The captures that are kept, each checked, and when each was written; nothing half-written is beside them."""
    assert not list(folder.rglob(".*partial*"))
    shots = [plan.shot(series, normal) for series in plan.series for normal in plan.file.normals()]
    found = [shot for shot in shots if read_shot(folder / "coupons", shot) is not None]
    folders = list((folder / "coupons").glob("*/*"))
    assert len(found) == len(folders)
    return {place: place.stat().st_mtime_ns for place in folders}


def result(folder):
    return {name: (folder / name).read_bytes() for name in ("map.nc", "samples.nc")}


def test_a_campaign_that_fills_the_disk_says_so_and_ends_in_the_same_map_once_there_is_room(
    tmp_path, n10, campaign, small_disk
):
    plan, folder = read_campaign(campaign, n10), small_disk.place / "map"
    run_campaign(plan, known_source(smooth), tmp_path / "whole")
    expected = len(list((tmp_path / "whole/coupons").glob("*/*")))

    small_disk.resize(40)  # room for some captures
    told = run([*KNOWN, campaign, "-o", folder], 3)
    assert "No space left on device" in told
    assert "run the same command again" in told
    first = whole_captures(plan, folder)
    assert 0 < len(first) < expected

    small_disk.resize(384)  # for all of them, and for samples.nc: the map is larger
    told = run([*KNOWN, campaign, "-o", folder], 3)
    assert f"{folder / 'map.nc'}: cannot be written (No space left on device)" in told
    second = whole_captures(plan, folder)
    assert len(second) == expected
    assert first.items() <= second.items()
    assert {path.name for path in folder.iterdir()} == {"coupons", "samples.nc"}

    small_disk.resize(8192)
    run([*KNOWN, campaign, "-o", folder], 0)
    assert whole_captures(plan, folder) == second
    assert result(folder) == result(tmp_path / "whole")


def test_a_map_over_the_limit_of_a_file_is_told_and_made_once_the_limit_is_gone(tmp_path, n10, campaign):
    plan, folder = read_campaign(campaign, n10), tmp_path / "map"
    told = run([*KNOWN, campaign, "-o", folder], 3, limits=limit_files(100_000))
    assert f"{folder / 'samples.nc'}: cannot be written (File too large)" in told
    assert {path.name for path in folder.iterdir()} == {"coupons"}
    before = whole_captures(plan, folder)
    run_campaign(plan, known_source(smooth), folder)
    assert whole_captures(plan, folder) == before
    run_campaign(plan, known_source(smooth), tmp_path / "whole")
    assert result(folder) == result(tmp_path / "whole")


def test_a_run_sweeps_what_a_killed_one_was_writing(tmp_path, n10, campaign):
    run_campaign(read_campaign(campaign, n10), known_source(smooth), tmp_path / "map")
    whole = sorted(path.relative_to(tmp_path) for path in (tmp_path / "map").rglob("*"))
    (tmp_path / "map/.map.nc.4711.partial").write_bytes(b"half")
    (next((tmp_path / "map/coupons").glob("*")) / ".+0.0000+0.0000.partial-0123456789ab").mkdir()
    run_campaign(read_campaign(campaign, n10), known_source(smooth), tmp_path / "map")
    assert sorted(path.relative_to(tmp_path) for path in (tmp_path / "map").rglob("*")) == whole


@pytest.fixture
def captured(tmp_path, scenes, n10):
    """A capture of matt white in a folder, and how a command takes the same."""
    scene, at = scenes / "coupon/matt_white.xml", (0.0, -100.0, 500.0)
    view = look_at(at, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 0.0) @ n10.rig.reference.sensor_from_camera.inverse()
    sensor = SimulatedSensor(n10)
    loaded = load_scene(scene, n10.wavelength_nm)
    write_capture(sensor.capture(loaded, view, rendering=Rendering(samples=1, depth=1), seed=1), tmp_path / "capture")
    return tmp_path / "capture", [scene, "--position", *at, "--samples", 1, "--depth", 1]


def test_render_and_decode_on_a_full_disk_leave_nothing_half_written(captured, small_disk):
    folder, view = captured
    place = small_disk.place
    told = run([*MITSIM, "render", *view, "-o", place / "capture"], 3)
    assert f"{place / 'capture'}: cannot be written (No space left on device)" in told
    told = run([*MITSIM, "decode", folder, "-o", place / "cloud.ply"], 3)
    assert f"{place / 'cloud.ply'}: cannot be written (No space left on device)" in told
    assert list(place.iterdir()) == []


def test_a_part_on_a_full_disk_leaves_no_folder(tmp_path, small_disk):
    trimesh.creation.icosphere(5, 15.0).export(tmp_path / "ball.stl")
    told = run([*MITSIM, "part", tmp_path / "ball.stl", "-o", small_disk.place / "ball"], 3)
    assert f"{small_disk.place / 'ball'}: cannot be written (No space left on device)" in told
    assert list(small_disk.place.iterdir()) == []


def test_a_cloud_over_the_limit_of_a_file_leaves_what_was_there_before(captured, tmp_path):
    cloud = tmp_path / "clouds/cloud.ply"
    cloud.parent.mkdir()
    cloud.write_text("what was there before")
    told = run([*MITSIM, "decode", captured[0], "-o", cloud], 3, limits=limit_files(16 * 1024))
    assert f"{cloud}: cannot be written (File too large)" in told
    assert [path.name for path in cloud.parent.iterdir()] == ["cloud.ply"]
    assert cloud.read_text() == "what was there before"


def test_files_on_a_full_disk_are_whole_or_not_there(small_disk, rng):
    """Every room from none to enough, in one process: a writer that fails must not keep the room."""
    data = xr.Dataset({name: ("x", rng.random(1000)) for name in "abcdef"}, attrs={"about": "text " * 1000})
    figure = Figure()
    figure.subplots().plot(rng.random(100))
    writers = {
        "data.nc": lambda path: write_netcdf(data, path),
        "deflated.nc": lambda path: write_netcdf(data, path, {name: {"zlib": True} for name in data}),
        "figure.png": lambda path: write_png(figure, path),
        "numbers.json": lambda path: write_json(path, rng.random(2000).tolist()),
    }
    for name, write in writers.items():
        path, failed = small_disk.place / name, 0
        for kib in range(4, 256, 8):
            small_disk.resize(kib)
            try:
                write(path)
            except OSError as error:
                failed += 1
                assert (error.errno, error.filename) == (errno.ENOSPC, str(path))
                assert list(small_disk.place.iterdir()) == []
                continue
            break
        assert failed > 0
        assert [file.name for file in small_disk.place.iterdir()] == [name]
        if path.suffix == ".nc":
            assert xr.load_dataset(path).drop_attrs(deep=False).identical(data.drop_attrs(deep=False))
        path.unlink()


def test_what_a_disk_says_when_it_is_full_is_known():
    """The device /dev/full says it wherever there is a Linux."""
    if not Path("/dev/full").exists():
        pytest.skip("no /dev/full on this system")
    with pytest.raises(OSError) as caught:
        Path("/dev/full").write_bytes(np.zeros(10, np.uint8).tobytes())
    assert caught.value.errno in FULL


def test_a_device_is_not_replaced_by_a_file(tmp_path):
    """Writing whole ends in a rename, and a user may be root."""
    os.mkfifo(tmp_path / "pipe")
    for file in (Path("/dev/null"), tmp_path / "pipe"):
        with pytest.raises(InputError, match="a device or a pipe"):
            check_file(file)
    check_file(tmp_path / "cloud.ply")
