"""A folder with the files that examples name, and a capture and cloud of the small camera in it."""

import os
import shutil
import sys
from pathlib import Path

import pytest

import mitsim as ms
from tests.smaller_sensors import coarse_sensor

ROOT = Path(__file__).resolve().parents[2]
HERE = Path(__file__).parent

#: files that examples name
FILES = (
    ROOT / "scenes/two_pillars/two_pillars.xml",
    ROOT / "scenes/two_pillars/matt_white.xml",
    ROOT / "scenes/two_pillars/task.toml",
    ROOT / "scenes/coupon/coupon.xml",
    HERE / "small.toml",
)


def capture_into(folder: Path) -> None:
    """Write ``capture``, ``cloud.ply`` and ``coupon.ply``: the small camera's, of a matt-white part and coupon."""
    sensor = ms.load_sensor(folder / "small.toml")
    scene = ms.load_scene(folder / "matt_white.xml", sensor)
    capture = ms.render(scene, sensor, ms.look_at((0, -300, 400)), samples=8, depth=1, check=False)
    ms.write_capture(capture, folder / "capture")
    ms.write_cloud(ms.decode(capture), folder / "cloud.ply")
    coupon = ms.load_scene(folder / "coupon_white.xml", sensor, {"half_size": 150})
    flat = ms.render(coupon, sensor, ms.look_at((0, 0, 450), up=(0, 1, 0)), samples=8, depth=1, check=False)
    ms.write_cloud(ms.decode(flat), folder / "coupon.ply")


@pytest.fixture(scope="session")
def prepared(tmp_path_factory) -> Path:
    """The folder, made once."""
    folder = tmp_path_factory.mktemp("examples")
    for file in FILES:
        shutil.copy(file, folder)
    shutil.copy(ROOT / "scenes/coupon/matt_white.xml", folder / "coupon_white.xml")
    # a study of a sensor that has a quarter of the pixels
    study = (HERE / "study.toml").read_text(encoding="utf-8")
    sensor = coarse_sensor("ensenso-n10", 2, folder).name
    (folder / "study.toml").write_text(study.replace('"ensenso-n10"', f'"{sensor}"'), encoding="utf-8")
    capture_into(folder)
    return folder


@pytest.fixture(autouse=True)
def _closed_figures():
    """Close the figures that a test has opened: pyplot keeps them, and warns when they are many."""
    yield
    if "matplotlib.pyplot" in sys.modules:
        sys.modules["matplotlib.pyplot"].close("all")


@pytest.fixture
def workplace(prepared, tmp_path, monkeypatch) -> Path:
    """A copy of the folder of one's own, and the current one."""
    folder = tmp_path / "work"
    shutil.copytree(prepared, folder, copy_function=os.link)
    monkeypatch.chdir(folder)
    return folder
