"""netCDF is read only as far as a schema allows; damage of any kind ends in one message."""

import numpy as np
import pytest
import xarray as xr

from characterisation.files.atomic_io import write_netcdf
from characterisation.files.datasets import LARGEST_DATASET, Schema, Variable, read_dataset
from characterisation.files.errors import InputError
from characterisation.maps.performance_map import PerformanceMap
from characterisation.maps.shipped import shipped_maps

SCHEMA = Schema(
    "points of a test",
    {
        "x": Variable(("row", "column"), low=0.0, high=2.0, gaps=True),
        "count": Variable(("row",), "whole", 0, 9),
        "name": Variable(("row",), "text"),
        "good": Variable(("row",), "truth"),
        "extra": Variable(("row",), needed=False),
    },
    {"row": (1, 10)},
    ("name",),
    "make it again",
)


def dataset():
    x = np.arange(12.0).reshape(4, 3) / 8
    x[1, 1] = np.nan
    return xr.Dataset(
        {
            "x": (("row", "column"), x, {"units": "mm"}),
            "count": ("row", [1, 2, 3, 4]),
            "name": ("row", ["a", "bc", "ß", "d"]),
            "good": ("row", [True, False, True, True]),
            "other": ("row", np.arange(4.0, dtype=np.float32)),
        },
        attrs={"seed": 3, "made": "here", "list": ["a", "b"], "one": ["a"], "f": 0.25},
    )


@pytest.mark.parametrize("encoding", [None, {"x": {"zlib": True, "complevel": 5}}])
def test_what_was_written_is_read(tmp_path, encoding):
    write_netcdf(dataset(), tmp_path / "a.nc", encoding)
    read = read_dataset(tmp_path / "a.nc", SCHEMA)
    assert read.equals(dataset()) and read.attrs["made"] == "here" and "content_sha256" not in read.attrs
    write_netcdf(read, tmp_path / "b.nc")  # and once more round
    assert read_dataset(tmp_path / "b.nc", SCHEMA).equals(dataset())


def test_every_map_that_comes_with_mitsim_is_one():
    for path in shipped_maps().values():
        assert PerformanceMap.load(path).samples


def test_values_that_were_changed_are_known_by_their_digest(tmp_path):
    write_netcdf(dataset(), tmp_path / "a.nc")
    data = xr.load_dataset(tmp_path / "a.nc")
    data["other"][2] += 1e-6
    data.to_netcdf(tmp_path / "b.nc")
    with pytest.raises(InputError, match="content_sha256"):
        read_dataset(tmp_path / "b.nc", SCHEMA)
    del data.attrs["content_sha256"]
    data.to_netcdf(tmp_path / "c.nc")
    read_dataset(tmp_path / "c.nc", SCHEMA)


def test_of_a_file_of_another_kind_only_the_fault_is_told(tmp_path):
    """Before, the last 200 characters of a traceback."""
    (tmp_path / "a.nc").write_text("not netCDF")
    with pytest.raises(InputError, match=r"cannot be read \((\w+Error): .*Unknown file format: [^)]*a\.nc'\); allowed"):
        read_dataset(tmp_path / "a.nc", SCHEMA)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda d: d.drop_vars("count"), "count: found nothing"),
        (lambda d: d.rename(x="y"), "x: found nothing"),
        (lambda d: d.transpose(), r"x: found dimensions \(column, row\)"),
        (lambda d: d.assign(x=d["x"].astype(str)), "x: found"),
        (lambda d: d.assign(count=d["count"] + 0.5), "count: found float64"),
        (lambda d: d.assign(count=d["count"] * 100), "count: found 100"),
        (lambda d: d.assign(count=-d["count"]), "count: found -1"),
        (lambda d: d.assign(x=d["x"] + np.inf), "x: found inf"),
        (lambda d: d.assign(x=d["x"] + 1.5), "allowed: 0 to 2"),
        (lambda d: d.assign(name=("row", [1, 2, 3, 4])), "name: found int64"),
        (lambda d: d.assign(name=("row", ["a", "a", "b", "c"])), "name: found the same twice"),
        (lambda d: d.assign(good=("row", [0, 1, 2, 0])), "good: found 2"),
        (lambda d: d.assign(extra=("row", [0.0, np.nan, 1.0, 2.0])), "extra: found 1 values that are not numbers"),
        (lambda d: xr.concat([d] * 3, "row"), "dimension row: found 12"),
        (lambda d: d.isel(row=slice(0, 0)), "dimension row: found 0"),
        (lambda d: d.assign_attrs(made="x" * 2_000_000), "made: found 2,000,000 characters"),
    ],
)
def test_another_form_is_refused_with_its_variable(tmp_path, change, told):
    change(dataset()).to_netcdf(tmp_path / "a.nc")
    with pytest.raises(InputError, match=told) as caught:
        read_dataset(tmp_path / "a.nc", SCHEMA)
    assert caught.value.where == str(tmp_path / "a.nc")


