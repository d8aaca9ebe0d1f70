"""Traces and height maps: synthetic surfaces whose numbers are known, and files that are refused."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from characterisation.files.errors import InputError
from mitsim.scene.surface.diffraction import lobe_alpha
from mitsim.scene.surface.measured import height_map, profile, read_height_map, read_profile


def gaussian_surface(rng, size, length_u, length_v=None):
    """Gaussian heights of rms 1 with autocorrelation exp(-(x/lu)^2 - (y/lv)^2), lengths in samples."""
    fy, fx = np.meshgrid(np.fft.fftfreq(size), np.fft.rfftfreq(size), indexing="ij")
    length_v = length_u if length_v is None else length_v
    envelope = np.exp(-((np.pi * fx * length_u) ** 2 + (np.pi * fy * length_v) ** 2) / 2)
    z = np.fft.irfft2(np.fft.rfft2(rng.normal(size=(size, size))) * envelope, (size, size))
    return z / z.std()


def test_alpha_of_a_gaussian_surface_is_twice_its_height_over_its_length(rng):
    """Rough limit, 1 %: each map holds (1024 / 12)^2 / pi = 2300 cells, and an rms over M of them is known to
    1 / sqrt(2 M) = 1.5 %; the mean of 10 maps to 0.5 %, of which two are allowed.
    """
    length, sigma = 12.0, 1.2
    found = []
    for _ in range(10):
        areal = height_map(sigma * gaussian_surface(rng, 1024, length), 1.0)
        pair = [lobe_alpha(rho, areal.Sq, 450.0) for rho in (areal.along, areal.across)]
        found.append(np.sqrt(np.mean(np.square(pair))))
        assert np.isclose(areal.Sq, sigma, rtol=0.02)
    assert np.isclose(np.mean(found), 2 * sigma / length, rtol=0.01)


@pytest.mark.parametrize("turn", [0.0, 0.5, -1.2])
def test_lay_and_both_widths_of_a_turned_elongated_surface(rng, turn):
    """Marks eight times longer than wide, along ``turn``; the area holds some 300 cells, so widths are good to 5 %."""
    size, short, long = 768, 6.0, 48.0
    fy, fx = np.meshgrid(np.fft.fftfreq(size), np.fft.rfftfreq(size), indexing="ij")
    along = fx * np.cos(turn) + fy * np.sin(turn)
    across = -fx * np.sin(turn) + fy * np.cos(turn)
    envelope = np.exp(-((np.pi * along * long) ** 2 + (np.pi * across * short) ** 2) / 2)
    z = np.fft.irfft2(np.fft.rfft2(rng.normal(size=(size, size))) * envelope, (size, size))
    areal = height_map(z / z.std(), 1.0)
    assert abs((areal.lay - turn + np.pi / 2) % np.pi - np.pi / 2) < np.radians(1.5)
    assert np.isclose(lobe_alpha(areal.across, areal.Sq, 450.0), 2 / short, rtol=0.08)
    assert np.isclose(lobe_alpha(areal.along, areal.Sq, 450.0), 2 / long, rtol=0.08)


def test_a_sine_on_a_slope_has_its_closed_form():
    x = np.arange(4000) * 0.5
    found = profile(0.5, 3.0 + 0.01 * x + np.sqrt(2) * np.sin(2 * np.pi * x / 40))
    assert np.isclose(found.Rq, 1.0, rtol=2e-3)
    assert np.isclose(found.Ra, 2 * np.sqrt(2) / np.pi, rtol=2e-3)
    assert np.allclose(found.autocorrelation(found.lags), np.cos(2 * np.pi * found.lags / 40), atol=0.02)


@given(st.floats(0.01, 100.0), st.floats(-10, 10), st.floats(-0.1, 0.1))
def test_units_offset_and_tilt_do_not_change_the_shape(scale, offset, tilt):
    rng = np.random.default_rng(3)
    z = np.convolve(rng.normal(size=400), np.ones(8) / 8, "valid")
    x = np.arange(len(z)) * 0.5
    one, other = profile(0.5, z), profile(0.5, scale * z + offset + tilt * x)
    assert np.isclose(other.Rq / one.Rq, scale, rtol=1e-6)
    assert np.allclose(one.rho, other.rho, atol=1e-6)


def trace(x, z, header="x_um,z_um"):
    return header + "\n" + "\n".join(f"{a:.9g},{b:.9g}" for a, b in zip(x, z, strict=True)) + "\n"


def test_a_trace_in_mm_is_the_trace_in_um(tmp_path, rng):
    x, z = np.arange(500) * 0.5, np.convolve(rng.normal(size=509), np.ones(10) / 10, "valid")
    (tmp_path / "um.csv").write_text(trace(x, z))
    (tmp_path / "mm.csv").write_text("# from the bench\n" + trace(z / 1e3, x / 1e3, "z_mm, x_mm"))
    one, other = read_profile(tmp_path / "um.csv"), read_profile(tmp_path / "mm.csv")
    assert np.isclose(one.Ra, other.Ra, rtol=1e-5)
    assert np.isclose(one.Rq, other.Rq, rtol=1e-5)
    assert one.name == "um.csv"


X, Z = np.arange(300) * 0.5, np.sin(np.arange(300.0))


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (trace(X, Z, "x,z"), "a header of two columns"),
        (trace(X, Z, "x_um,z_nm"), "a header of two columns"),
        (trace(X, Z, "1.0,2.0"), "a header of two columns"),
        ("", "a header of two columns"),
        (trace(X[:50], Z[:50]), "50 points"),
        (trace(X**1.2, Z), "an uneven step"),
        (trace(X[::-1], Z), "an uneven step"),
        (trace(X, 0 * Z), "check the unit"),
        (trace(X, Z) + "1,2,3\n", "number of columns changed"),
        (trace(X, Z) + "150,oops\n", "could not convert string .oops"),
        (trace(X, Z) + "150,nan\n", "missing value"),
        (trace(X, Z).replace(",", ";"), "a header of two columns"),
    ],
)
def test_what_is_no_trace_is_refused(tmp_path, text, says):
    (tmp_path / "trace.csv").write_text(text)
    with pytest.raises(InputError, match=says):
        read_profile(tmp_path / "trace.csv")


def test_missing_files_are_named_where_they_were_asked_for(tmp_path):
    with pytest.raises(InputError) as caught:
        read_profile(tmp_path / "no.csv", "part.xml: bsdf 'a'", "profile_along")
    assert (caught.value.where, caught.value.field) == ("part.xml: bsdf 'a'", "profile_along")
    with pytest.raises(InputError) as caught:
        read_height_map(tmp_path / "no.npy", 1.0, "part.xml")
    assert (caught.value.where, caught.value.field) == ("part.xml", "height_map")


def test_a_height_map_is_the_same_from_csv_and_npy(tmp_path, rng):
    z = gaussian_surface(rng, 96, 5.0)
    np.save(tmp_path / "map.npy", z)
    np.savetxt(tmp_path / "map.csv", z, delimiter=",", fmt="%.9g")
    one, other = read_height_map(tmp_path / "map.npy", 0.5), read_height_map(tmp_path / "map.csv", 0.5)
    assert np.isclose(one.Sq, other.Sq, rtol=1e-5) and np.isclose(one.lay, other.lay, rtol=1e-5)
    np.testing.assert_allclose(one.rho_along, other.rho_along, rtol=1e-5, atol=1e-6)
    (tmp_path / "map.npy").rename(tmp_path / "MAP.NPY")
    assert read_height_map(tmp_path / "MAP.NPY", 0.5).Sq == one.Sq  # before, read as text


@pytest.mark.parametrize(
    ("array", "says"),
    [
        (np.zeros(100), "an array of shape"),
        (np.zeros((100, 100), complex), "complex"),
        (np.zeros((10, 100)), "10 x 100 heights"),
        (np.zeros((100, 100)), "heights of rms 0"),
        (np.full((100, 100), np.nan), "10000 heights missing"),
        (np.array([["a"]]), "type <U1"),
    ],
)
def test_what_is_no_height_map_is_refused(tmp_path, array, says):
    np.save(tmp_path / "map.npy", array)
    with pytest.raises(InputError, match=says):
        read_height_map(tmp_path / "map.npy", 1.0)


def test_a_file_that_is_no_array_is_refused(tmp_path):
    (tmp_path / "map.npy").write_text("heights")
    with pytest.raises(InputError, match="does not load"):
        read_height_map(tmp_path / "map.npy", 1.0)
