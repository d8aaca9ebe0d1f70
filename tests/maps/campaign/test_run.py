"""Campaigns that are stopped, changed, refined and limited by a stage, with a sensor that is known."""

import errno
import json
import math
import os
import shutil
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr

from characterisation.coupon.orientations import sphere_directions
from characterisation.files import atomic_io
from characterisation.files.errors import InputError, MissingEnvironmentError
from mitsim.maps.campaign import run as run_module
from mitsim.maps.campaign.run import run_campaign
from tests.maps.campaign.known_clouds import known_source, smooth, stepped
from tests.quick_process import QuickProcess

pytestmark = pytest.mark.usefixtures("coarse_maps")

#: enough where it does not matter what is shown
WHITE = [{"scene": "matt_white.xml"}]


def counting(source, taken):
    def finish(shots):
        taken.extend((shot.series.name, shot.name) for shot in shots)
        yield from source(shots)

    return finish


def result(folder):
    return {name: (folder / name).read_bytes() for name in ("map.nc", "samples.nc")}


@pytest.fixture
def no_map(monkeypatch):
    """Campaigns that end without a map, which takes longer than their captures: only its attributes are there."""

    def attributes_alone(tables, attributes, largest):
        return SimpleNamespace(data=SimpleNamespace(attrs=attributes), save=lambda path: None)

    monkeypatch.setattr(run_module, "build_map", attributes_alone)


def test_a_campaign_goes_on_where_it_was(tmp_path, planned):
    plan, taken = planned(distances_mm=[500], samples=WHITE), []
    source = counting(known_source(smooth), taken)
    run_campaign(plan, source, tmp_path)
    whole = result(tmp_path)
    expected = len(plan.file.normals()) * len(plan.series)
    assert len(taken) == len(set(taken)) == expected
    run_campaign(plan, source, tmp_path)
    assert len(taken) == expected
    assert result(tmp_path) == whole
    kept = sorted((tmp_path / "coupons").glob("*/*"))
    for folder in kept[::7]:
        shutil.rmtree(folder)
    run_campaign(plan, source, tmp_path)
    assert len(taken) == expected + len(kept[::7])
    assert result(tmp_path) == whole


def test_the_order_in_which_captures_come_does_not_matter(tmp_path, planned):
    plan, source = planned(distances_mm=[500], refine={"subdivisions": 2}, samples=WHITE), known_source(stepped)
    run_campaign(plan, source, tmp_path / "one")
    run_campaign(plan, lambda shots: source(list(reversed(shots))), tmp_path / "two")
    assert result(tmp_path / "one") == result(tmp_path / "two")


def test_a_denser_plan_keeps_what_was_taken(tmp_path, planned, no_map):
    taken = []
    source = counting(known_source(smooth), taken)
    coarse = planned(distances_mm=[500])
    run_campaign(coarse, source, tmp_path)
    before = set(taken)
    dense = planned(
        distances_mm=[500], orientations=[{"up_to_deg": 30, "subdivisions": 2}, {"up_to_deg": 60, "subdivisions": 1}]
    )
    run_campaign(dense, source, tmp_path)
    assert len(taken) == len(set(taken))
    assert len(set(taken) - before) == len(dense.series) * (len(dense.file.normals()) - len(coarse.file.normals()))


def test_another_coupon_or_sensor_is_another_folder(planned, n10):
    names = {planned().series[0].name}
    names |= {planned(samples=[{"scene": "matt_white.xml", "parameters": {"reflectance": 0.4}}]).series[0].name}
    names |= {planned(samples_per_pixel=4).series[0].name, planned(seed=2).series[0].name}
    assert len(names) == 4


