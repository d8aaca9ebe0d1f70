"""Try mitsim as it is installed: every module, and every stage of the pipeline that needs a dependency, small.

Run by the Python of an environment into which mitsim was installed; see ``versions.py``. Exit code 1 if one fails.
"""

from __future__ import annotations

import importlib
import pkgutil
import subprocess
import sys
import tempfile
import traceback
from collections.abc import Callable
from pathlib import Path

SCENES = Path(__file__).resolve().parents[1] / "scenes"

STUDY = """scene = "{scenes}/two_pillars/two_pillars.xml"
task = "{scenes}/two_pillars/task.toml"
sensor = "ensenso-n10"
parameters = {{ plane_Ra = 0.37, pillar_Ra = 0.37 }}
views = {{ subdivisions = 0 }}
"""

CAMPAIGN = """distances_mm = [500]
samples_per_pixel = 1
orientations = [{{ up_to_deg = 10, subdivisions = 0 }}]
samples = [{{ scene = "{scenes}/coupon/matt_white.xml" }}]
"""


def mitsim(*arguments: object) -> str:
    """Run a command; what it printed on stdout."""
    call = [sys.executable, "-W", "default", "-m", "mitsim", *map(str, arguments)]
    done = subprocess.run(call, capture_output=True, text=True, timeout=900, check=False)
    if done.returncode:
        raise RuntimeError(
            f"mitsim {' '.join(map(str, arguments))}: exit code {done.returncode}\n{done.stderr[-3000:]}"
        )
    return done.stdout


def modules() -> None:
    """Every module of both packages."""
    import characterisation
    import mitsim

    for package in (characterisation, mitsim):
        for one in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
            if not one.name.endswith(("__main__", "step_worker")):
                importlib.import_module(one.name)


def help_of_commands() -> None:
    """typer, click and rich."""
    assert "calibrate" in mitsim("--help")
    for command in ("render", "export", "map", "fit"):
        mitsim(command, "--help")
    mitsim("doctor")


def capture_and_cloud() -> None:
    """Mitsuba, Dr.Jit, LLVM, OpenCV, OpenEXR."""
    place = ("--position", 60, -80, 550)
    mitsim("render", SCENES / "coupon/matt_white.xml", *place, "-o", "c", "--samples", 1, "--depth", 1, "--truth")
    mitsim("decode", "c", "-o", "cloud.ply")
    mitsim("import", "c/images/left_000.png", "--help")


def structured_light() -> None:
    """Fringes and their decoder."""
    place = ("--position", 0, 0, 600, "--sensor", "zivid-2-m70")
    mitsim("render", SCENES / "coupon/matt_white.xml", *place, "-o", "z", "--samples", 1, "--depth", 1)
    mitsim("decode", "z", "-o", "z.ply")


def campaign_and_map() -> None:
    """netCDF, xarray, scipy, matplotlib."""
    Path("campaign.toml").write_text(CAMPAIGN.format(scenes=SCENES.as_posix()))
    mitsim("map", "make", "campaign.toml", "-o", "map")
    mitsim("map", "compare", "map/map.nc", "ensenso-n10", "-o", "compared")


def parts() -> None:
    """trimesh, networkx and lxml: a mesh, one with flipped triangles, and 3MF."""
    import trimesh

    box = trimesh.creation.box((20, 30, 10))
    box.export("box.stl")
    box.export("box.3mf")
    flipped = trimesh.Trimesh(box.vertices, [*box.faces[:6].tolist(), *box.faces[6:, ::-1].tolist()], process=False)
    flipped.export("flipped.stl")
    for name in ("box.stl", "box.3mf", "flipped.stl"):
        mitsim("part", name, "-o", f"part_{name}")
        mitsim("check", f"part_{name}/{next(Path(f'part_{name}').glob('*.xml')).name}")


def step_part() -> None:
    """OpenCASCADE."""
    from OCP.BRepPrimAPI import BRepPrimAPI_MakeBox
    from OCP.STEPControl import STEPControl_AsIs, STEPControl_Writer

    writer = STEPControl_Writer()
    writer.Transfer(BRepPrimAPI_MakeBox(20.0, 30.0, 10.0).Shape(), STEPControl_AsIs)
    writer.Write("box.step")
    mitsim("part", "box.step", "-o", "part_step")


def scores_and_report() -> None:
    """pydantic, jinja2, the prediction."""
    Path("study.toml").write_text(STUDY.format(scenes=SCENES.as_posix()))
    assert "view" in mitsim("study", "score", "study.toml", "-o", "scores")


def exports() -> None:
    """Every writer of other tools' files."""
    for suffix in ("pcd", "e57", "mcap"):
        mitsim("export", "cloud", "cloud.ply", "-o", f"cloud.{suffix}")
    mitsim("export", "map", "ensenso-n10", "-o", "exported_map")
    for name in ("pygltflib", "pxr.Usd", "rerun", "pypcd4", "pye57", "rosbags.rosbag2"):
        importlib.import_module(name)


def cluster() -> None:
    """Dask: a campaign on a worker of this machine."""
    from distributed import LocalCluster

    with LocalCluster(n_workers=1, threads_per_worker=1, processes=True, dashboard_address=None) as made:
        mitsim("map", "make", "campaign.toml", "-o", "map_there", "--scheduler", made.scheduler_address)
    assert Path("map/map.nc").read_bytes() == Path("map_there/map.nc").read_bytes()


def recordings_and_devices() -> None:
    """What recordings and devices are read with."""
    for name in ("mcap.reader", "mcap_protobuf.decoder", "lz4.frame", "zstandard", "google.protobuf", "serial"):
        importlib.import_module(name)
    import lz4.frame
    import zstandard

    data = bytes(range(256)) * 100
    assert lz4.frame.decompress(lz4.frame.compress(data)) == data
    assert zstandard.decompress(zstandard.compress(data)) == data


TRIED: tuple[Callable[[], None], ...] = (
    modules,
    help_of_commands,
    capture_and_cloud,
    structured_light,
    campaign_and_map,
    parts,
    step_part,
    scores_and_report,
    exports,
    cluster,
    recordings_and_devices,
)


def main() -> int:
    """Try all of them, and say which fail."""
    import os

    wrong = 0
    with tempfile.TemporaryDirectory(prefix="mitsim-smoke-") as folder:
        os.chdir(folder)
        for one in TRIED:
            try:
                one()
            except Exception:
                wrong += 1
                print(f"{one.__name__}: fails\n{traceback.format_exc()[-3000:]}", flush=True)
            else:
                print(f"{one.__name__}: works", flush=True)
        os.chdir("/")
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
