"""From a fitted sensor file to a report in one command: the steps, their times, and what stops them before the fit."""

import pytest

from characterisation.files.errors import InputError
from mitsim.cli.fit_journey import map_and_run, read_journey
from mitsim.cli.options import asking
from mitsim.scene import backend
from tests.shell import ROOT
from tests.small_study import few_measurements, small_study
from tests.smaller_sensors import coarse_sensor

CAMPAIGN = """
distances_mm = [400, 900]
coupon_px = 60
samples_per_pixel = 1
orientations = [{{ up_to_deg = 75, subdivisions = 0 }}]
[[samples]]
scene = "{coupon}/matt_white.xml"
[[samples]]
scene = "{coupon}/coupon.xml"
parameters = {{ Ra = 0.74 }}
[[samples]]
scene = "{coupon}/coupon.xml"
parameters = {{ Ra = 0.37 }}
"""


@pytest.fixture
def files(tmp_path):
    (tmp_path / "task.toml").write_text(few_measurements(), encoding="utf-8")
    study = small_study("{ plane_Ra = 0.37, pillar_Ra = 0.74 }", task=tmp_path / "task.toml")
    (tmp_path / "study.toml").write_text(study, encoding="utf-8")
    text = CAMPAIGN.format(coupon=(ROOT / "scenes" / "coupon").as_posix())
    (tmp_path / "campaign.toml").write_text(text, encoding="utf-8")
    return tmp_path


def test_map_and_report_follow_the_sensor_file(files, capsys):
    backend.activate()
    sensor = coarse_sensor("ensenso-n10", 4, files)
    journey = read_journey(files / "study.toml", files / "campaign.toml", sensor, 0.1, asking(True))
    map_and_run(journey, sensor)
    told = capsys.readouterr().err
    assert "step 2 of 3: the map, " in told and " captures of about " in told
    assert f"step 3 of 3: run {files / 'study.toml'}, at most 0.1 min" in told
    assert (journey.folder / "map" / "map.nc").is_file()
    assert (journey.folder / "run" / "report.html").is_file()


def test_what_stops_a_journey_is_said_before_the_fit(files):
    with pytest.raises(InputError, match=r"--campaign.*study\.toml names none"):
        read_journey(files / "study.toml", None, files / "a.toml", None, None)
    with pytest.raises(InputError, match="no such file"):
        read_journey(files / "study.toml", files / "none.toml", files / "a.toml", None, None)
    (files / "study.toml").write_text("scene = 3\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"study\.toml"):
        read_journey(files / "study.toml", files / "campaign.toml", files / "a.toml", None, None)
