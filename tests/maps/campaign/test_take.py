"""Where a campaign's captures come from: rendered, or found in a folder."""

import json
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from typer.testing import CliRunner

from characterisation.files.errors import InputError
from mitsim.capture.folder import read_capture, write_capture
from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.decoding.cloud import capture_geometry
from mitsim.maps.campaign import store
from mitsim.maps.campaign.acquire import (
    NAMED,
    check_directions,
    found_shots,
    found_source,
    in_turn,
    measured,
    out_of_range,
    simulated_source,
)
from mitsim.maps.campaign.plan import covering
from mitsim.maps.campaign.run import measure_captures, run_campaign
from mitsim.maps.campaign.store import shot_folder
from mitsim.sensor.preset import load_sensor, presets
from mitsim.sensor.transforms import Transform
from tests.smaller_sensors import coarse_sensor


@pytest.fixture(scope="module")
def sensor_file(tmp_path_factory):
    """The sensor file of an N10 with a quarter of the pixels."""
    return coarse_sensor("ensenso-n10", 2, tmp_path_factory.mktemp("sensor"))


@pytest.fixture(scope="module")
def kept(tmp_path_factory, scenes, sensor_file):
    """A rendered campaign that keeps its images, in a folder."""
    from mitsim.maps.campaign.campaign_file import CampaignFile
    from mitsim.maps.campaign.plan import plan_campaign

    file = CampaignFile.model_validate(
        {
            "distances_mm": [500],
            "samples_per_pixel": 1,
            "samples": [{"scene": "matt_white.xml"}, {"scene": "coupon.xml", "parameters": {"Ra": 0.37}}],
            "orientations": [{"up_to_deg": 35, "subdivisions": 1}],
            "keep_images": True,
        }
    )
    sensor = load_sensor(sensor_file)
    plan = plan_campaign(scenes / "coupon/campaign.toml", file, sensor)
    folder = tmp_path_factory.mktemp("kept")
    run_campaign(plan, in_turn(simulated_source(SimulatedSensor(sensor), 1), plan), folder)
    return plan, folder


def test_captures_that_were_kept_measure_the_same(tmp_path, kept):
    """The campaign cannot know whether a capture is made now or was found in a folder."""
    plan, folder = kept
    found = found_shots(folder, plan)
    assert len(found) == len(plan.series) * len(plan.file.normals())
    again = measure_captures(plan, list(found.values()), in_turn(found_source(found), plan), tmp_path)
    assert again.data.attrs["source"] == "simulated"
    first, second = (xr.load_dataset(where / "samples.nc") for where in (folder, tmp_path))
    columns = ["sample_number", "distance", "normal_x", "normal_y"]
    order = [np.lexsort([np.round(table[name].values, 6) for name in columns]) for table in (first, second)]
    for name in first.data_vars:
        if name != "orientation":
            values = [table[name].values[by] for table, by in zip((first, second), order, strict=True)]
            # the pose went through a file and an inverse: 1e-12 of it is lost
            assert np.allclose(*values, rtol=1e-6, atol=1e-9, equal_nan=True), name


@pytest.mark.parametrize(("near", "far"), [(200, 400), (700, 950)])
def test_coupons_out_of_the_decoders_range_are_told(kept, near, far):
    """By the poses of the captures: 500 mm from the sensor, less by the tilt of the rectified axis, 1 % at most."""
    plan, folder = kept
    found = found_shots(folder, plan)
    assert out_of_range(plan, found) == []
    assert out_of_range(plan) == []
    matcher = plan.sensor.settings.model_copy(update={"near_mm": near, "far_mm": far})
    other = replace(plan, sensor=replace(plan.sensor, matcher=matcher))
    *lines, rest = out_of_range(other, found)
    assert len(lines) == NAMED and rest == (
        f"warning: and {len(found) - NAMED} of {len(found)} more are outside the range"
    )
    assert lines[0].startswith(f"warning: {next(iter(found))}: the coupon is at a depth of 4")
    assert lines[0].endswith(
        f"(by its pose), but the decoder searches {near} to {far} mm: change near_mm and far_mm in [matcher] of the "
        "sensor file of ensenso-n10"
    )
    planned = out_of_range(other)
    assert len(planned) == 2 and "at 500 mm: the coupon" in planned[0] and "(by the plan)" in planned[0]


