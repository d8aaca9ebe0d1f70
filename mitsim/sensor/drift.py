"""Model the drift of a rig between its calibration and its use by a few named terms.

Signal chain: one-sigma figures of the terms -> modes, each a change of several parameters of the rig -> covariance of
the drift, added to that of the calibration.

A calibration is valid for the day and the temperature at which it was made. Shocks, creep and warming change the rig
afterwards. The terms are the rotation of the second eye (camera or projector) relative to the first (vergence, row
error, roll), the focal lengths, and the baseline, which lengthens with temperature. The terms are independent of one
another and of the errors of the calibration, so covariances add.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from characterisation.files.errors import InputError
from mitsim.sensor.camera import Camera, Rig
from mitsim.sensor.rig_parameters import eyes


@dataclass(frozen=True)
class Drift:
    """One-sigma figures of drift since the calibration.

    - ``vergence_mrad``: rotation of the second eye about the axis perpendicular to baseline and view.
    - ``row_mrad``: rotation about the baseline, which shifts its rows by the focal length times the angle.
    - ``roll_mrad``: rotation about its view axis.
    - ``focal_relative``: relative change of both focal lengths of an eye together, independent for each eye [1].
    - ``baseline_per_kelvin`` [1/K], times ``temperature_k`` [K]: relative change of the baseline.
    - ``path_offset_mm``: offset of a time-of-flight path.
    """

    # "recorded" refers to the Ensenso recordings of docs/how-to/real-captures.md
    #: recorded: the device's own correction turned each camera of an N10 by 0.17 mrad toward the other, 0.34 mrad
    #: together; one such difference of two calibrations gives 0.34 / sqrt(2)
    vergence_mrad: float = 0.24
    #: recorded: rows of three Ensenso units off by 0.09, 0.22 and 0.008 px at f = 589, 1474 and 1154 px under the
    #: calibrations in use; their root mean square. An N10 under its factory's was off by 1.5 mrad
    row_mrad: float = 0.12
    #: assumed: as the row error, of the same mounts
    roll_mrad: float = 0.12
    #: assumed: 5 K at 2e-5 per K, a lens of glass in a mount of aluminium
    focal_relative: float = 1e-4
    #: known: thermal expansion of aluminium
    baseline_per_kelvin: float = 23e-6
    #: assumed: between the temperatures of calibration and use, once the sensor is warm
    temperature_k: float = 5.0
    #: recalled: after warming up, distances of a Kinect V2 stay within a millimetre or so (Lachat et al., Remote
    #: Sensing 7, 2015)
    path_offset_mm: float = 1.0

    def __post_init__(self) -> None:
        for term in fields(self):
            value = getattr(self, term.name)
            if not (np.isfinite(value) and value >= 0):
                raise InputError("drift", term.name, value, "a standard deviation, 0 or more")

    @classmethod
    def none(cls) -> Drift:
        """Return zero drift: the sensor is used where and when it was calibrated."""
        return cls(**{term.name: 0.0 for term in fields(cls)})

    def numbers(self) -> dict[str, Any]:
        """Return the terms by name."""
        return asdict(self)


@dataclass(frozen=True)
class DriftMode:
    """One mode of drift: its ``name``, its ``sigma`` [1, rad or mm], and the ``step`` of each parameter per unit."""

    name: str
    sigma: float
    step: dict[str, float] = field(default_factory=dict)


def drift_modes(rig: Rig, names: tuple[str, ...], drift: Drift) -> list[DriftMode]:
    """Return the independent modes of drift of the eyes that have parameters among ``names``."""
    optics = {name: eye for name, eye in eyes(rig).items() if f"{name}.focal_x_px" in names}
    out = [
        DriftMode(
            f"focal length of {name}",
            drift.focal_relative,
            {f"{name}.focal_x_px": float(eye.matrix[0, 0]), f"{name}.focal_y_px": float(eye.matrix[1, 1])},
        )
        for name, eye in optics.items()
    ]
    if "path.offset_mm" in names:
        out.append(DriftMode("offset of the path", drift.path_offset_mm, {"path.offset_mm": 1.0}))
    reference = next(iter(rig.cameras.values()))
    for name, eye in optics.items():
        if f"{name}.rotation_x_rad" not in names:
            continue
        baseline = eye.centre - reference.centre
        for kind, milliradian, axis in zip(
            ("vergence", "row error", "roll"),
            (drift.vergence_mrad, drift.row_mrad, drift.roll_mrad),
            _axes(eye, baseline),
            strict=True,
        ):
            step = {f"{name}.rotation_{letter}_rad": float(part) for letter, part in zip("xyz", axis, strict=True)}
            out.append(DriftMode(f"{kind} of {name}", milliradian * 1e-3, step))
        longer = {f"{name}.position_{letter}_mm": float(part) for letter, part in zip("xyz", baseline, strict=True)}
        out.append(DriftMode(f"baseline to {name}", drift.baseline_per_kelvin * drift.temperature_k, longer))
    return out


def _axes(eye: Camera, baseline: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
    """Return the axes of vergence, row error and roll in the eye's own frame, unit vectors (3,)."""
    view = np.array([0.0, 0.0, 1.0])
    along = eye.sensor_from_camera.rotation.T @ baseline
    along -= (along @ view) * view
    length = np.linalg.norm(along)
    along = along / length if length > 0 else np.array([1.0, 0.0, 0.0])
    return np.cross(view, along), along, view
