"""A capture from a user's own sensor file keeps its decoder's settings: it decodes alike with and without the file."""

from __future__ import annotations

import json
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError

from characterisation.cloud_files import read_cloud
from characterisation.files.documents import fields_of
from characterisation.files.errors import InputError
from mitsim.capture.capture import Capture
from mitsim.capture.decoding import SETTINGS_OF, read_settings
from mitsim.capture.folder import read_capture, write_capture
from mitsim.capture.simulated.rendering import Rendering
from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.cli.decode import decode
from mitsim.decoding.cloud import decoder_settings
from mitsim.decoding.decoder_registry import technology_of
from mitsim.scene.load import load_scene
from mitsim.sensor.imager import WrittenImager
from mitsim.sensor.preset import load_sensor, presets
from mitsim.sensor.sensor_file import ImagerTable
from mitsim.sensor.transforms import look_at

ROOT = Path(__file__).parents[2]
PRESETS = ROOT / "mitsim/sensor/presets"

#: file that an own sensor is made of, changes of its text, and the table of its decoder in the sensor file
OWN = {
    "structured_light": (
        ROOT / "tests/data/fringes.toml",
        {"far_mm = 900": "far_mm = 590\nminimum_modulation_dn = 30.0\nconsistency_sigma = 1.5"},
        "decoder",
    ),
    "active_stereo": (
        PRESETS / "ensenso-n10.toml",
        {'name = "ensenso-n10"': 'name = "mine"', "block_size": "uniqueness_percent = 30\nblock_size"},
        "matcher",
    ),
    "time_of_flight": (
        PRESETS / "kinect-v2.toml",
        {'name = "kinect-v2"': 'name = "mine"', "minimum_amplitude_dn = 0.15": "minimum_amplitude_dn = 45.0"},
        "demodulation",
    ),
}


class Taken:
    """A capture folder of an own sensor, and the sensor's file."""

    def __init__(self, technology: str, folder: Path) -> None:
        source, changes, self.table = OWN[technology]
        text = source.read_text(encoding="utf-8")
        if technology == "active_stereo":
            text = "\n".join(line for line in text.splitlines() if not line.startswith("uniqueness_percent"))
        for old, new in changes.items():
            assert text.count(old) == 1, old
            text = text.replace(old, new)
        self.file, self.folder = folder / "mine.toml", folder / "capture"
        self.file.write_text(text, encoding="utf-8")
        self.sensor = load_sensor(self.file)
        self.given = tomllib.loads(text)[self.table]
        assert self.sensor.name not in presets()
        scene = load_scene(ROOT / "scenes/coupon/matt_white.xml", self.sensor.wavelength_nm)
        pose = look_at([150, -100, 560], [0, 0, 0], [0, 1, 0])
        coupon = pose.inverse().points(60.0 * np.array([[a, b, 0] for a in (-1, 1) for b in (-1, 1)]))
        capture = SimulatedSensor(self.sensor).capture(
            scene, pose, rendering=Rendering(samples=1), seed=4, around=coupon
        )
        write_capture(capture, self.folder)

    def cloud(self, name: str, sensor: str | None = None):
        decode(self.folder, self.folder.parent / name, sensor)
        return read_cloud(self.folder.parent / name)


@pytest.fixture(scope="module", params=OWN)
def taken(request, tmp_path_factory):
    return Taken(request.param, tmp_path_factory.mktemp("own"))


def with_settings(capture: Capture, **changed) -> Capture:
    """The capture with other settings; None leaves one out."""
    return replace(capture, decoding=capture.decoding.model_copy(update=changed))


