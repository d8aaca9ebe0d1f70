"""What decoding reads of a capture: written and read back alike for every technology, and refused where it is wrong."""

from __future__ import annotations

import json

import pytest

from characterisation.files.errors import InputError
from characterisation.region_of_interest import Roi
from mitsim.capture.decoding import SETTINGS_OF, Decoding, read_settings, settings_table
from mitsim.decoding.decoder_registry import TECHNOLOGIES
from mitsim.sensor.imager import Imager
from mitsim.sensor.light_code import GrayCode, PhaseShift
from mitsim.sensor.modulation import AmplitudeModulation
from mitsim.sensor.pattern import RandomDots

IMAGER = Imager(5.3, 0.6, 10000, 12.5, 1.0, 0.01, 12, 64.0, 4.0, gamma=1.8, corner_blur_px=0.7)
PATTERNS = {
    "active_stereo": RandomDots(kind="random_dots", run_length_px=5.0, bright_share=0.5, blur_px=0.9, seed=10),
    "structured_light": PhaseShift(kind="phase_shift", periods_px=[100, 16], steps=[3, 5]),
    "time_of_flight": AmplitudeModulation(kind="amplitude_modulation", frequencies_mhz=[16, 80]),
}
RECORDS = {"scene": "a.xml", "seed": 3, "noise": {"shot": True}}


def full(technology: str) -> Decoding:
    """Every value stated, none of them its default."""
    return Decoding(
        decoder=SETTINGS_OF[technology](near_mm=123.0, far_mm=456.5),
        imager=IMAGER,
        pattern=PATTERNS.get(technology, GrayCode(kind="gray_code")),
        projector_size_px=(1280, 720),
        exposure_s=(0.001, 0.1 + 0.2),
        black_level_dn=3.0,
        gamma=1.8,
        ambient_image=True,
        read_out={"left": Roi(1, 2, 30, 40)},
        near_mm=120.0,
        far_mm=460.0,
        range_mm=(130.0, 440.0),
    )


@pytest.mark.parametrize("technology", SETTINGS_OF)
@pytest.mark.parametrize("decoding", [full, lambda technology: Decoding()], ids=["all", "nothing"])
def test_what_is_written_is_read_back(technology, decoding):
    stated = decoding(technology)
    table = json.loads(json.dumps(settings_table(stated, RECORDS), allow_nan=False))
    assert read_settings("settings.json", table, technology) == (stated, RECORDS)


def test_only_what_is_stated_is_written():
    assert settings_table(Decoding(exposure_s=0.01), {"gain": 2}) == {"exposure_s": 0.01, "gain": 2}
    # of a decoder every value is kept, whatever later versions take as its default
    written = settings_table(full("active_stereo"), {})
    assert set(written) == set(Decoding.model_fields)
    assert set(written["decoder"]) == set(SETTINGS_OF["active_stereo"].model_fields)


def test_every_technology_has_settings_and_a_decoder():
    assert set(SETTINGS_OF) == set(TECHNOLOGIES)


@pytest.mark.parametrize(
    ("key", "value", "told"),
    [
        ("exposure_s", "auto", "exposure_s"),
        ("exposure_s", [], "exposure_s"),
        ("exposure_s", -1.0, "exposure_s"),
        ("read_out", {"left": [0, 0, 10]}, "left, top, width, height"),
        ("read_out", {"left": "all"}, "left, top, width, height"),
        ("read_out", {"left": [0, 0, 10, 10.5]}, "left, top, width, height"),
        ("pattern", {"kind": "grey_code"}, "gray_code"),
        ("projector_size_px", [8, 720], "projector_size_px"),
        ("imager", {"f_number": 2.8}, r"imager\.pixel_um"),
        ("range_mm", [0, 100], "range_mm"),
        ("gamma", 0, "gamma"),
        ("decoder", {"near_mm": 5.0, "far_mm": 4.0}, "near_mm under far_mm"),
        ("decoder", {"near_mm": 1.0, "far_mm": 4.0, "bit_share": 0.2}, r"decoder\.bit_share"),
    ],
)
def test_a_wrong_value_is_an_error_that_names_the_file_and_the_key(key, value, told):
    with pytest.raises(InputError, match=rf"settings\.json: {key}.*{told}|settings\.json: .*{told}"):
        read_settings("settings.json", {key: value}, "active_stereo")


def test_a_record_cannot_hide_what_decoding_reads():
    with pytest.raises(InputError, match=r"exposure_s.*Capture\.decoding"):
        settings_table(Decoding(), {"exposure_s": 0.1})


def test_an_unknown_technology_is_refused():
    with pytest.raises(InputError, match=r"sonar.*active_stereo"):
        read_settings("settings.json", {}, "sonar")
