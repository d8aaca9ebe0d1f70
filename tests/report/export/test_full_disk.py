"""Writers of other libraries on a disk that is full: one error that says so, and no file cut short."""

from __future__ import annotations

import errno

import numpy as np
import pytest

from mitsim.report.export.cloud_points import cloud_points
from mitsim.report.export.e57 import write_e57
from mitsim.report.export.gltf import write_glb
from mitsim.report.export.rerun_recording import write_rrd
from mitsim.report.export.run_scene import read_run_scene
from mitsim.report.export.usd import write_usd
from mitsim.sensor.transforms import Transform
from tests.report.view_sphere_run import write_expecting_run

#: largest file of the process while it writes [bytes]: below that of any of these
LARGEST = 2048


def write_scans(scene, path):
    cloud = cloud_points(scene.views[0].clouds["predicted"])
    write_e57([("scan", cloud, Transform(np.eye(3), np.zeros(3)))], path)


@pytest.mark.parametrize(
    ("write", "suffix", "library"),
    [
        (write_usd, ".usda", "pxr.Usd"),
        (write_usd, ".usdc", "pxr.Usd"),
        (write_usd, ".usdz", "pxr.Usd"),
        (lambda scene, path: write_rrd(scene, path, "a-run"), ".rrd", "rerun"),
        (write_scans, ".e57", "pye57"),
        (write_glb, ".glb", "pygltflib"),
    ],
)
def test_a_full_disk_is_named_and_leaves_no_file(tmp_path, write, suffix, library):
    pytest.importorskip(library)
    resource = pytest.importorskip("resource")
    scene = read_run_scene(write_expecting_run(tmp_path / "run"))
    folder = tmp_path / "written"
    folder.mkdir()
    old = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (LARGEST, old[1]))
    try:
        with pytest.raises(OSError) as raised:
            write(scene, folder / f"run{suffix}")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, old)
    assert (raised.value.errno, raised.value.filename) == (errno.EFBIG, str(folder / f"run{suffix}"))
    assert not list(folder.iterdir())