def test_the_cloud_is_the_same_with_and_without_the_sensor_file(taken, capsys):
    without, with_file = taken.cloud("without.ply"), taken.cloud("with.ply", str(taken.file))
    assert "default settings" not in capsys.readouterr().err
    assert without.points.tobytes() == with_file.points.tobytes()
    assert without.status.tobytes() == with_file.status.tobytes()
    assert (without.sigma is None) == (with_file.sigma is None)
    if with_file.sigma is not None:
        assert without.sigma.tobytes() == with_file.sigma.tobytes()
    # the settings of the file matter: with the technology's own, as it was, the cloud is another
    default = replace(read_capture(taken.folder), sensor="of an earlier mitsim")
    old = taken.folder.parent / "old"
    write_capture(with_settings(default, decoder=None, imager=None), old, overwrite=True)
    decode(old, taken.folder.parent / "old.ply")
    assert "; default settings, since settings.json has none" in capsys.readouterr().err
    other = read_cloud(taken.folder.parent / "old.ply")
    assert 1000 < with_file.valid.sum() != other.valid.sum()


def test_the_folder_keeps_what_the_file_says(taken):
    kept = json.loads((taken.folder / "settings.json").read_text())
    assert {key: kept["decoder"][key] for key in taken.given} == taken.given
    settings, imager = decoder_settings(read_capture(taken.folder))
    assert (settings, imager) == (taken.sensor.settings, taken.sensor.imager)


def test_a_file_that_bears_a_presets_name_is_decoded_with_its_own_settings(taken):
    """The capture's own settings come before those of the preset of its name."""
    named = {"structured_light": "zivid-2-m70", "active_stereo": "ensenso-n10", "time_of_flight": "kinect-v2"}
    capture = replace(read_capture(taken.folder), sensor=named[taken.sensor.technology])
    assert decoder_settings(capture)[0] == taken.sensor.settings
    assert decoder_settings(with_settings(capture, decoder=None))[0] == load_sensor(capture.sensor).settings


def test_an_old_folder_still_loads(taken):
    old = with_settings(read_capture(taken.folder), decoder=None, imager=None)
    kind = technology_of(old.technology)
    settings, imager = decoder_settings(old)
    assert isinstance(settings, SETTINGS_OF[old.technology])
    assert (settings.near_mm, settings.far_mm, imager) == (*kind.range_mm, None)
    # a folder of an import has decoder settings and no imager
    assert decoder_settings(with_settings(read_capture(taken.folder), imager=None)) == (taken.sensor.settings, None)


@pytest.mark.parametrize(
    ("key", "value", "told"),
    [
        ("decoder", {"far_mm": "far"}, r"decoder\.far_mm: found 'far'"),
        ("decoder", {"far_mm": 1.0}, r"decoder\.near_mm: .*near_mm under far_mm"),
        ("decoder", {"colour": 1}, r"decoder\.colour"),
        ("decoder", {"far_mm": float("nan")}, r"decoder\.far_mm"),
        ("imager", {"full_well_e": 0}, r"imager\.full_well_e: found 0"),
        ("imager", {"f_number": "2.8 or so"}, r"imager\.f_number"),
    ],
)
def test_a_bad_value_is_an_error_that_names_file_and_field(taken, key, value, told):
    written = json.loads((taken.folder / "settings.json").read_text())
    for bad, words in ((written[key] | value, told), (5, key)):
        with pytest.raises(InputError, match=rf"settings\.json: {words}"):
            read_settings("settings.json", written | {key: bad}, taken.sensor.technology)


def test_settings_of_another_technology_are_an_error(taken):
    capture = read_capture(taken.folder)
    other = {"active_stereo": "structured_light"}.get(capture.technology, "active_stereo")
    with pytest.raises(InputError, match=r"settings\.json: decoder"):
        decoder_settings(replace(capture, technology=other))


@pytest.mark.parametrize("name", presets())
def test_an_imager_comes_back_from_its_table(name):
    imager = load_sensor(name).imager
    table = json.loads(json.dumps(TypeAdapter(WrittenImager).dump_python(imager, mode="json", by_alias=True)))
    assert TypeAdapter(WrittenImager).validate_python(table) == imager
    assert set(table) == set(fields_of(ImagerTable)) - {"focus_mm"}
    for key in ("pixel_um", "full_well_e"):
        with pytest.raises(ValidationError, match=f"a value of each of imager.{key}"):
            TypeAdapter(WrittenImager).validate_python({name: table[name] for name in table if name != key})
