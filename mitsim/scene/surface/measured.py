"""Evaluate measured heights, a profile trace or an areal map, for the scattering of light.

Signal chain: CSV or .npy -> form removed (parabola of a trace, plane of a map) -> Ra, Rq or Sa, Sq (ISO
21920-2, ISO 25178-2) -> structure function 1 - rho(tau) along the relevant directions.

The structure function is the mean over pairs of points, <(z(x + tau) - z(x))^2> / (2 sigma^2). At short lags, where rho
is nearly 1, it is more stable than a difference of two autocorrelations. No cut-off filter is applied: filter a trace
with waviness (lambda_c) beforehand.
"""

from __future__ import annotations

import io
import os
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.fft import irfft2, next_fast_len, rfft2
from scipy.ndimage import map_coordinates

from characterisation.files.checked_files import read_bounded, read_text_bounded
from characterisation.files.errors import InputError, in_one_line
from mitsim.scene.surface.diffraction import Autocorrelation, sampled

#: fewest points of a trace
_FEWEST_POINTS = 200

#: least number of heights of a map along each side; chosen
_SMALLEST_MAP = 64

#: largest number of heights of a map along each side, which bounds the memory; chosen
_LARGEST_MAP = 4096

#: largest text table [bytes]
_LARGEST_TABLE = 128 * 1024**2

_FLAT_UM = 1e-4
_UM_PER = {"um": 1.0, "mm": 1e3}


@dataclass(frozen=True)
class Profile:
    """A trace without its form: ``Ra``, ``Rq`` [um]; autocorrelation ``rho`` at ``lags`` [um], both (n,)."""

    Ra: float
    Rq: float
    lags: NDArray[np.float64] = field(repr=False)
    rho: NDArray[np.float64] = field(repr=False)
    name: str = "trace"

    @property
    def autocorrelation(self) -> Autocorrelation:
        """Return the autocorrelation as a function of the lag [um]."""
        return sampled(self.lags, self.rho)


@dataclass(frozen=True)
class HeightMap:
    """An areal map with its plane removed."""

    #: ``Sa``, ``Sq`` [um]
    Sa: float
    Sq: float
    lay: float  # direction of the lay [rad] from the columns' axis (x) towards the rows' (y), -pi/2 to pi/2
    lags: NDArray[np.float64] = field(repr=False)
    #: ``rho_along``, ``rho_across``: autocorrelations along and across it at ``lags`` [um], all (n,)
    rho_along: NDArray[np.float64] = field(repr=False)
    rho_across: NDArray[np.float64] = field(repr=False)
    name: str = "height map"

    @property
    def along(self) -> Autocorrelation:
        """Return the autocorrelation along the lay as a function of the lag [um]."""
        return sampled(self.lags, self.rho_along)

    @property
    def across(self) -> Autocorrelation:
        """Return the autocorrelation across the lay as a function of the lag [um]."""
        return sampled(self.lags, self.rho_across)


