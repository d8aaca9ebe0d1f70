"""Read, write and sample the covariance that a calibration leaves in a rig's parameters.

The file contains standard deviations, correlations, and the nominal values that they belong to. The covariance of
another rig is rejected. The fields are described in docs/reference/formats/rig-covariance.md.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from characterisation.files.atomic_io import write_text
from characterisation.files.documents import Document, read_toml
from characterisation.files.errors import InputError
from mitsim.sensor.camera import Rig
from mitsim.sensor.fitted_to import FittedCapture
from mitsim.sensor.rig_parameters import check_names, parameter_values

#: least eigenvalue of a correlation matrix that counts as 0; files contain correlations to eight decimal places
_LEAST_EIGENVALUE = -1e-6


#: digits of standard deviations and correlations in a digest: numbers of threads and processors change both by up to
#: 5e-10 (N10, Zivid 2 M70, Kinect V2 with 1 and 2 threads of OpenBLAS and another kernel), and rounding to 1e-3 leaves
#: a chance of 1 in 1000 that one of a thousand numbers changes. Chosen
_ALIKE_SIGMA = ".3e"
_ALIKE_CORRELATION = 3


@dataclass(frozen=True)
class RigCovariance:
    """Covariance of the deviations of a rig's true parameters from the nominal ones.

    ``names`` of the parameters (:func:`~mitsim.sensor.rig_parameters.parameter_names`); ``covariance`` (n, n) in
    their units; ``source``: the method that gave it; ``details``: its settings; ``fitted_to``: images of the board
    that decided it; ``simulated``: computed in this process, not read, so that its last digits depend on the machine.
    """

    names: tuple[str, ...]
    covariance: NDArray[np.float64]
    source: str
    details: Mapping[str, str | float] = field(default_factory=dict)
    fitted_to: tuple[FittedCapture, ...] = ()
    simulated: bool = False

    def __post_init__(self) -> None:
        if self.covariance.shape != (len(self.names),) * 2:
            raise ValueError(f"covariance {self.covariance.shape} of {len(self.names)} parameters")

    @property
    def one_sigma(self) -> NDArray[np.float64]:
        """Return the standard deviation of every parameter, (n,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def correlation(self) -> NDArray[np.float64]:
        """Return the correlation matrix (n, n); a parameter with zero variance correlates with none."""
        scale = np.where(self.one_sigma > 0, self.one_sigma, 1.0)
        out = self.covariance / np.outer(scale, scale)
        np.fill_diagonal(out, 1.0)
        return np.asarray(out)

    @property
    def digest(self) -> str:
        """Return the SHA-256 of the covariance; of a simulated one, of the digits that all machines compute alike."""
        content = self.covariance
        if self.simulated:
            sigma = [float(f"{value:{_ALIKE_SIGMA}}") for value in self.one_sigma.tolist()]
            content = np.array([*sigma, *(self.correlation.round(_ALIKE_CORRELATION) + 0.0).ravel()])
        return hashlib.sha256(content.tobytes()).hexdigest()

    def plus(self, modes: Iterable[tuple[float, Mapping[str, float]]], source: str) -> RigCovariance:
        """Return the covariance plus independent modes, each a variance and its changes of parameters by name.

        Parameters that are not among ``names`` come last. ``source`` is added to that of the covariance.
        """
        modes = list(modes)
        names = tuple(dict.fromkeys((*self.names, *(name for _, step in modes for name in step))))
        total = np.zeros((len(names), len(names)))
        total[: len(self.names), : len(self.names)] = self.covariance
        for variance, step in modes:
            changes = np.array([step.get(name, 0.0) for name in names])
            total += variance * np.outer(changes, changes)
        return replace(self, names=names, covariance=total, source=f"{self.source}; {source}")

    def draw(self, rng: np.random.Generator) -> NDArray[np.float64]:
        """Draw one deviation of all parameters from nominal, (n,), normally distributed.

        The draw uses the eigenvectors of the correlation matrix, so a singular covariance is allowed. It takes one
        standard normal number for each, in the order of ascending eigenvalues.
        """
        values, vectors = np.linalg.eigh(self.correlation)
        standard = rng.standard_normal(len(self.names))
        return np.asarray(self.one_sigma * (vectors @ (np.sqrt(np.clip(values, 0, None)) * standard)))


class CovarianceFile(Document):
    """The TOML document of a rig's covariance."""

    source: str = Field(min_length=1, max_length=400)
    one_sigma: dict[str, Annotated[float, Field(ge=0)]] = Field(min_length=1, max_length=200)
    nominal: dict[str, float]
    correlation: list[list[Annotated[float, Field(ge=-1, le=1)]]] = Field(default=[])
    details: dict[str, str | float] = Field(default={})
    fitted_to: list[FittedCapture] = Field(default=[], max_length=10000)


def read_rig_covariance(path: str | Path, rig: Rig) -> RigCovariance:
    """Read the covariance of a rig's calibration, and check that it belongs to the given rig.

    Raises InputError if the file is not such a document, names a parameter that the rig does not have, belongs to a rig
    with other values, or its correlations are no correlation matrix.
    """
    table = read_toml(path, CovarianceFile)
    names = tuple(table.one_sigma)
    check_names(rig, names, str(path))
    _check_nominal(path, rig, names, table.nominal)
    correlation = _full(path, table.correlation, len(names))
    least = float(np.linalg.eigvalsh(correlation).min())
    if least < _LEAST_EIGENVALUE:
        hint = "write the fitted correlations to at least six decimal places"
        raise InputError(path, "correlation", f"an eigenvalue of {least:.2g}", "a matrix without negative ones", hint)
    sigma = np.array(list(table.one_sigma.values()))
    return RigCovariance(
        names, correlation * np.outer(sigma, sigma), table.source, table.details, tuple(table.fitted_to)
    )


def write_rig_covariance(path: str | Path, covariance: RigCovariance, rig: Rig) -> None:
    """Write the covariance of a rig's calibration as TOML, atomically.

    Raises InputError if the rig lacks one of the parameters.
    """
    nominal = parameter_values(rig, covariance.names)
    rounded = [np.round(row[: index + 1], 8) + 0.0 for index, row in enumerate(covariance.correlation)]
    lines = ["# The covariance that a calibration leaves in the parameters of a rig; read by mitsim."]
    lines += [f"source = {_text(covariance.source)}", "", "# the lower triangle, in the order of [one_sigma]"]
    lines += ["correlation = [", *(f"  [{', '.join(f'{value:.8g}' for value in row)}]," for row in rounded), "]"]
    lines += ["", "[one_sigma]", *_rows(dict(zip(covariance.names, covariance.one_sigma, strict=True)), ".7g")]
    lines += ["", "[nominal]", *_rows(dict(zip(covariance.names, nominal, strict=True)), ".10g")]
    if covariance.details:
        lines += ["", "[details]", *_rows(covariance.details, ".6g")]
    for capture in covariance.fitted_to:
        lines += ["", "[[fitted_to]]", *_rows(capture.model_dump(), "")]
    write_text(path, "\n".join(lines) + "\n")


def _check_nominal(path: str | Path, rig: Rig, names: tuple[str, ...], nominal: dict[str, float]) -> None:
    """Raise an error naming the parameters whose nominal values differ from the rig's."""
    without, beyond = [name for name in names if name not in nominal], [name for name in nominal if name not in names]
    if without or beyond:
        field = ", ".join((without + beyond)[:6])
        raise InputError(path, f"nominal: {field}", "other parameters", "the parameters of [one_sigma], each once")
    rig_values = parameter_values(rig, names)
    nominal_values = np.array([nominal[name] for name in names])
    other = np.flatnonzero(~np.isclose(nominal_values, rig_values, rtol=1e-6, atol=1e-9))
    if len(other):
        found = ", ".join(f"{names[i]} {nominal_values[i]:.8g}" for i in other[:4])
        allowed = ", ".join(f"{rig_values[i]:.8g}" for i in other[:4]) + ", the nominal values of this rig"
        hint = f"{len(other)} of {len(names)} values differ: the covariance belongs to another rig; calibrate this one"
        raise InputError(path, "nominal", found, allowed, hint)


def _full(path: str | Path, rows: list[list[float]], count: int) -> NDArray[np.float64]:
    """Return a correlation matrix (n, n) from its full rows or its lower triangle; the identity without rows."""
    if not rows:
        return np.eye(count)
    allowed = f"{count} rows, of {count} values each or of 1, 2, ... {count} (the lower triangle)"
    lengths = [len(row) for row in rows]
    if lengths == list(range(1, count + 1)):
        matrix = np.zeros((count, count))
        for index, row in enumerate(rows):
            matrix[index, : index + 1] = matrix[: index + 1, index] = row
    elif lengths == [count] * count:
        matrix = np.array(rows)
    else:
        shown = ", ".join(map(str, lengths[:6])) + (", ..." if len(lengths) > 6 else "")
        raise InputError(path, "correlation", f"{len(rows)} rows of {shown} values", allowed)
    skew = np.abs(matrix - matrix.T)
    if skew.max() > 1e-6:
        i, j = np.unravel_index(int(skew.argmax()), skew.shape)
        found = f"{matrix[i, j]:g} in row {i + 1}, column {j + 1}, {matrix[j, i]:g} across the diagonal"
        raise InputError(path, "correlation", found, "a symmetric matrix")
    if np.abs(np.diag(matrix) - 1).max() > 1e-6:
        raise InputError(path, "correlation", f"{np.diag(matrix).min():g} on the diagonal", "ones on the diagonal")
    return (matrix + matrix.T) / 2


def _rows(values: Mapping[str, str | float], digits: str) -> list[str]:
    return [
        f"{_text(key)} = {_text(value) if isinstance(value, str) else _number(value, digits)}"
        for key, value in values.items()
    ]


def _number(value: float, digits: str) -> str:
    text = format(float(value), digits)
    return text if any(mark in text for mark in ".en") else text + ".0"


def _text(value: str) -> str:
    """Return a TOML basic string, which has JSON's escapes; TOML has no bytes of file names that are not UTF-8."""
    return json.dumps(value.encode(errors="replace").decode(), ensure_ascii=False)
