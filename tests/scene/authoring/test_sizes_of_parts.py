"""Parts whose file states the wrong unit are read quickly, and their size is told."""

from __future__ import annotations

import sys
import time

import numpy as np
import pytest

from characterisation.files.errors import InputError
from mitsim.scene.authoring import read_step as reading
from mitsim.scene.authoring.part_folder import read_part
from mitsim.scene.authoring.read_step import step_installed
from tests.scene.authoring.bracket import write_step

pytestmark = pytest.mark.skipif(not step_installed(), reason="OpenCASCADE, which reads STEP, is not installed")


@pytest.fixture
def ring_in(tmp_path):
    """Return a function that writes a torus of radii 20 and 5 whose numbers are in another unit than they should be."""

    def write(prefix):
        from OCP.BRepPrimAPI import BRepPrimAPI_MakeTorus

        path = write_step([("ring", BRepPrimAPI_MakeTorus(20.0, 5.0).Shape(), None)], tmp_path / "ring.step")
        text = path.read_text()
        assert "SI_UNIT(.MILLI.,.METRE.)" in text
        path.write_text(text.replace("SI_UNIT(.MILLI.,.METRE.)", f"SI_UNIT({prefix},.METRE.)"))
        return path

    return write


def test_a_part_in_metres_instead_of_mm_is_meshed_coarsely_and_told(ring_in, capsys):
    """At the chord of 0.01 mm its 4 pi^2 20 5 m^2 would take over 10 million triangles."""
    part = read_part(ring_in("$"))
    assert sum(len(face.triangles) for face in part.faces) <= 1_000_000
    assert sum(face.area for face in part.faces) == pytest.approx(4 * np.pi**2 * 20e3 * 5e3, rel=1e-3)
    assert max(face.sag for face in part.faces) < 2e-5 * np.sqrt(2 * 50e3**2 + 10e3**2)
    assert any("71.4 m across" in one and "the file states m: if" in one for one in part.remarks)
    assert "71.4 m across" in capsys.readouterr().err  # before it is meshed


@pytest.mark.parametrize(
    ("prefix", "size", "unit"), [(".KILO.", r"7\.14e\+04 m", r"1e\+06 mm"), (".MICRO.", r"0\.07\d* mm", "um")]
)
def test_a_part_of_an_impossible_size_is_not_meshed(ring_in, prefix, size, unit):
    with pytest.raises(InputError, match=f"a part ({size}) across.* states {unit}: if that is wrong, export it again"):
        read_part(ring_in(prefix))


def test_a_part_that_cannot_be_meshed_in_time_is_told(ring_in, monkeypatch):
    monkeypatch.setattr(reading, "_SECONDS", 0.01)
    start = time.monotonic()
    with pytest.raises(InputError, match=r"cannot be meshed within .* check its unit and size, give a larger --chord"):
        read_part(ring_in(".MILLI."))
    assert time.monotonic() - start < 60


def test_a_face_that_takes_long_does_not_leave_the_user_without_a_word(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(reading, "_STILL_EVERY_S", 0.2)
    command = [sys.executable, "-c", "import time; time.sleep(1)"]
    reading.run_worker(command, tmp_path / "plate.step", lambda size: [])
    assert "plate.step: still meshing after" in capsys.readouterr().err
