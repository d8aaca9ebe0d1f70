"""A sensor that was fitted to a capture says so wherever it is judged against this capture."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from characterisation.files.errors import InputError
from mitsim.sensor.fitted_to import FittedCapture, images_digest, recorded_in, records_of, shows_the_fit
from mitsim.sensor.preset import load_sensor
from mitsim.sensor.sensor_text import sensor_checksum
from mitsim.twin.sensor.run import sensor_path

IMAGES = {"left": np.arange(24, dtype=np.uint8).reshape(2, 3, 4), "right": np.zeros((2, 3, 4), np.uint8)}


def test_the_digest_is_that_of_the_grey_levels():
    assert images_digest(IMAGES) == images_digest({"a": IMAGES["left"].copy(), "b": IMAGES["right"].copy()})
    changed = IMAGES["left"].copy()
    changed[1, 2, 3] += 1
    others = [IMAGES | {"left": changed}, IMAGES | {"left": IMAGES["left"].reshape(2, 4, 3)}]
    others += [{"left": IMAGES["left"]}, dict(reversed(IMAGES.items()))]
    assert images_digest(IMAGES) not in [images_digest(other) for other in others]


def test_a_sensor_file_lists_its_captures_and_only_these_are_told(tmp_path):
    digest = images_digest(IMAGES)
    text = sensor_path("zivid-2-m70").read_text(encoding="utf-8")
    listed = f'fitted_to = [{{ name = "captures/sheet", images_sha256 = "{digest}" }}]\n'
    (tmp_path / "mine.toml").write_text(listed + text, encoding="utf-8")
    mine = load_sensor(tmp_path / "mine.toml")
    assert mine.fitted_to == (FittedCapture(name="captures/sheet", images_sha256=digest),)
    assert "captures/sheet" in shows_the_fit(mine.fitted_to, IMAGES, "mine")
    assert shows_the_fit(mine.fitted_to, {"left": IMAGES["right"]}, "mine") == ""
    assert shows_the_fit((), IMAGES, "mine") == ""
    # maps and kept trials of a file without the list stay valid
    assert sensor_checksum(mine) == sensor_checksum(replace(mine, fitted_to=()))
    assert recorded_in(records_of(mine.fitted_to), "settings.json") == mine.fitted_to
    assert records_of(()) == {} and recorded_in({"seed": 1}, "settings.json") == ()


@pytest.mark.parametrize("wrong", [3, "x", [{}], [{"name": "a", "images_sha256": "short"}], {"name": "a"}])
def test_another_form_is_one_message(wrong):
    with pytest.raises(InputError, match="fitted_to"):
        recorded_in({"fitted_to": wrong}, "settings.json")
