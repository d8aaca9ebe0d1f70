"""Writers of other libraries on a disk that is full: one error that says so, and no file cut short.

A limit on the size of files stands in for the disk. It holds for the whole process, and libraries of other tests may
not survive it, so the writers run in a process of their own.
"""

from __future__ import annotations

import errno
import json
import subprocess
import sys
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

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


#: by suffix: writer, and the library that it needs
WRITERS: dict[str, tuple[Callable[[Any, Path], Any], str]] = {
    ".usda": (write_usd, "pxr"),
    ".usdc": (write_usd, "pxr"),
    ".usdz": (write_usd, "pxr"),
    ".rrd": (lambda scene, path: write_rrd(scene, path, "a-run"), "rerun"),
    ".e57": (write_scans, "pye57"),
    ".glb": (write_glb, "pygltflib"),
}


def print_errors(run: str, folder: str) -> None:
    """Print the error (errno, file) of each writer on a full disk, and the files that it leaves."""
    import resource

    scene, errors = read_run_scene(Path(run)), {}
    resource.setrlimit(resource.RLIMIT_FSIZE, (LARGEST, resource.getrlimit(resource.RLIMIT_FSIZE)[1]))
    for suffix, (write, library) in WRITERS.items():
        if find_spec(library) is None:
            continue
        try:
            write(scene, Path(folder) / f"run{suffix}")
            errors[suffix] = None
        except OSError as error:
            errors[suffix] = [error.errno, error.filename]
    print(json.dumps([errors, [path.name for path in Path(folder).iterdir()]]))


def test_a_full_disk_is_named_and_leaves_no_file(tmp_path):
    pytest.importorskip("resource")
    run, folder = write_expecting_run(tmp_path / "run"), tmp_path / "written"
    folder.mkdir()
    code = f"from {__name__} import print_errors; print_errors({str(run)!r}, {str(folder)!r})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0 and "Traceback" not in done.stderr, done.stderr
    errors, left = json.loads(done.stdout.splitlines()[-1])
    assert errors == {suffix: [errno.EFBIG, str(folder / f"run{suffix}")] for suffix in errors}
    assert ".glb" in errors and not left
