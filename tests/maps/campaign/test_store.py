"""Tables of kept captures whose bytes were changed and signed again: each is refused in one message."""

import hashlib
import io
import json

import numpy as np
import pytest

from characterisation.files.checked_files import content_checksum
from characterisation.files.errors import InputError
from mitsim.maps.campaign.run import run_campaign
from tests.maps.campaign.known_clouds import known_source, smooth


@pytest.fixture
def stored(tmp_path, planned):
    """A campaign of a few shots, and how to run it again."""
    plan = planned(distances_mm=[500], orientations=[{"up_to_deg": 20, "subdivisions": 0}])

    def again():
        run_campaign(plan, known_source(smooth), tmp_path)

    again()
    return next((tmp_path / "coupons").rglob("patches.npy")), again


def signed(path, data):
    """Write a table as if mitsim had written it."""
    path.write_bytes(data)
    index = path.with_name("shot.json")
    table = json.loads(index.read_text())
    table["files"]["patches.npy"] = {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    index.write_text(json.dumps({**table, "checksum": content_checksum(table)}))


def with_header(header: str, body: bytes = b"") -> bytes:
    text = header.encode() + b"\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text + body


def saved(table) -> bytes:
    stream = io.BytesIO()
    np.save(stream, table)
    return stream.getvalue()


HEADERS = {
    "empty": b"",
    "no table": b"\x93NUMPY",
    "nested": with_header("[" * 9000),
    "code": with_header("{'descr': exit()}"),
    "digits": with_header("{'descr': '<f8', 'fortran_order': False, 'shape': (" + "9" * 5000 + ",)}"),
    "huge": with_header("{'descr': '<f8', 'fortran_order': False, 'shape': (10000000000000,)}"),
    "negative": with_header("{'descr': '<f8', 'fortran_order': False, 'shape': (-8,)}"),
    "long": with_header("{'descr': '<f8', 'fortran_order': False, 'shape': (0,)}" + " " * 50_000),
    "objects": with_header("{'descr': '|O', 'fortran_order': False, 'shape': (1,)}", b"\x80\x04K\x01."),
    "version": b"\x93NUMPY\x09\x00\x04\x00{}  ",
    "plain": saved(np.zeros(5)),
    "grid": saved(np.zeros((2, 2), "f8,f8")),
}


@pytest.mark.parametrize("name", HEADERS)
def test_a_header_that_makes_no_table_is_one_message(stored, name):
    path, again = stored
    signed(path, HEADERS[name])
    with pytest.raises(InputError) as caught:
        again()
    assert str(path) in str(caught.value) and len(str(caught.value)) < 1000


@pytest.mark.parametrize(
    ("column", "value", "told"),
    [
        ("distance", np.nan, "not numbers"),
        ("distance", -1.0, "1 to"),
        ("normal_x", 2.0, "-1 to 1"),
        ("recovered_fraction", np.inf, "0 to 1"),
        ("ray_noise_inliers", -0.1, "0 to"),
    ],
)
def test_a_number_that_cannot_be_names_its_column(stored, column, value, told):
    path, again = stored
    table = np.load(path)
    table[column][0] = value
    signed(path, saved(table))
    with pytest.raises(InputError, match=f"{column}.*{told}"):
        again()


def test_a_column_that_is_missing_or_is_no_number_is_named(stored):
    path, again = stored
    table = np.load(path)
    rest = [name for name in table.dtype.names if name != "points"]
    signed(path, saved(table[rest].copy()))
    with pytest.raises(InputError, match="points"):
        again()
    kinds = [(name, "U4" if name == "points" else table.dtype[name]) for name in table.dtype.names]
    signed(path, saved(table.astype(kinds)))
    with pytest.raises(InputError, match="columns of numbers"):
        again()