def test_characterise_warns_before_it_measures(tmp_path, kept, scenes, sensor_file):
    from mitsim.cli.program import app

    _, folder = kept
    text = re.sub(r"(?m)^near_mm = \d+", "near_mm = 700", sensor_file.read_text())
    other = sensor_file.with_name("n10.toml")  # beside the calibration that it names
    other.write_text(text)
    (tmp_path / "campaign.toml").write_text(
        f"""distances_mm = [500]
samples_per_pixel = 1
orientations = [{{ up_to_deg = 35, subdivisions = 1 }}]
[[samples]]
scene = '{scenes / "coupon/matt_white.xml"}'
[[samples]]
scene = '{scenes / "coupon/coupon.xml"}'
parameters = {{ Ra = 0.37 }}
"""
    )
    call = [
        "map",
        "make",
        str(tmp_path / "campaign.toml"),
        "--sensor",
        str(other),
        "--captures",
        str(folder),
        "-o",
        str(tmp_path / "out"),
    ]
    done = CliRunner().invoke(app, call)
    warned = [line for line in done.stderr.splitlines() if line.startswith("warning: ")]
    assert len(warned) == NAMED + 1, done.output
    assert "the decoder searches 700 to 950 mm" in warned[0]


def altered(kept, tmp_path, change):
    """A folder with one of the captures, changed."""
    plan, folder = kept
    capture = read_capture(next(iter(found_shots(folder, plan))))
    write_capture(change(capture), tmp_path / "found")
    return plan, tmp_path / "found"


@pytest.mark.parametrize(
    ("change", "field"),
    [
        (lambda c: replace(c, sensor="ensenso-n35"), "sensor"),
        (lambda c: replace(c, settings={}), "coupon.sample"),
        (lambda c: replace(c, settings={"coupon": {"sample": "brass"}}), "coupon.sample"),
        (lambda c: replace(c, world_from_sensor=None), "world_from_sensor"),
        (
            lambda c: replace(c, world_from_sensor=replace(c.world_from_sensor, translation=np.array([0, 0, 700.0]))),
            "distance",
        ),
        (lambda c: replace(c, world_from_sensor=Transform(np.eye(3), np.array([0, 0, -500.0]))), "world_from_sensor"),
    ],
)
def test_a_capture_that_cannot_be_placed_is_named(kept, tmp_path, change, field):
    plan, folder = altered(kept, tmp_path, change)
    with pytest.raises(InputError) as caught:
        found_shots(folder, plan)
    assert caught.value.field == field
    assert str(folder) in str(caught.value)


def test_an_empty_folder_is_told(kept, tmp_path):
    with pytest.raises(InputError, match="no captures"):
        found_shots(tmp_path, kept[0])


def test_a_shot_with_images_is_checked_file_by_file(kept, tmp_path):
    plan, folder = kept
    shutil.copytree(folder, tmp_path / "copy")
    image = next((tmp_path / "copy/coupons").rglob("*.png"))
    image.write_bytes(image.read_bytes()[:-10])
    with pytest.raises(InputError) as caught:
        run_campaign(plan, in_turn(lambda shot: pytest.fail("taken again"), plan), tmp_path / "copy")
    assert str(image) in str(caught.value)
    shot = json.loads(next(iter((tmp_path / "copy/coupons").rglob("shot.json"))).read_text())
    assert any(name.startswith("capture/images/") for name in shot["files"])


