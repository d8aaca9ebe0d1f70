"""A capture is decoded once for several commands, and again when anything of it changes."""

from dataclasses import replace

import numpy as np
import pytest

from mitsim.decoding import kept_clouds
from mitsim.decoding.kept_clouds import kept_cloud
from mitsim.sensor.matcher import MatcherSettings
from mitsim.sensor.preset import load_sensor
from tests.seen_shapes import cloud_of, plane


@pytest.fixture
def decoder(tmp_path, monkeypatch):
    """Count decodings; the cache is a folder of the test, and every cloud took long."""
    monkeypatch.setenv("MITSIM_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(kept_clouds, "SLOW_S", -1.0)
    calls = []

    def decode():
        calls.append(1)
        return cloud_of(plane([0, 0, 500], [0, 0.1, -1]))

    (tmp_path / "capture").mkdir()
    (tmp_path / "capture" / "image.png").write_bytes(b"image")
    return tmp_path / "capture", decode, calls


def test_the_second_call_has_the_same_cloud_without_decoding(decoder):
    path, decode, calls = decoder
    first, second = (kept_cloud(path, ("settings", 3), decode) for _ in range(2))
    assert len(calls) == 1
    assert np.array_equal(first.points, second.points)
    assert np.array_equal(first.status, second.status)


def test_a_change_of_files_or_settings_decodes_again(decoder):
    path, decode, calls = decoder
    kept_cloud(path, (3,), decode)
    kept_cloud(path, (4,), decode)
    (path / "image.png").write_bytes(b"other")
    kept_cloud(path, (3,), decode)
    assert len(calls) == 3


def test_a_change_that_no_representation_shows_decodes_again(decoder):
    """Before, another filter of the matcher, or another calibration file, gave the kept cloud."""
    path, decode, calls = decoder
    rig = load_sensor("ensenso-n10").rig
    matcher = MatcherSettings(near_mm=300, far_mm=900)
    longer = replace(rig.reference, matrix=rig.reference.matrix * [[1 + 1e-10], [1], [1]])
    for count in (3, 3):
        kept_cloud(path, (matcher, rig), decode)
        kept_cloud(path, (matcher.model_copy(update={"median_px": 5}), rig), decode)
        kept_cloud(path, (matcher, replace(rig, cameras=rig.cameras | {"left": longer})), decode)
        assert len(calls) == count


def test_a_damaged_cache_or_none_decodes(decoder, tmp_path, monkeypatch):
    path, decode, calls = decoder
    kept_cloud(path, (), decode)
    next((tmp_path / "cache" / "clouds").glob("*.ply")).write_bytes(b"ply\n")
    kept_cloud(path, (), decode)
    monkeypatch.setenv("MITSIM_CACHE", "")
    kept_cloud(path, (), decode)
    monkeypatch.setenv("MITSIM_CACHE", str(path / "image.png"))  # no folder
    kept_cloud(path, (), decode)
    assert len(calls) == 4


def test_old_clouds_are_removed(decoder, tmp_path, monkeypatch):
    path, decode, _ = decoder
    monkeypatch.setattr(kept_clouds, "MOST_CLOUDS", 2)
    for number in range(4):
        kept_cloud(path, (number,), decode)
    assert len(list((tmp_path / "cache" / "clouds").glob("*.ply"))) == 2
