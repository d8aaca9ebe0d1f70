"""Memory that is left to a process in a container."""

import pytest

from mitsim.running import executor


@pytest.mark.parametrize(
    ("names", "cached"),
    [
        (("memory.max", "memory.current", "memory.stat"), "inactive_file"),
        (
            ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes", "memory/memory.stat"),
            "total_inactive_file",
        ),
    ],
)
def test_cached_files_are_no_memory_in_use(tmp_path, monkeypatch, names, cached):
    monkeypatch.setattr(executor, "_GROUP", tmp_path)
    free = executor.available_memory()
    (tmp_path / "memory").mkdir()
    for name, text in zip(names, ("3000000", "2500000", f"active_file 7\n{cached} 2000000\nother 1"), strict=True):
        (tmp_path / name).write_text(text)
    assert executor.available_memory() == 2_500_000
    (tmp_path / names[0]).write_text("max")
    assert executor.available_memory() > min(free, 3_000_000)