def test_orientations_are_added_where_f_changes_and_nowhere_else(tmp_path, planned, no_map):
    bands = [{"up_to_deg": 60, "subdivisions": 2}]
    plan = planned(refine={"fraction": 0.15, "subdivisions": 3}, orientations=bands, distances_mm=[500], samples=WHITE)
    performance = run_campaign(plan, known_source(stepped), tmp_path)
    names = [folder.name for folder in (tmp_path / "coupons").glob("*/*")]
    across = np.array([[float(name[:7]), float(name[7:])] for name in names])
    normals = np.column_stack([across, np.sqrt(1 - (across**2).sum(axis=1))])
    finest = np.degrees(np.arccos(np.clip(sphere_directions(3)[:, 2], -1, 1)))
    assert len(plan.file.normals()) < len(names) < 0.75 * (finest <= 60).sum()

    def gaps(incidence_deg):
        """From places at one incidence to the nearest orientation [deg]."""
        azimuth, theta = np.linspace(0, 2 * np.pi, 180), math.radians(incidence_deg)
        ring = np.column_stack(
            [np.sin(theta) * np.cos(azimuth), np.sin(theta) * np.sin(azimuth), np.full(180, np.cos(theta))]
        )
        return np.degrees(np.arccos(np.clip(ring @ normals.T, -1, 1)).min(axis=1))

    # normals of the finest spacing, 8.6 deg, leave gaps of up to 5 deg; those that were planned, 17 deg apart, of 10
    assert gaps(40).max() < 6
    assert gaps(15).max() > 8
    assert performance.data.attrs["unresolved_edges"] > 0  # the step is steeper than the finest spacing


def test_nothing_is_added_where_nothing_changes(tmp_path, planned, no_map):
    def flat(distance, normals):
        return np.full(distance.shape, 0.6), np.full(distance.shape, 0.3)

    # "changes" is a difference that noise alone makes in a few of a hundred pairs: hence several seeds
    added, planned_captures, unresolved = [], 0, 0
    for seed in range(1, 5):
        plan = planned(refine={}, seed=seed)
        performance = run_campaign(plan, known_source(flat), tmp_path / str(seed))
        count = len(plan.file.normals()) * len(plan.series)
        added.append(performance.data.attrs["captures"] - count)
        planned_captures += count
        unresolved += performance.data.attrs["unresolved_edges"]
    assert sum(count == 0 for count in added) >= 3
    assert sum(added) < 0.08 * planned_captures
    assert unresolved <= 2


def test_what_a_stage_cannot_reach_is_left_out_and_listed(tmp_path, planned, capsys):
    axes = [
        {"name": "pan", "direction": [0, 1, 0], "limits_deg": [-30, 30]},
        {"name": "tilt", "direction": [1, 0, 0], "limits_deg": [-90, 90]},
    ]
    plan = planned(stage={"axes": axes})
    performance = run_campaign(plan, known_source(smooth), tmp_path)
    normals = plan.file.normals()
    beyond = np.abs(np.degrees(np.arctan2(normals[:, 0], normals[:, 2]))) > 30
    assert 0 < beyond.sum() < len(normals)
    assert performance.data.attrs["unreachable_orientations"] == beyond.sum()
    listed = np.loadtxt(tmp_path / "unreachable.csv", delimiter=",", skiprows=1)
    assert np.allclose(listed[:, :2], normals[beyond][:, :2], atol=1e-6)
    assert f"{beyond.sum()} of {len(normals)} orientations are beyond the stage" in capsys.readouterr().err
    assert performance.data.attrs["captures"] == (~beyond).sum() * len(plan.series)
    fixed = planned(stage={"axes": [{"name": "pan", "direction": [0, 1, 0], "limits_deg": [70, 80]}]})
    with pytest.raises(InputError, match="exclude all"):
        run_campaign(fixed, known_source(smooth), tmp_path / "none")


def test_where_the_map_ends_is_told(planned):
    for limit, subdivisions, told in ((40, 2, "31.7 deg off"), (65, 2, "63.4 deg off"), (64, 2, ""), (60, 3, "")):
        bands = [{"up_to_deg": 10, "subdivisions": 2}, {"up_to_deg": limit, "subdivisions": subdivisions}]
        words = planned(orientations=bands).file.edge_in_words()
        assert len(words) == bool(told) and all(told in word and f"up_to_deg = {limit}:" in word for word in words)


