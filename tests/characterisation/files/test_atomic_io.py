"""A file is whole or is not there, and an older one survives a failure."""

from __future__ import annotations

import errno

import pytest

from characterisation.files.atomic_io import atomic_folder, atomic_write, atomic_write_named

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
