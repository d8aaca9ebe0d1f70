"""A capture is decoded once for several commands, and again when anything of it changes."""

from dataclasses import replace

import numpy as np
import pytest

from mitsim.decoding import kept_clouds
from mitsim.decoding.kept_clouds import kept_cloud
from mitsim.sensor.decoder_settings import DecoderSettings
from mitsim.sensor.matcher import MatcherSettings
from tests.capture.test_capture import two_cameras
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

    return two_cameras(["left", "right"]), decode, calls


def test_the_second_call_has_the_same_cloud_without_decoding(decoder):
    _, decode, calls = decoder  # captures that were read twice are equal, not the same
    first, second = (kept_cloud((two_cameras(["left", "right"]), 3), decode) for _ in range(2))
    assert len(calls) == 1
    assert np.array_equal(first.points, second.points)
    assert np.array_equal(first.status, second.status)


def test_a_change_of_images_rig_or_pattern_decodes_again(decoder):
    """Before, a calibration outside the capture's folder or in a sensor file did not count."""
    capture, decode, calls = decoder
    images = {name: stack.copy() for name, stack in capture.images.items()}
    images["right"][0, 40, 60] += 1
    left = capture.rig.cameras["left"]
    longer = replace(left, matrix=left.matrix * [[1 + 1e-12, 1, 1], [1, 1, 1], [1, 1, 1]])
    rig = replace(capture.rig, cameras=capture.rig.cameras | {"left": longer})
    others = [replace(capture, images=images), replace(capture, rig=rig), replace(capture, bits=7)]
    for other in (capture, *others):
        kept_cloud((other, 3), decode)
    assert len(calls) == 4


@pytest.mark.parametrize(
    ("kind", "change"),
    [
        (DecoderSettings, {"smoothing_px": 2.0}),
        (MatcherSettings, {"median_px": 5}),
        (MatcherSettings, {"speckle_px": 100}),
        (MatcherSettings, {"speckle_range_px": 3.0}),
        (MatcherSettings, {"census_window_px": 9}),
        (MatcherSettings, {"sub_pixel": "parabola"}),
    ],
)
def test_a_change_of_any_setting_decodes_again(decoder, kind, change):
    """Before, settings that are not in the repr did not count."""
    capture, decode, calls = decoder
    settings = kind(near_mm=100, far_mm=900)
    for chosen in (settings, settings.model_copy(update=change)):
        kept_cloud((capture, chosen), decode)
    assert len(calls) == 2


def test_a_damaged_cache_or_none_decodes(decoder, tmp_path, monkeypatch):
    _, decode, calls = decoder
    kept_cloud((), decode)
    next((tmp_path / "cache" / "clouds").glob("*.ply")).write_bytes(b"ply\n")
    kept_cloud((), decode)
    (tmp_path / "file").write_bytes(b"")
    monkeypatch.setenv("MITSIM_CACHE", "")
    kept_cloud((), decode)
    monkeypatch.setenv("MITSIM_CACHE", str(tmp_path / "file"))  # no folder
    kept_cloud((), decode)
    assert len(calls) == 4


def test_old_clouds_are_removed(decoder, tmp_path, monkeypatch):
    _, decode, _ = decoder
    monkeypatch.setattr(kept_clouds, "MOST_CLOUDS", 2)
    for number in range(4):
        kept_cloud(number, decode)
    assert len(list((tmp_path / "cache" / "clouds").glob("*.ply"))) == 2
