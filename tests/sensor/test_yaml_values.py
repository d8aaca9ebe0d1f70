"""YAML of any program: read as PyYAML does where both agree on the type, bounded, and refused in words."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from characterisation.files.errors import InputError
from mitsim.sensor.yaml_values import DEEPEST, read_yaml

FILE = Path("a.yaml")
NAMES = st.text(st.characters(codec="utf-8", categories=["L", "N"]), min_size=1, max_size=8)
VALUES = st.recursive(
    st.floats(allow_nan=False) | st.integers(-(10**17), 10**17) | st.booleans() | st.none() | NAMES,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(NAMES, inner, max_size=4),
    max_leaves=20,
)


def read(text):
    return read_yaml(FILE, text.encode(), "YAML")


@settings(max_examples=60, deadline=None)
@given(st.dictionaries(NAMES, VALUES, min_size=1, max_size=5), st.sampled_from([None, False, True]))
def test_what_python_dumps_is_read(table, flow):
    """Sequences stand at their key's indentation, as in ``yaml.dump`` by default."""
    text = yaml.dump(table, default_flow_style=flow, allow_unicode=True, sort_keys=False)
    assert read(text) == [table]


def test_sequences_at_the_indentation_of_their_key():
    assert read("K:\n- [1.0, 0]\n- [0, 2]\nd:\n- 3\n") == [{"K": [[1.0, 0], [0, 2]], "d": [3]}]


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e-05", 1e-5),
        ("-.Inf", -np.inf),
        ("+2.", 2.0),
        ("on", "on"),
        ("12:30", "12:30"),
        ("2020-01-01", "2020-01-01"),
        ("'3'", "3"),
        ("!!float '3'", 3),
        ("!!python/tuple [1, 2]", [1, 2]),
        ("~", None),
        ("True", True),
    ],
)
def test_types_are_those_of_yaml_1_2(text, value):
    found = read(f"1e3: {text}\n")[0]["1e3"]
    assert found == value and type(found) is type(value)
    assert np.isnan(read("a: .Nan")[0]["a"])


@pytest.mark.parametrize("flags", [0, cv2.FILE_STORAGE_FORMAT_YAML])
def test_the_dialect_of_opencv_has_the_numbers_that_opencv_reads(tmp_path, flags):
    path = tmp_path / "a.yml"
    rng = np.random.default_rng(1)
    written = {"K": rng.normal(size=(3, 3)), "single": np.float32([[1 / 3]]), "channels": rng.normal(size=(2, 3, 2))}
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE | flags)
    for name, value in written.items():
        storage.write(name, value)
    storage.write("text", 'a: "b" # c')
    storage.release()
    (found,) = read_yaml(path, path.read_bytes(), "YAML")
    assert found.pop("text") == 'a: "b" # c'
    for name, value in written.items():
        np.testing.assert_array_equal(found[name], value)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("a: 1\nb: 2\na: 3\n", "a: found the key twice in the map of line 1"),
        ("a: [1\n", "not YAML .*line 2"),
        ("a: " + "[" * (DEEPEST + 1) + "]" * (DEEPEST + 1), "nested over"),
        ("a: &a [*a]", "alias of an unknown value"),
        ("a: &a0 [1, 1]\n" + "".join(f"b{k}: &a{k + 1} [*a{k}, *a{k}]\n" for k in range(40)), "values; allowed: up to"),
        ("- 1\n", "without names"),
        ("!!opencv-matrix {rows: 1, cols: 2, dt: d, data: [1.0, 2.0]}\n", "without names"),
        ("", "nothing in it"),
    ],
)
def test_what_is_refused(text, told):
    with pytest.raises(InputError, match=told):
        read(text)


def test_documents_and_merged_maps():
    assert read("a: &x {b: 1}\nc:\n  <<: *x\n  d: 2\n---\na: 3\n...\n") == [
        {"a": {"b": 1}, "c": {"b": 1, "d": 2}},
        {"a": 3},
    ]