def profile(spacing_um: float, heights_um: ArrayLike, name: str = "trace") -> Profile:
    """Evaluate even heights (n,) [um], with the seven-point slope of ISO 4287; ValueError if flat to 0.1 nm."""
    z = np.asarray(heights_um, float)
    position = np.linspace(-1, 1, len(z))
    z = z - np.polynomial.polynomial.polyval(position, np.polynomial.polynomial.polyfit(position, z, 2))
    variance = _variance(z)
    steps = _steps(len(z) // 4)
    structure = np.array([np.mean((z[k:] - z[:-k]) ** 2) for k in steps]) / (2 * variance)
    return Profile(
        float(np.abs(z).mean()),
        float(np.sqrt(variance)),
        np.asarray(steps * spacing_um, float),
        1 - structure,
        name,
    )


def read_profile(path: str | Path, where: str | Path = "", key: str = "profile") -> Profile:
    """Read a trace: a CSV with a header of two columns, x_um or x_mm and z_um or z_mm, evenly spaced.

    ``where`` and ``key`` name the place that refers to the file, for messages. Raises InputError if the file is
    missing, is not such a table, is too short, has gaps or is flat.
    """
    path = Path(path)
    lines = _lines(path, where, key)
    header = [name.strip() for name in lines[0].split(",")] if lines else []
    allowed = "a header of two columns, x_um or x_mm and z_um or z_mm"
    if sorted(name[:2] for name in header) != ["x_", "z_"] or any(name[2:] not in _UM_PER for name in header):
        raise InputError(path, "header", repr(",".join(header)), allowed)
    values = _numbers(lines[1:], path)
    if values.shape[1] != 2:
        raise InputError(path, "", f"{values.shape[1]} numbers in a row", "two, as in the header")
    columns = {name[0]: values[:, i] * _UM_PER[name[2:]] for i, name in enumerate(header)}
    if len(values) < _FEWEST_POINTS:
        raise InputError(path, "", f"{len(values)} points", f"at least {_FEWEST_POINTS}")
    steps = np.diff(columns["x"])
    spacing = float(steps.mean())
    if spacing <= 0 or np.abs(steps - spacing).max() > 0.01 * spacing:
        worst = 2 + int(np.argmax(np.abs(steps - np.median(steps)))) + 1
        allowed = "evenly increasing, each step within 1 % of the mean"
        raise InputError(path, "x", f"an uneven step near line {worst}", allowed, "resample the trace evenly")
    try:
        return profile(spacing, columns["z"], path.name)
    except ValueError as error:
        raise InputError(path, "z", str(error), "a rough trace", "check the unit") from None


def height_map(heights_um: ArrayLike, spacing_um: float, name: str = "height map") -> HeightMap:
    """Evaluate an areal map (rows, columns) [um] of square spacing [um]; rows run along y, columns along x.

    The lay is the direction of least rms slope: an eigenvector of the covariance of the gradient. The eigenvalues are
    the mean square slopes along and across it. Raises ValueError if the map is flat to 0.1 nm.
    """
    z = np.asarray(heights_um, float)
    y, x = np.meshgrid(np.linspace(-1, 1, z.shape[0]), np.linspace(-1, 1, z.shape[1]), indexing="ij")
    plane = np.stack([np.ones(z.size), x.ravel(), y.ravel()], axis=1)
    z = z - (plane @ np.linalg.lstsq(plane, z.ravel(), rcond=None)[0]).reshape(z.shape)
    # fourth-order differences; a central difference loses 4 % of the slope at 12 samples per wave
    dx = (8 * (z[2:-2, 3:-1] - z[2:-2, 1:-3]) - (z[2:-2, 4:] - z[2:-2, :-4])) / (12 * spacing_um)
    dy = (8 * (z[3:-1, 2:-2] - z[1:-3, 2:-2]) - (z[4:, 2:-2] - z[:-4, 2:-2])) / (12 * spacing_um)
    covariance = np.array([[np.mean(dx * dx), np.mean(dx * dy)], [np.mean(dx * dy), np.mean(dy * dy)]])
    axes = np.linalg.eigh(covariance)[1]
    lay = float(np.arctan2(axes[1, 0], axes[0, 0]))
    lay = (lay + np.pi / 2) % np.pi - np.pi / 2
    variance = _variance(z)
    reach = min(z.shape) // 4
    structure = _structure(z, reach) / (2 * variance)
    steps = _steps(reach - 2)
    along, across = (
        1 - map_coordinates(structure, [reach + steps * np.sin(turn), reach + steps * np.cos(turn)], order=3)
        for turn in (lay, lay + np.pi / 2)
    )
    lags = np.asarray(steps * spacing_um, float)
    return HeightMap(
        Sa=float(np.abs(z).mean()),
        Sq=float(np.sqrt(variance)),
        lay=lay,
        lags=lags,
        rho_along=along,
        rho_across=across,
        name=name,
    )


def read_height_map(path: str | Path, spacing_um: float, where: str | Path = "") -> HeightMap:
    """Read an areal map [um]: a two-dimensional .npy, or a CSV of numbers without a header, row by row.

    ``spacing_um`` is that of its heights [um]. Messages name ``where``, the place that refers to the file. Raises
    InputError if the file is missing, is not such a grid, is too small or too large, has gaps or is flat.
    """
    path = Path(path)
    if path.suffix.lower() == ".npy":
        _there(path, where, "height_map", "a .npy or CSV of heights in um")
        try:
            z = np.lib.format.read_array(io.BytesIO(read_bounded(path)), allow_pickle=False, max_header_size=1000)
        except InputError:
            raise
        except Exception as error:  # the header is parsed as Python text and can raise any exception
            cause = in_one_line(error)
            raise InputError(path, "", f"a file that does not load ({cause})", "an array of numbers") from None
        if z.ndim != 2 or z.dtype.kind not in "fiu":
            raise InputError(path, "", f"an array of shape {z.shape} and type {z.dtype}", "a grid of real numbers")
    else:
        z = _numbers(_lines(path, where, "height_map"), path)
    z = z.astype(float)
    if z.ndim != 2 or min(z.shape) < _SMALLEST_MAP or max(z.shape) > _LARGEST_MAP:
        allowed = f"{_SMALLEST_MAP} to {_LARGEST_MAP} each way"
        raise InputError(path, "", f"{' x '.join(map(str, z.shape))} heights", allowed)
    if not np.isfinite(z).all():
        raise InputError(path, "", f"{(~np.isfinite(z)).sum()} heights missing", "a full grid", "fill the gaps first")
    try:
        return height_map(z, spacing_um, path.name)
    except ValueError as error:
        raise InputError(path, "", str(error), "a rough map", "check that the heights are in um") from None


def _variance(z: NDArray[np.float64]) -> float:
    variance = float(np.mean(z**2))
    if variance < _FLAT_UM**2:
        raise ValueError(f"heights of rms {np.sqrt(variance):.2g} um")
    return variance


def _steps(most: int) -> NDArray[np.int64]:
    """Return lags in samples: the first twenty, then increasingly sparse."""
    return np.unique(np.concatenate([np.arange(1, 21), np.geomspace(21, max(most, 22), 60).round()]).astype(np.int64))


def _structure(z: NDArray[np.float64], reach: int) -> NDArray[np.float64]:
    """Return the mean of (z(x + lag) - z(x))^2 over all pairs [um^2], (2 reach + 1,) * 2, lag 0 at the centre."""
    shape = [next_fast_len(n + reach, real=True) for n in z.shape]
    whole, height, square = (rfft2(a, shape) for a in (np.ones_like(z), z, z**2))
    pairs = irfft2(whole * whole.conj(), shape)
    # the sum of squares over the shifted overlap mirrors that over the unshifted one
    sums = irfft2(square * whole.conj() + whole * square.conj() - 2 * height * height.conj(), shape)
    lags = np.arange(-reach, reach + 1)
    near = np.ix_(lags, lags)
    return np.asarray(np.maximum(sums[near], 0.0) / np.maximum(pairs[near], 1.0))


def _there(path: Path, where: str | Path, key: str, allowed: str) -> None:
    if not os.path.lexists(path):
        raise InputError(where or path, key, f"no file {path}", allowed)


def _lines(path: Path, where: str | Path, key: str) -> list[str]:
    """Return the lines of a CSV without empty lines and comments."""
    _there(path, where, key, "a file beside the scene XML")
    lines = read_text_bounded(path, largest=_LARGEST_TABLE).splitlines()
    return [line for line in lines if line.strip() and not line.startswith("#")]


def _numbers(lines: list[str], path: Path) -> NDArray[np.float64]:
    """Return the numbers of a CSV, (rows, columns)."""
    if not lines:
        raise InputError(path, "", "no numbers", "rows of numbers")
    try:
        values = np.loadtxt(lines, delimiter=",", ndmin=2)
    except ValueError as error:
        allowed = "rows of equally many numbers with a decimal point"
        raise InputError(path, "", f"a table that does not load ({str(error)[:200]})", allowed) from None
    gaps = np.flatnonzero(~np.isfinite(values).all(axis=1))
    if len(gaps):
        raise InputError(path, f"row {gaps[0] + 1} of numbers", "a missing value", "finite numbers", "fill the gaps")
    return values
