"""A file is whole or is not there, and an older one survives a failure."""

from __future__ import annotations

import pytest

from characterisation.whole_files import written_whole


def test_a_failure_leaves_what_was_there(tmp_path):
    target = tmp_path / "map.nc"
    with written_whole(target) as file:
        file.write_text("old")
    with pytest.raises(RuntimeError), written_whole(target) as file:
        file.write_text("half")
        raise RuntimeError
    assert target.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["map.nc"]


def test_nothing_written_is_a_fault(tmp_path):
    with pytest.raises(FileNotFoundError), written_whole(tmp_path / "nothing"):
        pass
