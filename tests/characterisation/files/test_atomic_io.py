"""A file is whole or is not there, and an older one survives a failure."""

from __future__ import annotations

import errno
import json
import os
import sys

import pytest

from characterisation.files.atomic_io import atomic_folder, atomic_write, atomic_write_named, write_folder, write_json

both = pytest.mark.parametrize("written", [atomic_write, atomic_write_named])


@both
def test_a_failure_leaves_what_was_there(tmp_path, written):
    target = tmp_path / "map.nc"
    with written(target) as file:
        file.write_text("old")
    with pytest.raises(RuntimeError), written(target) as file:
        file.write_text("half")
        raise RuntimeError
    assert target.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["map.nc"]


@both
def test_nothing_written_is_a_fault(tmp_path, written):
    with pytest.raises(FileNotFoundError), written(tmp_path / "nothing"):
        pass
    assert not list(tmp_path.iterdir())


@both
def test_a_full_disk_names_the_file_that_was_wanted(tmp_path, written):
    with pytest.raises(OSError, match="No space left") as raised, written(tmp_path / "cloud.e57"):
        raise OSError(errno.ENOSPC, "No space left on device", "somewhere/else")
    assert raised.value.filename == str(tmp_path / "cloud.e57")


def test_a_file_is_written_by_its_own_name(tmp_path):
    with atomic_write_named(tmp_path / "part.usdc") as file:
        assert file.name == "part.usdc" and file.parent.parent == tmp_path
        file.write_text("whole")
    assert (tmp_path / "part.usdc").read_text() == "whole"


def test_a_folder_is_there_whole_or_not_at_all(tmp_path):
    with pytest.raises(RuntimeError), atomic_folder(tmp_path / "new" / "data") as folder:
        (folder / "half.txt").write_text("half")
        raise RuntimeError
    assert not list((tmp_path / "new").iterdir())
    with atomic_folder(tmp_path / "new" / "data") as folder:
        (folder / "whole.txt").write_text("whole")
        assert not (tmp_path / "new" / "data").exists()
    assert [p.relative_to(tmp_path).as_posix() for p in tmp_path.rglob("*.txt")] == ["new/data/whole.txt"]
    assert [p.name for p in (tmp_path / "new").iterdir()] == ["data"]
    with pytest.raises(OSError, match="No space left") as raised, atomic_folder(tmp_path / "full"):
        raise OSError(errno.ENOSPC, "No space left on device", "somewhere/else")
    assert raised.value.filename == str(tmp_path / "full")


needs_links = pytest.mark.skipif(sys.platform == "win32", reason="links need a privilege on Windows")


@needs_links
@both
@pytest.mark.parametrize("there", [True, False])
def test_a_link_stays_and_the_file_that_it_points_to_is_written(tmp_path, written, there):
    (tmp_path / "store").mkdir()
    if there:
        (tmp_path / "store" / "cloud").write_text("old")
    (tmp_path / "latest.ply").symlink_to("store/cloud")
    with written(tmp_path / "latest.ply") as file:
        file.write_text("new")
    assert (tmp_path / "latest.ply").is_symlink() and (tmp_path / "store" / "cloud").read_text() == "new"
    assert sorted(p.name for p in tmp_path.rglob("*")) == ["cloud", "latest.ply", "store"]


@needs_links
def test_a_link_to_a_folder_stays_and_its_folder_is_written(tmp_path):
    (tmp_path / "disk" / "one").mkdir(parents=True)
    (tmp_path / "one").symlink_to("disk/one")
    with atomic_folder(tmp_path / "one") as folder:
        (folder / "first").write_text("first")
    write_folder(tmp_path / "one", {"second": b"second"}, overwrite=["first"])
    (tmp_path / "two").symlink_to("disk/two")
    write_folder(tmp_path / "two", {"third": b"third"})
    assert (tmp_path / "one").is_symlink() and (tmp_path / "two").is_symlink()
    names = sorted(p.relative_to(tmp_path / "disk").as_posix() for p in (tmp_path / "disk").rglob("*"))
    assert names == ["one", "one/second", "two", "two/third"]


def test_a_folder_is_replaced_but_for_what_others_wrote_into_it(tmp_path):
    """Before, a user's files in the folder of a capture, of poses or of an exported map were deleted."""
    folder = tmp_path / "one"
    write_folder(folder, {"first": b"old", "images/left": b"old", "images/right": b"old"})
    (folder / "notes").mkdir()
    (folder / "notes" / "a.txt").write_text("mine")
    (folder / "program.py").write_text("mine")
    with pytest.raises(OSError):
        write_folder(folder, {"first": b"new"})
    write_folder(folder, {"first": b"new", "images/left": b"new"}, overwrite=("first", "images", "second"))
    files = {p.relative_to(folder).as_posix(): p.read_text() for p in folder.rglob("*") if p.is_file()}
    assert files == {"first": "new", "images/left": "new", "notes/a.txt": "mine", "program.py": "mine"}
    assert [p.name for p in tmp_path.iterdir()] == ["one"]


def test_json_keeps_a_file_name_that_is_not_utf8(tmp_path):
    name = os.fsdecode(b"caf\xe9 \xc3\xa9.toml")  # e acute in Latin-1, then in UTF-8
    write_json(tmp_path / "run.json", {"study": name})
    text = (tmp_path / "run.json").read_bytes().decode("utf-8")
    assert os.fsencode(json.loads(text)["study"]) == b"caf\xe9 \xc3\xa9.toml"