def test_every_file_that_is_truncated_or_edited_is_named(tmp_path, planned):
    plan = planned(distances_mm=[500], orientations=[{"up_to_deg": 30, "subdivisions": 0}])
    run_campaign(plan, known_source(smooth), tmp_path)
    files = [file for file in (tmp_path / "coupons").rglob("*") if file.is_file()]
    assert len(files) == 2 * plan.file.normals().shape[0] * len(plan.series)
    for file in files:
        data = file.read_bytes()
        middle = len(data) // 2
        for damaged in (data[:middle], b"", data[:middle] + bytes([data[middle] ^ 1]) + data[middle + 1 :]):
            file.write_bytes(damaged)
            with pytest.raises(InputError) as caught:
                run_campaign(plan, known_source(smooth), tmp_path)
            assert str(file) in str(caught.value)
            assert "remove this folder" in str(caught.value)
        file.unlink()
        with pytest.raises(InputError, match="no such file"):
            run_campaign(plan, known_source(smooth), tmp_path)
        file.write_bytes(data)
    run_campaign(plan, known_source(smooth), tmp_path)


def test_an_edited_number_in_a_shot_is_found(tmp_path, planned):
    """A well-formed edit: only the checksum tells."""
    plan = planned(distances_mm=[500], orientations=[{"up_to_deg": 30, "subdivisions": 0}])
    run_campaign(plan, known_source(smooth), tmp_path)
    file = next((tmp_path / "coupons").rglob("shot.json"))
    table = json.loads(file.read_text())
    file.write_text(json.dumps({**table, "seed": table["seed"] + 1}))
    with pytest.raises(InputError, match="checksum"):
        run_campaign(plan, known_source(smooth), tmp_path)


def test_a_full_disk_loses_nothing(tmp_path, planned, monkeypatch):
    plan, taken, calls = planned(distances_mm=[500], samples=WHITE), [], []
    source, write = counting(known_source(smooth), taken), atomic_io._write_synced

    def full(file, data):
        calls.append(file)
        if len(calls) > 15:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        write(file, data)

    monkeypatch.setattr(atomic_io, "_write_synced", full)
    with pytest.raises(MissingEnvironmentError, match="No space left"):
        run_campaign(plan, source, tmp_path)
    monkeypatch.undo()
    kept = len(list((tmp_path / "coupons").glob("*/*")))
    assert kept == 7  # two files each
    run_campaign(plan, source, tmp_path)
    run_campaign(plan, known_source(smooth), tmp_path / "whole")
    assert result(tmp_path) == result(tmp_path / "whole")


def test_a_campaign_that_is_killed_goes_on_and_ends_the_same(tmp_path, scenes):
    """Four kills here; tests/benchmarks/kills.py does fifty."""
    text = (
        "distances_mm = [500]\norientations = [{ up_to_deg = 40, subdivisions = 1 }]\n"
        "refine = { sigma = 0.2, subdivisions = 2 }\n"
        f"samples = [{{ scene = '{(scenes / 'coupon/matt_white.xml').as_posix()}' }}]\n"
    )
    (tmp_path / "campaign.toml").write_text(text)
    command = [Path(__file__).with_name("known_clouds.py"), tmp_path / "campaign.toml"]
    assert QuickProcess(*command, tmp_path / "whole").wait()[0] == 0
    rng, kept = np.random.default_rng(5), tmp_path / "killed/coupons"
    counts = []
    for _ in range(4):
        running = QuickProcess(*command, tmp_path / "killed", "0.05")
        before = len(list(kept.glob("*/[+-]*")))
        deadline = time.monotonic() + 60
        while len(list(kept.glob("*/[+-]*"))) < before + 1 and running.running and time.monotonic() < deadline:
            time.sleep(0.01)
        time.sleep(rng.uniform(0, 0.2))
        running.kill()
        counts.append(len(list(kept.glob("*/[+-]*"))))
    assert counts[0] > 0
    assert counts == sorted(counts)
    assert QuickProcess(*command, tmp_path / "killed").wait()[0] == 0
    assert result(tmp_path / "killed") == result(tmp_path / "whole")
    assert not list(kept.rglob(".*partial*"))


def test_the_map_knows_how_it_was_made(tmp_path, planned):
    plan = planned(distances_mm=[500])
    attributes = run_campaign(plan, known_source(smooth), tmp_path).data.attrs
    assert attributes["sensor"] == "ensenso-n10"
    assert attributes["source"] == "simulated"
    assert attributes["captures"] == len(plan.series) * len(plan.file.normals())
    patches = xr.load_dataset(tmp_path / "samples.nc")
    assert set(np.unique(patches["sample_number"])) == {0, 1}
    assert patches["orientation"].max() == len(plan.file.normals()) - 1
    assert math.isnan(patches["roughness"].values[0])