def test_every_file_of_every_capture_is_named_when_it_is_truncated(kept, tmp_path):
    plan, folder = kept
    captures = tmp_path / "coupons"
    shutil.copytree(folder / "coupons", captures)
    shots = [plan.shot(series, normal) for series in plan.series for normal in plan.file.normals()]
    tried = 0
    for shot in shots:
        for file in [path for path in shot_folder(captures, shot).rglob("*") if path.is_file()]:
            data = file.read_bytes()
            for length in (0, len(data) // 2, len(data) - 2):  # shot.json ends in a line feed that says nothing
                file.write_bytes(data[:length])
                with pytest.raises(InputError) as caught:
                    store.read_shot(captures, shot)
                assert caught.value.where == str(file)
                tried += 1
            file.write_bytes(data)
        assert store.read_shot(captures, shot) is not None
    assert tried == 3 * len([path for path in captures.rglob("*") if path.is_file()]) > 3 * 7 * len(shots)


@pytest.mark.parametrize("name", presets())
def test_distances_that_nobody_named_cover_the_range(name):
    sensor = load_sensor(name)
    near, far = sensor.working_range_mm
    distances = np.array(covering(sensor))
    assert distances[0] == pytest.approx(near, rel=1e-3)
    assert distances[-1] == pytest.approx(far, rel=1e-3)
    assert (distances[1:] / distances[:-1]).max() <= 1.6 * 1.001


def test_two_captures_of_one_pose_are_refused(tmp_path, kept):
    """The last was measured twice, and the map counted it as two."""
    plan, folder = kept
    place = next(iter(found_shots(folder, plan)))
    for name in ("0", "1"):
        shutil.copytree(place, tmp_path / name)
    with pytest.raises(InputError, match="found the orientation of"):
        found_shots(tmp_path, plan)


@pytest.mark.parametrize(
    ("turn", "shift", "told"),
    [
        ((0, 0, 0), 0.0, False),
        ((10, 0, 0), 0.0, True),
        ((0, 9, 0), 0.0, True),
        ((0, 0, 30), 0.0, False),
        ((0, 0, 0), 20.0, True),
        ((2, 0, 0), 1.0, False),
    ],
)
def test_a_pose_that_contradicts_the_points_is_told(kept, capfd, turn, shift, told):
    """With all poses turned by 10 deg the map was 10 deg wrong; with all 20 mm too near, F was 0. Both in silence."""
    plan, folder = kept
    shots = found_shots(folder, plan)
    place, shot = min(shots.items(), key=lambda one: -one[1].normal[2])
    capture = read_capture(place)
    moved = Transform.from_degrees(turn, (0.0, 0.0, shift)) @ capture.world_from_sensor
    capture = replace(capture, source="device", world_from_sensor=moved)
    measured(capture, shot, capture_geometry(capture, plan.sensor.settings), plan.sensor, False)
    assert ("from the coupon at its pose: check the pose" in capfd.readouterr().err) == told


def said_of(plan, place, shot, capfd, pose):
    capture = replace(read_capture(place), source="device", world_from_sensor=pose)
    measured(capture, shot, capture_geometry(capture, plan.sensor.settings), plan.sensor, False)
    return capfd.readouterr().err


def test_poses_of_the_inverse_direction_are_told(kept, capfd):
    """Before, a tilt of 32 deg gave no patch, or F = 0, in silence. The pose without a tilt is its own inverse."""
    plan, folder = kept
    shots = {place: shot for place, shot in found_shots(folder, plan).items() if "white" in shot.series.sample.finish}
    assert len(shots) > 5
    for place, shot in shots.items():
        pose = read_capture(place).world_from_sensor
        assert said_of(plan, place, shot, capfd, pose) == ""
        told = "if its pose is inverted" in said_of(plan, place, shot, capfd, pose.inverse())
        assert told == (shot.normal[2] < 0.99)


@pytest.mark.parametrize("inverted", ["all", "none", "one"])
def test_a_campaign_of_inverted_poses_is_refused(kept, tmp_path, inverted):
    """One of many is told as it is measured."""
    plan, folder = kept
    for number, place in enumerate(sorted(found_shots(folder, plan))):
        capture = read_capture(place)
        wrong = inverted == "all" or (inverted == "one" and number == 1)
        pose = capture.world_from_sensor.inverse() if wrong else capture.world_from_sensor
        write_capture(replace(capture, source="device", world_from_sensor=pose), tmp_path / str(number))
    found = found_shots(tmp_path, plan)
    if inverted == "all":
        with pytest.raises(
            InputError, match=r"pose.json: world_from_sensor: found poses that fit .*only if .* inverted"
        ):
            check_directions(plan, found)
    else:
        check_directions(plan, found)


@pytest.mark.parametrize("turn", [(0, 60, 0), (0, 180, 0), (90, 0, 0)])
def test_a_coupon_out_of_the_image_is_told(kept, capfd, turn):
    plan, folder = kept
    place, shot = next(iter(found_shots(folder, plan).items()))
    pose = read_capture(place).world_from_sensor @ Transform.from_degrees(turn, (0.0, 0.0, 0.0))
    assert "the coupon at its pose is outside the image" in said_of(plan, place, shot, capfd, pose)


def test_a_capture_that_was_taken_again_is_measured_again(tmp_path, kept):
    """The same pose and another image, in the folder of the former; a capture that is the same is not read again."""
    plan, folder = kept
    place = next(place for place, shot in found_shots(folder, plan).items() if "white" in shot.series.sample.finish)
    capture = read_capture(place)
    read, fractions = [], []
    for darker in (1, 1, 64):
        images = {name: stack // darker for name, stack in capture.images.items()}
        write_capture(replace(capture, images=images), tmp_path / "captures/one", overwrite=True)
        (shot,) = found_shots(tmp_path / "captures", plan).values()

        def take(shot):
            read.append(darker)  # noqa: B023 - called in this turn
            return found_source({tmp_path / "captures/one": shot})(shot)

        measure_captures(plan, [shot], in_turn(take, plan), tmp_path / "map")
        fractions.append(store.read_shot(tmp_path / "map/coupons", shot).patches["recovered_fraction"].values.mean())
    assert read == [1, 64]
    assert fractions[0] == fractions[1] > 0.9 > fractions[2]
