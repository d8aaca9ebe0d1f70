"""Damaged MATLAB files are refused before SciPy's C code reads them; sound ones pass."""

from __future__ import annotations

import struct
import subprocess
import sys

import numpy as np
import pytest
import scipy.sparse
from scipy.io import savemat

from characterisation.files.errors import InputError
from mitsim.sensor.calibration_tree import read_tree
from mitsim.sensor.mat_structure import check_mat

READ = "import sys; from pathlib import Path; from mitsim.sensor.calibration_tree import read_tree; "
READ += "read_tree([Path(sys.argv[1])])"


def saved(path, **values):
    savemat(path, values)
    return bytearray(path.read_bytes())


@pytest.mark.parametrize("packed", [False, True])
def test_all_that_scipy_writes_is_read(tmp_path, packed):
    cells = np.empty(3, object)
    cells[:] = [np.eye(2), "text", {"inner": 3}]
    values = {
        "matrix": np.eye(3),
        "complex": np.eye(3) * 1j,
        "text": "Jürgen",
        "empty": np.zeros((0, 3)),
        "struct": {"x": 1, "y": {"z": np.arange(5, dtype=np.int8)}},
        "cells": cells,
        "sparse": scipy.sparse.csc_matrix(np.eye(4)),
        "logical": scipy.sparse.csc_matrix(np.eye(4, dtype=bool)),
        "flags": np.array([True, False]),
    }
    savemat(tmp_path / "a.mat", values, do_compression=packed)
    found = read_tree([tmp_path / "a.mat"])
    np.testing.assert_array_equal(found.find("struct.y.z").value, np.arange(5))
    assert {name.partition(".")[0] for name in found.names()} == set(values)


def test_a_mark_of_complex_numbers_does_not_end_the_process(tmp_path):
    """SciPy takes the next variable for the imaginary part, and its type for an address."""
    data = saved(tmp_path / "a.mat", K=np.eye(3), D=np.zeros(5))
    assert data[144] == 6  # the class of K: double
    data[145] |= 0x08
    (tmp_path / "a.mat").write_bytes(data)
    done = subprocess.run([sys.executable, "-c", READ, tmp_path / "a.mat"], capture_output=True, text=True, timeout=60)
    assert done.returncode == 1, done.stderr  # an exception, no signal
    assert "InputError" in done.stderr and "damaged" in done.stderr


@pytest.mark.parametrize(
    ("at", "value", "told"),
    [
        (128, 99, "type 99 in place of a variable"),
        (136, 5, "without its class"),
        (144, 99, "class 99"),
        (152, 7, "without its size"),
        (160, -3, "-3 x 3"),
        (160, 4, "9 numbers in place of 12"),
        (176, 77, "numbers of type 77"),
        (180, 10_000, "10000 bytes where"),
    ],
)
def test_damage_is_named(tmp_path, at, value, told):
    data = saved(tmp_path / "a.mat", K=np.eye(3))
    data[at : at + 4] = struct.pack("<i", value)
    with pytest.raises(InputError, match=told):
        check_mat(tmp_path / "a.mat", bytes(data), 1 << 20)


def test_row_indices_of_sparse_matrices_stay_inside(tmp_path):
    data = saved(tmp_path / "a.mat", S=scipy.sparse.csc_matrix(np.eye(4)))
    at = data.index(struct.pack("<4i", 0, 1, 2, 3))
    data[at : at + 4] = struct.pack("<i", 1 << 30)
    with pytest.raises(InputError, match="rows outside"):
        check_mat(tmp_path / "a.mat", bytes(data), 1 << 20)


def test_packed_variables_do_not_unpack_to_gigabytes(tmp_path):
    savemat(tmp_path / "a.mat", {"K": np.zeros(1_000_000)}, do_compression=True)
    with pytest.raises(InputError, match="unpacked"):
        check_mat(tmp_path / "a.mat", (tmp_path / "a.mat").read_bytes(), 1 << 16)


def test_a_packed_variable_that_is_cut_off_is_refused(tmp_path):
    """All numbers are there, but the end of the stream with its checksum is missing."""
    savemat(tmp_path / "a.mat", {"K": np.eye(3)}, do_compression=True)
    data = (tmp_path / "a.mat").read_bytes()
    (length,) = struct.unpack("<I", data[132:136])
    cut = data[:132] + struct.pack("<I", length - 4) + data[136:-4]
    with pytest.raises(InputError, match="cut off"):
        check_mat(tmp_path / "a.mat", cut, 1 << 20)


def test_an_object_of_the_toolbox_gets_the_commands_that_save_it(tmp_path):
    """Of an object MATLAB writes three names and bytes of its own."""

    def element(kind, content):
        return struct.pack("<II", kind, len(content)) + content + bytes(-len(content) % 8)

    data = bytes(saved(tmp_path / "a.mat", K=np.eye(3)))
    names = b"".join(element(1, name) for name in (b"stereoParams", b"MCOS", b"stereoParameters"))
    made = element(14, element(6, struct.pack("<II", 17, 0)) + names + data[128:])
    (tmp_path / "a.mat").write_bytes(data[:128] + made)
    with pytest.raises(InputError, match=r"an object that only MATLAB can read.*toStruct\(stereoParams\)"):
        read_tree([tmp_path / "a.mat"])
    (tmp_path / "a.mat").write_bytes(data + made)  # with numbers beside the object
    assert read_tree([tmp_path / "a.mat"]).names() == ["K"]
