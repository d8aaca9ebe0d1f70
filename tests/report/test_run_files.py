"""A folder is one run's: results of another are moved away, and no page mixes two."""

import json
import shutil

import pytest

from characterisation.files.errors import InputError
from mitsim.report.page import write_report
from mitsim.study.run_files import claim_folder, digests_of
from mitsim.study.run_folder import read_run
from tests.plain_pages import without_pictures
from tests.report.conftest import CHECKED

NAMES = (
    "map.nc",
    "samples.nc",
    "scores.nc",
    "checks.nc",
    "statement.json",
    *(f"clouds/{kind}_{view:04d}.ply" for kind in ("predicted", "rendered") for view in CHECKED),
    *(f"captures/view_{view:04d}/capture.json" for view in CHECKED),
)


@pytest.fixture
def folder(run_folder, tmp_path):
    """A copy whose run.json names its files."""
    shutil.copytree(run_folder, tmp_path / "run")
    out = tmp_path / "run"
    about = json.loads((out / "run.json").read_text(encoding="utf-8"))
    about["files"] = digests_of(out, NAMES)
    (out / "run.json").write_text(json.dumps(about), encoding="utf-8")
    return out


def read_all(folder):
    run = read_run(folder)
    for view in run.checked:
        run.predicted(view), run.decoded(view), run.capture(view)


def test_a_run_of_named_files_is_read(folder):
    read_all(folder)
    with without_pictures():
        assert write_report(folder).stat().st_size > 0


@pytest.mark.parametrize("name", [NAMES[0], NAMES[2], NAMES[3], NAMES[4], NAMES[5], NAMES[8], NAMES[-1]])
def test_a_file_of_another_run_is_refused(folder, name):
    """Each stays readable by itself: only its digest tells."""
    path = folder / name
    path.write_bytes(path.read_bytes() + (b"\n" if path.suffix == ".json" else b"\0"))
    with pytest.raises(InputError, match="another run") as caught:
        read_all(folder)
    assert str(path) in str(caught.value)


def test_files_that_run_json_does_not_name_are_not_read(folder):
    shutil.copy(folder / NAMES[5], folder / "clouds" / "predicted_0011.ply")
    about = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    for name in ("samples.nc", "statement.json"):
        del about["files"][name]
        (folder / name).write_bytes(b"of another run")
    (folder / "run.json").write_text(json.dumps(about), encoding="utf-8")
    run = read_run(folder)
    assert run.patches is None and run.statement is None
    assert 11 not in run.clouds and sorted(run.clouds) == sorted(CHECKED)


def test_results_of_another_study_are_moved_away_whole(folder):
    for name in ("sheet.pdf", "view_set.csv"):
        (folder / name).write_bytes(b"of the study before")
    before = {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    (folder / "trials").mkdir()
    (folder / "trials" / "view_0001.jsonl").write_text("kept", encoding="utf-8")
    moved = claim_folder(folder, "run", "b" * 32)
    assert moved is not None and moved.parent == folder / "earlier"
    assert {path.relative_to(moved): path.read_bytes() for path in moved.rglob("*") if path.is_file()} == {
        path: data for path, data in before.items() if path.name not in ("map.nc", "samples.nc")
    }
    assert (folder / "trials" / "view_0001.jsonl").read_text(encoding="utf-8") == "kept"
    with pytest.raises(InputError, match=r"run\.json"):
        read_run(folder)


def test_the_same_study_goes_on_where_it_was(folder):
    assert claim_folder(folder, "run", "a" * 32) is not None  # whose it was is not known
    (folder / "scores.nc").write_bytes(b"of a")
    (folder / "run.json").write_bytes(b"of a, not finished")
    assert claim_folder(folder, "run", "a" * 32) is None
    assert not (folder / "run.json").exists()
    assert (folder / "scores.nc").read_bytes() == b"of a"
    second = claim_folder(folder, "score", "a" * 32)
    assert second is not None and (second / "scores.nc").read_bytes() == b"of a"
    (folder / "scores.nc").write_bytes(b"scored")
    third = claim_folder(folder, "run", "c" * 32)
    assert third is not None and third != second and len({third.name, second.name}) == 2