def test_a_small_file_does_not_unpack_to_gigabytes(tmp_path):
    rows, columns = 4, LARGEST_DATASET // 32 + 1
    import netCDF4

    with netCDF4.Dataset(tmp_path / "a.nc", "w") as file:
        file.createDimension("row", rows)
        file.createDimension("column", columns)
        file.createVariable("x", "f8", ("row", "column"), zlib=True, fill_value=0.0)
        for name in ("count", "good"):
            file.createVariable(name, "i4", ("row",))
        file.createVariable("name", str, ("row",))
    assert (tmp_path / "a.nc").stat().st_size < 100_000
    with pytest.raises(InputError, match=r"size: found .* bytes unpacked"):
        read_dataset(tmp_path / "a.nc", SCHEMA)


@pytest.mark.parametrize("content", [b"", b"no netCDF", b"CDF\x01" + bytes(200), b"\x89HDF\r\n\x1a\n" + bytes(500)])
def test_what_is_no_netcdf_is_refused(tmp_path, content):
    (tmp_path / "a.nc").write_bytes(content)
    with pytest.raises(InputError, match=r"a\.nc: (x: )?found"):
        read_dataset(tmp_path / "a.nc", SCHEMA)
    for other in (tmp_path, tmp_path / "none.nc"):
        with pytest.raises(InputError, match=r"no such file|no file"):
            read_dataset(other, SCHEMA)


def test_times_and_packed_numbers_are_not_guessed(tmp_path):
    data = dataset()
    data["x"].attrs["units"] = "days since 2000-01-01"
    data.to_netcdf(tmp_path / "a.nc")
    assert read_dataset(tmp_path / "a.nc", SCHEMA)["x"].dtype == float
    dataset().to_netcdf(tmp_path / "b.nc", encoding={"x": {"scale_factor": 0.1, "dtype": "i2", "_FillValue": -1}})
    with pytest.raises(InputError, match="packed"):
        read_dataset(tmp_path / "b.nc", SCHEMA)


def test_a_damaged_file_is_known_before_hdf5_parses_it(tmp_path, monkeypatch):
    write_netcdf(dataset(), tmp_path / "a.nc")
    data = bytearray((tmp_path / "a.nc").read_bytes())
    data[len(data) // 2] ^= 1
    (tmp_path / "a.nc").write_bytes(data)
    monkeypatch.setattr("xarray.open_dataset", lambda *_, **__: pytest.fail("it was parsed"))
    with pytest.raises(InputError, match="damaged since it was written"):
        read_dataset(tmp_path / "a.nc", SCHEMA)


def test_a_reader_that_does_not_end_is_given_up(tmp_path, monkeypatch):
    dataset().to_netcdf(tmp_path / "a.nc")
    monkeypatch.setattr("characterisation.files.datasets._PROBE", "import time; time.sleep(60)")
    monkeypatch.setattr("characterisation.files.datasets.PATIENCE_S", 0.5)
    with pytest.raises(InputError, match=r"did not finish within 0\.5 s"):
        read_dataset(tmp_path / "a.nc", SCHEMA)
